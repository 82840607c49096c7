"""Transferred instances on their way from a transfer method to the model."""

from typing import NamedTuple

import numpy as np


class Supply(NamedTuple):
    """Transferred instances for a number of state-action pairs, one pair a row (see ``Transfer.supply``).

    :param count: int64, shape (n,): instances for each pair, 0 if the pair cannot be settled
    :param weight: float64, shape (n, most)
    :param effect: float64, shape (n, most, n_variables): predicted displacement, unit coordinates of the target
    :param reward: float64, shape (n, most)
    :param terminated: bool, shape (n, most)
    """

    count: np.ndarray  # type: ignore[assignment]
    weight: np.ndarray
    effect: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray

    @classmethod
    def none(cls, n: int, n_variables: int) -> "Supply":
        """Nothing for any of ``n`` pairs."""
        return cls(
            count=np.zeros(n, dtype=np.int64),
            weight=np.empty((n, 0)),
            effect=np.empty((n, 0, n_variables)),
            reward=np.empty((n, 0)),
            terminated=np.empty((n, 0), dtype=np.bool_),
        )
