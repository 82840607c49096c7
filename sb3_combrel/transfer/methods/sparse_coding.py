"""A mapping between tasks by sparse coding of random samples, and Gaussian process regression (Ammar et al. 2012)."""

from __future__ import annotations

import warnings
from dataclasses import KW_ONLY, dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from sb3_combrel.common.checks import check_count, check_positive
from sb3_combrel.transfer.methods.learned_translation import LearnedTranslation, Standard

if TYPE_CHECKING:
    from sklearn.gaussian_process import GaussianProcessRegressor

N_ITERATIONS = 30
FIRST_NOISE = 0.1  # noise of the standardised target triplets, as a variance, that the regression starts from


class Codes(NamedTuple):
    """Both samples as sparse codes, shape (n_samples, n_atoms), over one dictionary, shape (n_atoms, n_target_columns)."""

    source: np.ndarray
    target: np.ndarray
    dictionary: np.ndarray


def sparse_codes(source: np.ndarray, target: np.ndarray, n_atoms: int, sparsity: float, seed: int) -> Codes:
    """Code standardised triplets of both tasks, one a row, over one dictionary, see :class:`SparseCodingMapping`."""
    from sklearn.decomposition import DictionaryLearning, sparse_encode
    from sklearn.exceptions import ConvergenceWarning

    def learn(rows: np.ndarray, n: int) -> np.ndarray:
        learner = DictionaryLearning(n, alpha=sparsity, max_iter=N_ITERATIONS, fit_algorithm="cd", random_state=seed)
        return np.asarray(learner.fit(rows).components_)

    def encode(rows: np.ndarray, dictionary: np.ndarray) -> np.ndarray:
        return np.asarray(sparse_encode(rows, dictionary, algorithm="lasso_cd", alpha=sparsity, max_iter=10_000))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the dictionaries need not be the best there are
        first = encode(source, learn(source, target.shape[1]))
        first = Standard.of(first).to(first)
        dictionary = learn(first, n_atoms)
        return Codes(encode(first, dictionary), encode(target, dictionary), dictionary)


def fit_regression(source: np.ndarray, target: np.ndarray, seed: int) -> GaussianProcessRegressor:
    """Fit a Gaussian process from standardised source triplets to target triplets, all columns with one kernel."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    noise = WhiteKernel(FIRST_NOISE, (1e-6, 1e1))
    kernel = ConstantKernel(1.0, (1e-2, 1e3)) * RBF(np.sqrt(source.shape[1]), (1e-1, 1e3)) + noise
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # a noise or a length at its bound is what it is
        return GaussianProcessRegressor(kernel, random_state=seed).fit(source, target)


@dataclass(repr=False, eq=False)
class SparseCodingMapping(LearnedTranslation):
    """Pairs random transitions of both tasks by their sparse codes, and transfers all source data by regression on the pairs.

    Paper: Ammar, Tuyls, Taylor, Driessens & Weiss, "Reinforcement learning transfer via sparse coding" (AAMAS 2012). Source
    triplets (state, action, next state) are coded over a dictionary with as many atoms as a target triplet has columns; a
    second, larger dictionary is learned for these codes, over which the target's triplets are coded too. Each source triplet
    is paired with the target triplet whose code is nearest; a Gaussian process learns from the pairs, and carries all source
    data over.

    What differs from the paper: triplets are of unit coordinates, with the effect in place of the next state and one column
    for each action, standardised, the first codes too. The Gaussian process is exact. Translated data are instances that join
    the target's own, nearest first, instead of starting fitted Q-iteration or LSPI. Rewards and ends are the source's.

    What to expect: the first dictionary's atoms, in any order and with any sign, are compared with the columns of target
    triplets one by one, so nothing makes pairs correspond. ``transfer/prediction_error`` says how well the instances used
    predicted.

    Arguments that are not listed here: see :class:`~sb3_combrel.transfer.methods.learned_translation.LearnedTranslation`.

    Example::

        model = FittedRMax("combrel/MountainCar4D-v0", transfer=SparseCodingMapping(source, n_random_steps=100))
        model.learn(total_timesteps=5_000)

    :param n_atoms: atoms of the second dictionary; None: twice the columns of a target triplet
    :param sparsity: weight of the codes' absolute values beside half the squared error
    :raises ValueError: if an argument is out of range; when learning starts, if a state variable of either task is periodic
    """

    _: KW_ONLY
    n_atoms: int | None = None
    sparsity: float = 0.1

    #: Mean squared error on the pairs that the regression was fitted to; 1 is that of the mean of standardised columns.
    regression_error = np.nan

    def __post_init__(self) -> None:
        super().__post_init__()
        check_count("n_atoms", self.n_atoms, none_allowed=True)
        check_positive("sparsity", self.sparsity)

    def learn_translation(self, source: np.ndarray, target: np.ndarray, instances: np.ndarray) -> np.ndarray:
        from scipy.spatial import cKDTree

        seed = int(self.rng.integers(2**31))
        of_source, of_target = Standard.of(source), Standard.of(target)
        from_rows, to_rows = of_source.to(source), of_target.to(target)
        n_atoms = 2 * to_rows.shape[1] if self.n_atoms is None else self.n_atoms
        codes = sparse_codes(from_rows, to_rows, n_atoms, self.sparsity, seed)
        _, nearest = cKDTree(codes.target).query(codes.source)
        regression = fit_regression(from_rows, to_rows[nearest], seed)
        self.regression_error = float(((regression.predict(from_rows) - to_rows[nearest]) ** 2).mean())
        return of_target.back(regression.predict(of_source.to(instances)))

    def statistics(self) -> dict[str, float]:
        return {**super().statistics(), "transfer/regression_error": self.regression_error}

    def get_state(self) -> dict[str, np.ndarray]:
        return {**super().get_state(), "regression_error": np.array([np.nan_to_num(self.regression_error, nan=-1.0)])}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        super().set_state(state)
        error = float(state["regression_error"][0])
        self.regression_error = error if error >= 0.0 else np.nan
