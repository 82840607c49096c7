"""Transferred instances on their way from a transfer method to the model."""

import numpy as np

from sb3_combrel.common.array_struct import ArrayStruct


class Supply(ArrayStruct):
    """Transferred instances for a number of state-action pairs, one pair a row (see ``Transfer.supply``).

    Rows beyond those asked for mean nothing: a transfer method may write to the same supply again and again.

    :param count: int64, shape (n,): instances for each pair, 0 if the pair cannot be settled
    :param weight: float64, shape (n, most)
    :param effect: float64, shape (n, most, n_variables): predicted displacement, unit coordinates of the target
    :param reward: float64, shape (n, most)
    :param terminated: bool, shape (n, most)
    """

    count: np.ndarray
    weight: np.ndarray
    effect: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray

    @classmethod
    def empty(cls, n: int, n_variables: int, most: int = 0) -> "Supply":
        """Nothing for any of ``n`` pairs yet, and room for ``most`` instances of each."""
        return cls(
            count=np.zeros(n, dtype=np.int64),
            weight=np.empty((n, most)),
            effect=np.empty((n, most, n_variables)),
            reward=np.empty((n, most)),
            terminated=np.empty((n, most), dtype=np.bool_),
        )
