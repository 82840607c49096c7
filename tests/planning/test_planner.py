"""The planner against value iteration on the same finite MDP, staying included."""

import numpy as np
import pytest
from helpers.kernel_models import N_ACTIONS, learn, make_model
from helpers.naive_fitted_rmax import NaiveFittedRMax
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.planning.planner import Planner

KERNEL = dict(breadth=0.35, min_weight=0.01, min_fraction=0.13)
MIN_VALUE, MANY = -60.0, 10_000


def walk(seed, n, n_variables=2, goal=0.8, noise=False):
    """Steps about the box; those that end near the upper corner end the episode."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        state, action = rng.random(n_variables), int(rng.integers(N_ACTIONS))
        next_state = np.clip(state + rng.normal((0.12 if action else -0.12), 0.05, n_variables), 0.0, 1.0)
        reward = float(rng.normal()) if noise else -1.0
        yield state, action, reward, next_state, bool((next_state > goal).all())


def planned(grid=((3,), 1), seed=1, n=80, gamma=0.9, max_value=2.0, tolerance=1e-12, noise=True, follows_changes=False):
    """A planner of a model that has learned a walk."""
    model = make_model(grid, KERNEL, gamma)
    learn(model, walk(seed, n, len(grid[0]), noise=noise))
    return planner_of(model, max_value, tolerance, follows_changes)


def planner_of(model, max_value=2.0, tolerance=1e-12, follows_changes=False):
    arguments = {"tolerance": tolerance, "follows_changes": follows_changes}
    return Planner(model.mdp, max_value=max_value, min_value=MIN_VALUE, **arguments)


def values_of_rows(planner, upper=np.inf, optimism=True):
    """Value iteration on the rows of the finite MDP.

    :param upper: bounds of the points' values, besides ``max_value``
    :param optimism: False: only pairs that have a model count
    """
    mdp, (low, high) = planner.mdp, planner.bounds
    arrays, n = mdp.arrays, mdp.grid.n_points
    upper = np.minimum(np.broadcast_to(upper, n), high)
    values = upper.copy() if optimism else np.full(n, low)
    for _ in range(20_000):
        backed_up = values.copy()
        for point in range(n):
            q = [low]
            for action in range(mdp.n_actions):
                if arrays.modelled[action * n + point]:
                    length = arrays.length[point, action]
                    to, weight = arrays.to[point, action, :length], arrays.weight[point, action, :length]
                    q.append(arrays.reward[point, action] + weight @ values[to])
                elif optimism:
                    q.append(np.inf)
            backed_up[point] = min(max(q), upper[point])
        if np.abs(backed_up - values).max() < 1e-12:
            return backed_up
        values = backed_up
    raise AssertionError("value iteration did not converge")


@pytest.mark.parametrize(
    ("grid", "gamma", "max_value"),
    [
        *[(((4,), 0), 0.97, 10.0), (((1, 2, 1), 0), 0.8, 3.0), (((2, 2), 1), 1.0, 0.0)],
        (((2, 3), 0, (False, True)), 0.9, 5.0),
    ],
)
def test_sweeps_converge_to_the_values_of_exact_value_iteration(grid, gamma, max_value):
    planner = planned(grid, 1, 80, gamma, max_value, noise=gamma < 1.0)
    sweeps = planner.sweep(MANY)
    assert 2 < sweeps < 1000 and planner.sweep(MANY) <= 2
    naive = NaiveFittedRMax(
        *grid[:2], N_ACTIONS, KERNEL, gamma=gamma, max_value=max_value, periodic=grid[2] if len(grid) > 2 else None
    )
    for transition in walk(1, 80, len(grid[0]), noise=gamma < 1.0):
        naive.add(*transition)
    modelled = planner.mdp.arrays.modelled.reshape(naive.known.shape)
    assert modelled[naive.known].all()
    naive.known[:] = modelled
    np.testing.assert_allclose(planner.values, naive.optimal_values(MIN_VALUE), atol=1e-7)
    np.testing.assert_allclose(planner.values, values_of_rows(planner), atol=1e-7)
    assert np.unique(np.round(planner.values, 6)).size > 5, "a problem without interest"


def test_few_sweeps_leave_work_that_later_ones_finish_and_the_number_is_returned():
    planner, other = planned(((3, 2), 0), gamma=0.95), planned(((3, 2), 0), gamma=0.95)
    assert planner.sweep(0) == 0 and (planner.values == 2.0).all()
    n = planner.sweep(MANY)
    assert n > 4 and other.sweep(2) == 2
    other.sweep(MANY)
    np.testing.assert_allclose(planner.values, other.values, atol=1e-9)


def test_sweeps_end_when_no_value_changes_by_more_than_the_tolerance():
    rough, precise = (planned(((3, 2), 0), tolerance=tolerance) for tolerance in (0.1, 1e-12))
    assert rough.sweep(MANY) < precise.sweep(MANY)
    # What is left is a tenth, discounted for ever.
    assert 1e-6 < np.abs(rough.values - precise.values).max() <= 0.1 * 0.9 / (1.0 - 0.9)


CHANGED_GRIDS = [((6,), 0), ((5, 4), 0), ((4, 5), 0, (True, False)), ((3, 3, 4), 0, (False, True, False))]
CHANGES = ["learn", "learn", "upper", "worth", "max", "lowest", "restore"]


def short_steps(seed, n, n_variables):
    """Steps about the box and out of it, one as long as the other: all rows lead as far as any."""
    for state, action, reward, _, terminated in walk(seed, n, n_variables, noise=True):
        yield state, action, reward, state + (0.03 if action else -0.03), terminated


def narrow_model(grid, gamma):
    """A model few points of which are changed by a transition, which may lose an old one to it."""
    model = make_model(grid, {**KERNEL, "breadth": 0.08}, gamma, max_instances=150)
    learn(model, short_steps(0, 300, len(grid[0])))
    return model


def change_both(change, rng, planners, models, seed):
    """Change the same of each planner and model."""
    grid = models[0].grid
    numbers, some = rng.uniform(-6.0, 2.0, grid.n_points), rng.random(grid.n_points) < 0.02
    for planner, model in zip(planners, models, strict=True):
        if change == "learn":
            learn(model, short_steps(seed, 1, grid.n_variables))
        elif change == "upper":
            planner.set_upper(np.where(some, numbers, 2.0))
        elif change == "worth":
            planner.set_worth(np.where(some, np.minimum(numbers, planner.upper), planner.worth))
        elif change == "max":
            planner.set_max_value(float(numbers[0]) + 2.0)
        elif change == "lowest":
            planner.bounds = planner.bounds[0] - 3.0, planner.bounds[1]
        else:
            planner.restore(np.where(some, numbers, planner.values))


@settings(deadline=None, derandomize=True, max_examples=30)
@given(
    st.integers(0, 10**6),
    st.sampled_from(CHANGED_GRIDS),
    st.lists(st.tuples(st.sampled_from(CHANGES), st.sampled_from([1, 2, MANY])), min_size=1, max_size=12),
)
def test_sweeps_that_follow_all_changes_find_what_sweeps_over_all_points_find(seed, grid, changes):
    """With a tolerance of 0 to the last bit, however rows, bounds and values change in between."""
    rng, models = np.random.default_rng(seed), [narrow_model(grid, 0.5) for _ in range(2)]
    planners = [planner_of(model, 2.0, 0.0, k == 1) for k, model in enumerate(models)]
    for k, (change, n) in enumerate([("learn", MANY), *changes]):
        change_both(change, rng, planners, models, seed + k)
        assert len({planner.sweep(n) for planner in planners}) == 1
        np.testing.assert_array_equal(planners[0].values, planners[1].values)


@settings(deadline=None, derandomize=True, max_examples=12)
@given(st.integers(0, 10**6), st.sampled_from(CHANGED_GRIDS[:3]), st.sampled_from([1e-2, 1e-6]))
def test_what_changes_leave_out_is_within_the_tolerance(seed, grid, tolerance):
    rng, model = np.random.default_rng(seed), narrow_model(grid, 0.9)
    planner = planner_of(model, 2.0, tolerance, follows_changes=True)
    for k in range(12):
        change_both(CHANGES[k % len(CHANGES)], rng, [planner], [model], seed + k)
        planner.sweep(MANY)
    planner.set_worth(None)
    planner.sweep(MANY)
    # A value may have changed by so much without being passed on, and so may what it was backed up from, discounted for ever.
    left = np.abs(planner.values - values_of_rows(planner, planner.upper)).max()
    assert left <= 2 * tolerance / (1.0 - 0.9)


def test_points_on_which_no_change_bears_are_left_out():
    model = narrow_model(((6,), 0), 0.9)
    planner = planner_of(model, follows_changes=True)
    planner.sweep(MANY)
    changed, span = model.mdp.arrays.changed, model.mdp.arrays.span[0]
    assert not changed.any() and 1 < span < 8
    # Nobody looks at a value that nothing has changed.
    planner.values[0] = wrong = -50.0
    learn(model, [(np.array([0.95]), 0, 1.0, np.array([0.97]), False)])
    assert 0 < changed.sum() < 20
    planner.sweep(1)
    assert planner.values[0] == wrong
    planner.restore(planner.values)
    planner.sweep(MANY)
    np.testing.assert_allclose(planner.values, values_of_rows(planner), atol=1e-9)


@settings(deadline=None, derandomize=True, max_examples=12)
@given(
    st.integers(0, 10**6), st.integers(0, 40), st.lists(st.sampled_from(["lower", "raise", "none"]), min_size=1, max_size=4)
)
def test_values_are_bounded_by_what_is_given_and_optimistic_ones_are_that(seed, n, changes):
    """However bounds come, fall and rise between transitions: exactly, as from the beginning with the last of them."""
    rng, model = np.random.default_rng(seed), make_model(((3,), 1), KERNEL, 0.9)
    planner = Planner(model.mdp, max_value=2.0, min_value=MIN_VALUE, tolerance=1e-12)
    optimistic = model.mdp.arrays.n_optimistic
    for k, change in enumerate(changes):
        learn(model, walk(seed + k, n, 1))
        lowest, highest = {"lower": (-6.0, 0.0), "raise": (-2.0, 3.0), "none": (np.inf, np.inf)}[change]
        upper = None if change == "none" else rng.uniform(lowest, highest, model.grid.n_points)
        planner.set_upper(upper)
        assert (planner.values <= planner.upper).all() and planner.upper.max() <= 2.0
        assert planner.is_bounded == (upper is not None)
        np.testing.assert_array_equal(planner.values[optimistic > 0], planner.upper[optimistic > 0])
        planner.sweep(MANY)
        expected = values_of_rows(planner, upper=np.inf if upper is None else upper)
        np.testing.assert_allclose(planner.values, expected, atol=1e-9)
        np.testing.assert_array_equal(planner.values[optimistic > 0], planner.upper[optimistic > 0])


@settings(deadline=None, derandomize=True, max_examples=12)
@given(st.integers(0, 10**6), st.integers(0, 60), st.sampled_from([1.0, 0.9]))
def test_while_searching_each_point_has_the_worth_it_is_given_and_what_the_ways_to_others_leave_of_theirs(seed, n, gamma):
    planner = planned(((3,), 1), seed, n, gamma, max_value=0.0, noise=False)
    worth = -np.random.default_rng(seed).uniform(0.0, 2.0 * -MIN_VALUE, planner.mdp.grid.n_points)
    planner.set_worth(worth)
    planner.sweep(MANY)
    arrays, n_points = planner.mdp.arrays, len(worth)
    own = np.maximum(worth, MIN_VALUE)
    expected = own.copy()
    for _ in range(1_000):
        for point in range(n_points):
            for action in range(N_ACTIONS):
                if arrays.modelled[action * n_points + point]:
                    ways = range(arrays.length[point, action])
                    after = sum(arrays.weight[point, action, k] * expected[arrays.to[point, action, k]] for k in ways)
                    expected[point] = min(0.0, max(expected[point], arrays.reward[point, action] + after))
    np.testing.assert_allclose(planner.values, expected, atol=1e-6)
    assert n < 20 or (planner.values > own).any(), "a problem without interest"
    # Bounds that come again do not undo what sweeps have found.
    found = planner.values.copy()
    planner.set_upper(None)
    np.testing.assert_array_equal(planner.values, found)
    planner.set_worth(None)
    planner.sweep(MANY)
    np.testing.assert_allclose(planner.values, values_of_rows(planner), atol=1e-6)


@pytest.mark.parametrize("upper", [np.zeros(3), np.zeros((11, 1)), 0.0, np.full(11, np.nan)])
def test_bounds_that_are_not_one_number_a_point_are_refused(upper):
    planner = planned(n=0)
    assert planner.mdp.grid.n_points == 11
    with pytest.raises(ValueError, match=r"value_bound\(\) must return None or a finite number for each of the 11 states"):
        planner.set_upper(upper)


@pytest.mark.parametrize("max_value", [-0.5, 5.0])
def test_another_max_value_changes_what_is_optimistic_at_once_and_the_rest_by_sweeps(max_value):
    planner = planned(n=9)
    planner.sweep(MANY)
    upper = np.where(np.arange(11) == 8, 1.0, np.inf).clip(max=2.0)
    for bounds in (None, upper):
        planner.set_upper(bounds)
        planner.set_max_value(max_value)
        optimistic = planner.mdp.arrays.n_optimistic > 0
        assert 0 < optimistic.sum() < 11 and planner.bounds == (MIN_VALUE, max_value)
        np.testing.assert_array_equal(planner.values[optimistic], planner.upper[optimistic])
        expected = np.full(11, max_value) if bounds is None else np.where(np.arange(11) == 8, min(1.0, max_value), max_value)
        np.testing.assert_array_equal(planner.upper, expected)
        planner.sweep(MANY)
        np.testing.assert_allclose(planner.values, values_of_rows(planner, planner.upper), atol=1e-9)
        planner.set_max_value(2.0)


@pytest.mark.parametrize(("grid", "n"), [(((4,), 0), 4), (((3, 3), 0), 14), (((3, 3), 0, (False, True)), 14)])
def test_cautious_values_are_those_of_the_modelled_pairs_alone_and_come_from_below(grid, n):
    planner = planned(grid, seed=1, n=n)
    planner.sweep(MANY)
    before, exact = planner.values.copy(), values_of_rows(planner, optimism=False)
    lower = np.full(len(before), MIN_VALUE)
    for max_sweeps in (0, 1, 3, MANY):
        values = planner.cautious_values(max_sweeps)
        assert (values >= lower - 1e-12).all() and (values <= exact + 1e-9).all()
        lower = values
    np.testing.assert_allclose(lower, exact, atol=1e-9)
    nothing = ~planner.mdp.arrays.modelled.reshape(N_ACTIONS, -1).any(axis=0)
    assert nothing.any() and (lower[nothing] == MIN_VALUE).all()
    assert (lower <= before + 1e-9).all() and (lower < before).any()
    np.testing.assert_array_equal(planner.values, before)


def test_restored_values_are_cut_to_their_bounds_and_converge_to_the_same_as_before():
    planner = planned(((3, 2), 1), seed=3, n=100, gamma=0.95)
    planner.sweep(MANY)
    expected = planner.values.copy()
    planner.restore(expected)
    np.testing.assert_array_equal(planner.values, expected)
    planner.restore(expected + 100.0 * np.random.default_rng(0).normal(size=len(expected)))
    assert planner.values.max() <= 2.0 and planner.values.min() >= MIN_VALUE
    planner.sweep(MANY)
    np.testing.assert_allclose(planner.values, expected, atol=1e-7)


@pytest.mark.parametrize(
    ("resolution", "breadth", "room", "transitions", "follows_changes"),
    [(3, 0.35, 2, list(walk(2, 40, 1)), False), (6, 0.08, 12, list(short_steps(2, 90, 1)), True)],
)
def test_a_pair_that_has_lost_its_instances_is_worth_max_value_again(resolution, breadth, room, transitions, follows_changes):
    model, lost = make_model(((resolution,), 0), {**KERNEL, "breadth": breadth}, 0.9, max_instances=room), 0
    planner = planner_of(model, follows_changes=follows_changes)
    for transition in transitions:
        known = model.known.copy()
        learn(model, [transition])
        lost += int((known & ~model.known).sum())
        planner.sweep(MANY)
        np.testing.assert_allclose(planner.values, values_of_rows(planner), atol=1e-8)
    assert lost > 0


@pytest.mark.parametrize(("reward", "expected"), [(-1.0, MIN_VALUE), (1.0, 2.0)])
def test_values_of_pairs_that_lead_nowhere_are_their_bounds(reward, expected):
    model = make_model(((2, 2), 0), KERNEL)
    learn(model, [(state, action, reward, state, False) for state, action, _, _, _ in walk(0, 80)])
    planner = Planner(model.mdp, max_value=2.0, min_value=MIN_VALUE, tolerance=1e-12)
    planner.sweep(MANY)
    modelled = model.mdp.arrays.n_optimistic == 0
    assert modelled.any() and (planner.values[modelled] == expected).all() and (planner.values[~modelled] == 2.0).all()
