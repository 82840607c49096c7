"""The local linear model: effects by weighted linear regression on the instances near a state."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_combrel.common.constants import RIDGE
from sb3_combrel.common.regression import LocalFit
from sb3_combrel.models.base import NO_PAIRS, FitOfEffects, InstanceTransfer, ModelSettings, Predictions
from sb3_combrel.models.grid_model import GridModel
from sb3_combrel.models.linear_rows import (
    LinearArrays,
    LinearScratch,
    predict_alone,
    predict_own,
    update_rows,
)
from sb3_combrel.planning.mdp import FiniteMDP

# Degrees of freedom, in weights of the nearest instance, below which residuals are but rounding.
FEWEST_DEGREES = 1e-3


class LocalLinear(GridModel):
    """Local linear regression, one model for each action (Atkeson, Moore & Schaal 1997).

    An instance at distance d (unit coordinates) weighs exp(-d^2 / breadth^2); these weights decide what is known, as in
    the kernel average. The effect at a state is fitted, as a linear function of the state, to its ``n_neighbors`` nearest
    instances with a kernel that is narrower where they lie closer: as broad as makes the last of them weigh 0.05. The bias
    of a kernel average is of the order of the breadth, that of a linear fit of the order of its square, so a broad kernel,
    which needs few instances, predicts well. Predicted numbers stay within the range of those of the fitted instances.
    Whether an episode ends, and what that pays, depends on where one arrives (see ``models.ends``); or both are fitted as
    effects are (``ModelSettings.ends_by_action``).

    A row of the finite MDP leads from a grid point to where its action, held until the cell is left, leads by the pair's
    fit: values interpolated once a cell are nearer to the truth than those interpolated once a step (Munos & Moore 2002).

    A prior (a transfer method with ``use="prior"``) counts as an instance at the very state, of the weight that it has there.
    Its effects and weights are those at the grid points, interpolated between them. What is known, rewards and ends are by the
    own instances alone.
    """

    takes_prior = searches = plans_finer = asks_what_ends = True

    def __init__(self, mdp: FiniteMDP, settings: ModelSettings, transfer: InstanceTransfer | None = None):
        self._fitted = mdp.grid.n_variables + 1, mdp.grid.n_variables + 1 + settings.ends_by_action
        super().__init__(mdp, settings, transfer)
        d, n_pairs, n_near = self.grid.n_variables, len(self.known), settings.n_neighbors
        self.linear = LinearArrays(np.zeros((n_pairs, 2 * d)), np.zeros(d), np.full(self.n_actions, np.inf))
        self._fit = tuple(LocalFit.empty(n_near, d, settings.ends_by_action))
        self._scratch = tuple(LinearScratch(*(np.empty(n) for n in (d, d, d, d, 2, 2 * d))))
        self._prior_version = -1

    def _slot_for(self, state: np.ndarray, action: int) -> tuple[int, np.ndarray]:
        slot, removed = super()._slot_for(state, action)
        if slot < self.instances.size[action]:
            self.linear.radius[action] = np.inf
        return slot, removed

    def renew_prior(self) -> np.ndarray:
        if self._prior is None or self._prior.prior_version() == self._prior_version:
            return NO_PAIRS
        self._prior_version = self._prior.prior_version()
        n_points, points = self.grid.n_points, self.grid.points()
        changed = np.zeros((self.n_actions, 1), dtype=np.bool_)
        for action in range(self.n_actions):
            pairs = slice(action * n_points, (action + 1) * n_points)
            given = np.column_stack(self._prior.prior(points, np.full(n_points, action)))
            changed[action] = not np.array_equal(given, self.linear.prior[pairs])
            self.linear.prior[pairs] = given
        return np.flatnonzero(self.known.reshape(self.n_actions, -1) & changed)

    def _write_rows(self, pairs: tuple[np.ndarray, int], transferred: tuple[Any, ...]) -> int:
        mdp, planned = self.mdp, (self.mdp.gamma, self._threshold, self._prior is not None, self.n_added)
        model = self._plain_experience, tuple(self.linear), tuple(self.pairs), tuple(mdp.arrays), self.grid.plain
        scratch = tuple(mdp.scratch), self._fit, self._scratch
        return int(update_rows.call(*model, tuple(self.kernel), planned, pairs, transferred, *scratch))

    def predict_alone(self, state: np.ndarray, action: int) -> tuple[np.ndarray, float]:
        found = np.zeros(self.grid.n_variables)
        given = self._plain_experience[0], tuple(self.kernel), state, action
        return found, float(predict_alone.call(*given, self._fit, self._scratch, found))

    def predict(self, states: np.ndarray, actions: np.ndarray) -> Predictions:
        """Predict as :meth:`~sb3_combrel.models.base.Model.predict`, and how sure that is: :attr:`Predictions.fit`."""
        each = [self._fit_of(state, action) for state, action in zip(states, actions.tolist(), strict=True)]
        return super().predict(states, actions)._replace(fit=FitOfEffects(*map(np.array, zip(*each, strict=True))))

    def _fit_of(self, state: np.ndarray, action: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Slopes, residual variance and leverage of one fit.

        The variance is over as many degrees of freedom as weighted instances leave (Schaal & Atkeson, NIPS 1993).
        """
        d, fit = self.grid.n_variables, LocalFit(*self._fit)
        fit.weighted[0] = 0.0
        _, leverage = self.predict_alone(np.ascontiguousarray(state, dtype=np.float64), action)
        weight = fit.weighted[0].ravel()
        used = weight > 0.0
        if not used.any():
            return np.full((d, d), np.nan), np.full(d, np.nan), np.nan
        weight, z, effect = weight[used], fit.z.reshape(d + 1, -1).T[used], fit.number.reshape(len(fit.number), -1).T[used, :d]
        inverse = np.linalg.inv((z.T * weight) @ z + RIDGE * np.diag([0.0] + [1.0] * d))
        residual = effect - z @ (inverse @ (z.T * weight) @ effect)
        freedom = weight.sum() - (weight**2 * ((z @ inverse) * z).sum(axis=1)).sum()
        enough = freedom > FEWEST_DEGREES
        variance = (weight[:, None] * residual**2).sum(axis=0) / freedom if enough else np.full(d, np.inf)
        return fit.solution[1 : d + 1, :d].copy(), variance, leverage

    def _predict_own(self, state: np.ndarray) -> float:
        model = self._plain_experience, tuple(self.linear), self.grid.plain, self._prior is not None
        scratch = self._fit, self._scratch, self.mdp.scratch[1:4]
        given = *model, state, tuple(self.kernel), self.exploration_threshold, *scratch, tuple(self._prediction)
        return float(predict_own.call(*given))
