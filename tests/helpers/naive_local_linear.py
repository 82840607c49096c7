"""The local linear model again, written from its definition in plain loops and NumPy: slow, and independent of the package.

Nothing is incremental: what is predicted, and each row, is computed from the transitions up to a given one.
"""

import math
from typing import NamedTuple

import numpy as np

from helpers.naive_fitted_rmax import Instance, NaiveGrid, apart

# Figures of the definition, as the documentation states them.
NARROWEST, RIDGE = 1e-6, 0.001
ON_GRID, MAX_STEPS = 0.5, 50
# Arrivals farther than so many squared breadths beyond the nearest do not count; this is what the nearest adds to a breadth.
NEGLIGIBLE, ROUNDING = 9.0, 1e-7


class Predicted(NamedTuple):
    """Of one action at one state; ``weight``: of the instances behind it."""

    effect: np.ndarray
    reward: float
    end: float
    weight: float


def ridge_regression(weights, z, numbers, ridge=RIDGE):
    """Mean and slopes by least squares, with the ridge on the slopes as further rows."""
    weights, z, numbers = (np.asarray(array, dtype=float) for array in (weights, z, numbers))
    root, d = np.sqrt(weights)[:, None], z.shape[1]
    rows = np.vstack([root * np.column_stack([np.ones(len(z)), z]), math.sqrt(ridge) * np.eye(d + 1)[1:]])
    right = np.vstack([root * numbers, np.zeros((d, numbers.shape[1]))])
    found = np.linalg.lstsq(rows, right, rcond=None)[0]
    return found[0], found[1:]


class Fit:
    """Effects, then the reward, as linear functions around a state, within the range of the instances."""

    def __init__(self, away, squared, numbers, ended, breadth, n_neighbors, min_weight, prior):
        """The instances come nearest first.

        :param away: shape (n, d): where they are, seen from the state; ``squared``: their squared distances
        :param numbers: shape (n, d + 1); or (n, d + 2), whether they ended an episode last, if the action decides that
        :param breadth: of the broad kernel; ``min_weight``: of the last of ``n_neighbors`` instances
        :param prior: effects, shape (d,), and as how many instances at the state they count, the same
        """
        broad = breadth
        if len(squared) == n_neighbors:
            breadth = min(breadth, max(NARROWEST * breadth, math.sqrt(squared[-1] / -math.log(min_weight))))
        weights = np.exp((squared[0] - squared) / breadth**2)
        going_on = ~ended if not ended.all() else ended
        numbers, d = numbers.copy(), away.shape[1]
        # What an end pays is known by where it is; or else where it leads does not matter.
        for unknown in range(d) if numbers.shape[1] == d + 2 else [d]:
            numbers[ended, unknown] = np.average(numbers[going_on, unknown], weights=weights[going_on])
        self.mean, slopes = ridge_regression(weights, away / breadth, numbers)
        self.slopes = slopes / breadth
        self.low, self.high = numbers.min(axis=0), numbers.max(axis=0)
        design = np.column_stack([np.ones(len(away)), away / breadth])
        penalty = RIDGE * np.diag([0.0] + [1.0] * away.shape[1])
        leverage = np.linalg.inv((design.T * weights) @ design + penalty)[0, 0]
        # In instances at the state; that of the nearest alone bounds it, by the broad kernel.
        sure = min(leverage * math.exp(squared[0] / breadth**2), math.exp(squared[0] / broad**2))
        self.design, self.penalty, self.weights, self.effects, self.sure = design, penalty, weights, numbers[:, :d], sure
        for v in np.flatnonzero(prior[1]):
            # An instance of such a weight moves the mean to that of the prior and of own instances worth 1 / sure.
            pull = prior[1][v] / (prior[1][v] + 1.0 / sure)
            all_weights = np.append(weights, pull / (1.0 - pull) / leverage)
            z, more = np.vstack([away, np.zeros(away.shape[1])]) / breadth, np.append(numbers[:, v], prior[0][v])
            [self.mean[v]], [*slopes] = ridge_regression(all_weights, z, more[:, None])
            self.slopes[:, v] = np.ravel(slopes) / breadth
            self.low[v], self.high[v] = more.min(), more.max()
        residuals = numbers[:, :d] - self.mean[:d] - away @ self.slopes[:, :d]
        apart = ((away[:, None] - away[None]) ** 2).sum(axis=2) + np.diag([np.inf] * len(away))
        # Of an instance alone there is none.
        self.noise = (residuals - residuals[apart.argmin(axis=1)]) / math.sqrt(2.0)

    def at(self, away):
        return np.clip(self.mean + away @ self.slopes, self.low, self.high)


