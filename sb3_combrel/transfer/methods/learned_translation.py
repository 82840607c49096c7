"""What methods share that learn a mapping from random samples of both tasks, and transfer all source data through it."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import KW_ONLY, dataclass
from time import perf_counter
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.checks import check_boolean, check_count, check_positive
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.sources.recipes import checked_source
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask, Transfer
from sb3_combrel.transfer.candidates import SourceLike, load_one_source
from sb3_combrel.transfer.methods.mapping_transfer import DEFAULT_BREADTH, DEFAULT_BREADTH_DECAY
from sb3_combrel.transfer.methods.timbrel import TIMBREL

MIN_SAMPLES = 10  # with fewer samples there is nothing to learn a mapping from
DEFAULT_SAMPLE_STEPS = 200


def triplets(states: np.ndarray, actions: np.ndarray, effects: np.ndarray, n_actions: int) -> np.ndarray:
    """Return transitions of one task as numbers, in its unit coordinates: state, one column for each action, and effect.

    :param effects: next state minus state, shape (n, n_variables), as ``states``; ``actions``: int64, shape (n,)
    :return: float64, shape (n, 2 * n_variables + n_actions)
    """
    return np.hstack([states, np.eye(n_actions)[actions], effects])


class Standard(NamedTuple):
    """Columns with mean 0 and standard deviation 1: ``mean`` and ``deviation`` of each, shape (n_columns,)."""

    mean: np.ndarray
    deviation: np.ndarray

    @classmethod
    def of(cls, rows: np.ndarray) -> Standard:
        """Take them from rows; columns that do not vary are only shifted."""
        deviation = rows.std(axis=0)
        return cls(rows.mean(axis=0), np.where(deviation > 1e-12, deviation, 1.0))

    def to(self, rows: np.ndarray) -> np.ndarray:
        """Standardise rows."""
        return (rows - self.mean) / self.deviation

    def back(self, rows: np.ndarray) -> np.ndarray:
        """Undo :meth:`to`."""
        return self.mean + rows * self.deviation


@dataclass(repr=False, eq=False)
class LearnedTranslation(Transfer):
    """Learns a mapping from random samples of both tasks, once; then all source data are instances in target coordinates.

    The first ``n_random_steps`` transitions of the target, with random actions, are its sample; until then nothing is
    transferred. The source's is drawn from its instances. Then a subclass translates all of these, with their rewards and
    ends, in some seconds. Where the target's own do not suffice, the nearest translated ones come first, as in
    :class:`~sb3_combrel.transfer.methods.timbrel.TIMBREL`.

    :param source: source instances, or a path to them
    :param n_random_steps: steps of the target that its sample takes
    :param n_source_samples: source instances that the mapping is learned from, at most
    :param breadth: kernel breadth of transferred instances, unit coordinates of the target
    :param breadth_decay: see :class:`~sb3_combrel.transfer.methods.mapping_transfer.MappingTransfer`; ``transfer_terminals``:
        the same
    :raises ValueError: if an argument is out of range; when learning starts, if a state variable of either task is periodic
    """

    source: SourceLike
    _: KW_ONLY
    n_random_steps: int = DEFAULT_SAMPLE_STEPS
    n_source_samples: int = 300
    breadth: float = DEFAULT_BREADTH
    breadth_decay: float = DEFAULT_BREADTH_DECAY
    transfer_terminals: bool = True

    def __post_init__(self) -> None:
        self.source = checked_source(self.source)
        check_count("n_random_steps", self.n_random_steps, min=MIN_SAMPLES)
        check_count("n_source_samples", self.n_source_samples, min=MIN_SAMPLES)
        check_positive("breadth", self.breadth)
        check_positive("breadth_decay", self.breadth_decay, max=1.0)
        check_boolean("transfer_terminals", self.transfer_terminals)
        self.transfer_terminals = bool(self.transfer_terminals)

    @abstractmethod
    def learn_translation(self, source: np.ndarray, target: np.ndarray, instances: np.ndarray) -> np.ndarray:
        """Learn a mapping from samples; return the source's ``instances`` as the target's, to be clipped.

        All are rows of :func:`triplets`; of the columns of actions that are returned the largest decides.
        """

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        super().bind(task, rng)
        name = type(self).__name__
        self.source = self._source = load_one_source(self.source, name)  # a saved model must not depend on other files
        for of, periodic in (("source", self._source.periodic), ("target", tuple(task.periodic or ()))):
            if any(periodic):
                raise ValueError(
                    f"{name} does not support periodic state variables, got periodic={periodic} of the {of}; give both tasks "
                    "sine and cosine of the angle as variables, or take another transfer method"
                )
        self._samples = np.empty((0, 2 * task.n_variables + 1))
        # State, action and next state of each source instance in unit coordinates of the target, once there is a mapping.
        self._rows = self._samples
        #: All source instances in target coordinates, raw units of the target; None until the mapping has been learned.
        self.translated: SourceInstances | None = None
        # It transfers the translated instances; as long as there are none it is asked for nothing.
        self._timbrel = TIMBREL(self._source, InterTaskMapping((0,) * task.n_variables, (0,) * task.n_actions))
        self._timbrel.bind(task, np.random.default_rng(0))
        self._seconds = 0.0

    def mapping_steps(self) -> int:
        """Return how many steps of the target have been taken for the mapping."""
        return len(self._samples)

    def action(self, state: np.ndarray) -> int | None:
        return int(self.rng.integers(self._bound_task.n_actions)) if len(self._samples) < self.n_random_steps else None

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        if self.translated is not None:
            self._timbrel.environment = self.environment
            self._timbrel.observe(state, action, reward, next_state, terminated)
            return
        self._samples = np.vstack([self._samples, [*state, action, *(next_state - state)]])
        if len(self._samples) == self.n_random_steps:
            self._learn()

    def _learn(self) -> None:
        began = perf_counter()
        source, d = self._source, self._bound_task.n_variables
        states = source.scaling.to_unit(source.states)
        effects = source.scaling.to_unit(source.next_states) - states
        instances = triplets(states, source.actions, effects, source.n_actions)
        rows = np.sort(self.rng.permutation(len(source))[: self.n_source_samples])
        seen_states, seen_actions, seen_effects = np.split(self._samples, [d, d + 1], axis=1)
        target = triplets(seen_states, seen_actions[:, 0].astype(np.int64), seen_effects, self._bound_task.n_actions)
        found = self.learn_translation(instances[rows], target, instances)
        found_states, found_actions, found_effects = np.split(found, [d, found.shape[1] - d], axis=1)
        # Nothing is known of states outside the box, nor of effects beyond those seen.
        states = np.clip(found_states, 0.0, 1.0)
        effects = np.clip(found_effects, seen_effects.min(axis=0), seen_effects.max(axis=0))
        self._transfer_rows(np.column_stack([states, found_actions.argmax(axis=1), np.clip(states + effects, 0.0, 1.0)]))
        self._seconds = perf_counter() - began

    def _transfer_rows(self, rows: np.ndarray) -> None:
        task, source, d = self._bound_task, self._source, self._bound_task.n_variables
        self._rows = rows
        states, after = task.scaling.to_raw(rows[:, :d]), task.scaling.to_raw(rows[:, d + 1 :])
        actions = np.clip(rows[:, d], 0, task.n_actions - 1).astype(np.int64)
        space = task.scaling.low, task.scaling.high, task.n_actions, task.state_names, task.action_names
        origin = {"env": f"{source.origin.get('env', 'an unnamed task')} by {type(self).__name__}"}
        self.translated = SourceInstances(states, actions, source.rewards, after, source.terminated, *space, origin)
        identity = InterTaskMapping(tuple(range(task.n_variables)), tuple(range(task.n_actions)))
        names = ("breadth", "breadth_decay", "transfer_terminals")
        self._timbrel = TIMBREL(self.translated, identity, **{name: getattr(self, name) for name in names})
        self._timbrel.bind(task, self.rng)

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        if self.translated is None:
            return super().transferred(states, actions, own_weight)
        return self._timbrel.transferred(states, actions, own_weight)

    def changed(self, known: np.ndarray) -> bool | np.ndarray:
        return self.translated is not None and self._timbrel.changed(known)

    def end_episode(self, truncated: bool) -> None:
        if self.translated is not None:
            self._timbrel.environment = self.environment
            self._timbrel.end_episode(truncated)

    def break_off(self) -> None:
        self._timbrel.break_off()

    def note_use(self, transferred: TransferredInstances) -> None:
        if self.translated is not None:
            self._timbrel.note_use(transferred)

    def lowest_reward(self) -> float:
        return float(self._source.rewards.min())

    def statistics(self) -> dict[str, float]:
        figures = {
            "transfer/steps_to_find_mapping": self.mapping_steps(),
            "transfer/mapping_found": float(self.translated is not None),
            "transfer/mapping_seconds": self._seconds,
            "transfer/translated_spread": self._spread(),
        }
        return figures if self.translated is None else {**figures, **self._timbrel.statistics()}

    def _spread(self) -> float:
        """Standard deviation of the translated states over that of the sample's, mean over variables; near 0: no relation."""
        if self.translated is None or self.task is None:
            return np.nan
        sampled = self._samples[:, : self.task.n_variables].std(axis=0)
        spread = self.task.scaling.to_unit(self.translated.states).std(axis=0)
        return float((spread / np.maximum(sampled, 1e-12))[sampled > 1e-12].mean()) if (sampled > 1e-12).any() else np.nan

    def get_state(self) -> dict[str, np.ndarray]:
        of_timbrel = {f"timbrel_{name}": array for name, array in self._timbrel.get_state().items()}
        return {"samples": self._samples.copy(), "translated": self._rows.copy(), **of_timbrel}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        self._samples = state["samples"].copy()
        if len(state["translated"]) == len(self._source):
            self._transfer_rows(state["translated"].copy())
            self._timbrel.set_state({name.removeprefix("timbrel_"): array for name, array in state.items()})
