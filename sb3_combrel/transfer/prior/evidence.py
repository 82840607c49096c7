"""How far a source, as the prior of the target's model, is borne out by the target's own transitions."""

from __future__ import annotations

import numpy as np

from sb3_combrel.transfer.recorded_transitions import RecordedTransitions

# Errors of a step that are smaller than this part of a variable's range tell nothing.
SMALLEST_ERROR = 1e-4
# What the evidence is good for is renewed first after so many transitions of the target, and whenever this many times as much
# has been observed as at the last time.
FIRST_RENEWAL, RENEWAL_GROWTH = 10, 2**0.5


class PriorEvidence:
    """Evidence for a source, by target action and variable: whether it predicts the target better than the learner without it.

    The source competes with the learner itself *without* the source, which predicts each transition before it is seen as well.
    Its effect counts as so many own instances as the ratio of their squared errors says, as one instance predicts with the
    variance of the learner's errors: the geometric mean of the ratio, so that no single transition decides, as one that hits a
    wall would. Where the source has data of weight w it counts by w / (1 + w) of this, as its variance is 1 + 1 / w times that
    of its errors. A transition counts by the same part as evidence.

    :param n_actions: target actions
    :param n_variables: target variables
    """

    def __init__(self, n_actions: int, n_variables: int):
        #: The ratio of the learner's own squared errors to the source's, as last renewed; shape (n_actions, n_variables).
        self.strength = np.ones((n_actions, n_variables))
        self.forget()

    def forget(self) -> None:
        """Forget all transitions."""
        shape = self.strength.shape
        # Sums over transitions of logarithms of ratios: to the learner's own squared errors, and how many these are.
        self._to_own, self._n_own = np.zeros(shape), np.zeros(shape[0])
        #: Sums of the errors of rewards: of the source's, and of the mean of those before.
        self.reward_errors = np.zeros(2)
        self._rewards = np.zeros(2)

    def note(
        self,
        action: int,
        effect: np.ndarray,
        predicted: np.ndarray,
        own: np.ndarray | None,
        rewards: tuple[float, float],
        weight: float,
    ) -> None:
        """Take in a transition.

        :param predicted: effect by the source; ``own``: by the learner without it, None for nothing; shape (n_variables,)
        :param rewards: the reward, and what the source predicts
        :param weight: of the source's data there
        """
        part = weight / (1.0 + weight)
        error = _log_error(effect - predicted)
        if own is not None:
            self._to_own[action] += part * (_log_error(effect - own) - error)
            self._n_own[action] += part
        reward, expected = rewards
        n, total = self._rewards.tolist()
        if n > 0.0:
            self.reward_errors += part * abs(reward - expected), part * abs(reward - total / n)
        self._rewards += 1.0, reward

    def replay(self, seen: RecordedTransitions, effects: np.ndarray, rewards: np.ndarray, weights: np.ndarray) -> None:
        """Gather the evidence anew, from what is predicted now of transitions ``seen``."""
        self.forget()
        for i in range(seen.n):
            own = seen.predicted[i] if seen.is_predicted[i] else None
            expected = float(seen.rewards[i]), float(rewards[i])
            self.note(int(seen.actions[i]), seen.effects[i], effects[i], own, expected, float(weights[i]))

    def mean_strength(self) -> float:
        """The geometric mean of :attr:`strength`."""
        return float(np.exp(np.log(self.strength).mean()))

    def renew(self) -> None:
        """Renew :attr:`strength`; one transition without any evidence is counted besides."""
        self.strength = np.exp(self._to_own / (self._n_own[:, None] + 1.0))

    def weights(self, coverage: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """As how many own instances the source counts where its data have the weight ``coverage``, shape (n, n_variables)."""
        return (coverage / (1.0 + coverage))[:, None] * self.strength[actions]

    def explains_rewards(self) -> bool:
        """Whether the source predicts rewards no worse than their mean so far does."""
        source, mean = self.reward_errors.tolist()
        return bool(source <= mean + SMALLEST_ERROR * self._rewards[0])

    def get_state(self) -> np.ndarray:
        """What was learned, float64, for :meth:`set_state`."""
        parts = self.strength, self._to_own, self._n_own, self.reward_errors, self._rewards
        return np.concatenate([part.ravel() for part in parts])

    def set_state(self, state: np.ndarray) -> None:
        """Take over what :meth:`get_state` returned."""
        parts = self.strength, self._to_own, self._n_own, self.reward_errors, self._rewards
        for part, values in zip(parts, np.split(state, np.cumsum([part.size for part in parts])[:-1]), strict=True):
            part.ravel()[:] = values


def _log_error(error: np.ndarray) -> np.ndarray:
    return np.asarray(np.log(error * error + SMALLEST_ERROR**2))
