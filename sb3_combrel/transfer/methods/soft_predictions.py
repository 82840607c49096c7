"""What a mixture of mappings predicts of the target, through the source's model."""

from __future__ import annotations

import numpy as np

from sb3_combrel.transfer.methods.soft_mapping import Readings, Terms, as_source, brought_back
from sb3_combrel.transfer.prior.copies import distinct_rows
from sb3_combrel.transfer.source_model import SourceModel, SourcePredictions

# Predictions of the sample are stored for so many mappings with a source action.
MAX_STORED = 128
# Pairs that are predicted at once.
AT_ONCE = 4096

Predicted = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


class MixturePredictions:
    """
    Predicts pairs of the target by the mean over a mixture.

    The effect is the sum over copies of the mean over the mixture; the reward is the mean of the copies'; an end, the product
    of theirs; the weight of the source's data, the least of theirs.

    :param model: of the source
    :param readings: the deterministic mappings
    :param mean: of the source's states, unit coordinates, shape (n_source_variables,)
    :param sample: states that are asked for again and again, unit coordinates, shape (n_points, n_target_variables)
    """

    def __init__(self, model: SourceModel, readings: Readings, mean: np.ndarray, sample: np.ndarray):
        self.model = model
        self.readings = readings
        self.mean = mean
        self.sample = sample
        self.terms: Terms
        self._stored: dict[tuple[int, int], tuple[np.ndarray, SourcePredictions]] = {}

    def set_terms(self, terms: Terms) -> None:
        """Use this mixture from now on."""
        self.terms = terms
        self.n_copies = 1 + int(terms.copy.max())

    def predict(self, states: np.ndarray, actions: np.ndarray) -> Predicted:
        """
        Predict pairs of the target.

        :param states: unit coordinates, shape (n, n_target_variables)
        :param actions: int64, shape (n,)
        :return: effects, shape (n, n_target_variables); rewards, probabilities of termination, and weights, shape (n,)
        """
        n, d = states.shape
        if n == len(self.sample) and n > 1 and (actions == actions[0]).all() and np.array_equal(states, self.sample):
            return self._predict_sample(int(actions[0]))
        found = np.zeros((n, d)), np.zeros(n), np.ones(n), np.zeros(n)
        for first in range(0, n, AT_ONCE):
            rows = slice(first, first + AT_ONCE)
            for array, part in zip(found, self._predict_some(states[rows], actions[rows]), strict=True):
                array[rows] = part
        return found

    def _predict_some(self, states: np.ndarray, actions: np.ndarray) -> Predicted:
        """Predict pairs, all with all terms of their actions at once."""
        terms, (n, d) = self.terms, states.shape
        count = np.diff(terms.first)[actions]
        row = np.repeat(np.arange(n), count)
        term = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + np.repeat(terms.first[actions], count)
        variable, sign = self.readings.variable[terms.mapping[term]], self.readings.sign[terms.mapping[term]]
        predicted = self.model.predict(as_source(states[row], variable, sign, self.mean), terms.action[term])
        share, place = terms.share[term], row * self.n_copies + terms.copy[term]
        effects = share[:, None] * brought_back(predicted.effect, variable, sign, d)
        effect = np.column_stack([np.bincount(row, effects[:, v], n) for v in range(d)])
        each = [
            np.bincount(place, share * of_terms, n * self.n_copies).reshape(n, self.n_copies) for of_terms in predicted[1:]
        ]
        return _joined(effect, each[0], each[1], each[2])

    def _predict_sample(self, action: int) -> Predicted:
        """Predict the whole sample, one term after the other; different states of the source once."""
        terms, (n, d) = self.terms, self.sample.shape
        effect, each = np.zeros((n, d)), np.zeros((3, n, self.n_copies))
        for t in range(terms.first[action], terms.first[action + 1]):
            variable, sign = self.readings.variable[terms.mapping[t]], self.readings.sign[terms.mapping[t]]
            kind, predicted = self._of_sample(int(terms.mapping[t]), int(terms.action[t]))
            effect += terms.share[t] * brought_back(predicted.effect, variable, sign, d)[kind]
            for sums, of_kinds in zip(each, predicted[1:], strict=True):
                sums[:, terms.copy[t]] += terms.share[t] * of_kinds[kind]
        return _joined(effect, each[0], each[1], each[2])

    def _of_sample(self, mapping: int, action: int) -> tuple[np.ndarray, SourcePredictions]:
        """The number of each state's prediction, int32, shape (n_points,), and the predictions."""
        if (mapping, action) not in self._stored:
            at = as_source(self.sample, self.readings.variable[mapping], self.readings.sign[mapping], self.mean)
            chosen, kind = distinct_rows(at)
            predicted = self.model.predict(at[chosen], np.full(len(chosen), action, dtype=np.int64))
            if len(self._stored) >= MAX_STORED:
                del self._stored[next(iter(self._stored))]
            self._stored[mapping, action] = kind.astype(np.int32), predicted
        return self._stored[mapping, action]


def _joined(effect: np.ndarray, reward: np.ndarray, end: np.ndarray, weight: np.ndarray) -> Predicted:
    """Join what copies predict, shape (n, n_copies) each; effects have been added."""
    return effect, reward.mean(axis=1), end.prod(axis=1), weight.min(axis=1)
