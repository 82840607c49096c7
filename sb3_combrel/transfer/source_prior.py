"""A source as the prior of the target's model: seen through a mapping, and believed as far as the target bears it out."""

from __future__ import annotations

import numpy as np

from sb3_combrel.common.prior import PriorPredictions
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.borne_out import GOES_ON, TRANSITIONS_BEFORE_WARNING, Outcomes, warn_of_error
from sb3_combrel.transfer.copies import MANY, Copies, Predicted
from sb3_combrel.transfer.copy_sums import CopySums
from sb3_combrel.transfer.placed_errors import PlacedErrors
from sb3_combrel.transfer.prior_candidates import PriorCandidates
from sb3_combrel.transfer.prior_choice import Choice, Chooser, moved
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions
from sb3_combrel.transfer.source_use import SourceUse

FIRST_RENEWAL = 10
# Choice and trust are renewed whenever this many times as much has been observed as at the last time.
RENEWAL_GROWTH = 2**0.5
# So many transitions are compared with what all copies predict; later ones one in so many, which suffices to notice a change.
ALL_MEASURED, MEASURED_LATER = 500, 5
# Transitions of a target action from which on a source is believed about it.
MIN_TRANSITIONS = 10
# How much of a variable's effects must be explained; less is not clearly better than "nothing changes". With 0.25 for the
# mean that is fitted to, a Mountain Car as the source cost the iCub's arm 18 to 87 % more steps (two times ten seeds); with
# 0.5 it costs 3 to 5 %, and sources that are right are not affected.
MIN_EXPLAINED = 0.5
# Trust is in steps of this: with every change all pairs are predicted anew.
TRUST_STEP = 0.1


