"""The planner against exact value iteration on the same finite MDP, self-loops included."""

import numpy as np
import pytest
from helpers.kernel_models import N_ACTIONS, add_instances, make_model
from helpers.naive_fitted_rmax import NaiveFittedRMax
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.planning.corrections import CELL_OFFSET, CELLS_PER_GRID_CELL, MAX_VISITS, CorrectionArrays
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.q_values import Prediction, QValues
from sb3_combrel.planning.sweeping import Planner

NO_LIMIT = 10**9
KERNEL = dict(breadth=0.35, min_weight=0.01, min_fraction=0.13)
MIN_VALUE = -60.0


class Problem:
    """A planner with its model, and the definition, given the same transitions."""

    def __init__(
        self, resolution=(2, 2), margin=1, gamma=1.0, max_value=0.0, tolerance=1e-11, max_instances=None, periodic=None
    ):
        self.model = make_model((resolution, margin, periodic), KERNEL, gamma, max_instances)
        values = dict(gamma=gamma, max_value=max_value, periodic=periodic)
        self.naive = NaiveFittedRMax(resolution, margin, N_ACTIONS, KERNEL, **values)
        self.planner = Planner(self.model.mdp, max_value=max_value, min_value=MIN_VALUE, tolerance=tolerance)

    def update(self, transition, max_backups=NO_LIMIT):
        """One step of learning; the pairs that changed, and the backups done."""
        pairs = self.model.add(*transition)
        self.model.update_rows(pairs)
        return pairs, self.planner.update(pairs, max_backups)

    def learn(self, transitions, max_backups=NO_LIMIT):
        for transition in (transitions := list(transitions)):
            self.update(transition, max_backups)
        add_instances(self.naive, transitions)
        # Which is tested with the models, and slow to find out here.
        self.naive.known[:] = self.model.known.reshape(self.naive.known.shape)

    def plan(self, max_backups=NO_LIMIT):
        return self.planner.update(np.empty(0, dtype=np.int64), max_backups)

    def exact(self):
        return self.naive.optimal_values(MIN_VALUE)

    @property
    def optimistic(self):
        return ~self.naive.known.all(axis=0)


