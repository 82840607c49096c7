"""Fitted R-Max as RL-Zoo builds it: from a configuration file, with sources that are learnt when they are missing."""

from __future__ import annotations

import inspect
from typing import Any

from stable_baselines3.common.type_aliases import GymEnv

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.transfer.registry import make_transfer, restore_transfer
from sb3_combrel.zoo.sources import with_sources


class ZooFittedRMax(FittedRMax):
    """
    :class:`~sb3_combrel.FittedRMax` whose ``transfer`` may name a source task that has yet to be learnt.

    A model that it saves holds the source instances, not the name of their file: it can be loaded on other machines, and
    with ``FittedRMax.load`` as well.

    :param policy: "FittedRMaxPolicy"; must be given, as RL-Zoo cannot go on with a trained agent without it
    :param env: the environment to learn from
    :param kwargs: all other arguments of :class:`~sb3_combrel.FittedRMax`
    :raises ValueError: if ``policy`` is missing, a source cannot be had, or an argument is out of range
    """

    def __init__(
        self, policy: str | type[FittedRMaxPolicy] | None = None, env: GymEnv | str | None = None, **kwargs: Any
    ) -> None:
        if policy is None:
            raise ValueError('the configuration has no "policy"; add "policy: FittedRMaxPolicy" to its entry')
        known = [name for name in inspect.signature(FittedRMax).parameters if not name.startswith("_")]
        unknown = sorted(set(kwargs) - set(known) - {"_init_setup_model"})
        if unknown:
            raise ValueError(f"the configuration has {', '.join(unknown)}, which FittedRMax does not know; it knows {known}")
        super().__init__(policy, env, **kwargs)

    def _setup_model(self) -> None:
        # Here and not in the constructor: when RL-Zoo resumes, load() brings the arguments in behind its back.
        self.transfer = with_sources(restore_transfer(self.transfer))
        try:
            make_transfer(self.transfer)
        except TypeError as error:
            raise ValueError(f"transfer: {error}") from error
        super()._setup_model()
