"""What Fitted R-Max asks of a transfer method."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_combrel.common.scaling import StateScaling

if TYPE_CHECKING:
    from sb3_combrel.common.transferred import Supply


@dataclass(frozen=True)
class TargetTask:
    """The target task, as a transfer method sees it.

    :param scaling: raw <-> unit coordinates
    :param n_actions: number of actions
    :param sample_states: the finite sample of states, unit coordinates, shape (n_points, n_variables); pair
        ``action * n_points + point`` is a state-action pair of it
    :param exploration_threshold: weight that settles a pair
    :param min_weight: instances with less weight do not count
    :param min_fraction: nearest first, an instance counts while it has this part of the weight before it
    :param state_names: names of the state variables, for display
    :param action_names: names of the actions, for display
    """

    scaling: StateScaling
    n_actions: int
    sample_states: np.ndarray
    exploration_threshold: float
    min_weight: float
    min_fraction: float
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]

    @property
    def n_variables(self) -> int:
        """Number of state variables."""
        return self.scaling.n_variables


class Transfer(ABC):
    """A transfer method: it observes the target task, and supplies translated source instances.

    It is asked for instances of a pair only while the target's own instances do not settle that pair. A transfer
    object given to an algorithm is a description; the algorithm binds a copy of it to its task.
    """

    @abstractmethod
    def bind(self, target: TargetTask, rng: np.random.Generator) -> None:
        """Get ready to transfer to ``target``.

        :param rng: source of all chance
        :raises ValueError: if source or mappings do not fit the target
        """

    @abstractmethod
    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        """Take notice of a transition of the target task (unit coordinates)."""

    @abstractmethod
    def lowest_reward(self) -> float:
        """The lowest reward among all that can be supplied; known once bound."""

    def end_episode(self, truncated: bool) -> None:  # noqa: B027 - a method may well ignore it
        """Take notice that an episode has ended, by its time limit or (not ``truncated``) in a terminal state."""

    @abstractmethod
    def renewed(self, known: np.ndarray) -> np.ndarray:
        """The pairs for which :meth:`supply` has something else to say than when it was last asked; int64.

        :param known: pairs that need nothing and are left out, bool, shape (n_pairs,)
        """

    @abstractmethod
    def supply(self, pairs: np.ndarray, own_weight: np.ndarray, known: np.ndarray) -> Supply:
        """Translated instances for pairs of the sample.

        :param pairs: shape (n,)
        :param own_weight: sum of the weights of each pair's own instances, shape (n,)
        :param known: pairs that need none, bool, shape (n,)
        :return: for each pair instances that together with its own reach the threshold, or none; good until the next call
        """

    @abstractmethod
    def supply_at(self, state: np.ndarray, own_weight: np.ndarray) -> Supply:
        """The same at an exact state, one row an action; good until the next call.

        :param state: unit coordinates, shape (n_variables,)
        :param own_weight: shape (n_actions,); actions that reach the threshold need nothing
        """

    def arguments(self) -> dict[str, Any]:
        """The constructor's arguments that make this object anew, unbound; a saved model is rebuilt from them.

        By default the attributes that bear the arguments' names. They may be numbers, text, arrays, source instances,
        mappings, sets of mappings, and sequences and dicts of these; arrays and tuples come back as lists.

        :raises AttributeError: if an argument has no such attribute
        """
        # A constructor that takes *args or **kwargs fails here as well, unless it keeps them by these names.
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}

    def saved_arrays(self) -> dict[str, np.ndarray]:
        """What was learned since it was bound, float64, to be saved with a model.

        Names and shapes stay the same, but for the number of rows of arrays with several axes.
        """
        return {}

    def restore(self, saved: dict[str, np.ndarray]) -> None:  # noqa: B027 - nothing saved, nothing to restore
        """Take up what :meth:`saved_arrays` gave; called on a freshly bound object."""

    def statistics(self) -> dict[str, float]:
        """Figures for the logger, by name."""
        return {}
