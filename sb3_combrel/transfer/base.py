"""What Fitted R-Max asks of a transfer method."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sb3_combrel.common.periodic import differences, periodic_flags
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances
from sb3_combrel.transfer.report import NotBoundError, TransferReport

#: How a model may use the source, see :attr:`Transfer.use`.
USES = ("instances", "prior", "actions")


@dataclass(frozen=True)
class TargetTask:
    """The target task, as a transfer method sees it."""

    scaling: StateScaling  #: raw <-> unit coordinates, by the bounds of the variables
    n_actions: int
    sample_states: np.ndarray  #: states that are planned with, unit coordinates, shape (n_points, n_variables)
    #: Weight that own and transferred instances of a state-action pair must reach together.
    exploration_threshold: float
    min_weight: float  #: instances with less weight do not count
    min_fraction: float  #: nearest first, an instance counts while it has this fraction of the weight before it
    state_names: tuple[str, ...]
    action_names: tuple[str, ...]
    periodic: Sequence[bool] | None = None  #: which state variables wrap, 0 and 1 being the same; None: none
    takes_prior: bool = False  #: whether the target's model takes a prior (``use="prior"``)
    gamma: float = 1.0  #: discount factor
    max_value: float = 0.0  #: upper bound on the return from any state

    def __post_init__(self) -> None:
        object.__setattr__(self, "periodic", periodic_flags(self.periodic, self.n_variables))

    @property
    def n_variables(self) -> int:
        """Number of state variables."""
        return self.scaling.n_variables

    def effect(self, state: np.ndarray, next_state: np.ndarray) -> np.ndarray:
        """Next state minus state, unit coordinates; of periodic variables the shortest way."""
        return differences(next_state, state, np.array(self.periodic))


class Transfer(ABC):
    """A transfer method: it observes transitions of the target task, and returns instances for states and actions of it.

    It is asked where the target's own instances do not suffice. A transfer object given to an algorithm is a description: the
    algorithm binds a copy of it to its task. Only :meth:`observe`, and what :attr:`use` names, have to be written. States and
    effects are in unit coordinates of the target, ``task.scaling``.
    """

    task: TargetTask | None = None  #: the target task and the random number generator, from :meth:`bind` on
    rng: np.random.Generator

    #: How the model uses the source: "instances": they join the target's own where these do not suffice; "prior": it is the
    #: mean that they are fitted to, see :meth:`prior`; "actions": not at all, see :meth:`action`.
    use: str = "instances"

    #: Which of several environments the next call of :meth:`action`, :meth:`observe` or :meth:`end_episode` is about.
    environment: int = 0

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        """Prepare for a target task; what was learned of another one is forgotten.

        :param rng: generator of all random numbers that the method draws; predictions must draw none
        :raises ValueError: if the method does not fit the task
        """
        if self.use not in USES:
            raise ValueError(f"{type(self).__name__}.use must be one of {', '.join(USES)}, got {self.use!r}")
        if self.use == "instances" and type(self).transferred is Transfer.transferred:
            raise ValueError(
                f'{type(self).__name__} has use="instances", but no method transferred(states, actions, own_weight)'
            )
        keeps, takes = (getattr(type(self), name) is not getattr(Transfer, name) for name in ("get_state", "set_state"))
        if keeps != takes:
            raise ValueError(f"{type(self).__name__} must have both get_state() and set_state(state), or neither")
        self.task = task
        self.rng = rng

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        """Return instances for states and actions.

        :param states: unit coordinates, shape (n, n_variables)
        :param actions: int64, shape (n,)
        :param own_weight: sum of the kernel weights of the target's own instances there, shape (n,)
        :return: for each pair instances whose weights and ``own_weight`` together reach ``task.exploration_threshold``, or
            none, which leaves it optimistic; good until the next call
        """
        return TransferredInstances.empty(len(actions), states.shape[1])

    def transferred_to_sample(self, points: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        """As :meth:`transferred`, for states of the finite sample; a method may store results by state.

        :param points: rows of ``task.sample_states``, int64, shape (n,)
        """
        return self.transferred(self._bound_task.sample_states[points], actions, own_weight)

    @property
    def _bound_task(self) -> TargetTask:
        if self.task is None:
            name = type(self).__name__
            raise ValueError(
                f"{name} is bound to no task: a method bind(task, rng) of its own must call super().bind(task, rng)"
            )
        return self.task

    @property
    def informs_model(self) -> bool:
        """Whether the target's model uses the source."""
        return self.use != "actions"

    def action(self, state: np.ndarray) -> int | None:
        """Decide an action for the agent while it learns, or leave it to the agent.

        Called once for each step of learning, never for predictions, and only of a method that overrides it.

        :param state: unit coordinates, shape (n_variables,)
        :return: the action, from 0 on; None leaves it to the agent
        """
        return None

    @abstractmethod
    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        """Take in a transition of the target task.

        :param state: unit coordinates, shape (n_variables,), as ``next_state``; ``action``: from 0 on; ``reward``: raw
        :param terminated: the episode ended in a terminal state; a time limit is none
        """

    def note_prediction(self, effect: np.ndarray, leverage: float) -> None:  # noqa: B027 - a method may well ignore it
        """Take in what the target's own instances alone predict of the transition that :meth:`observe` takes in next.

        Called only if :attr:`use` is "prior": whether a source helps to predict is measured by it.

        :param effect: next state minus state, unit coordinates, shape (n_variables,)
        :param leverage: by how much the variance of one instance is multiplied in it; 0 if nothing is predicted
        """

    def end_episode(self, truncated: bool) -> None:  # noqa: B027 - a method may well ignore it
        """Take in the end of an episode; ``truncated``: by its time limit, not in a terminal state."""

    def break_off(self) -> None:  # noqa: B027 - a method may well ignore it
        """Take in that all environments have been reset, and that the episodes that went on are none."""

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        """Say where the instances may differ from those returned before; called after each transition and each episode.

        :param known: bool, shape (n_actions, n_points): pairs whose own instances suffice, which may be left out
        :return: True: everywhere; False: nowhere; or bool, shape (n_actions, n_points). By default everywhere,
            if there are any instances
        """
        return self.use == "instances"

    def prior(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        """Predict states and actions of the target; asked only if :attr:`use` is "prior".

        It must depend on nothing but its arguments while :meth:`prior_version` stays the same.

        :param states: unit coordinates, shape (n, n_variables)
        :param actions: int64, shape (n,)
        :return: good until the next call
        :raises NotImplementedError: if the method has no prior
        """
        raise NotImplementedError(f'{type(self).__name__} has use="prior", but no method prior(states, actions)')

    def prior_version(self) -> int:
        """Return a number that grows whenever what :meth:`prior` returns may have changed.

        All pairs of the sample are then asked for again: not at every step.
        """
        return 0

    def value_bound(self) -> np.ndarray | None:
        """Return an upper bound on the return from each state of the sample, the value of what is not known there.

        Asked only if :attr:`use` is "prior", and again whenever :meth:`prior_version` has grown. If it is too low, the best
        may never be tried (Asmuth, Littman & Zinkov, "Potential-based shaping in model-based RL", AAAI 2008).

        :return: raw, shape (n_points,); None: ``task.max_value`` everywhere, which is the default
        """
        return None

    def change_optimism(self, gamma: float, max_value: float) -> None:
        """Take in another discount factor and upper bound on returns, found from rewards; :meth:`value_bound` follows.

        :param gamma: discount factor; ``max_value``: raw
        """
        self.task = replace(self._bound_task, gamma=gamma, max_value=max_value)

    def check_degree(self, degree: int) -> None:
        """Check that a model of this degree can take what is transferred.

        :param degree: 0 for a kernel average, 1 for a local linear model
        :raises ValueError: if it cannot
        """
        if self.use == "prior" and degree < 1:
            raise ValueError(
                f'{type(self).__name__}(use="prior") needs the local linear model, FittedRMax(degree=1), got degree={degree}; '
                'or use="instances"'
            )

    def note_use(self, transferred: TransferredInstances) -> None:  # noqa: B027 - a method may well ignore it
        """Take in that the agent acts on what :meth:`transferred` returned last, for one state with every action."""

    def lowest_reward(self) -> float:
        """Return the lowest reward among all instances that may be transferred; called once bound."""
        return 0.0

    def arguments(self) -> dict[str, Any]:
        """Return the constructor's arguments that make this object, unbound; from them a saved model is rebuilt.

        By default the attributes that bear their names: numbers, text, arrays, source instances, mappings, sets of mappings,
        and sequences and dicts of these. Arrays and tuples come back as lists.

        :raises AttributeError: if an argument has no such attribute
        """
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}

    def get_state(self) -> dict[str, np.ndarray]:
        """Return what was learned since it was bound, float64, to be saved with a model.

        Names and shapes stay the same, but for the number of rows of arrays with several axes.
        """
        return {}

    def set_state(self, state: dict[str, np.ndarray]) -> None:  # noqa: B027 - nothing saved, nothing to restore
        """Restore what :meth:`get_state` returned; called on an object that was just bound.

        Afterwards every pair of the sample is asked for once more: :meth:`changed` need not report this.
        """

    def sample_moved(self) -> None:  # noqa: B027 - most keep nothing by state of the sample
        """Take in, after :meth:`set_state`, that the sample had other states when the state was returned."""

    def statistics(self) -> dict[str, float]:
        """Return figures for the logger, by name."""
        return {}

    def report(self) -> TransferReport:
        """Say what was transferred, as far as the method knows it; by default its arguments and its figures for the logger.

        :return: a report to print, with all its figures as fields
        :raises NotBoundError: (a ValueError) if no algorithm uses this object
        """
        self._check_bound("report")
        return TransferReport(method=repr(self), use=self.use, statistics=self.statistics())

    def _check_bound(self, name: str) -> None:
        """:raises NotBoundError: if results are asked for under ``name``, and the object is a description only"""
        if self.task is None and not name.startswith("__"):
            what = "" if name.startswith("_") else f" ({name})"
            raise NotBoundError(
                f"{type(self).__name__} has no results{what}: an algorithm uses a copy of this object; "
                "after model = FittedRMax(env, transfer=...).learn(), results are on that copy, model.transfer"
            )

    def __repr__(self) -> str:
        """The method with those of its arguments that differ from their defaults."""
        try:
            given = self.arguments()
        except AttributeError:
            return object.__repr__(self)
        defaults = {name: each.default for name, each in inspect.signature(type(self)).parameters.items()}
        shown = [f"{name}={value!r}" for name, value in given.items() if not _equal(value, defaults.get(name))]
        return f"{type(self).__name__}({', '.join(shown)})"


def _equal(value: Any, default: Any) -> bool:
    """Whether an argument, of any type, has its default value."""
    return value is default or (type(value) is type(default) and bool(np.all(value == default)))