class SourcePrior(SourceUse):
    """
    What a source predicts of the target, through a mapping that is given or chosen by compliance.

    *What it claims.* The weight of a prediction is that of the source's data there, the least of all copies', times the
    trust in the mapping for the target action: which part of the effects of the target's own transitions with it the source
    explains, of the variable of which it explains least (see :meth:`explained`; a sum over variables would hide a wrong
    action, which shows in velocities alone). No trust below ``MIN_EXPLAINED``, or before ``MIN_TRANSITIONS`` of the action;
    of a mapping that is given, trust in all actions together stands in for that of an action with fewer. Nothing is claimed
    any more while the source's ends or rewards are doubted (see :class:`Outcomes`), and no transition that may end before
    an end has been confirmed.

    *What it predicts.* Its effects are the mean that the target's own instances are fitted to wherever it claims nothing, too:
    all but those on variables of which it turns out to explain less than ``MIN_EXPLAINED`` under the action;
    these are 0.

    :param copies: the copies that can be chosen
    :param task: the target task
    :param choose: chooses from the sums over the target's transitions; or the choice that is given
    :param whole: see :meth:`Copies.measure`
    :param max_transitions: target transitions by which is chosen, at most; what is chosen then is checked on
    :param transfer_terminals: whether the source's ends are used at all
    :param first_renewal: target transitions after which is chosen first; all of them are compared with what all copies
        predict. Equal to ``max_transitions``, it is chosen once
    """

    candidates: PriorCandidates

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
        self.whole = whole
        self._choose = None if isinstance(choose, Choice) else choose
        self.max_transitions = 0 if self._choose is None else max_transitions
        self.transfer_terminals = transfer_terminals
        self.sums = CopySums.zero(len(copies), copies.most_actions, task.n_actions, task.n_variables)
        self.n_switches = 0
        self.trust = np.zeros(task.n_actions)
        # Whether the source's effects on each variable are used, by target action.
        self.explains = np.ones((task.n_actions, task.n_variables), dtype=np.bool_)
        rewards = np.concatenate([source.rewards for source in copies.sources])
        self.outcomes = Outcomes(rewards, float(task.exploration_threshold))
        #: Errors of the mapping in use, where the source has data.
        self.errors = PlacedErrors(task)
        #: Transitions whose outcome the source claimed to know.
        self.n_claimed = 0
        self._claims = False, False
        self.transitions = RecordedTransitions(task.n_variables)
        # How each recorded transition's episode went on: 0 it did, 1 it terminated, 2 it reached its time limit.
        self._ended = np.zeros(64, dtype=np.int64)
        self._renewal_due = float(first_renewal)
        self._all_measured = max(ALL_MEASURED, first_renewal)
        self._warned = False
        self.choice: Choice | None = None
        self._stored: dict[tuple[int, int, int], tuple[np.ndarray, np.ndarray, Predicted]] = {}
        if isinstance(choose, Choice):
            self._set_choice(choose)

    @property
    def chooses(self) -> bool:
        """Whether it is chosen by compliance, and not given or drawn."""
        return self._choose is not None

    def choose(self, sums: CopySums) -> Choice:
        """Choose from sums over the target's transitions; only where :attr:`chooses` is true."""
        assert self._choose is not None
        return self._choose(sums)

    # -------------------------------------------------------------------- asking

    def predict(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        """
        Predict pairs of the target.

        :param states: unit coordinates, shape (n, n_variables)
        :param actions: int64, shape (n,)
        """
        if self.choice is None:
            return PriorPredictions.nothing(len(actions), self.task.n_variables)
        effect, reward, end, coverage = self._raw(np.ascontiguousarray(states, dtype=np.float64), actions)
        if not self.explains.all():
            effect *= self.explains[actions]
        return PriorPredictions(effect, reward, end, self._claimed(end, coverage, actions))

    def _claimed(self, end: np.ndarray, coverage: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """The weight that is claimed for predictions: that of the source's data, as far as it is believed."""
        if self.outcomes.doubted:
            return np.zeros(len(actions))
        weight = coverage * self.trust[actions]
        if not self._ends_believed:
            weight[end >= GOES_ON] = 0.0
        return weight

    @property
    def _ends_believed(self) -> bool:
        return self.transfer_terminals and self.outcomes.confirmed > 0

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

    # ----------------------------------------------------------------- observing

    def observe(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool) -> None:
        """
        Take in a transition of the target.

        :param state: unit coordinates; ``effect``: next state minus state
        :param reward: raw
        """
        self.n_observed += 1
        recorded = self.n_observed <= self.max_transitions
        if recorded:
            self._record(state, action, reward, effect, terminated)
            if self.n_observed <= self._all_measured or self.n_observed % MEASURED_LATER == 0:
                self.copies.measure(state, action, effect, self.sums, self.whole)
        if self.choice is not None:
            self._check(state, action, reward, effect, terminated, recorded)
        if self.n_observed >= self._renewal_due:
            self._renewal_due = RENEWAL_GROWTH * self.n_observed
            self._renew(recorded)
            self._warn()
        self._note_claims()

    def _record(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool) -> None:
        i = self.transitions.add(state, action, reward, effect)
        if i == len(self._ended):
            self._ended = np.concatenate([self._ended, np.zeros_like(self._ended)])
        self._ended[i] = int(terminated)

    def _check(
        self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool, recorded: bool
    ) -> None:
        """Compare a transition with what was predicted of it."""
        actions = np.array([action], dtype=np.int64)
        predicted = self.copies.predict(self._used, self._work_space, np.ascontiguousarray(state)[None], actions)
        predicted_effect, r, end, weight = predicted
        self.n_claimed += bool(self._claimed(end, weight, actions)[0] > 0.0)
        self._compare(state, action, effect, predicted_effect[0], float(weight[0]))
        self.outcomes.note(float(weight[0]), float(end[0]), float(r[0]), reward, terminated)
        self.candidates.note_use(action, self._moved(action))
        if not recorded:
            self.copies.follow(self._used, action, effect, predicted, self.sums)

    def _compare(self, state: np.ndarray, action: int, effect: np.ndarray, predicted: np.ndarray, weight: float) -> None:
        if weight >= self.copies.threshold:
            self.errors.note(state, action, effect, predicted)

    def end_episode(self, truncated: bool) -> None:
        """Take in the end of an episode; ``truncated``: by its time limit."""
        if self.n_observed == 0:
            return
        if truncated and self.n_observed <= self.max_transitions:
            self._ended[self.transitions.n - 1] = 2
        if self.choice is not None:
            self.outcomes.end_episode(truncated)
        self._note_claims()

    def _note_claims(self) -> None:
        """Let the version grow if ends and rewards are doubted, or believed, that were not before."""
        claims = self.outcomes.doubted, self._ends_believed
        self.version += claims != self._claims
        self._claims = claims

    # ------------------------------------------------------------------ choosing

    def _renew(self, choose: bool) -> None:
        """Renew choice and trust."""
        if choose and self._choose is not None:
            choice = self._choose(self.sums)
            if not choice.same(self.choice):
                self.n_switches += self.choice is not None
                self._set_choice(choice)
                self._replay()
                self.version += 1
        explained = self.explained()
        trust = np.where(explained >= MIN_EXPLAINED, np.floor(explained / TRUST_STEP + 1e-9) * TRUST_STEP, 0.0)
        missed, founded = self._missed()
        explains = (founded < MIN_TRANSITIONS) | (missed <= (1.0 - MIN_EXPLAINED) * founded) | ~self._in_copies()
        if not (np.array_equal(trust, self.trust) and np.array_equal(explains, self.explains)):
            self.trust, self.explains = trust, explains
            self.version += 1

    def _set_choice(self, choice: Choice) -> None:
        self.choice = choice
        self._used = self.copies.uses(*choice)
        self._work_space = self.copies.work_space(self._used)
        self._stored.clear()

    def _replay(self) -> None:
        """Count anew what confirms and contradicts what is predicted through another mapping."""
        self.outcomes.forget()
        self.errors.forget()
        n, seen = self.transitions.n, self.transitions
        effect, reward, end, weight = self._raw(seen.states[:n].copy(), seen.actions[:n].copy())
        for i, ended in enumerate(self._ended[:n].tolist()):
            self._compare(seen.states[i], int(seen.actions[i]), seen.effects[i], effect[i], float(weight[i]))
            self.outcomes.note(float(weight[i]), float(end[i]), float(reward[i]), float(seen.rewards[i]), ended == 1)
            if ended:
                self.outcomes.end_episode(ended == 2)

    def explained(self) -> np.ndarray:
        """
        Return which part of the effects is explained, for each target action, of the variable of which least is.

        Of a transition and variable, 1 less squared error over squared effect, within bounds: so a few large effects, such as
        those of a car that hits the wall, count no more than others. Of a variable in a copy, over the transitions where the
        source has data; of one that stays, over all: 0 where it moved.

        :return: shape (n_target_actions,); 1 for an exact source, 0 or less for one no better than "nothing changes", 0 for an
            action with too few transitions
        """
        missed, founded = self._missed()
        explained = np.zeros(self.task.n_actions)
        together = founded.sum(axis=0)
        if self._choose is None and together.min() >= MIN_TRANSITIONS:
            explained[:] = 1.0 - (missed.sum(axis=0) / together).max()
        enough = founded.min(axis=1) >= MIN_TRANSITIONS
        explained[enough] = 1.0 - (missed[enough] / founded[enough]).max(axis=1)
        return explained

    def _missed(self) -> tuple[np.ndarray, np.ndarray]:
        """What is not explained of the effects of each target action and variable, and over how many transitions."""
        missed = self.sums.moved.copy()
        founded = np.repeat(self.sums.n[:, None], self.task.n_variables, axis=1)
        for a in range(self.task.n_actions):
            for copy, used in self._moved(a):
                has = self.copies.state[copy] >= 0
                missed[a, has] = self.sums.missed[copy, a, used, has]
                founded[a, has] = self.sums.founded[copy, a, used]
        return missed, founded

    def _in_copies(self) -> np.ndarray:
        """Which variables each target action's copies have, bool, shape (n_target_actions, n_variables)."""
        found = np.zeros((self.task.n_actions, self.task.n_variables), dtype=np.bool_)
        for a in range(self.task.n_actions):
            for copy, _ in self._moved(a):
                found[a] |= self.copies.state[copy] >= 0
        return found

    def _moved(self, action: int) -> list[tuple[int, int]]:
        """The copies that a target action moves, and the source actions by which it does."""
        return [] if self.choice is None else moved(self.choice, action)

    # ------------------------------------------------------------------- figures

    def error(self) -> float:
        """
        Return the mean squared error of the predicted effects on the target's own transitions, over that of "no change".

        Of the mapping in use, on all transitions so far; NaN before the first that moves.
        """
        baseline = float(self.sums.effect.sum())
        errors = self.sums.effect.copy()
        for a in range(self.task.n_actions):
            for copy, used in self._moved(a):
                has = self.copies.state[copy] >= 0
                errors[a, has] = self.sums.error[copy, a, used, has]
        return float(errors.sum()) / baseline if baseline > 0.0 else np.nan

    def _warn(self) -> None:
        """Warn once if the source predicts worse than "no change"."""
        if self._warned or self.n_observed < TRANSITIONS_BEFORE_WARNING or not self.error() > 1.0:
            return
        self._warned = True
        warn_of_error(self.copies.sources, self.n_observed, self.error())

    def statistics(self) -> dict[str, float]:
        """Figures for the logger, by name."""
        return {
            "transfer/prediction_error": self.error(),
            "transfer/prior_trust": float(self.trust.mean()),
            "transfer/prior_doubted": float(self.outcomes.doubted),
            "transfer/ends_confirmed": self.outcomes.confirmed,
            "transfer/ends_contradicted": self.outcomes.contradicted,
            "transfer/prior_copies": 0 if self.choice is None else int((self.choice.copies >= 0).sum(axis=1).max(initial=0)),
            "transfer/switches": self.n_switches,
            "transfer/target_transitions": self.n_observed,
        }

    # --------------------------------------------------------------- describing

    def measured_sums(self) -> CopySums:
        """The sums, with numbers of transitions of those that compliances have been added up of: later ones have none."""
        number = np.arange(1, self.transitions.n + 1)
        measured = (number <= ALL_MEASURED) | (number % MEASURED_LATER == 0)
        actions = self.transitions.actions[: self.transitions.n][measured]
        return self.sums._replace(n=np.bincount(actions, minlength=self.task.n_actions).astype(np.float64))

    def mean_compliance(self) -> np.ndarray:
        """Mean compliance of what each target action is made of, shape (n_target_actions,); NaN where nothing is chosen."""
        found, sums = np.full(self.task.n_actions, np.nan), self.measured_sums()
        for a in range(self.task.n_actions):
            if self._choose is None or sums.n[a] == 0.0:
                continue
            means = [sums.compliance[copy, a, used] / sums.n[a] for copy, used in self._moved(a)]
            found[a] = np.prod(means) if means else np.nan
        return found

    def describe(self) -> str:
        """Say what each target action is made of: "East: Right on (x, vx) as (x, v), Neutral on (y, vy) as (x, v); ..."."""
        return self.candidates.describe_choice(self.choice)

    @property
    def makes_choices(self) -> bool:
        return True

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

    # -------------------------------------------------------------------- saving

    def get_state(self) -> dict[str, np.ndarray]:
        """What was learned, float64 arrays."""
        n, d = self.transitions.n, self.task.n_variables
        chosen = np.full((3, self.task.n_actions, d), -1.0)
        if self.choice is not None:
            chosen[0] = 0.0
            for row, array in zip(chosen[1:], self.choice, strict=True):
                row[:, : array.shape[1]] = array
        figures = self.n_observed, self.n_switches, self.version, self._renewal_due, self._warned, self._n_slots()
        return {
            "transitions": np.column_stack([self.transitions.rows(), self._ended[:n]]),
            "prior_choice": chosen.ravel(),
            "prior_trust": self.trust.copy(),
            "prior_explains": self.explains.ravel().astype(np.float64),
            "prior_outcomes": self.outcomes.get_state(),
            "prior_figures": np.array(figures, dtype=np.float64),
            "prior_errors": np.concatenate([[float(self.n_claimed)], self.errors.sums.ravel()]),
            "prior_uses": self.candidates.get_state(),
            **{f"prior_sums_{name}": array.ravel().copy() for name, array in self.sums._asdict().items()},
        }

    def _n_slots(self) -> int:
        return 0 if self.choice is None else self.choice.copies.shape[1]

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Take over what :meth:`get_state` returned; for a new object."""
        d, n_actions = self.task.n_variables, self.task.n_actions
        for *row, ended in state["transitions"]:
            action = int(np.clip(row[-1], 0, n_actions - 1))
            self._record(np.array(row[:d]), action, float(row[-2]), np.array(row[d : 2 * d]), False)
            self._ended[self.transitions.n - 1] = int(ended)
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
        self.trust = state["prior_trust"].copy()
        self.explains = state["prior_explains"].reshape(n_actions, d) > 0.5
        self.outcomes.set_state(state["prior_outcomes"])
        self.n_claimed = int(state["prior_errors"][0])
        self.errors.sums.ravel()[:] = state["prior_errors"][1:]
        self._claims = self.outcomes.doubted, self._ends_believed
        self.candidates.set_state(state["prior_uses"])
