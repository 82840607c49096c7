"""Fitted R-Max as RL-Zoo builds it, from a configuration file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from stable_baselines3.common.type_aliases import GymEnv

from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.fitted_rmax.arguments import check_actions
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.planning.grid import fitting_grid
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.by_name import check_argument_names, make_transfer

MAX_PAIRS = 2_000_000
"""State-action pairs of the grid beyond which "finer" is not applied: about 1.5 GB."""


class ZooFittedRMax(FittedRMax):
    """:class:`~sb3_combrel.FittedRMax` with arguments that suit a study of RL-Zoo; ``FittedRMax.load`` loads what it saves.

    ``resolution`` may also be "coarser" or "finer": than the one of ``None``, which suits the task and the breadth, by a
    factor of two a variable (if that takes less than about 1.5 GB).

    :param policy: "FittedRMaxPolicy"; must be given, as RL-Zoo needs it to continue with a trained agent
    :param transfer_kwargs: arguments of the transfer method that a study has drawn; they replace those in ``transfer``, one by
        one, where that transfers instances (``use: instances``): a prior has none that a study draws
    :param kwargs: all other arguments of :class:`~sb3_combrel.FittedRMax`
    :raises ValueError: if ``policy`` is missing, or an argument is unknown or out of range
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
        self.transfer_kwargs = transfer_kwargs
        check_argument_names(FittedRMax, kwargs)
        super().__init__(policy, env, **kwargs)

    def _setup_model(self) -> None:
        # Not in the constructor: when RL-Zoo resumes, load() sets the arguments after it.
        if self.transfer_kwargs:
            changed = with_arguments(self.transfer, self.transfer_kwargs)
            given = cast(Transfer, make_transfer(self.transfer))
            check_argument_names(type(given), self.transfer_kwargs)
            if given.arguments().get("use") == "instances":
                self.transfer = changed
            else:
                warn_user(
                    f"what is drawn for {type(given).__name__}, {', '.join(self.transfer_kwargs)}, is not used, as it is of "
                    'transferred instances: write "use: instances" in the configuration to search it'
                )
        self.transfer_kwargs = None
        if isinstance(self.resolution, str):
            self.resolution = self._relative_resolution(self.resolution)
        super()._setup_model()

    def _relative_resolution(self, wanted: str) -> int:
        """Compute the resolution for "coarser" or "finer"."""
        if wanted not in ("coarser", "finer"):
            raise ValueError(f'resolution must be a whole number, one for each variable, "coarser" or "finer", got {wanted!r}')
        check_actions(self.action_space)
        n_actions = int(self.action_space.n)  # type: ignore[attr-defined]
        n_variables = len(StateScaling.limits_of(self.observation_space, self.bounds)[0])
        settings = self.settings.model_settings(n_variables)
        suited, *_ = fitting_grid(n_variables, n_actions, None, settings.model_breadth, settings.min_weight).resolution
        if wanted == "coarser":
            return max(1, suited - 1)
        n_pairs = (2 ** (suited + 1) + 1) ** n_variables * n_actions
        return suited + 1 if n_pairs <= MAX_PAIRS else suited


def with_arguments(transfer: Any, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Replace arguments in ``{method: arguments}``, which ``transfer`` must be (else a ValueError)."""
    if not isinstance(transfer, dict) or len(transfer) != 1:
        raise ValueError(
            f"transfer_kwargs={dict(changes)!r} needs a transfer method in the configuration file, such as "
            f"'transfer: {{sb3_combrel.COMBREL: {{source: file.npz}}}}'; transfer is {transfer!r}"
        )
    ((method, given),) = transfer.items()
    return {method: {**(given or {}), **changes}}
