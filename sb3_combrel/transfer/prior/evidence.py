"""How far a source, as the prior of the target's model, is borne out by the target's own transitions."""

from __future__ import annotations

import numpy as np

# Errors of a step that are smaller than this part of a variable's range, or of the largest reward, tell nothing.
SMALLEST_ERROR = 1e-4
# As how many own instances a source may count; 0: the learner without the source, beforehand as probable as all others.
STRENGTHS = np.array([0.0, *4.0 ** np.arange(-4, 2)])
PROBABILITIES = np.array([0.5, *np.full(len(STRENGTHS) - 1, 0.5 / (len(STRENGTHS) - 1))])
#: What the target's own instances alone predict, shape (n_variables,), and the leverage of their fit, 0 for nothing.
OwnPrediction = tuple[np.ndarray, float]
# What the evidence is good for is renewed first after so many transitions of the target, and whenever this many times as much
# has been observed as at the last time.
FIRST_RENEWAL, RENEWAL_GROWTH = 10, 2**0.5


class PriorEvidence:
    """Evidence for a source, by target action and variable: whether the learner predicts the target better with it.

    Hypotheses are that the source counts as so many own instances, ``STRENGTHS``; "no source" is one of them. Each predicts a
    transition before it is seen: with an own prediction of leverage h, from a fit to own instances alone, and with data of the
    source of weight w, the source's effect has the part p h / (1 + p h), where p is the strength times w / (1 + w) (see
    ``join_prior``). The likelihood is Student's t with one degree of freedom, whose scale is the geometric mean of the own
    errors so far. :attr:`strength` is the mean of the posterior. What was predicted through a mapping that is no longer in use
    counts as well: it says how well mappings are chosen.

    :param n_actions: target actions
    :param n_variables: target variables
    :param reward_size: of the source's largest reward, raw
    """

    def __init__(self, n_actions: int, n_variables: int, reward_size: float = 1.0):
        #: As how many own instances the source counts, as last renewed; shape (n_actions, n_variables).
        self.strength = np.full((n_actions, n_variables), STRENGTHS @ PROBABILITIES)
        shape = self.strength.shape
        #: Logarithms of the likelihoods, up to what all hypotheses have in common, shape (n_actions, n_variables, n).
        self.likelihood = np.zeros((*shape, len(STRENGTHS)))
        # Sums of logarithms of own squared errors, and of how many.
        self._own_errors, self._n_own = np.zeros(shape), np.zeros(shape[0])
        # The hypothesis of the largest posterior, by number, as last renewed.
        self._likeliest = np.zeros(shape)
        #: Sums of the errors of rewards: of the source's, and of the mean of those before.
        self.reward_errors = np.zeros(2)
        self._rewards, self._reward_size = np.zeros(2), reward_size

    def note(
        self,
        action: int,
        effect: np.ndarray,
        predicted: np.ndarray,
        own: OwnPrediction | None,
        rewards: tuple[float, float],
        weight: float,
    ) -> None:
        """Take in a transition.

        :param predicted: effect by the source, shape (n_variables,)
        :param own: by the learner without it, and its leverage, 0 where it predicts nothing; None for the same
        :param rewards: the reward, and what the source predicts
        :param weight: of the source's data there
        """
        part = weight / (1.0 + weight)
        if own is not None and own[1] > 0.0:
            error = effect - own[0]
            self._own_errors[action] += np.log(error * error + SMALLEST_ERROR**2)
            self._n_own[action] += 1.0
            squared_scale = np.exp(self._own_errors[action] / self._n_own[action])[:, None]
            pull = STRENGTHS * part * own[1]
            errors = error[:, None] - pull / (1.0 + pull) * (predicted - own[0])[:, None]
            self.likelihood[action] -= np.log1p(errors * errors / squared_scale)
        self._note_reward(*rewards, part)

    def _note_reward(self, reward: float, expected: float, part: float) -> None:
        n, total = self._rewards.tolist()
        if n > 0.0:
            self.reward_errors += part * abs(reward - expected), part * abs(reward - total / n)
        self._rewards += 1.0, reward

    def note_rewards_anew(self, rewards: np.ndarray, expected: np.ndarray, weights: np.ndarray) -> None:
        """Forget the rewards so far, and take in those of all transitions: another source predicts others; shape (n,) each."""
        self.reward_errors[:], self._rewards[:] = 0.0, 0.0
        for reward, of_source, weight in zip(rewards.tolist(), expected.tolist(), weights.tolist(), strict=True):
            self._note_reward(reward, of_source, weight / (1.0 + weight))

    def strength_of_actions(self, of: np.ndarray) -> np.ndarray:
        """The geometric mean of :attr:`strength` over variables, shape (n_actions,); NaN without any.

        :param of: the variables of which the source says something, bool, shape (n_actions, n_variables)
        """
        with np.errstate(divide="ignore", invalid="ignore"):  # one that is surely wrong may count as nothing at all
            total = np.where(of, np.log(self.strength), 0.0).sum(axis=1)
            return np.asarray(np.exp(total / of.sum(axis=1)))

    def no_source(self, of: np.ndarray) -> np.ndarray:
        """The probability of "no source", mean over the variables ``of``, as there: shape (n_actions,)."""
        posterior = self._posterior()
        found = np.where(of, posterior[:, :, 0] / posterior.sum(axis=2), 0.0).sum(axis=1)
        with np.errstate(invalid="ignore"):
            return np.asarray(found / of.sum(axis=1))

    def renew(self) -> None:
        """Renew :attr:`strength`."""
        posterior = self._posterior()
        self.strength = posterior @ STRENGTHS / posterior.sum(axis=2)
        self._likeliest = posterior.argmax(axis=2).astype(np.float64)

    def _posterior(self) -> np.ndarray:
        """Of the hypotheses, up to a factor."""
        posterior: np.ndarray = PROBABILITIES * np.exp(self.likelihood - self.likelihood.max(axis=2, keepdims=True))
        return posterior

    def has_changed(self) -> bool:
        """Whether other hypotheses are the likeliest than when :attr:`strength` was renewed."""
        return bool((self._posterior().argmax(axis=2) != self._likeliest).any())

    def weights(self, coverage: np.ndarray, actions: np.ndarray) -> np.ndarray:
        """As how many own instances the source counts where its data have the weight ``coverage``, shape (n, n_variables)."""
        return (coverage / (1.0 + coverage))[:, None] * self.strength[actions]

    def explains_rewards(self) -> bool:
        """Whether the source predicts rewards no worse than their mean so far does."""
        source, mean = self.reward_errors.tolist()
        return bool(source <= mean + SMALLEST_ERROR * self._reward_size * self._rewards[0])

    def _parts(self) -> tuple[np.ndarray, ...]:
        errors = self._own_errors, self._n_own, self.reward_errors, self._rewards
        return self.strength, self.likelihood, self._likeliest, *errors

    def get_state(self) -> np.ndarray:
        """What was learned, float64, for :meth:`set_state`."""
        return np.concatenate([part.ravel() for part in self._parts()])

    def set_state(self, state: np.ndarray) -> None:
        """Take over what :meth:`get_state` returned."""
        sizes = np.cumsum([part.size for part in self._parts()])
        for part, values in zip(self._parts(), np.split(state, sizes[:-1]), strict=True):
            part.ravel()[:] = values
