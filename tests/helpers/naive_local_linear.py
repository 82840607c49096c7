"""The local linear model again, written from its definition in plain loops and NumPy: slow, and independent of the package.

Nothing is incremental but what the definition itself says has a history: how far the instances of a pair may be, and what is
known, which stays known unless the kernel that decides it narrows, and whether an outcome has told states apart.
"""

import math
from typing import NamedTuple

import numpy as np

from helpers.naive_fitted_rmax import Instance, NaiveGrid, apart

# Figures of the definition, as the documentation states them.
LAST_WEIGHT = 0.05
NARROWEST = 0.02
RIDGE = 0.001
EXPLAINED_WEIGHT = 0.5
PRIOR_WEIGHT, PRIOR_OUTCOME_WEIGHT = 0.5, 0.1
ON_GRID = 0.5
EXPLORED, EXPLORED_AGAIN, CHECKED_EVERY = 0.9, 0.99, 50


class Predicted(NamedTuple):
    """Of one action at one state; ``weight``: sum of exp(-narrowing d^2 / breadth^2) over the instances behind it."""

    effect: np.ndarray
    reward: float
    end: float
    weight: float


def squared_distance(at, state, periodic):
    total = 0.0
    for d in apart(at, state, periodic):
        total += d * d
    return total


def ridge_regression(weights, states, effects, ridge):
    """Intercept and slopes, by least squares: the ridge as further rows, beneath data whose means are subtracted."""
    weights, states, effects = (np.asarray(array, dtype=float) for array in (weights, states, effects))
    d = states.shape[1]
    mean_state, mean_effect = np.average(states, axis=0, weights=weights), np.average(effects, axis=0, weights=weights)
    root = np.sqrt(weights)[:, None]
    rows = np.vstack([root * (states - mean_state), math.sqrt(ridge) * np.eye(d)])
    right = np.vstack([root * (effects - mean_effect), np.zeros((d, effects.shape[1]))])
    slopes = np.linalg.lstsq(rows, right, rcond=None)[0]
    return mean_effect - mean_state @ slopes, slopes