def walk(seed, n, n_variables=2, goal=0.8, reward=lambda rng: -1.0):
    """Steps about the box; those that end near the upper corner end the episode."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        state, action = rng.random(n_variables), int(rng.integers(N_ACTIONS))
        next_state = np.clip(state + rng.normal((0.12 if action else -0.12), 0.05, n_variables), 0.0, 1.0)
        yield state, action, reward(rng), next_state, bool((next_state > goal).all())


@pytest.mark.parametrize(
    ("resolution", "margin", "gamma", "max_value", "periodic"),
    [
        *[((4,), 0, 0.97, 10.0, None), ((1, 2, 1), 0, 0.8, 3.0, None), ((2, 2), 1, 1.0, 0.0, None)],
        ((2, 3), 0, 0.9, 5.0, (False, True)),
    ],
)
def test_sweeping_to_convergence_gives_the_values_of_exact_value_iteration(resolution, margin, gamma, max_value, periodic):
    problem = Problem(resolution, margin, gamma, max_value, periodic=periodic)
    noise = (lambda rng: -1.0) if gamma == 1.0 else (lambda rng: float(rng.normal()))
    problem.learn(walk(1, 80, len(resolution), reward=noise))
    assert problem.planner.n_queued == 0
    np.testing.assert_allclose(problem.planner.values, problem.exact(), atol=1e-7)
    assert np.unique(np.round(problem.planner.values, 6)).size > 5, "a problem without interest"


def test_passes_over_the_grid_reach_the_same_values_and_a_few_leave_the_rest_of_the_work_queued():
    problem = Problem((3, 2), 0, gamma=0.95, max_value=5.0)
    problem.learn(walk(1, 80), max_backups=0)
    problem.planner.sweep_all(2)
    assert problem.planner.n_queued > 0
    problem.plan()
    exact = problem.exact()
    np.testing.assert_allclose(problem.planner.values, exact, atol=1e-7)
    problem.planner.restore(np.where(problem.optimistic, 5.0, exact - 3.0))
    problem.planner.sweep_all(10_000)
    assert problem.planner.n_queued == 0
    np.testing.assert_allclose(problem.planner.values, exact, atol=1e-7)


def test_a_pair_that_has_lost_its_instances_is_worth_max_value_again():
    problem, lost = Problem((3,), 0, gamma=0.9, max_value=2.0, max_instances=2), 0
    known = problem.model.known.copy()
    for transition in walk(2, 40, 1):
        problem.update(transition)
        lost += int((known & ~problem.model.known).sum())
        known = problem.model.known.copy()
        np.testing.assert_allclose(problem.planner.values, values_of_rows(problem), atol=1e-8)
    assert lost > 0


def values_of_rows(problem, optimistic=True, upper=np.inf):
    """Value iteration on the rows of the finite MDP.

    :param optimistic: False: without optimistic pairs; a point that has no other takes the least value of its neighbours
    :param upper: bounds of the points' values, besides ``max_value``
    """
    arrays, n = problem.model.mdp.arrays, problem.model.grid.n_points
    low, high = problem.planner.bounds
    upper = np.minimum(np.broadcast_to(upper, n), high)
    values = problem.planner.values.copy() if not optimistic else upper.copy()
    for _ in range(2000):
        backed_up = values.copy()
        for point in range(n):
            q = [low]
            for pair in (point, n + point):
                if arrays.modelled[pair]:
                    to, weight = arrays.rows.entries(pair)
                    q.append(arrays.reward[pair] + weight @ values[to])
                elif optimistic:
                    q.append(np.inf)
            backed_up[point] = min(max(q), upper[point])
            if not optimistic and len(q) == 1:
                backed_up[point] = min(values[neighbour] for neighbour in neighbours_of(point, problem.model.grid))
        if np.abs(backed_up - values).max() < 1e-12:
            return backed_up
        values = backed_up
    raise AssertionError("value iteration did not converge")


@settings(deadline=None, derandomize=True, max_examples=6)
@given(
    st.integers(0, 10**6), st.integers(0, 40), st.lists(st.sampled_from(["lower", "raise", "none"]), min_size=1, max_size=4)
)
def test_values_are_bounded_by_what_is_given_and_optimistic_ones_are_that(seed, n, changes):
    """However bounds come, fall and rise between transitions: exactly, as from the beginning with the last of them."""
    rng, problem = np.random.default_rng(seed), Problem((3,), 1, gamma=0.9, max_value=2.0)
    for k, change in enumerate(changes):
        for transition in walk(seed + k, n, 1):
            problem.update(transition)
        lowest, highest = {"lower": (-6.0, 0.0), "raise": (-2.0, 3.0), "none": (np.inf, np.inf)}[change]
        upper = None if change == "none" else rng.uniform(lowest, highest, problem.model.grid.n_points)
        problem.planner.set_upper(upper)
        problem.plan()
        np.testing.assert_allclose(problem.planner.values, values_of_rows(problem, upper=np.inf if upper is None else upper))
        optimistic = problem.model.mdp.arrays.n_optimistic > 0
        np.testing.assert_array_equal(problem.planner.values[optimistic], problem.planner.upper[optimistic])
        problem.planner.set_upper(None if upper is None else upper.copy())
        assert problem.planner.n_queued == 0, "the same bounds again leave the queue alone"
        assert problem.planner.upper.max() <= 2.0


@pytest.mark.parametrize("upper", [np.zeros(3), np.zeros((11, 1)), 0.0, np.full(11, np.nan)])
def test_bounds_that_are_not_one_number_a_point_are_refused(upper):
    problem = Problem((3,), 1, gamma=0.9, max_value=2.0)
    assert problem.model.grid.n_points == 11
    with pytest.raises(ValueError, match=r"value_bound\(\) must return None or a finite number for each of the 11 states"):
        problem.planner.set_upper(upper)


def neighbours_of(point, grid):
    """Points one step along one axis away."""
    points = np.arange(grid.n_points).reshape(grid.arrays.shape)
    at = np.unravel_index(point, points.shape)
    for axis, n in enumerate(points.shape):
        for step in (-1, 1):
            if 0 <= at[axis] + step < n or grid.arrays.periodic[axis]:
                yield points[tuple((c + step * (k == axis)) % points.shape[k] for k, c in enumerate(at))]


@pytest.mark.parametrize(
    ("resolution", "seed", "n", "periodic"), [((4,), 0, 4, None), ((3, 3), 1, 14, None), ((3, 3), 1, 14, (False, True))]
)
def test_exploitation_values_are_those_of_the_modelled_pairs_alone(resolution, seed, n, periodic):
    problem = Problem(resolution, 0, gamma=0.9, max_value=2.0, tolerance=1e-12, periodic=periodic)
    for transition in walk(seed, n, len(resolution)):
        problem.update(transition)
    modelled = problem.model.mdp.arrays.n_optimistic < N_ACTIONS
    assert 0 < modelled.sum() < len(modelled), "points with a model and points without"
    before, values = problem.planner.values.copy(), problem.planner.exploitation_values()
    np.testing.assert_allclose(values, values_of_rows(problem, optimistic=False), atol=1e-5)
    assert (values <= before + 1e-9).all() and (values < before).any()
    np.testing.assert_array_equal(problem.planner.values, before)


def test_bounded_work_leaves_the_rest_queued_and_later_calls_finish_it():
    bounded, unbounded = Problem((3, 2), 0, gamma=0.95), Problem((3, 2), 0, gamma=0.95)
    transitions = list(walk(1, 90))
    for transition in transitions:
        pairs, backups = bounded.update(transition, 3)
        assert backups <= len(pairs) + 3
    unbounded.learn(transitions)
    assert bounded.planner.n_queued > 0
    assert np.abs(bounded.planner.values - unbounded.planner.values).max() > 1e-3, "there is work left"
    calls = 0
    while bounded.planner.n_queued:
        assert 0 < bounded.plan(50) <= 50
        calls += 1
        assert calls < 10_000
    assert calls > 1
    np.testing.assert_allclose(bounded.planner.values, unbounded.planner.values, atol=1e-8)
    np.testing.assert_allclose(bounded.planner.values, unbounded.exact(), atol=1e-7)
    assert bounded.plan(50) == 0, "nothing is left to do"


def test_the_points_around_the_agent_are_backed_up_at_once():
    """With no backups left for the queue, the points around a state still take up what was propagated to them."""
    problem = Problem((3, 2), 0, gamma=0.95)
    problem.learn(walk(1, 90), max_backups=0)
    changed = problem.planner.values.copy()
    backups = problem.planner.update(np.empty(0, dtype=np.int64), 0, around=np.array([0.55, 0.4]))
    corners = list(problem.naive.grid.corners(np.array([0.55, 0.4])))
    assert 0 < backups <= len(corners)
    changed = np.flatnonzero(changed != problem.planner.values)
    assert len(changed) > 0 and set(changed) <= set(corners)


def test_restored_values_converge_to_the_same_as_before():
    problem = Problem((3, 2), 1, gamma=0.95, max_value=5.0)
    problem.learn(walk(3, 100))
    expected = problem.planner.values.copy()
    problem.planner.restore(expected + np.random.default_rng(0).normal(size=len(expected)))
    assert problem.planner.values.max() <= 5.0, "values are cut to their bounds"
    assert problem.planner.n_queued == (problem.model.mdp.arrays.n_optimistic == 0).sum() > 0
    problem.plan()
    backed_up = problem.model.mdp.arrays.n_optimistic == 0
    problem.planner.values[~backed_up] = expected[~backed_up]
    problem.planner.restart()
    problem.plan()
    np.testing.assert_allclose(problem.planner.values, expected, atol=1e-7)


def test_a_change_up_to_the_tolerance_is_not_propagated_and_costs_no_more_than_that():
    gamma, tolerance = 0.9, 0.1
    problem = Problem((3, 2), 0, gamma, tolerance=tolerance)
    problem.learn(walk(4, 90))
    exact = problem.exact()
    error = np.abs(problem.planner.values - exact).max()
    # A successor may have moved by the tolerance since it was last propagated, and was as far from that when last used.
    assert error <= 2 * tolerance * gamma / (1 - gamma)
    assert error > 1e-6, "with such a tolerance the values cannot be exact"
    precise = Problem((3, 2), 0, gamma, tolerance=1e-11)
    precise.learn(walk(4, 90))
    assert np.abs(precise.planner.values - exact).max() < error


def test_values_never_leave_their_bounds():
    problem = Problem((2, 2), 0, gamma=1.0)
    for state, action, _, _, _ in walk(0, 80):
        problem.update((state, action, -1.0, state, False))  # leads nowhere
    modelled = problem.model.mdp.arrays.n_optimistic == 0
    assert modelled.any()
    np.testing.assert_array_equal(problem.planner.values[modelled], MIN_VALUE)
    problem = Problem((2, 2), 0, gamma=1.0)
    for state, action, _, _, _ in walk(0, 80):
        problem.update((state, action, 1.0, state, False))
    np.testing.assert_array_equal(problem.planner.values, 0.0)


# Where an interpolated value is too high and visits bring no progress, corrections cap it: the parts, through Q at states.
GRID = StateGrid(2, 3, 0)
LAST = 8  # the last grid coordinate of each axis
Q = QValues(1, 2)
BOUNDS = (-1e6, 1e6)


def function_of(values, corrections):
    return values, tuple(corrections), GRID.plain, 1.0, BOUNDS, np.full(GRID.n_points, BOUNDS[1])


def visit(values, corrections, state, best_q, episode=0, times=1, tolerance=0.05, max_visits=MAX_VISITS):
    """Visit a state whose only action ends the episode with a reward of ``best_q``; the corrections, with more room."""
    prediction = Prediction.empty(1, 0, 2)
    prediction.modelled[0], prediction.reward[0] = True, best_q
    for _ in range(times):
        corrections = corrections.with_room()
        visitor = (episode, tolerance, max_visits)
        Q.compute(prediction, np.asarray(state, dtype=float), function_of(values, corrections), visitor)
        assert Q.q[0] == best_q
    return corrections


def value_at(values, corrections, state):
    """The value of a state: Q of an action that leads there without a reward."""
    elsewhere = np.array([0.5, 0.5]) if np.abs(np.asarray(state) - 0.5).max() > 0.1 else np.zeros(2)
    prediction = Prediction.empty(1, 1, 2)
    prediction.modelled[0], prediction.length[0], prediction.probability[0, 0] = True, 1, 1.0
    prediction.effect[0, 0] = np.asarray(state) - elsewhere
    Q.compute(prediction, elsewhere, function_of(values, corrections))
    return float(Q.q[0])


def key_of(state, corrections):
    """The number of the small cell around a state; the corrections are used for it, and emptied again."""
    corrections = visit(np.zeros(GRID.n_points), corrections, state, -1.0, max_visits=0)
    [row] = corrections.rows()
    corrections.table.fill(-1)
    corrections.n_states[0] = 0
    return int(row[0])


def naive_cell(state):
    """The small cell around a state, one number a variable."""
    return tuple(np.floor(np.clip(np.asarray(state) * LAST, 0, LAST) * CELLS_PER_GRID_CELL + CELL_OFFSET).astype(int).tolist())


@settings(deadline=None, derandomize=True, max_examples=15)
@given(st.integers(0, 10**6), st.integers(1, 400), st.integers(0, 5))
def test_corrections_are_found_by_their_cells_as_the_table_grows(seed, n, capacity):
    """Compared with a dict: the last state visited in a cell, and its best action value."""
    rng = np.random.default_rng(seed)
    values, corrections, expected = np.zeros(GRID.n_points), CorrectionArrays.empty(2, 2**capacity), {}
    for state in rng.random((n, 2)):
        best_q = -float(rng.random()) - 0.1
        corrections = visit(values, corrections, state, best_q, max_visits=0)
        expected[naive_cell(state)] = (best_q, *state)
    rows = corrections.rows()
    assert len(rows) == len(expected) <= len(corrections.key) < len(corrections.table)
    assert {tuple(row[1:]) for row in rows} == set(expected.values())
    for state in rng.random((50, 2)):
        cap, *_ = expected.get(naive_cell(state), (0.0,))
        assert value_at(values, corrections, state) == pytest.approx(cap)


def test_corrections_come_back_from_their_rows():
    rng = np.random.default_rng(0)
    values, corrections = -10.0 * rng.random(GRID.n_points), CorrectionArrays.empty(2)
    for state in rng.random((400, 2)):
        corrections = visit(values, corrections, state, -20.0 - float(rng.random()), max_visits=0)
    again = CorrectionArrays.of_rows(corrections.rows())
    # Of rows with the same key the last one counts.
    last = CorrectionArrays.of_rows(np.vstack([corrections.rows()[:5] - [0.0, 1000.0, 0.0, 0.0], corrections.rows()]))
    np.testing.assert_array_equal(again.rows(), corrections.rows())
    for state in rng.random((200, 2)):
        assert value_at(values, again, state) == value_at(values, last, state) == value_at(values, corrections, state)


def test_small_cells_are_smaller_than_grid_cells_and_do_not_share_numbers():
    axis, corrections = np.linspace(0.0, LAST, LAST * 3 * 4 + 1), CorrectionArrays.empty(2)
    by_cell = {}
    for x in axis:
        for y in axis:
            by_cell.setdefault(key_of((x / LAST, y / LAST), corrections), []).append((x, y))
    assert 24**2 <= len(by_cell) <= 25**2
    for positions in by_cell.values():
        assert np.ptp(np.array(positions), axis=0).max() < 1 / 3 + 1e-9
    assert key_of((-5.0, 9.0), corrections) == key_of((0.0, 1.0), corrections), "what is outside counts as the edge"
    for at in (0.0, 1.0, 2.0, 7.0, 8.0, 1 / 3, 0.4, 0.5, 2.4):
        keys = {key_of(((at + error) / LAST, 1.0), corrections) for error in (-1e-12, 0.0, 1e-12)}
        assert len(keys) == 1, "a rounding error at a round number"


def test_nothing_is_corrected_before_max_visits():
    values, state = np.zeros(GRID.n_points), (0.3, 0.4)
    corrections = visit(values, CorrectionArrays.empty(2), state, -3.0, times=MAX_VISITS)
    assert value_at(values, corrections, state) == 0.0
    corrections = visit(values, corrections, state, -3.0)
    assert value_at(values, corrections, state) == pytest.approx(-3.0)


def test_visits_are_counted_by_episode_and_cell():
    values, corrections = np.zeros(GRID.n_points), CorrectionArrays.empty(2)
    for episode in range(4 * MAX_VISITS):
        corrections = visit(values, corrections, (0.3, 0.4), -3.0, episode)
    assert len(corrections.rows()) == 0
    for k in range(4 * MAX_VISITS):
        corrections = visit(values, corrections, (0.3, k / (4 * MAX_VISITS)), -3.0, episode=1000)
    assert len(corrections.rows()) == 0


def test_a_value_that_is_not_too_high_is_not_corrected():
    values = np.full(GRID.n_points, -2.0)
    corrections = visit(values, CorrectionArrays.empty(2), (0.3, 0.4), -2.04, times=5 * MAX_VISITS)
    assert len(corrections.rows()) == 0
    corrections = visit(values, corrections, (0.3, 0.4), -1.0, times=5 * MAX_VISITS)
    assert len(corrections.rows()) == 0
    # Nor is any when the agent is not there, as for a prediction.
    corrections = visit(values, CorrectionArrays.empty(2), (0.3, 0.4), -30.0, episode=-1, times=3 * MAX_VISITS)
    assert len(corrections.rows()) == 0 and not corrections.visits.any()


def test_a_correction_counts_in_its_cell_only_and_never_raises_a_value():
    rng = np.random.default_rng(0)
    values, corrected = -10.0 * rng.random(GRID.n_points), np.array([0.3, 0.4])
    corrections = visit(values, CorrectionArrays.empty(2), corrected, -30.0, times=MAX_VISITS + 1)
    lowered = 0
    for state in [*rng.random((500, 2)), *(corrected + rng.uniform(-0.02, 0.02, (50, 2)))]:
        plain = GRID.interpolate(values, state)
        if naive_cell(state) == naive_cell(corrected):
            assert value_at(values, corrections, state) == pytest.approx(plain - 30.0 - GRID.interpolate(values, corrected))
            lowered += 1
        else:
            assert value_at(values, corrections, state) == pytest.approx(plain)
    assert lowered > 10
    # Once the grid's own value is lower than the correction, the correction has no effect.
    values[:] = -50.0
    assert value_at(values, corrections, corrected) == pytest.approx(-50.0)
