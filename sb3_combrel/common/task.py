"""What an agent is told of its task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sb3_combrel.common.scaling import StateScaling


@dataclass(frozen=True)
class Task:
    """
    State variables and actions of a task.

    :param scaling: raw <-> unit coordinates of its states
    :param n_actions: number of actions
    :param state_names: names of the state variables, for display; by default s0, s1, ...
    :param action_names: names of the actions, for display; by default a0, a1, ...
    """

    scaling: StateScaling
    n_actions: int
    state_names: Sequence[str] = ()
    action_names: Sequence[str] = ()

    def __post_init__(self) -> None:
        names = self.state_names or [f"s{k}" for k in range(self.n_variables)]
        object.__setattr__(self, "state_names", tuple(names))
        object.__setattr__(self, "action_names", tuple(self.action_names or [f"a{k}" for k in range(self.n_actions)]))

    @property
    def n_variables(self) -> int:
        """Number of state variables."""
        return self.scaling.n_variables
