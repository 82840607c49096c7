"""The callback that records source instances while an SB3 algorithm learns."""

from __future__ import annotations

from sb3_combrel.sources.recording import TransitionRecorder
from sb3_combrel.sources.source_instances import SourceInstances


class SourceRecorder(TransitionRecorder):
    """
    Callback that records every transition while an SB3 algorithm learns; read them from :meth:`source_instances`.

    Under ``VecNormalize`` the original states and rewards are recorded.

    :param max_instances: how many to keep at most, a uniform random sample of all; None for all
    :param bounds: ``(low, high)`` of the states if the observation space has none
    :param seed: seed of the sample
    :param verbose: SB3's verbosity
    """

    def source_instances(self) -> SourceInstances:
        """What has been recorded so far; ``ValueError`` if nothing has been."""
        return SourceInstances(*self.transitions())
