"""The planner against exact value iteration on the same finite model, self-loops and all."""

import numpy as np
import pytest
from helpers.naive_fitted_rmax import NaiveFittedRMax

from sb3_combrel.models.kernel_average import KernelModel
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.sweeping import Planner

NO_LIMIT = 10**9
KERNEL = dict(breadth=0.35, min_weight=0.01, min_fraction=0.13)
N_ACTIONS = 2
MIN_VALUE = -60.0


class Problem:
    """A planner and the definition, fed the same transitions."""

    def __init__(self, resolution=(2, 2), margin=1, gamma=1.0, max_value=0.0, tolerance=1e-11, max_instances=None):
        self.model = KernelModel(
            StateGrid(len(resolution), resolution, margin),
            N_ACTIONS,
            model_breadth=KERNEL["breadth"],
            min_weight=KERNEL["min_weight"],
            min_fraction=KERNEL["min_fraction"],
            exploration_threshold=1.0,
            gamma=gamma,
            max_instances=max_instances,
        )
        self.naive = NaiveFittedRMax(resolution, margin, N_ACTIONS, gamma=gamma, max_value=max_value, **KERNEL)
        self.planner = Planner(self.model, max_value=max_value, min_value=MIN_VALUE, tolerance=tolerance)

    def learn(self, transitions, max_backups=NO_LIMIT):
        for transition in transitions:
            self.planner.update(self.model.add(*transition), max_backups)
            self.naive.add(*transition)

    def think(self, max_backups=NO_LIMIT):
        return self.planner.update(np.empty(0, dtype=np.int64), max_backups)

    def exact(self):
        return self.naive.optimal_values(MIN_VALUE)

    @property
    def hopeful(self):
        return ~self.naive.known.all(axis=0)


def walk(seed, n, n_variables=2, goal=0.8, reward=lambda rng: -1.0):
    """Steps about the box; those that end near the upper corner end the episode."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        state = rng.random(n_variables)
        action = int(rng.integers(N_ACTIONS))
        effect = rng.normal((0.12 if action else -0.12), 0.05, n_variables)
        next_state = np.clip(state + effect, 0.0, 1.0)
        yield state, action, reward(rng), next_state, bool((next_state > goal).all())


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("resolution", "margin", "gamma", "max_value"),
    [((2, 2), 1, 0.9, 5.0), ((4,), 0, 0.97, 10.0), ((1, 2, 1), 0, 0.8, 3.0), ((3, 2), 0, 1.0, 0.0), ((2, 2), 1, 1.0, 0.0)],
)
def test_sweeping_to_convergence_gives_the_values_of_exact_value_iteration(resolution, margin, gamma, max_value, seed):
    problem = Problem(resolution, margin, gamma, max_value)
    noise = (lambda rng: -1.0) if gamma == 1.0 else (lambda rng: float(rng.normal()))
    problem.learn(walk(seed, 120, len(resolution), reward=noise))
    assert problem.planner.n_waiting == 0
    np.testing.assert_allclose(problem.planner.values, problem.exact(), atol=1e-7)
    assert np.unique(np.round(problem.planner.values, 6)).size > 5, "a problem without interest"


@pytest.mark.parametrize("seed", range(3))
def test_passes_over_the_grid_come_to_the_same_values_and_leave_nothing_waiting(seed):
    problem = Problem((3, 2), 1, gamma=0.9, max_value=5.0)
    problem.learn(walk(seed, 120), max_backups=0)
    problem.planner.sweep_all(10_000)
    assert problem.planner.n_waiting == 0
    np.testing.assert_allclose(problem.planner.values, problem.exact(), atol=1e-7)


def test_a_few_passes_leave_the_rest_of_the_work_waiting():
    problem = Problem((3, 2), 1, gamma=0.99, max_value=5.0)
    problem.learn(walk(1, 120), max_backups=0)
    problem.planner.sweep_all(2)
    assert problem.planner.n_waiting > 0
    problem.think()
    np.testing.assert_allclose(problem.planner.values, problem.exact(), atol=1e-7)


def test_values_follow_while_pairs_become_known_one_by_one():
    problem = Problem((3,), 1, gamma=0.95)
    ever_hopeful = problem.hopeful.copy()
    for transition in walk(5, 60, 1):
        problem.learn([transition])
        np.testing.assert_allclose(problem.planner.values, problem.exact(), atol=1e-7)
        assert (problem.planner.values[problem.hopeful] == 0.0).all(), "optimistic points have max_value exactly"
    assert ever_hopeful.all() and not problem.hopeful.all()


def test_a_pair_that_is_forgotten_is_worth_max_value_again():
    """With room for two instances an action, old pairs lose all instances and become optimistic again."""
    problem = Problem((3,), 0, gamma=0.9, max_value=2.0, max_instances=2)
    forgotten = 0
    known = problem.model.arrays.known.copy()
    for transition in walk(2, 80, 1):
        problem.planner.update(problem.model.add(*transition), NO_LIMIT)
        forgotten += int((known & ~problem.model.arrays.known).sum())
        known = problem.model.arrays.known.copy()
        np.testing.assert_allclose(problem.planner.values, values_of_rows(problem), atol=1e-8)
    assert forgotten > 0


def values_of_rows(problem):
    """Value iteration on the model's own rows."""
    model, n = problem.model, problem.model.grid.n_points
    values = np.full(n, problem.planner.bounds[1])
    for _ in range(2000):
        backed_up = values.copy()
        for point in range(n):
            q = [problem.planner.bounds[0]]
            for pair in (point, n + point):
                if not model.arrays.known[pair]:
                    q.append(np.inf)
                    continue
                to, weight = model.arrays.rows.entries(pair)
                q.append(model.arrays.reward[pair] + weight @ values[to])
            backed_up[point] = min(max(q), problem.planner.bounds[1])
        if np.abs(backed_up - values).max() < 1e-12:
            return backed_up
        values = backed_up
    raise AssertionError("value iteration did not converge")


