"""Fitted R-Max again, written from its definition in plain loops: slow, obvious, and independent of the package.

Nothing is incremental: every list, row and value is computed from all instances seen. Only which pairs were known before is
stored, because a pair that was known once stays known.
"""

import itertools
import math

import numpy as np


class Instance:
    """One transition in unit coordinates."""

    def __init__(self, state, action, reward, next_state, terminated, periodic=None):
        self.state = np.array(state, dtype=float)
        self.action = action
        self.reward = reward
        self.effect = np.array(apart(next_state, self.state, periodic))
        self.terminated = terminated


def apart(a, b, periodic=None):
    """What separates two states along each variable; along a periodic one the shortest way around."""
    found = []
    for x, y, wraps in zip(a, b, periodic or [False] * len(b), strict=True):
        d = x - y
        while wraps and d >= 0.5:
            d -= 1.0
        while wraps and d < -0.5:
            d += 1.0
        found.append(d)
    return found


def kernel(distance_squared, breadth):
    return math.exp(-distance_squared / breadth**2)


def kept_instances(state, instances, breadth, min_weight, min_fraction, periodic=None):
    """(number, weight) of the instances that count at ``state``, nearest first."""
    weighted = []
    for number, instance in enumerate(instances):
        if instance is None:
            continue
        w = kernel(sum(d**2 for d in apart(state, instance.state, periodic)), breadth)
        if w >= min_weight:
            weighted.append((number, w))
    weighted.sort(key=lambda pair: -pair[1])
    kept = []
    for number, w in weighted:
        if kept and w / sum(v for _, v in kept) < min_fraction:
            break
        kept.append((number, w))
    return kept


class NaiveGrid:
    """Grid points by their whole-numbered coordinates."""

    def __init__(self, resolution, margin, periodic=None, lines=None):
        """:param lines: of each variable, from 0 to 1, in place of even ones"""
        self.cells = [2**r for r in resolution]
        self.periodic = list(periodic or [False] * len(resolution))
        self.margin = [0 if wraps else margin for wraps in self.periodic]
        self.shape = [c if wraps else c + 1 + 2 * margin for c, wraps in zip(self.cells, self.periodic, strict=True)]
        self.lines = lines or [
            [(i - m) / cells for i in range(n + wraps)]
            for n, m, cells, wraps in zip(self.shape, self.margin, self.cells, self.periodic, strict=True)
        ]
        self.coordinates = list(itertools.product(*[range(n) for n in self.shape]))
        self.number = {coordinates: i for i, coordinates in enumerate(self.coordinates)}

    def unit(self, point):
        return np.array([lines[c] for c, lines in zip(self.coordinates[point], self.lines, strict=True)])

    def width(self, point, k, above):
        """The width of the cell of variable ``k`` above or below a point; infinite where there is none."""
        lines, at = self.lines[k], self.coordinates[point][k]
        if not above and at == 0:
            return lines[-1] - lines[-2] if self.periodic[k] else math.inf
        low = at if above else at - 1
        return lines[low + 1] - lines[low] if low + 1 < len(lines) else math.inf

    def corners(self, unit):
        """{point: weight} of multilinear interpolation, or for more than four variables of that within a simplex.

        What lies outside the grid is clipped to its edge, or goes around.
        """
        by_variable = []
        for u, lines, n, wraps in zip(unit, self.lines, self.shape, self.periodic, strict=True):
            at = np.interp(u % 1.0 if wraps else u, lines, np.arange(len(lines)))
            low = min(math.floor(at), len(lines) - 2)
            by_variable.append([(low, 1.0 - (at - low)), ((low + 1) % n, at - low)])
        corners = {}
        if len(by_variable) > 4:
            return self.simplex(by_variable)
        for corner in itertools.product(*by_variable):
            weight = math.prod(w for _, w in corner)
            if weight > 0.0:
                corners[self.number[tuple(c for c, _ in corner)]] = weight
        return corners

    def simplex(self, by_variable):
        """{point: weight} of the simplex of a cell: from its lowest corner on, the variable that is farthest on first.

        :param by_variable: ((low, weight), (high, weight)) of each
        """
        parts = [high[1] for _, high in by_variable]
        corner, before, corners = [low[0] for low, _ in by_variable], 1.0, {}
        for k in sorted(range(len(parts)), key=lambda k: -parts[k]):
            corners[self.number[tuple(corner)]] = before - parts[k]
            corner[k], before = by_variable[k][1][0], parts[k]
        corners[self.number[tuple(corner)]] = before
        return {point: weight for point, weight in corners.items() if weight > 0.0}

    def clipped(self, unit):
        edges = zip(self.margin, self.cells, self.periodic, strict=True)
        beyond = [math.inf if wraps else margin / c for margin, c, wraps in edges]
        return np.clip(unit, [-b for b in beyond], [1.0 + b for b in beyond])


