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
    # Number of state variables for which the shapes have been checked: they stay what they are.
    _fits = -1

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

    def check(self, n: int, n_variables: int, method: object) -> None:
        """Refuse what compiled code would read beyond its ends.

        :param n: rows that were asked for
        :param n_variables: of the target
        :param method: whoever supplied this
        :raises ValueError: if there are fewer rows, or the arrays do not fit each other
        """
        if self._fits != n_variables:
            self._check_shapes(n_variables, type(method).__name__)
        if len(self.count) < n:
            raise ValueError(f"{type(method).__name__} supplied {len(self.count)} rows, but was asked for {n}")
        count, most = self.count[:n], self.weight.shape[1]
        # What is below 0 is large without a sign.
        if n > 0 and np.maximum.reduce(count.view(np.uint64)) > most:
            raise ValueError(
                f"{type(method).__name__} supplied counts from {count.min()} to {count.max()}, with room for {most} instances"
            )

    def _check_shapes(self, n_variables: int, name: str) -> None:
        places = self.weight.shape
        expected = {"count": places[:1], "effect": (*places, n_variables), "reward": places, "terminated": places}
        for array, shape in expected.items():
            if getattr(self, array).shape != shape:
                raise ValueError(
                    f"{name} supplied {array} of shape {getattr(self, array).shape} with weight of shape {places}; "
                    f"with {n_variables} state variables that must be {shape}"
                )
        vars(self)["_fits"] = n_variables