def test_bounded_work_leaves_the_rest_waiting_and_later_calls_finish_it():
    bounded, unbounded = Problem((3, 2), 0, gamma=0.95), Problem((3, 2), 0, gamma=0.95)
    transitions = list(walk(1, 90))
    for transition in transitions:
        pairs = bounded.model.add(*transition)
        backups = bounded.planner.update(pairs, 3)
        assert backups <= len(pairs) + 3
    unbounded.learn(transitions)
    assert bounded.planner.n_waiting > 0
    assert np.abs(bounded.planner.values - unbounded.planner.values).max() > 1e-3, "there is work left"
    calls = 0
    while bounded.planner.n_waiting:
        assert 0 < bounded.think(50) <= 50
        calls += 1
        assert calls < 10_000
    assert calls > 1
    np.testing.assert_allclose(bounded.planner.values, unbounded.planner.values, atol=1e-8)
    np.testing.assert_allclose(bounded.planner.values, unbounded.exact(), atol=1e-7)
    assert bounded.think(50) == 0, "nothing to do, nothing done"


@pytest.mark.parametrize("tolerance", [0.3, 0.03])
def test_a_change_up_to_the_tolerance_is_not_passed_on_and_costs_no_more_than_that(tolerance):
    gamma = 0.9
    problem = Problem((3, 2), 0, gamma, tolerance=tolerance)
    problem.learn(walk(4, 90))
    exact = problem.exact()
    error = np.abs(problem.planner.values - exact).max()
    # A successor may have moved by the tolerance since it was last announced, and was as far from that when last used.
    assert error <= 2 * tolerance * gamma / (1 - gamma)
    assert error > 1e-6, "with such a tolerance the values cannot be exact"
    precise = Problem((3, 2), 0, gamma, tolerance=1e-11)
    precise.learn(walk(4, 90))
    assert np.abs(precise.planner.values - exact).max() < error


def test_values_never_leave_their_bounds():
    problem = Problem((2, 2), 0, gamma=1.0)
    for state, action, _, _, _ in walk(0, 80):
        problem.planner.update(problem.model.add(state, action, -1.0, state, False), NO_LIMIT)  # leads nowhere
    settled = problem.model.arrays.n_optimistic == 0
    assert settled.any()
    np.testing.assert_array_equal(problem.planner.values[settled], MIN_VALUE)
    problem = Problem((2, 2), 0, gamma=1.0)
    for state, action, _, _, _ in walk(0, 80):
        problem.planner.update(problem.model.add(state, action, 1.0, state, False), NO_LIMIT)
    np.testing.assert_array_equal(problem.planner.values, 0.0)