class NaiveFittedRMax:
    """The model, its values and Q, all from scratch."""

    def __init__(
        self, resolution, margin, n_actions, kernel, *, threshold=1.0, gamma=1.0, max_value=0.0, periodic=None, lines=None
    ):
        """:param kernel: dict of ``breadth``, ``min_weight`` and ``min_fraction``"""
        self.grid = NaiveGrid(resolution, margin, periodic, lines)
        self.n_points = len(self.grid.coordinates)
        self.n_actions = n_actions
        self.kernel = (kernel["breadth"], kernel["min_weight"], kernel["min_fraction"])
        self.threshold = threshold
        self.gamma = gamma
        self.max_value = max_value
        self.instances = [[] for _ in range(n_actions)]
        self.known = np.zeros((n_actions, self.n_points), dtype=bool)

    def add(self, state, action, reward, next_state, terminated):
        self.instances[action].append(Instance(state, action, reward, next_state, terminated, self.grid.periodic))
        for point in range(self.n_points):
            if sum(w for _, w in self.list_of(action, point)) >= self.threshold:
                self.known[action, point] = True

    def kept_at(self, state, action):
        return kept_instances(state, self.instances[action], *self.kernel, self.grid.periodic)

    def list_of(self, action, point):
        return self.kept_at(self.grid.unit(point), action)

    def row(self, action, point):
        """(R, {successor: probability}) of a pair, self-loop included and undiscounted."""
        kept = self.list_of(action, point)
        total = sum(w for _, w in kept)
        reward = 0.0
        successors = {}
        for number, w in kept:
            instance = self.instances[action][number]
            reward += w / total * instance.reward
            if instance.terminated:
                continue
            for to, fraction in self.grid.corners(self.grid.unit(point) + instance.effect).items():
                successors[to] = successors.get(to, 0.0) + w / total * fraction
        return reward, successors

    def matrices(self):
        """R (n_actions, n_points) and P (n_actions, n_points, n_points) of the known pairs, zero elsewhere."""
        rewards = np.zeros((self.n_actions, self.n_points))
        probabilities = np.zeros((self.n_actions, self.n_points, self.n_points))
        for action, point in zip(*np.nonzero(self.known), strict=True):
            rewards[action, point], successors = self.row(action, point)
            for to, p in successors.items():
                probabilities[action, point, to] = p
        return rewards, probabilities

    def optimal_values(self, min_value, tolerance=1e-12, max_sweeps=200_000):
        """Value iteration on the known pairs with their self-loops; a point with an unknown action has max_value."""
        rewards, probabilities = self.matrices()
        optimistic = ~self.known.all(axis=0)
        values = np.full(self.n_points, float(self.max_value))
        for _ in range(max_sweeps):
            backed_up = np.clip((rewards + self.gamma * probabilities @ values).max(axis=0), min_value, self.max_value)
            backed_up[optimistic] = self.max_value
            change = np.abs(backed_up - values).max()
            values = backed_up
            if change <= tolerance:
                return values
        raise AssertionError("value iteration did not converge")

    def known_at(self, state, action):
        """Whether some of an action's instances alone reach the threshold at an exact state.

        Of any instances those that weigh f T / (1 + f) or more suffice, f being min_fraction and T the threshold.
        """
        breadth, min_weight, min_fraction = self.kernel
        kept = kept_instances(state, self.instances[action], breadth, min_weight, min_fraction, self.grid.periodic)
        heavy = kept_instances(state, self.instances[action], breadth, min_weight, 0.0, self.grid.periodic)
        least = min_fraction * self.threshold / (1.0 + min_fraction)
        return max(sum(w for _, w in kept), sum(w for _, w in heavy if w >= least)) >= self.threshold

    def q_values(self, state, values, min_value, holds=False):
        """Q at an exact state from values at the grid points; staying put is worth the state's own Q.

        :param holds: whether an action is held until a cell is left: of a move by a part of a cell the rest is staying, and
            the value of where it leads counts by how much it differs from the value of staying
        """
        q, value_at = [], lambda unit: sum(p * values[to] for to, p in self.grid.corners(unit).items())
        for action in range(self.n_actions):
            kept = self.kept_at(state, action)
            total = sum(w for _, w in kept)
            if not self.known_at(state, action):
                q.append(self.max_value)
                continue
            reward = after = stay = 0.0
            for number, w in kept:
                instance = self.instances[action][number]
                reward += w / total * instance.reward
                if instance.terminated:
                    continue
                here, there = self.grid.clipped(state), self.grid.clipped(state + instance.effect)
                moved = zip(apart(there, here, self.grid.periodic), self.grid.cells, strict=True)
                part = min(1.0, max(abs(by) * cells for by, cells in moved))
                if part < 1e-12:
                    stay += w / total
                elif holds:
                    stay += w / total * (1.0 - part)
                    after += w / total * (value_at(there) - (1.0 - part) * value_at(here))
                else:
                    after += w / total * value_at(there)
            if 1.0 - self.gamma * stay < 1e-9:
                value = 0.0 if reward == 0.0 else math.copysign(math.inf, reward)
            else:
                value = (reward + self.gamma * after) / (1.0 - self.gamma * stay)
            q.append(min(max(value, min_value), self.max_value))
        return np.array(q)
