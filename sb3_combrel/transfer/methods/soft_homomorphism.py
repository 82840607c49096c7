"""Soft homomorphisms: a stochastic mapping of target to source states, fitted online (Sorg & Singh 2009)."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from time import perf_counter

import numpy as np

from sb3_combrel.common.checks import check_boolean, check_count, check_positive
from sb3_combrel.common.transferred import PriorPredictions
from sb3_combrel.sources.recipes import checked_source
from sb3_combrel.transfer.base import TargetTask, Transfer
from sb3_combrel.transfer.candidates import SourceLike, load_one_source, stacked_instances
from sb3_combrel.transfer.methods import soft_mapping as soft
from sb3_combrel.transfer.methods.soft_mapping import Logits
from sb3_combrel.transfer.prior.evidence import FIRST_RENEWAL, RENEWAL_GROWTH, OwnPrediction, PriorEvidence
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions
from sb3_combrel.transfer.source_model import DEFAULT_SOURCE_BREADTH, SourceModel

MAX_MAPPINGS = 2000  # each mapping predicts every transition that is fitted to with each source action
MAX_FITTED = 500
# The prediction of a copy is the mean over its most probable mappings and source actions: as many as have this probability
# together, at most so many.
MASS, MAX_TERMS = 0.98, 12


@dataclass(repr=False, eq=False)
class SoftHomomorphism(Transfer):
    """The source's model, seen through a stochastic mapping of states that is fitted to the target, is the prior of its model.

    Paper: Sorg & Singh, "Transfer via soft homomorphisms" (AAMAS 2009). A soft homomorphism maps a target state to a
    distribution over source states, such that the expected model of the source is that of the target.

    Here the mapping is a mixture of deterministic ones: every source variable reads one target variable, as it is or mirrored,
    no two the same; parameters are logits of what each variable reads, and of the source action for each target action. The
    prediction is the mean over the mixture of what the source's local linear model predicts, brought back to target
    coordinates. It is fitted by gradient descent after 10 transitions, and again whenever there are 1.4 times as many (about 1
    s for MountainCar2D to 4D), which costs no steps of the target.

    What differs from the paper: it maps to a finite set of source states, or by features made by hand, and transfers the
    source's value function; here the mixture's model is the prior (``FittedRMax(degree=1)``), actions are mapped as well, and
    a target with twice the source's variables is taken for two copies, whose predictions are added. An action can come out as
    a mean of others.

    How much its effects weigh: see :class:`~sb3_combrel.transfer.prior.evidence.PriorEvidence`.

    Example::

        model = FittedRMax("combrel/MountainCar4D-v0", transfer=SoftHomomorphism(source))
        model.learn(total_timesteps=5_000)

    :param source: source instances, or a path to them
    :param n_copies: copies of the source that the target is made of; None: as many as it has variables for, at least one
    :param mirrored: whether target variables may be read mirrored as well
    :param n_starts: random starts of each fit, besides the parameters of the last one
    :param max_transitions: target transitions that are recorded, at most; of these, 500 drawn at random are fitted to
    :param source_breadth: kernel breadth of the source's own model, in unit coordinates of the source
    :raises ValueError: if an argument is out of range; when learning starts, if there are more than 2,000 mappings
    """

    use = "prior"

    source: SourceLike
    _: KW_ONLY
    n_copies: int | None = None
    mirrored: bool = True
    n_starts: int = 4
    max_transitions: int = 3000
    source_breadth: float = DEFAULT_SOURCE_BREADTH

    def __post_init__(self) -> None:
        self.source = checked_source(self.source)
        check_count("n_copies", self.n_copies, none_allowed=True)
        check_count("n_starts", self.n_starts)
        check_count("max_transitions", self.max_transitions, min=FIRST_RENEWAL)
        check_boolean("mirrored", self.mirrored)
        check_positive("source_breadth", self.source_breadth)
        self.mirrored = bool(self.mirrored)

    def bind(self, task: TargetTask, rng: np.random.Generator) -> None:
        super().bind(task, rng)
        # A saved model must not depend on other files.
        self.source = self._source = source = load_one_source(self.source, type(self).__name__)
        d = task.n_variables
        n_mappings = soft.count_mappings(source.n_variables, d, self.mirrored)
        if n_mappings > MAX_MAPPINGS:
            advice = "mirrored=False would do, or " if self.mirrored else ""
            raise ValueError(
                f"SoftHomomorphism needs at most {MAX_MAPPINGS:,} mappings of states, got {n_mappings:,} of {d} target to "
                f"{source.n_variables} source variables; {advice}a source with fewer variables"
            )
        model = SourceModel(stacked_instances([source]), float(self.source_breadth))
        mean = source.scaling.to_unit(source.states).mean(axis=0)
        self._readings = soft.all_readings(source.n_variables, d, self.mirrored)
        copies = max(1, d // source.n_variables) if self.n_copies is None else self.n_copies
        shape = copies, source.n_variables, 1 + int(self._readings.number.max())
        self._shape = Logits(np.zeros(shape), np.zeros((copies, task.n_actions, source.n_actions)))
        self._logits: Logits | None = None
        self._mixture = soft.MixturePredictions(model, self._readings, mean)
        self._transitions = RecordedTransitions(d)
        self._evidence = PriorEvidence(task.n_actions, d, float(np.abs(source.rewards).max()))
        self._own: OwnPrediction | None = None
        self._squares = np.zeros(2)  # squared errors of predictions, and squared effects, of transitions as they came
        self._n_observed = self._n_fits = self._version = self._last_changed = 0
        self._fit_due, self._seconds = float(FIRST_RENEWAL), 0.0

    def prior_version(self) -> int:
        return self._version

    def lowest_reward(self) -> float:
        return float(self._source.rewards.min())

    def prior(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        if self._logits is None:
            return PriorPredictions.nothing(len(actions), self._bound_task.n_variables)
        effect, _, weight = self._mixture.predict(states, actions)
        return PriorPredictions(effect, self._evidence.weights(weight, actions))

    def note_prediction(self, effect: np.ndarray, leverage: float) -> None:
        self._own = effect, leverage

    def observe(self, state: np.ndarray, action: int, reward: float, next_state: np.ndarray, terminated: bool) -> None:
        effect = self._bound_task.effect(state, next_state)
        self._n_observed += 1
        if self._n_observed <= self.max_transitions:
            self._transitions.add(state, action, reward, effect, terminated)
        if self._logits is not None:
            [expected], [mean_reward], [weight] = self._mixture.predict(state[None], np.array([action]))
            self._squares += ((expected - effect) ** 2).sum(), effect @ effect
            self._evidence.note(action, effect, expected, self._own, (reward, float(mean_reward)), float(weight))
        if self._fit_due <= self._n_observed <= self.max_transitions:
            self._fit_due = RENEWAL_GROWTH * self._n_observed
            self._fit()

    def end_episode(self, truncated: bool) -> None:
        if self._evidence.has_changed():
            self._evidence.renew()
            self._version += 1

    def _fit(self) -> None:
        """Fit the mixture to the recorded transitions."""
        began = perf_counter()
        n, seen = self._transitions.n, self._transitions
        rows = np.arange(n) if n <= MAX_FITTED else np.sort(self.rng.choice(n, MAX_FITTED, replace=False))
        size = np.abs(seen.effects[:n]).mean(axis=0)
        scale = np.maximum(size, max(1e-2 * float(size.max()), 1e-6))
        data = soft.FitData(self._mixture.predict_each(seen.states[rows]), seen.actions[rows], seen.effects[rows], scale)
        found = self._state_mappings()
        self._use(soft.fit(self._logits, self._shape, self._readings, data, self.n_starts, int(self.rng.integers(2**63))))
        if self._state_mappings() != found:
            self._last_changed = self._n_observed
        self._evidence.renew()
        self._n_fits += 1
        self._version += 1
        self._seconds += perf_counter() - began

    def _use(self, logits: Logits) -> None:
        self._logits = logits
        self._mixture.set_terms(soft.most_probable(*soft.probabilities(logits, self._readings), MAX_TERMS, MASS))

    def _state_mappings(self) -> list[int]:
        """The most probable mapping of states of each copy, in any order of the copies; none before the first fit."""
        if self._logits is None:
            return []
        return sorted(soft.probabilities(self._logits, self._readings)[0].argmax(axis=1).tolist())

    def mapping_steps(self) -> int:
        """Return how many steps of the target had been taken when the mapping was first fitted; all if it never was."""
        return FIRST_RENEWAL if self._n_fits else self._n_observed

    def mixture(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the stochastic mapping.

        :return: probability that each source variable reads each target variable, [:, 0] as it is or [:, 1] mirrored, shape
            (n_copies, 2, n_source_variables, n_target_variables); of source actions, shape (n_copies, n_target_actions,
            n_source_actions)
        :raises ValueError: before the first fit, after 10 transitions
        """
        if self._logits is None:
            raise ValueError(f"there is no mapping before the target has been seen for {FIRST_RENEWAL} transitions")
        of_mapping, of_action = soft.probabilities(self._logits, self._readings)
        found = np.zeros((len(of_mapping), 2, self._source.n_variables, self._bound_task.n_variables))
        for (m, k), v in np.ndenumerate(self._readings.variable):
            if v >= 0:
                found[:, int(self._readings.sign[m, k] < 0.0), k, v] += of_mapping[:, m]
        return found, of_action

    def statistics(self) -> dict[str, float]:
        wrong, baseline = self._squares.tolist()
        of_mapping = soft.probabilities(self._logits, self._readings)[0] if self._logits else np.full((1, 1), np.nan)
        everything = np.ones(self._evidence.strength.shape, dtype=np.bool_)
        return {
            "transfer/prediction_error": wrong / baseline if baseline > 0.0 else np.nan,
            "transfer/prior_strength": float(self._evidence.strength_of_actions(everything).mean()),
            "transfer/mapping_probability": float(of_mapping.max(axis=1).mean()),
            "transfer/mapping_last_changed": self._last_changed,
            "transfer/fits": self._n_fits,
            "transfer/fit_seconds": self._seconds,
            "transfer/target_transitions": self._n_observed,
        }

    def get_state(self) -> dict[str, np.ndarray]:
        logits = self._shape if self._logits is None else self._logits
        figures = self._n_observed, self._n_fits, self._version, self._last_changed, self._fit_due, *self._squares
        return {
            "transitions": self._transitions.rows(),
            "soft_state_logits": logits.state.ravel().copy(),
            "soft_action_logits": logits.action.ravel().copy(),
            "soft_evidence": self._evidence.get_state(),
            "soft_figures": np.array(figures, dtype=np.float64),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        self._transitions.restore(state["transitions"], self._bound_task.n_actions)
        *counts, self._fit_due, wrong, baseline = state["soft_figures"].tolist()
        self._n_observed, self._n_fits, self._version, self._last_changed = (int(count) for count in counts)
        self._squares = np.array([wrong, baseline])
        if self._n_fits:
            given = state["soft_state_logits"], state["soft_action_logits"]
            self._use(Logits(*(array.reshape(like.shape).copy() for array, like in zip(given, self._shape, strict=True))))
        self._evidence.set_state(state["soft_evidence"])
