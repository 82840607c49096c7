"""What a transfer method predicts of the target as a prior, on its way to the model."""

from typing import NamedTuple

import numpy as np


class PriorPredictions(NamedTuple):
    """What a source predicts of n state-action pairs of the target (see ``Transfer.prior``). Unit coordinates of the target.

    :param effect: float64, shape (n, n_variables): predicted displacement; 0 for variables of which it says nothing
    :param reward: float64, shape (n,): expected reward, raw
    :param end: float64, shape (n,): probability of termination
    :param weight: float64, shape (n,): how well founded the prediction is, on the scale of the target's
        ``exploration_threshold``. A pair whose weight reaches the threshold is modelled without instances of its own; 0: it
        stays optimistic until they suffice, with ``effect`` still the mean to which they are fitted
    """

    effect: np.ndarray
    reward: np.ndarray
    end: np.ndarray
    weight: np.ndarray

    @classmethod
    def nothing(cls, n: int, n_variables: int) -> "PriorPredictions":
        """Predict no change of any of ``n`` pairs, and claim nothing."""
        return cls(np.zeros((n, n_variables)), np.zeros(n), np.zeros(n), np.zeros(n))
