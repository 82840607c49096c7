"""How a source enters the target's model once a transfer method is bound: what both ways, ``use``, have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import Candidate, MappedVariables


class NumberedCandidates(Protocol):
    """What candidates' numbers stand for."""

    def parts(self, candidate: int) -> Candidate:
        """Return a candidate's parts, by name."""

    def mapped_variables(self, candidate: int) -> MappedVariables:
        """Return what a candidate makes of each target variable, in numbers."""

    def describe(self, candidate: int) -> str:
        """Return target action, source action and pairs of variables of a candidate as text."""

    def source_action_names(self) -> list[str]:
        """Return the names of the source actions, each name once."""


class SourceUse(ABC):
    """
    What a transfer method that maps a source does with it in a target task, as ``use`` says.

    :class:`~sb3_combrel.transfer.instances.instance_transfer.InstanceTransfer` or
    :class:`~sb3_combrel.transfer.prior.source_prior.SourcePrior`. Methods that :class:`~sb3_combrel.transfer.base.Transfer`
    has too mean the same here; unless a class says otherwise no instances are transferred, and there is no prior.
    """

    task: TargetTask
    #: The source tasks' instances.
    sources: Sequence[SourceInstances]
    #: What the numbers that :meth:`choices`, :meth:`selected` and :meth:`uses` return stand for.
    candidates: NumberedCandidates
    #: Transitions of the target that were observed.
    n_observed: int = 0
    #: Grows whenever what :meth:`predict` returns may have changed.
    version: int = 0

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        """Return instances for states and actions."""
        return TransferredInstances.empty(len(actions), self.task.n_variables)

    def transferred_to_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        """Return instances for states of the sample, given by their numbers."""
        return TransferredInstances.empty(len(actions), self.task.n_variables)

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        """Say where the instances may differ from those returned before."""
        return False

    def predict(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        """Predict states and actions of the target, as its prior."""
        raise NotImplementedError(f"{type(self).__name__} has no prior")

    def value_bound(self) -> np.ndarray | None:
        """Return an upper bound on the return from each state of the sample; None: there is none."""
        return None

    @abstractmethod
    def observe(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool) -> None:
        """
        Take in a transition of the target.

        :param state: unit coordinates, shape (n_variables,); ``effect``: next state minus state, same shape
        :param action: from 0 on
        :param reward: raw
        :param terminated: the episode ended in a terminal state
        """

    @abstractmethod
    def end_episode(self, truncated: bool) -> None:
        """Take in the end of an episode; ``truncated``: by its time limit."""

    def note_use(self, transferred: TransferredInstances) -> None:  # noqa: B027 - a prior is not used step by step
        """Take in that the agent acts on the instances last returned by :meth:`transferred`."""

    @property
    @abstractmethod
    def makes_choices(self) -> bool:
        """Whether :meth:`choices` ever names a candidate."""

    @abstractmethod
    def choices(self) -> np.ndarray:
        """Return the candidate of each state-action pair of the sample, -1 for none, int64, shape (n_actions * n_points,)."""

    @abstractmethod
    def selected(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return the candidate of each of some states and actions, -1 for none, int64, shape (n,)."""

    @abstractmethod
    def uses(self) -> dict[int, int]:
        """Return how often each candidate was used."""

    @abstractmethod
    def statistics(self) -> dict[str, float]:
        """Return figures for the logger, by name."""

    @abstractmethod
    def get_state(self) -> dict[str, np.ndarray]:
        """Return what was learned, float64 arrays."""

    @abstractmethod
    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`get_state` returned; for a new object."""
