"""A source as the prior of the target's model: seen through a mapping, and believed as far as the target bears it out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sb3_combrel.common.transferred import PriorPredictions, TransferredInstances
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.outcome_evidence import TRANSITIONS_BEFORE_WARNING, RegionErrors, warn_of_error
from sb3_combrel.transfer.prior.claims import CLAIMED_WEIGHT, FIRST_RENEWAL, RENEWAL_GROWTH, Claims, part_explained
from sb3_combrel.transfer.prior.copies import MANY, Copies, Predicted
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.prior.prior_candidates import PriorCandidates
from sb3_combrel.transfer.prior.prior_choice import Choice, Chooser
from sb3_combrel.transfer.prior.value_bound import ValueBound
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions

# A variable that is predicted to stay moves, if it does, by more than this; in unit coordinates.
SMALLEST_MOVE = 0.005
# So many transitions are compared with what all copies predict; of later ones one in so many.
ALL_MEASURED, MEASURED_LATER = 500, 5


class SourcePrior:
    """What a source predicts of the target, through a mapping that is given or chosen by compliance.

    Methods of the same name mean what they do of ``Transfer`` and of ``MappingTransfer``. No instances are transferred. For
    what it claims to know, and which effects are used, see :class:`~sb3_combrel.transfer.prior.claims.Claims`.

    :param choose: chooses from the sums over the target's transitions; or the choice that is given
    :param whole: see :meth:`Copies.measure`
    :param max_transitions: target transitions by which is chosen, at most; what is chosen then is checked on
    :param first_renewal: target transitions after which is chosen first; equal to ``max_transitions``, it is chosen once
    """

    makes_choices = True

    def __init__(
        self,
        copies: Copies,
        task: TargetTask,
        choose: Chooser | Choice,
        *,
        whole: bool,
        max_transitions: int,
        transfer_terminals: bool = True,
        first_renewal: int = FIRST_RENEWAL,
    ):
        self.task = task
        self.sources = copies.sources
        self.copies = copies
        self.candidates = PriorCandidates(copies, task)
        self._value_bound = ValueBound(copies, task, min_weight=float(task.exploration_threshold) / CLAIMED_WEIGHT)
        self.whole = whole
        #: Chooses from sums over the target's transitions; None if the choice is given or drawn.
        self.choose = None if isinstance(choose, Choice) else choose
        self.max_transitions = 0 if self.choose is None else max_transitions
        self.sums = CopySums.zero(len(copies), copies.most_actions, task.n_actions, task.n_variables)
        self.n_switches = 0
        #: Transitions of the target that were observed.
        self.n_observed = 0
        #: Grows whenever what :meth:`predict` returns may have changed.
        self.version = 0
        rewards = np.concatenate([source.rewards for source in copies.sources])
        #: What it claims to know.
        self.claims = Claims(rewards, task, transfer_terminals)
        #: Errors of the mapping in use, where the source has data.
        self.errors = RegionErrors(task)
        #: Transitions whose outcome the source claimed to know.
        self.n_claimed = 0
        self.transitions = RecordedTransitions(task.n_variables)
        self._renewal_due = float(first_renewal)
        self._all_measured = max(ALL_MEASURED, first_renewal)
        self._warned = False
        self.choice: Choice | None = None
        self._stored: dict[tuple[int, int, int], tuple[np.ndarray, np.ndarray, Predicted]] = {}
        if isinstance(choose, Choice):
            self._set_choice(choose)

    def transferred(self, states: np.ndarray, actions: np.ndarray, own_weight: np.ndarray) -> TransferredInstances:
        return TransferredInstances.empty(len(actions), self.task.n_variables)

    transferred_to_sample = transferred

    def changed(self, known: np.ndarray) -> bool:
        return False

    def note_use(self, transferred: TransferredInstances) -> None:
        pass

    def predict(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        if self.choice is None:
            return PriorPredictions.nothing(len(actions), self.task.n_variables)
        effect, reward, end, coverage = self._raw(np.ascontiguousarray(states, dtype=np.float64), actions)
        return self.claims.restrict(effect, reward, end, coverage, actions)

    def _raw(self, states: np.ndarray, actions: np.ndarray) -> Predicted:
        """Predictions and coverage. Those of many pairs at once are stored: what is claimed of them changes more often."""
        if len(actions) < MANY:
            return self.copies.predict(self._used, self._work_space, states, actions)
        asked = len(actions), int(actions[0]), int(actions[-1])
        if asked in self._stored:
            last_states, last_actions, predicted = self._stored[asked]
            if np.array_equal(last_actions, actions) and np.array_equal(last_states, states):
                return tuple(array.copy() for array in predicted)  # type: ignore[return-value]
        predicted = self.copies.predict(self._used, self._work_space, states, actions)
        if len(self._stored) > self.task.n_actions:
            self._stored.clear()
        self._stored[asked] = states.copy(), actions.copy(), predicted
        return tuple(array.copy() for array in predicted)  # type: ignore[return-value]

    def observe(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool) -> None:
        """Take in a transition of the target; ``effect``: next state minus state, unit coordinates, shape (n_variables,)."""
        self.n_observed += 1
        recorded = self.n_observed <= self.max_transitions
        if recorded:
            self.transitions.add(state, action, reward, effect, terminated)
            if self._is_measured(self.n_observed):
                self.copies.measure(state, action, effect, self.sums, self.whole)
        if self.choice is not None:
            self._check(state, action, reward, effect, terminated, recorded)
        if self.n_observed >= self._renewal_due:
            self._renewal_due = RENEWAL_GROWTH * self.n_observed
            self._renew(recorded)
            if not self._warned and self.n_observed >= TRANSITIONS_BEFORE_WARNING and self.error() > 1.0:
                self._warned = True
                warn_of_error(self.sources, self.n_observed, self.error())
        self.version += self.claims.have_changed()

    def _is_measured(self, number: Any) -> Any:
        """Whether recorded transitions with these numbers, from 1 on, are compared with what all copies predict."""
        return (number <= self._all_measured) | (number % MEASURED_LATER == 0)

    def _check(
        self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool, recorded: bool
    ) -> None:
        """Compare a transition with what was predicted of it."""
        actions = np.array([action], dtype=np.int64)
        predicted = self.copies.predict(self._used, self._work_space, np.ascontiguousarray(state)[None], actions)
        predicted_effect, r, end, weight = predicted
        self.n_claimed += bool(self.claims.weight(end, weight, actions)[0] > 0.0)
        self._compare(state, action, effect, predicted_effect[0], float(weight[0]))
        self.claims.evidence.note(float(weight[0]), float(end[0]), float(r[0]), reward, terminated)
        self.candidates.note_use(action, self._moved(action))
        if not recorded:
            self.copies.measure_used(self._used, action, effect, predicted, self.sums)

    def _compare(self, state: np.ndarray, action: int, effect: np.ndarray, predicted: np.ndarray, weight: float) -> None:
        if weight >= self.copies.threshold:
            self.errors.note(state, action, effect, predicted)

    def value_bound(self) -> np.ndarray | None:
        """The source's values, while all target actions are explained and neither ends nor rewards are doubted, or None."""
        if self.choice is None or not self.claims.allow_bound():
            return None
        return self._value_bound.through(self.choice)

    def end_episode(self, truncated: bool) -> None:
        if self.n_observed == 0:
            return
        if truncated and self.n_observed <= self.max_transitions:
            self.transitions.note_time_limit()
        if self.choice is not None:
            self.claims.evidence.end_episode(truncated)
        self.version += self.claims.have_changed()

    def _renew(self, choose: bool) -> None:
        if choose and self.choose is not None:
            choice = self.choose(self.sums)
            if not choice.same(self.choice):
                self.n_switches += self.choice is not None
                self._set_choice(choice)
                self._replay()
                self.version += 1
        self.version += self.claims.renew(*self._unexplained(), self._in_copies())

    def _set_choice(self, choice: Choice) -> None:
        self.choice = choice
        self._used = self.copies.uses(*choice)
        self._work_space = self.copies.work_space(self._used)
        self._stored.clear()

    def _replay(self) -> None:
        """Count anew what confirms and contradicts what is predicted through another mapping."""
        self.errors.forget()
        n, seen = self.transitions.n, self.transitions
        effect, reward, end, weight = self._raw(seen.states[:n].copy(), seen.actions[:n].copy())
        for i in range(n):
            self._compare(seen.states[i], int(seen.actions[i]), seen.effects[i], effect[i], float(weight[i]))
        self.claims.replay(seen, reward, end, weight)

    def explained(self) -> np.ndarray:
        """Return which part of each target action's effects is explained, see ``part_explained``."""
        return part_explained(*self._unexplained())

    def _unexplained(self) -> tuple[np.ndarray, np.ndarray]:
        """What is not explained of the effects of each target action and variable, and over how many transitions.

        Of a transition and variable, squared error over squared effect, within bounds: so a few large effects count no more
        than others. Of a variable in a copy, over the transitions where the source has data; of one that stays, over all: how
        much it moves, in parts of what the action that moves it most does.
        """
        n_covered = np.repeat(self.sums.n[:, None], self.task.n_variables, axis=1)
        mean = self.sums.effect / np.maximum(n_covered, 1.0)
        unexplained = n_covered * np.sqrt(mean / np.maximum(mean.max(axis=0), SMALLEST_MOVE**2))
        for a, copy, used, has in self._moves():
            unexplained[a, has] = self.sums.unexplained[copy, a, used, has]
            n_covered[a, has] = self.sums.n_covered[copy, a, used]
        return unexplained, n_covered

    def _in_copies(self) -> np.ndarray:
        """Which variables each target action's copies have, bool, shape (n_target_actions, n_variables)."""
        found = np.zeros((self.task.n_actions, self.task.n_variables), dtype=np.bool_)
        for a, _, _, has in self._moves():
            found[a] |= has
        return found

    def _moved(self, action: int) -> list[tuple[int, int]]:
        """The copies that a target action moves, and the source actions by which it does."""
        return [] if self.choice is None else self.choice.moves(action)

    def _moves(self) -> Iterator[tuple[int, int, int, np.ndarray]]:
        """Of each target action: each copy that it moves, by which source action, and which variables the copy has."""
        for a in range(self.task.n_actions):
            for copy, used in self._moved(a):
                yield a, copy, used, self.copies.state[copy] >= 0

    def error(self) -> float:
        """Return the mean squared error of the mapping in use over that of "no change", on all steps; NaN if none moved."""
        baseline = float(self.sums.effect.sum())
        errors = self.sums.effect.copy()
        for a, copy, used, has in self._moves():
            errors[a, has] = self.sums.error[copy, a, used, has]
        return float(errors.sum()) / baseline if baseline > 0.0 else np.nan

    def statistics(self) -> dict[str, float]:
        return {
            "transfer/prediction_error": self.error(),
            "transfer/prior_trust": float(self.claims.trust.mean()),
            "transfer/prior_doubted": float(self.claims.evidence.doubted),
            "transfer/values_bounded": float(self.value_bound() is not None),
            "transfer/ends_confirmed": self.claims.evidence.confirmed,
            "transfer/ends_contradicted": self.claims.evidence.contradicted,
            "transfer/prior_copies": 0 if self.choice is None else int((self.choice.copies >= 0).sum(axis=1).max(initial=0)),
            "transfer/switches": self.n_switches,
            "transfer/target_transitions": self.n_observed,
        }

    def measured_sums(self) -> CopySums:
        """The sums, with numbers of transitions of those that compliances have been added up of: later ones have none."""
        measured = self._is_measured(np.arange(1, self.transitions.n + 1))
        actions = self.transitions.actions[: self.transitions.n][measured]
        return self.sums._replace(n=np.bincount(actions, minlength=self.task.n_actions).astype(np.float64))

    def mean_compliance(self) -> np.ndarray:
        """Mean compliance of what each target action is made of, shape (n_target_actions,); NaN where nothing is chosen."""
        found, sums = np.full(self.task.n_actions, np.nan), self.measured_sums()
        for a in range(self.task.n_actions):
            if self.choose is None or sums.n[a] == 0.0:
                continue
            means = [sums.compliance[copy, a, used] / sums.n[a] for copy, used in self._moved(a)]
            found[a] = np.prod(means) if means else np.nan
        return found

    def describe(self) -> str:
        """Say what each target action is made of: "East: Right on (x, vx) as (x, v), Neutral on (y, vy) as (x, v); ..."."""
        return self.candidates.describe_choice(self.choice)

    def choices_by_action(self) -> np.ndarray:
        """The candidate in use for each target action, int64, shape (n_target_actions,), -1 for none."""
        moves = [self._moved(a) for a in range(self.task.n_actions)]
        return np.array([self.candidates.number(a, of) if of else -1 for a, of in enumerate(moves)], dtype=np.int64)

    def choices(self) -> np.ndarray:
        return np.repeat(self.choices_by_action(), len(self.task.sample_states))

    def selected(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return self.choices_by_action()[actions]

    def uses(self) -> dict[int, int]:
        return self.candidates.uses()

    def get_state(self) -> dict[str, np.ndarray]:
        chosen, n_slots = np.full((3, self.task.n_actions, self.task.n_variables), -1.0), 0
        if self.choice is not None:
            chosen[0], n_slots = 0.0, self.choice.copies.shape[1]
            for row, array in zip(chosen[1:], self.choice, strict=True):
                row[:, : array.shape[1]] = array
        figures = self.n_observed, self.n_switches, self.version, self._renewal_due, self._warned, n_slots
        return {
            "transitions": self.transitions.rows(),
            "prior_choice": chosen.ravel(),
            **self.claims.get_state("prior_"),
            "prior_figures": np.array(figures, dtype=np.float64),
            "prior_errors": np.concatenate([[float(self.n_claimed)], self.errors.sums.ravel()]),
            "prior_uses": self.candidates.get_state(),
            **{f"prior_sums_{name}": array.ravel().copy() for name, array in self.sums._asdict().items()},
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        d, n_actions = self.task.n_variables, self.task.n_actions
        self.transitions.restore(state["transitions"], n_actions)
        for name, array in self.sums._asdict().items():
            array.ravel()[:] = state[f"prior_sums_{name}"]
        observed, switches, version, due, warned, n_slots = state["prior_figures"].tolist()
        chosen = state["prior_choice"].reshape(3, n_actions, d)[:, :, : int(n_slots)].astype(np.int64)
        if state["prior_choice"][0] >= 0.0:
            copies = np.clip(chosen[1], -1, len(self.copies) - 1)
            most = np.where(copies >= 0, self.copies.table.n_actions[copies] - 1, -1)
            self._set_choice(Choice(copies, np.minimum(chosen[2], most)))
        self.n_observed, self.n_switches, self.version = int(observed), int(switches), int(version)
        self._renewal_due, self._warned = due, warned > 0.5
        self.claims.set_state(state, "prior_")
        self.n_claimed = int(state["prior_errors"][0])
        self.errors.sums.ravel()[:] = state["prior_errors"][1:]
        self.candidates.set_state(state["prior_uses"])