class NaiveLocalLinear:
    """The model of a task.

    :param grid: (resolution by variable, margin[, periodic[, lines]])
    :param kernel: dict of ``breadth``, ``min_weight``, ``n_neighbors``, ``outcome_breadth`` and perhaps ``ends_by_action``
    :param prior: function of (state, action) that returns effect and weights, shape (d,) each; None for none
    """

    def __init__(self, grid, kernel, n_actions, *, threshold=1.0, prior=None, max_instances=None):
        self.grid = NaiveGrid(*grid)
        self.points = [self.grid.unit(point) for point in range(len(self.grid.coordinates))]
        self.n_points, self.n_actions, self.d = len(self.points), n_actions, len(grid[0])
        self.breadth, self.n_neighbors, self.min_weight = kernel["breadth"], kernel["n_neighbors"], kernel["min_weight"]
        self.ends_by_action = kernel.get("ends_by_action", False)
        self.outcome_breadth = min(self.breadth, kernel["outcome_breadth"]) ** 2
        self.reach = -math.log(self.min_weight) * self.breadth**2
        self.threshold, self.max_instances = threshold, max_instances
        self.prior = (lambda state, action: (np.zeros(self.d), np.zeros(self.d))) if prior is None else prior
        self.transitions = []

    @property
    def now(self):
        return len(self.transitions)

    def add(self, state, action, reward, next_state, terminated):
        """Add an instance; with ``max_instances`` in place of the nearest of its action."""
        new = Instance(state, action, reward, next_state, terminated, self.grid.periodic)
        new.state = np.where(self.grid.periodic, new.state % 1.0, new.state)
        present = self.present(action, self.now)
        new.slot, new.since, new.until = len(present), self.now + 1, math.inf
        if len(present) == self.max_instances:
            gone = self.nearest(new.state, action, self.now, math.inf)[0][1]
            new.slot, gone.until = gone.slot, new.since
        self.transitions.append(new)

    def present(self, action, now):
        """The instances of an action that are there after so many transitions, in the order of their slots."""
        there = [i for i in self.transitions if i.action == action and i.since <= now < i.until]
        return sorted(there, key=lambda i: i.slot)

    def squared(self, at, state):
        return sum(d * d for d in apart(at, state, self.grid.periodic))

    def nearest(self, at, action, now, reach):
        """(squared distance, instance), nearest first; of equal ones the one in the lower slot."""
        found = [(self.squared(at, i.state), i) for i in self.present(action, now)]
        return sorted((one for one in found if one[0] <= reach), key=lambda one: one[0])

    def needed_on_grid(self, now):
        """The weight that makes a pair known: less once an episode has ended, or rewards have differed."""
        some = self.transitions[:now]
        informed = any(i.terminated for i in some) or len({i.reward for i in some}) > 1
        return (ON_GRID if informed else 1.0) * self.threshold

    def prior_at(self, state, action):
        """The prior's effect and weights, multilinear between those at the grid points."""
        corners = self.grid.corners(state).items()
        return sum(part * np.array(self.prior(self.points[point], action)) for point, part in corners)

    def fitted(self, at, action, now):
        """The fit around a state, None without instances; and their weight under the broad kernel."""
        near = self.nearest(at, action, now, self.reach)[: self.n_neighbors]
        if not near:
            return None, 0.0
        squared, instances = np.array([q for q, _ in near]), [i for _, i in near]
        away = np.array([apart(i.state, at, self.grid.periodic) for i in instances])
        numbers = [[*i.effect, i.reward, *([float(i.terminated)] if self.ends_by_action else [])] for i in instances]
        ended = np.array([i.terminated for i in instances])
        prior = self.prior_at(at, action)
        fit = Fit(away, squared, np.array(numbers), ended, self.breadth, self.n_neighbors, self.min_weight, prior)
        return fit, np.exp(-squared / self.breadth**2).sum()

    def end_at(self, at, now):
        """The probability that arriving at a state ends the episode, and what an end there pays: all actions' arrivals."""
        arrivals = [i for action in range(self.n_actions) for i in self.present(action, now)]
        if not any(i.terminated for i in arrivals):
            return 0.0, 0.0
        squared = np.array([self.squared(at, i.state + i.effect) for i in arrivals])
        ended = np.array([i.terminated for i in arrivals])
        breadth = min(self.outcome_breadth, squared.min() + ROUNDING)
        weights = np.exp(-(squared - squared.min()) / breadth) * (squared - squared.min() <= NEGLIGIBLE * breadth)
        if not weights[ended].any():
            return 0.0, 0.0
        rewards = np.array([i.reward for i in arrivals])
        return weights[ended].sum() / weights.sum(), np.average(rewards[ended], weights=weights[ended])

    def mean_end(self, fit, at, now):
        """The same with noise: the mean over that of each instance, if it is larger than the nearest arrival is far."""
        arrivals = [i for action in range(self.n_actions) for i in self.present(action, now)]
        nearest = min(self.squared(at, i.state + i.effect) for i in arrivals)
        if np.average((fit.noise**2).sum(axis=1), weights=fit.weights) <= nearest:
            return self.end_at(at, now)
        ends, pays = np.array([self.end_at(at + noise, now) for noise in fit.noise]).T
        weights = fit.weights * ends
        return np.average(ends, weights=fit.weights), np.average(pays, weights=weights) if weights.any() else 0.0

    def outcome(self, fit, at, away, numbers, now):
        """Reward and probability of the end of a step from ``at`` that leads ``away`` from there.

        :param fit: around ``at``; None without instances
        :param numbers: what is fitted of it besides the effect
        """
        if self.ends_by_action:
            return tuple(numbers)
        [reward] = numbers
        end, pays = self.end_at(at + away, now) if fit is None else self.mean_end(fit, at + away, now)
        return (1.0 - end) * reward + end * pays, end

    def at_state(self, state, action):
        """Predict at an exact state, from all transitions."""
        fit, weight = self.fitted(state, action, self.now)
        numbers = np.append(self.prior_at(state, action)[0], [0.0, 0.0] if self.ends_by_action else [0.0])
        if fit is not None:
            numbers = fit.at(np.zeros(self.d))
        effect = numbers[: self.d]
        return Predicted(effect, *self.outcome(fit, state, effect, numbers[self.d :], self.now), weight)

    def weight_of(self, action, point, now):
        return self.fitted(self.points[point], action, now)[1]

    def known(self, action, point, now):
        return self.weight_of(action, point, now) >= self.needed_on_grid(now) * (1.0 - 1e-12)

    def row(self, action, point, now, gamma):
        """(R, {successor: probability}, discount) of a pair, staying included; the action is held until the cell is left."""
        at, cells = self.points[point], np.array(self.grid.cells, dtype=float)
        fit, _ = self.fitted(at, action, now)
        away, total, goes_on, discount = np.zeros(self.d), 0.0, 1.0, 1.0
        for n in range(MAX_STEPS):
            numbers = fit.at(away)
            after = self.within_grid(point, away + numbers[: self.d])
            stays = (np.abs(after - away) * cells <= 1e-6).all()
            # The part of the step that leaves the cell.
            edge = self.edges(point, after)
            beyond = np.abs(after) > np.abs(edge)
            part = min([1.0, *((edge - away)[beyond] / (after - away)[beyond])])
            reward, end = self.outcome(fit, at, after, numbers[self.d :], now)
            taken = 1.0 if n == 0 or end > 0.0 or stays else part
            total += discount * goes_on * taken * reward
            goes_on *= 1.0 - end
            discount *= gamma**taken
            away = away + taken * (after - away)
            if stays or taken < 1.0 or (np.abs(away) >= np.abs(self.edges(point, away))).any() or end > 0.5:
                break
        return total, {to: goes_on * p for to, p in self.grid.corners(at + away).items()} if goes_on > 0.0 else {}, discount

    def within_grid(self, point, away):
        """A displacement from a grid point that does not leave the grid."""
        first, last = np.array([(lines[0], lines[-1]) for lines in self.grid.lines]).T
        at = self.points[point]
        return np.where(np.array(self.grid.periodic), away, np.clip(away, first - at, last - at))

    def edges(self, point, away):
        """How far the next grid lines are from a grid point, on the side of a displacement."""
        return np.array([math.copysign(self.grid.width(point, k, a > 0.0), a) for k, a in enumerate(away)])
