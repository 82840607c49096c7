"""What an agent is told of its task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sb3_combrel.common.checks import checked_names
from sb3_combrel.common.scaling import StateScaling


@dataclass(frozen=True)
class Task:
    """State variables and actions of a task.

    :param scaling: raw <-> unit coordinates of its states
    :param n_actions: number of actions
    :param state_names: names of the state variables, for display; by default s0, s1, ...
    :param action_names: names of the actions, for display; by default a0, a1, ...
    :param bounds: raw <-> the unit coordinates in which variables correspond to those of other tasks; None: ``scaling``
    :param is_bounded: whether each state variable has bounds of its own, not those between which it has been observed
    :raises ValueError: if there are names, but not one for each variable or action, all different
    """

    scaling: StateScaling
    n_actions: int
    state_names: Sequence[str] = ()
    action_names: Sequence[str] = ()
    bounds: StateScaling = None  # type: ignore[assignment]
    is_bounded: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", self.bounds or self.scaling)
        for argument, n, letter in (("state_names", self.n_variables, "s"), ("action_names", self.n_actions, "a")):
            object.__setattr__(self, argument, checked_names(argument, getattr(self, argument), n, letter))

    @property
    def n_variables(self) -> int:
        """Number of state variables."""
        return self.scaling.n_variables
