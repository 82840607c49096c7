"""Fitted R-Max as RL-Zoo builds it: from a configuration file, with sources that are learnt if they are missing."""

from __future__ import annotations

import inspect
from typing import Any

from stable_baselines3.common.type_aliases import GymEnv

from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.fitted_rmax.arguments import check_actions
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.planning.grid import fitting_grid
from sb3_combrel.transfer.by_name import make_transfer, restore_transfer
from sb3_combrel.zoo.sources import with_arguments, with_sources

MAX_PAIRS = 2_000_000
"""State-action pairs of the grid beyond which "finer" is not applied: about 1.5 GB."""


class ZooFittedRMax(FittedRMax):
    """
    :class:`~sb3_combrel.FittedRMax` whose ``transfer`` may name a source task that has yet to be learnt.

    A model that it saves contains the source instances, not the name of their file: it can be loaded on other machines, and
    with ``FittedRMax.load`` as well.

    ``resolution`` may also be "coarser" or "finer": than the one of ``None``, which suits the task and the breadth, by a
    factor of two a variable (if that takes less than about 1.5 GB).

    :param policy: "FittedRMaxPolicy"; must be given, as RL-Zoo needs it to continue with a trained agent
    :param env: the environment to learn from
    :param transfer_kwargs: arguments of the transfer method that replace those in ``transfer``, so that a study
        or ``--hyperparams`` can change one of them
    :param kwargs: all other arguments of :class:`~sb3_combrel.FittedRMax`
    :raises ValueError: if ``policy`` is missing, a source can neither be read nor learnt, or an argument is out of range
    """

    def __init__(
        self,
        policy: str | type[FittedRMaxPolicy] | None = None,
        env: GymEnv | str | None = None,
        transfer_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if policy is None:
            raise ValueError('the configuration has no "policy"; add "policy: FittedRMaxPolicy" to its entry')
        known = [name for name in inspect.signature(FittedRMax).parameters if not name.startswith("_")]
        unknown = sorted(set(kwargs) - set(known) - {"_init_setup_model"})
        if unknown:
            raise ValueError(f"the configuration has {', '.join(unknown)}, which FittedRMax does not know; it knows {known}")
        self.transfer_kwargs = transfer_kwargs
        super().__init__(policy, env, **kwargs)

    def _setup_model(self) -> None:
        # Not in the constructor: when RL-Zoo resumes, load() sets the arguments after it.
        self.transfer = with_sources(with_arguments(restore_transfer(self.transfer), self.transfer_kwargs))
        self.transfer_kwargs = None
        try:
            make_transfer(self.transfer)
        except TypeError as error:
            raise ValueError(f"transfer: {error}") from error
        if isinstance(self.resolution, str):
            self.resolution = self._relative_resolution(self.resolution)
        super()._setup_model()

    def _relative_resolution(self, wanted: str) -> int:
        """Compute the resolution for "coarser" or "finer"."""
        if wanted not in ("coarser", "finer"):
            raise ValueError(f'resolution must be a whole number, one for each variable, "coarser" or "finer", got {wanted!r}')
        n_actions = check_actions(self.action_space)
        n_variables = StateScaling.from_space(self.observation_space, self.bounds).n_variables
        settings = self.settings.model_settings(n_variables)
        suited, *_ = fitting_grid(n_variables, n_actions, None, settings.model_breadth, settings.min_weight).resolution
        if wanted == "coarser":
            return max(1, suited - 1)
        n_pairs = (2 ** (suited + 1) + 1) ** n_variables * n_actions
        return suited + 1 if n_pairs <= MAX_PAIRS else suited
