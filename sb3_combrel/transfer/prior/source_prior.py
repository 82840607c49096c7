"""A source as the prior of the target's model, seen through a mapping: as strong as the target's transitions bear it out."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np

from sb3_combrel.common.transferred import PriorPredictions
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.outcome_evidence import TRANSITIONS_BEFORE_WARNING, RegionErrors, warn_of_error
from sb3_combrel.transfer.prior.copies import MANY, Copies, Predicted
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.prior.evidence import FIRST_RENEWAL, RENEWAL_GROWTH, OwnPrediction, PriorEvidence
from sb3_combrel.transfer.prior.image_ends import best_ending, best_source
from sb3_combrel.transfer.prior.prior_candidates import PriorCandidates
from sb3_combrel.transfer.prior.prior_choice import Choice, Chooser, choose_whole, whole_part
from sb3_combrel.transfer.prior.prior_history import N_FIRST, belief
from sb3_combrel.transfer.prior.value_bound import Episode, ValueBound
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions

# Rounding, in unit coordinates: a transition begins where the one before it led.
SAME_STATE = 1e-9
# So many transitions are compared with what all copies predict; of later ones one in so many.
ALL_MEASURED, MEASURED_LATER = 500, 5


class SourcePrior:
    """What a source predicts of the target, through a mapping that is given or chosen by evidence.

    Methods of the same name mean what they do of ``Transfer`` and of ``MappingTransfer``. No instances are transferred. How
    much its effects weigh is said in :class:`~sb3_combrel.transfer.prior.evidence.PriorEvidence`.

    :param choose: chooses from the sums over the target's transitions; or the choice that is given
    :param whole: whether a mapping for all variables is chosen, and not a division into copies
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
        transfer_terminals: bool,
        first_renewal: int = FIRST_RENEWAL,
    ):
        self.task = task
        self.sources = copies.sources
        self.copies = copies
        self.candidates = PriorCandidates(copies, task)
        self._value_bound = ValueBound(copies, task)
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
        self.transfer_terminals = transfer_terminals
        #: How far the mapping in use is borne out.
        largest = max(float(np.abs(source.rewards).max()) for source in copies.sources)
        self.evidence = PriorEvidence(task.n_actions, task.n_variables, largest)
        #: Errors of the mapping in use, where the source has data.
        self.errors = RegionErrors(task)
        #: The evidence over time, see ``belief``.
        self.history: list[np.ndarray] = []
        self._own: OwnPrediction | None = None
        #: Number of the environment that the transitions observed now come from.
        self.environment = 0
        # By environment: states, rewards and effects of the present episode.
        self._episodes: defaultdict[int, Episode] = defaultdict(list)
        #: Whether :attr:`bounding` explains all target actions, as last renewed; a given one does until it is shown not to.
        self.explains = isinstance(choose, Choice)
        #: The copies whose values bound the target's: see ``choose_whole`` and ``best_ending``.
        self.bounding: Choice | None = None
        #: By how much a return that was seen exceeds what the source bounds it by.
        self.excess = 0.0
        self.transitions = RecordedTransitions(task.n_variables)
        self._renewal_due = float(first_renewal)
        self._all_measured = max(ALL_MEASURED, first_renewal)
        self._warned = False
        self.choice: Choice | None = None
        self._stored: dict[tuple[bytes, bytes], Predicted] = {}
        if isinstance(choose, Choice):
            self.set_choice(choose)

    def predict(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        if self.choice is None:
            return PriorPredictions.nothing(len(actions), self.task.n_variables)
        effect, _, coverage = self._raw(np.ascontiguousarray(states, dtype=np.float64), actions)
        weight = np.where(self._in_copies()[actions], self.evidence.weights(coverage, actions), 0.0)
        return PriorPredictions(effect.copy(), weight)

    def note_prediction(self, effect: np.ndarray, leverage: float) -> None:
        self._own = effect, leverage

    def _raw(self, states: np.ndarray, actions: np.ndarray) -> Predicted:
        """Predictions and coverage. Those of many pairs at once are stored: their weights change more often."""
        if len(actions) < MANY:
            return self.copies.predict(self._used, states, actions)
        asked = states.tobytes(), actions.tobytes()
        if asked not in self._stored:
            if len(self._stored) > self.task.n_actions:
                self._stored.clear()
            self._stored[asked] = self.copies.predict(self._used, states, actions)
        return self._stored[asked]

    def observe(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, terminated: bool) -> None:
        """Take in a transition of the target; ``effect``: next state minus state, unit coordinates, shape (n_variables,)."""
        self.n_observed += 1
        recorded = self.n_observed <= self.max_transitions
        if recorded:
            self.transitions.add(state, action, reward, effect, terminated)
            if self.n_observed <= self._all_measured or self.n_observed % MEASURED_LATER == 0:
                self.copies.measure(state, action, effect, self.sums)
        if self.choice is not None:
            self._check(state, action, reward, effect, recorded)
        if self.n_observed >= self._renewal_due:
            self._renewal_due = RENEWAL_GROWTH * self.n_observed
            self._renew(recorded)
            if not self._warned and self.n_observed >= TRANSITIONS_BEFORE_WARNING and self.error() > 1.0:
                self._warned = True
                warn_of_error(self.sources, self.n_observed, self.error())
        episode = self._episodes[self.environment]
        if episode and np.abs(self.task.effect(state, episode[-1][0] + episode[-1][2])).max() >= SAME_STATE:
            # Past data, or transitions that are taken in once more in other unit coordinates: episodes may be cut anywhere.
            episode.clear()
        episode.append((state, reward, effect))

    def _check(self, state: np.ndarray, action: int, reward: float, effect: np.ndarray, recorded: bool) -> None:
        """Compare a transition with what was predicted of it."""
        actions = np.array([action], dtype=np.int64)
        predicted = self.copies.predict(self._used, np.ascontiguousarray(state)[None], actions)
        [predicted_effect], [expected], [weight] = predicted
        self._compare(state, action, effect, predicted_effect, float(weight))
        self.evidence.note(action, effect, predicted_effect, self._own, (reward, float(expected)), float(weight))
        self.candidates.note_use(action, self._moved(action))
        if not recorded:
            self.copies.measure_used(self._used, action, effect, predicted, self.sums)

    def _compare(self, state: np.ndarray, action: int, effect: np.ndarray, predicted: np.ndarray, weight: float) -> None:
        if weight >= self.task.exploration_threshold:
            self.errors.note(state, action, effect, predicted)

    def value_bound(self) -> np.ndarray | None:
        """The source's values and :attr:`excess`, at most ``max_value``; None unless effects and rewards are explained."""
        bound = self._bound()
        return None if bound is None else np.minimum(bound + self.excess, self.task.max_value)

    def _bound(self) -> np.ndarray | None:
        if self.bounding is None or not self.transfer_terminals or not self.explains:
            return None
        return self._value_bound.through(self.bounding)

    def why_unbounded(self) -> str:
        """Say why the source's values bound nothing; "" if they do."""
        if self.choice is None:
            return "no mapping has been chosen"
        if not self._in_copies().any():
            return "no mapping explains the target better than that nothing changes"
        if not self.transfer_terminals:
            return "transfer_terminals=False"
        if not self.evidence.explains_rewards():
            return "its rewards are not the target's"
        if not self.explains:
            return "some target action is not explained"
        if self._bound() is None:
            return "no whole source explains all target actions as well, or several do not cost the same at every step"
        return ""

    def _explains(self) -> bool:
        """Whether :attr:`bounding` explains each target action better than that nothing changes, and rewards.

        What was chosen must be worth, in nats, what it was chosen from.
        """
        assert self.bounding is not None
        found = np.zeros(self.task.n_actions)
        for a in range(self.task.n_actions):
            for copy, used in self.bounding.moves(a):
                found[a] += self.sums.gain[copy, a, used].sum()
                if self.choose is not None:
                    found[a] -= np.log(self.copies.table.n_actions[copy])
        chosen = bool((self.bounding.actions[self.bounding.copies >= 0] >= 0).all())
        return chosen and bool((found >= 0.0).all()) and self.evidence.explains_rewards()

    def break_off(self) -> None:
        self._episodes.clear()

    def end_episode(self, truncated: bool) -> None:
        version = self.version
        if self.evidence.has_changed():
            # An agent that a source has led astray for an episode is not to be led there again.
            self._renew_evidence()
        episode = self._episodes.pop(self.environment, [])
        # What follows a time limit may cost more than was gained until then.
        complete = not truncated or all(reward >= 0.0 for _, reward, _ in episode)
        self._renew_bounding()
        if episode and complete and self.bounding is not None and self._bound() is not None:
            excess = self._value_bound.excess(self.bounding, episode)
            if excess > self.excess:
                self.excess, self.version = excess, self.version + 1
        if self.version > version:
            self._note_belief()

    def _renew(self, choose: bool) -> None:
        if choose and self.choose is not None:
            choice = best_source(self.copies, self.sums, self.choose(self.sums), self.transitions)
            if not choice.same(self.choice):
                self.n_switches += self.choice is not None
                self.set_choice(choice)
                self._replay()
                self.version += 1
        self._renew_bounding()
        self._renew_evidence()
        self._note_belief()

    def _note_belief(self) -> None:
        """Add what is believed now to the history, in place of what was at the same step."""
        row = belief(self)
        if self.history and self.history[-1][0] == row[0]:
            self.history.pop()
        self.history.append(row)

    def _renew_evidence(self) -> None:
        if self.choice is not None:
            self.evidence.renew()
            self.explains = self._explains()
            self.version += 1

    def _renew_bounding(self) -> None:
        """Find anew which copies bound values; another bound has not been exceeded."""
        if self.choice is None or self.choose is None or self.n_observed > self.max_transitions:
            return
        choice = self.choice
        whole = whole_part(self.copies, choice) if self.whole else choose_whole(self.copies, self.sums, choice)
        whole = best_source(self.copies, self.sums, whole, self.transitions)
        bounding = best_ending(self.copies, self.sums, whole, self.transitions)
        if not bounding.same(self.bounding):
            self.bounding, self.excess, self.version = bounding, 0.0, self.version + 1
            self.explains = self._explains()

    def set_choice(self, choice: Choice) -> None:
        """Predict through these copies from now on."""
        self.choice, self.bounding = choice, whole_part(self.copies, choice)
        self._used = self.copies.uses(*choice)
        self._stored.clear()

    def _replay(self) -> None:
        """Count anew what confirms and contradicts what is predicted through another mapping."""
        self.errors.sums[:] = 0.0
        n, seen = self.transitions.n, self.transitions
        effect, expected, weight = self._raw(seen.states[:n].copy(), seen.actions[:n].copy())
        if len(self.copies.sources) > 1:
            self.evidence.note_rewards_anew(seen.rewards[:n], expected, weight)
        for i in range(n):
            self._compare(seen.states[i], int(seen.actions[i]), seen.effects[i], effect[i], float(weight[i]))

    def _in_copies(self) -> np.ndarray:
        """Which variables each target action's copies have, bool, shape (n_target_actions, n_variables)."""
        if self.choice is None:
            return np.zeros((self.task.n_actions, self.task.n_variables), dtype=np.bool_)
        copies, actions = self.choice
        moved = (copies >= 0) & (actions >= 0)
        return np.asarray((moved[:, :, None] & (self.copies.state[copies] >= 0)).any(axis=1))

    def change_optimism(self, gamma: float, max_value: float) -> None:
        """As of ``Transfer``."""
        self.task = replace(self.task, gamma=gamma, max_value=max_value)
        self._value_bound = ValueBound(self.copies, self.task)

    def _moved(self, action: int) -> list[tuple[int, int]]:
        """The copies that a target action moves, and the source actions by which it does."""
        return [] if self.choice is None else self.choice.moves(action)

    def error(self) -> float:
        """Return the mean squared error of the mapping in use over that of "no change", on the steps compared; NaN without."""
        baseline = float(self.sums.effect.sum())
        errors = self.sums.effect.copy()
        for a in range(self.task.n_actions):
            for copy, used in self._moved(a):
                has = self.copies.state[copy] >= 0
                errors[a, has] = self.sums.error[copy, a, used, has]
        return float(errors.sum()) / baseline if baseline > 0.0 else np.nan

    def strengths(self) -> np.ndarray:
        """As how many of the target's own instances the source counts, by target action; NaN where it is taken for nothing."""
        return self.evidence.strength_of_actions(self._in_copies())

    def no_source(self) -> np.ndarray:
        """How probable it is that the learner alone predicts better, by target action; NaN where it is taken for nothing."""
        return self.evidence.no_source(self._in_copies())

    def statistics(self) -> dict[str, float]:
        strengths = self.strengths()
        return {
            "transfer/prediction_error": self.error(),
            "transfer/prior_strength": float(np.nanmean(strengths)) if np.isfinite(strengths).any() else 0.0,
            "transfer/values_bounded": float(self.value_bound() is not None),
            "transfer/bound_exceeded": self.excess,
            "transfer/prior_copies": 0 if self.choice is None else int((self.choice.copies >= 0).sum(axis=1).max(initial=0)),
            "transfer/switches": self.n_switches,
            "transfer/target_transitions": self.n_observed,
        }

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
        chosen, n_slots = np.full((5, self.task.n_actions, self.task.n_variables), -1.0), 0
        if self.choice is not None and self.bounding is not None:
            chosen[0], n_slots = 0.0, self.choice.copies.shape[1]
            for row, array in zip(chosen[1:], (*self.choice, *self.bounding), strict=True):
                row[:, : array.shape[1]] = array
        figures = self.n_observed, self.n_switches, self.version, self._renewal_due, self._warned, n_slots, self.explains
        # Environment, state, reward and effect of each transition of the present episodes.
        episodes = [[e, *state, reward, *effect] for e, episode in self._episodes.items() for state, reward, effect in episode]
        return {
            "transitions": self.transitions.rows(),
            "prior_choice": chosen.ravel(),
            "prior_evidence": np.append(self.evidence.get_state(), self.excess),
            "prior_episodes": np.array(episodes, dtype=np.float64).reshape(-1, 2 * self.task.n_variables + 2),
            "prior_figures": np.array(figures, dtype=np.float64),
            "prior_errors": self.errors.sums.ravel().copy(),
            "prior_uses": self.candidates.get_state(),
            "prior_history": np.array(self.history, dtype=np.float64).reshape(-1, N_FIRST + 2 * self.task.n_actions),
            **{f"prior_sums_{name}": array.ravel().copy() for name, array in self.sums._asdict().items()},
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        d, n_actions = self.task.n_variables, self.task.n_actions
        self.transitions.restore(state["transitions"], n_actions)
        for name, array in self.sums._asdict().items():
            array.ravel()[:] = state[f"prior_sums_{name}"]
        observed, switches, version, due, warned, n_slots, explains = state["prior_figures"].tolist()
        chosen = state["prior_choice"].reshape(5, n_actions, d).astype(np.int64)
        if chosen[0].min() >= 0:
            choice, bounding = self._restored(chosen[1:3, :, : int(n_slots)]), self._restored(chosen[3:])
            self.set_choice(choice)
            self.bounding = whole_part(self.copies, bounding)
        self.n_observed, self.n_switches, self.version = int(observed), int(switches), int(version)
        self._renewal_due, self._warned, self.explains = due, warned > 0.5, explains > 0.5
        self.evidence.set_state(state["prior_evidence"][:-1])
        self.excess = float(state["prior_evidence"][-1])
        self._episodes.clear()
        for row in state["prior_episodes"]:
            self._episodes[int(row[0])].append((row[1 : d + 1].copy(), float(row[d + 1]), row[d + 2 :].copy()))
        self.errors.sums.ravel()[:] = state["prior_errors"]
        self.candidates.set_state(state["prior_uses"])
        self.history = list(state["prior_history"].copy())

    def _restored(self, numbers: np.ndarray) -> Choice:
        """A choice of copies and actions that there are, whatever a file says; shape (2, n_target_actions, n)."""
        copies = np.clip(numbers[0], -1, len(self.copies) - 1)
        most = np.where(copies >= 0, self.copies.table.n_actions[copies] - 1, -1)
        return Choice(copies, np.minimum(numbers[1], most))