class NaiveLocalLinear:
    """The model of a task, action by action.

    :param grid: (resolution by variable, margin[, periodic])
    :param kernel: dict of ``breadth``, ``min_weight``, ``n_neighbors`` and ``outcome_breadth``
    :param prior: function of (state, action) that returns effect, reward, end and whether it claims to know; None for none
    """

    def __init__(self, grid, kernel, n_actions, *, threshold=1.0, prior=None, max_model_steps=1):
        self.grid = NaiveGrid(*grid[:2], grid[2] if len(grid) > 2 else None)
        self.points = [self.grid.unit(point) for point in range(len(self.grid.coordinates))]
        self.n_points, self.n_actions, self.d = len(self.points), n_actions, len(grid[0])
        self.breadth, self.n_neighbors = kernel["breadth"], kernel["n_neighbors"]
        self.outcome_breadth = min(self.breadth, kernel["outcome_breadth"])
        self.full_reach = -math.log(kernel["min_weight"]) * self.breadth**2
        self.threshold = threshold
        self.prior = prior
        self.max_model_steps = max_model_steps
        self.instances = [[] for _ in range(n_actions)]
        shape = n_actions, self.n_points
        self.reach = np.full(shape, self.full_reach)
        self.limit = np.full(shape, self.n_neighbors + self.n_neighbors // 2)
        self.total = np.zeros(shape)
        self.known = np.zeros(shape, dtype=bool)
        # What has come so far, whatever has become of the instances.
        self.rewards, self.has_ended = [], False
        self.narrowing = 1.0

    def prior_at(self, state, action):
        return (np.zeros(self.d), 0.0, 0.0, False) if self.prior is None else self.prior(state, action)

    def prior_effect(self, state, action):
        """The prior's effect, multilinear between those at the grid points."""
        if self.prior is None:
            return np.zeros(self.d)
        corners = self.grid.corners(state).items()
        return sum(part * self.prior_at(self.points[point], action)[0] for point, part in corners)

    def target(self, instance):
        return instance.effect - self.prior_effect(instance.state, instance.action)

    def effect_range(self, action):
        """Least and largest effects: those of the instances, and those that the prior predicts on the grid."""
        effects = [instance.effect for instance in self.instances[action]]
        if self.prior is not None:
            effects += [self.prior_at(point, action)[0] for point in self.points]
        return (np.min(effects, axis=0), np.max(effects, axis=0)) if effects else None

    def distances(self, at, action):
        """(squared distance, number) of all instances of an action, the nearest first; of equal ones the lower number."""
        return sorted((squared_distance(at, i.state, self.grid.periodic), n) for n, i in enumerate(self.instances[action]))

    def narrowed(self, farthest):
        """The breadth of a kernel at whose full list the last squared distance is ``farthest``."""
        if farthest >= self.full_reach:
            return self.breadth
        return min(self.breadth, max(NARROWEST * self.breadth, math.sqrt(farthest / -math.log(LAST_WEIGHT))))

    def states_near(self, at, instances):
        """States of instances, their periodic variables by as many periods away as bring them nearest to a state."""
        return np.array([at + np.array(apart(i.state, at, self.grid.periodic)) for i in instances])

    def fit(self, at, action, counted, breadth):
        """Intercept, slopes, and what is left over near a state, of the instances that count; and their share of a claim.

        :param counted: (squared distance, number) of these
        :param breadth: of the kernel of the fit
        """
        instances = [self.instances[action][number] for _, number in counted]
        states, targets = self.states_near(at, instances), np.array([self.target(i) for i in instances])
        squared = np.array([d for d, _ in counted])
        weights, near = np.exp(-squared / breadth**2), np.exp(-squared / self.outcome_breadth**2)
        intercept, slopes = ridge_regression(weights, states, targets, RIDGE * breadth**2)
        left_over = near @ (targets - intercept - states @ slopes) / (near.sum() + EXPLAINED_WEIGHT)
        return intercept, slopes, left_over, weights.sum() / (weights.sum() + PRIOR_WEIGHT)

    def predicted(self, at, action, counted, breadth, known=None):
        """Predict from the instances that count, see :meth:`fit`; ``known``: whether they suffice, by their weight if None."""
        _, prior_reward, prior_end, claimed = self.prior_at(at, action)
        of_prior = self.prior_effect(at, action)
        low, high = self.effect_range(action) or (-np.inf, np.inf)
        if not counted:
            return Predicted(np.clip(of_prior, low, high), prior_reward, prior_end, 0.0)
        intercept, slopes, left_over, share = self.fit(at, action, counted, breadth)
        share = share if claimed else 1.0
        effect = np.clip(of_prior + share * (intercept + at @ slopes + left_over), low, high)
        squared = np.array([d for d, _ in counted])
        weight = float(np.exp(-squared * self.narrowing / self.breadth**2).sum())
        suffice = weight >= self.threshold if known is None else known
        instances = [self.instances[action][number] for _, number in counted]
        reward, end = self.outcome(squared, instances, prior_reward, prior_end, claimed and not suffice)
        return Predicted(effect, reward, end, weight)

    def outcome(self, squared, instances, prior_reward, prior_end, with_prior):
        """Averages by the narrower kernel, seen from the nearest instance, where weights would be too small for a quotient."""
        near = np.exp(-(squared - squared.min()) / self.outcome_breadth**2)
        rewards, ends = np.array([i.reward for i in instances]), np.array([float(i.terminated) for i in instances])
        if with_prior:
            closest = math.exp(-squared.min() / self.outcome_breadth**2)
            total = closest * near.sum() + PRIOR_OUTCOME_WEIGHT
            reward = (closest * near @ rewards + PRIOR_OUTCOME_WEIGHT * prior_reward) / total
            return reward, (closest * near @ ends + PRIOR_OUTCOME_WEIGHT * prior_end) / total
        return near @ rewards / near.sum(), near @ ends / near.sum()

    def at_state(self, state, action):
        """Predict at an exact state, from its nearest instances within reach."""
        counted = [entry for entry in self.distances(state, action) if entry[0] <= self.full_reach][: self.n_neighbors]
        full = len(counted) == self.n_neighbors
        return self.predicted(state, action, counted, self.narrowed(counted[-1][0]) if full else self.breadth)

    def claimed(self, action, point):
        return self.prior_at(self.points[point], action)[3]

    def counted(self, action, point):
        """(squared distance, number) of the instances that count for a pair."""
        return [entry for entry in self.distances(self.points[point], action) if entry[0] <= self.reach[action, point]]

    def at_pair(self, action, point):
        counted, breadth = self.counted(action, point), self.narrowed(self.reach[action, point])
        return self.predicted(self.points[point], action, counted, breadth, self.known[action, point])

    def sums(self, action, point):
        """Of a pair: the weighted sums of 1, x, x x^T, e, x e^T; and of narrower weights, of these times reward, end, x, e."""
        at, breadth = self.points[point], self.narrowed(self.reach[action, point])
        one, x, xx, e, xe = 0.0, *(np.zeros(n) for n in (self.d, (self.d, self.d), self.d, (self.d, self.d)))
        outcome = np.zeros(3 + 2 * self.d)
        for squared, number in self.counted(action, point):
            instance = self.instances[action][number]
            [state], target = self.states_near(at, [instance]), self.target(instance)
            w = math.exp(-squared / breadth**2)
            one, x, e = one + w, x + w * state, e + w * target
            xx, xe = xx + w * np.outer(state, state), xe + w * np.outer(state, target)
            near = math.exp(-squared / self.outcome_breadth**2)
            outcome += near * np.concatenate([[1.0, instance.reward, float(instance.terminated)], state, target])
        return np.concatenate([[one], x, xx[np.tril_indices(self.d)], e, xe.reshape(-1)]), outcome

    def row(self, action, point, gamma=1.0):
        """(R, {successor: probability}, steps) of a pair, staying included and undiscounted."""
        found = self.at_pair(action, point)
        ended = any(self.instances[action][number].terminated for _, number in self.counted(action, point))
        displacement, steps = found.effect, 1.0
        if self.max_model_steps > 1 and found.end == 0.0 and not ended:
            displacement, steps = self.follow(action, point)
        corners = self.grid.corners(self.points[point] + displacement) if found.end < 1.0 else {}
        reward = found.reward * (steps if gamma == 1.0 else (1.0 - gamma**steps) / (1.0 - gamma))
        return reward, {to: (1.0 - found.end) * part for to, part in corners.items()}, steps

    def follow(self, action, point):
        """Displacement and steps until a variable has changed by a cell; the last step is cut short there."""
        at, cells = self.points[point], np.array(self.grid.cells, dtype=float)
        first, claimed = self.at_pair(action, point).effect, self.claimed(action, point)
        slopes, share = np.zeros((self.d, self.d)), 1.0
        counted = self.counted(action, point)
        if counted:
            _, slopes, _, share = self.fit(at, action, counted, self.narrowed(self.reach[action, point]))
            share = share if claimed else 1.0
        low, high = self.effect_range(action)
        # The edge of the grid, from the point.
        last = np.array(self.grid.shape) - 1.0
        coordinates = np.array(self.grid.coordinates[point], dtype=float)
        least = np.where(self.grid.periodic, -np.inf, -coordinates / cells)
        most = np.where(self.grid.periodic, np.inf, (last - coordinates) / cells)
        away, steps = np.zeros(self.d), 0.0
        while steps < self.max_model_steps:
            effect = np.clip(first + share * away @ slopes + self.prior_change(action, point, away), low, high)
            after = np.clip(away + effect, least, most)
            parts = [1.0]
            for k in range(self.d):
                if steps > 0.0 and abs(after[k]) * cells[k] > 1.0:
                    parts.append((np.sign(after[k]) / cells[k] - away[k]) / (after[k] - away[k]))
            away = away + min(parts) * (after - away)
            steps += min(parts)
            if min(parts) < 1.0 or (np.abs(away) * cells).max() >= 1.0 or (np.abs(away) * cells).max() < 1e-6:
                break
        return away, steps

    def prior_change(self, action, point, away):
        """By how much the prior's effect changes, linear between the pair and those beside it, if they are claimed alike."""
        change = np.zeros(self.d)
        for j in np.flatnonzero(away):
            side = 1 if away[j] > 0.0 else -1
            beside = list(self.grid.coordinates[point])
            beside[j] += side
            if self.grid.periodic[j]:
                beside[j] %= self.grid.shape[j]
            elif not 0 <= beside[j] < self.grid.shape[j]:
                side = -side
                beside[j] += 2 * side
            other = self.grid.number[tuple(beside)]
            if self.claimed(action, other) == self.claimed(action, point):
                slope = self.prior_at(self.points[other], action)[0] - self.prior_at(self.points[point], action)[0]
                change += slope * side * self.grid.cells[j] * away[j]
        return change

    def informed(self):
        """Whether an outcome has told states apart: an end, or rewards that differ."""
        return self.has_ended or len(set(self.rewards)) > 1

    def needed_on_grid(self):
        """The weight that makes a grid point known."""
        return (ON_GRID if self.informed() else 1.0) * self.threshold

    def lower_threshold(self, threshold):
        self.threshold = threshold
        self.known |= self.total >= self.needed_on_grid()

    def note_outcome(self, reward, terminated):
        """The first outcome that tells states apart makes those pairs known that have what is needed from then on."""
        before = self.informed()
        self.rewards.append(reward)
        self.has_ended = self.has_ended or terminated
        if self.informed() and not before:
            self.decide_by(1.0)
            self.known |= self.total >= self.needed_on_grid()

    def decide_by(self, narrowing):
        """Let known be decided by a kernel of so much less squared breadth: all weights are computed anew if it is another."""
        if narrowing == self.narrowing:
            return
        self.narrowing = narrowing
        for action in range(self.n_actions):
            for point in range(self.n_points):
                squared = [d for d, _ in self.distances(self.points[point], action) if d <= self.full_reach]
                self.total[action, point] = sum(math.exp(-d * narrowing / self.breadth**2) for d in squared)

    def narrow_known(self):
        """Every so many transitions: half the squared breadth if nearly all is known, and no outcome has told states apart."""
        checked = len(self.rewards) % CHECKED_EVERY == 0
        explored = EXPLORED if self.narrowing == 1.0 else EXPLORED_AGAIN
        if checked and not self.informed() and self.known.sum() >= explored * self.known.size:
            self.decide_by(2.0 * self.narrowing)
            self.known &= self.total >= self.needed_on_grid()

    def add(self, state, action, reward, next_state, terminated):
        """Add an instance; the kernels of pairs that have too many by it narrow."""
        self.note_outcome(reward, terminated)
        self.put(len(self.instances[action]), Instance(state, action, reward, next_state, terminated, self.grid.periodic))

    def put(self, number, instance):
        action = instance.action
        self.instances[action][number : number + 1] = [instance]
        for point, at in enumerate(self.points):
            squared = squared_distance(at, instance.state, self.grid.periodic)
            if squared > self.reach[action, point]:
                continue
            self.total[action, point] += math.exp(-squared * self.narrowing / self.breadth**2)
            if not self.known[action, point]:
                self.known[action, point] = self.total[action, point] >= self.needed_on_grid()
            if self.known[action, point] or self.claimed(action, point):
                self.narrow(action, point)
        self.narrow_known()

    def narrow(self, action, point):
        """Let only the nearest instances of a pair count if there are more than its limit."""
        counted = self.counted(action, point)
        if len(counted) <= self.limit[action, point]:
            return
        self.reach[action, point] = counted[self.n_neighbors - 1][0]
        self.set_limit(action, point, len(self.counted(action, point)))

    def set_limit(self, action, point, n_counted):
        """Of many at one and the same distance twice as many."""
        n = self.n_neighbors
        self.limit[action, point] = max(n + n // 2, 2 * n_counted if n_counted > n + n // 4 else 0)


class NaiveReplacement:
    """The definition with ``max_instances``: the nearest instance of the action is replaced."""

    def __init__(self, naive, max_instances):
        self.naive, self.max_instances = naive, max_instances

    def add(self, state, action, reward, next_state, terminated):
        naive = self.naive
        naive.note_outcome(reward, terminated)
        number = len(naive.instances[action])
        if number == self.max_instances:
            number = naive.distances(state, action)[0][1]
            self.remove(action, number)
        naive.put(number, Instance(state, action, reward, next_state, terminated, naive.grid.periodic))

    def remove(self, action, number):
        """A narrow kernel that has lost more than half of its instances becomes as broad as is allowed, and narrows again."""
        naive, n = self.naive, self.naive.n_neighbors
        for point in range(naive.n_points):
            counted = [i for _, i in naive.counted(action, point)]
            if number not in counted:
                continue
            n_left, is_broad = len(counted) - 1, naive.reach[action, point] >= naive.full_reach
            if n_left > 0 and (2 * n_left >= n or is_broad):
                continue
            others = [squared for squared, i in naive.distances(naive.points[point], action) if i != number]
            within = [squared for squared in others if squared <= naive.full_reach]
            naive.reach[action, point] = within[n - 1] if len(within) >= n else naive.full_reach
            n_left = sum(squared <= naive.reach[action, point] for squared in within)
            naive.set_limit(action, point, n_left)
            if n_left == 0:
                naive.known[action, point], naive.total[action, point] = False, 0.0
        naive.instances[action][number].state = np.full(naive.d, np.inf)
