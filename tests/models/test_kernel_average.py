"""The kernel average on the grid against its definition: lists of kept instances, what is known, rows."""

import numpy as np
import pytest
from helpers.kernel_models import (
    GRIDS,
    KERNELS,
    N_ACTIONS,
    add_instances,
    assert_same_row,
    learn,
    learn_both,
    make_model,
    model_and_definition,
    pairs_of,
    random_transitions,
    row_of,
    without_staying,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.kernel_average import MIN_CHANGE

slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=30)
problems = st.tuples(
    st.sampled_from(GRIDS), st.sampled_from(KERNELS), st.integers(0, 10**6), st.integers(1, 40), st.sampled_from([1.0, 0.9])
)


@slow_and_repeatable
@given(problems)
def test_the_grid_of_a_kernel_average_is_the_one_of_the_definition(problem):
    model, naive = model_and_definition(*problem[:2])
    np.testing.assert_allclose(model.grid.points(), [naive.grid.unit(p) for p in range(naive.n_points)], atol=1e-15)


@slow_and_repeatable
@given(problems)
def test_every_list_has_the_instances_that_min_weight_and_min_fraction_keep(problem):
    grid, kernel, seed, n, _ = problem
    model, naive = model_and_definition(grid, kernel)
    learn_both(model, naive, random_transitions(seed, len(grid[0]), n))
    for action, point, pair in pairs_of(naive):
        expected = naive.list_of(action, point)
        index, weight = model.arrays.lists.entries(pair)
        assert list(index) == [number for number, _ in expected]
        np.testing.assert_allclose(weight, [w for _, w in expected], rtol=1e-9)
        assert model.own_weight[pair] == pytest.approx(sum(w for _, w in expected), rel=1e-9)


@slow_and_repeatable
@given(problems)
def test_a_pair_is_known_from_the_first_time_that_its_weights_reach_the_threshold(problem):
    grid, kernel, seed, n, _ = problem
    model, naive = model_and_definition(grid, kernel)
    for transition in random_transitions(seed, len(grid[0]), n):
        learn_both(model, naive, [transition])
        np.testing.assert_array_equal(model.known.reshape(N_ACTIONS, -1), naive.known)
    np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
    np.testing.assert_array_equal(model.mdp.arrays.n_optimistic, (~naive.known).sum(axis=0))


@slow_and_repeatable
@given(problems)
def test_a_transition_changes_the_rows_of_the_pairs_that_add_returns_and_of_no_others(problem):
    grid, kernel, seed, n, gamma = problem
    model, _ = model_and_definition(grid, kernel, gamma)
    *before, last = random_transitions(seed, len(grid[0]), n + 1)
    learn(model, before)
    changed = model.add(*last)
    model.update_rows(changed)
    partial = [(model.mdp.arrays.reward[pair], row_of(model.mdp, pair)) for pair in range(len(model.known))]
    model.update_all_rows()
    complete = [(model.mdp.arrays.reward[pair], row_of(model.mdp, pair)) for pair in range(len(model.known))]
    assert partial == complete
    assert len(np.unique(changed)) == len(changed) and (changed // model.grid.n_points == last[1]).all()


def test_a_pair_stays_known_when_a_nearer_instance_shortens_its_list_below_the_threshold():
    model, naive = model_and_definition(((1,), 0), dict(breadth=0.5, min_weight=0.01, min_fraction=0.6))
    pair = 1  # the grid point 0.5, action 0
    learn_both(model, naive, [(np.array([0.1]), 0, -1.0, np.array([0.2]), False)] * 2)
    assert model.known[pair] and model.own_weight[pair] > 1.0
    learn_both(model, naive, [(np.array([0.45]), 0, -2.0, np.array([0.95]), False)])
    assert model.own_weight[pair] < 1.0, "the case that this test is about"
    assert model.known[pair] and model.mdp.arrays.modelled[pair]
    assert model.mdp.arrays.reward[pair] == pytest.approx(-2.0), "its row is that of the instance now kept"


@slow_and_repeatable
@given(problems)
def test_rows_are_the_averaged_relative_effects_with_staying_summed_up(problem):
    grid, kernel, seed, n, gamma = problem
    model, naive = model_and_definition(grid, kernel, gamma)
    learn_both(model, naive, random_transitions(seed, len(grid[0]), n))
    for action, point, pair in pairs_of(naive):
        if not naive.known[action, point]:
            assert row_of(model.mdp, point, action) == {}
            continue
        reward, successors = without_staying(*naive.row(action, point), point, gamma)
        assert model.mdp.arrays.reward[pair] == pytest.approx(reward, rel=1e-9, abs=1e-9)
        assert_same_row(row_of(model.mdp, point, action), successors)


def model_of_one_variable(margin=0, gamma=1.0, **kernel):
    model, _ = model_and_definition(((2,), margin), dict(breadth=0.2, min_weight=0.01, min_fraction=0.01) | kernel, gamma)
    return model


def add_twice(model, state, effect, reward=-1.0, terminated=False):
    state = np.array([state])
    learn(model, [(state, 0, reward, state + effect, terminated)] * 2)


def test_an_instance_that_ended_its_episode_adds_reward_and_no_successor():
    model = model_of_one_variable()
    add_twice(model, 0.5, 0.25)
    assert row_of(model.mdp, 2) == pytest.approx({3: 1.0})
    add_twice(model, 0.5, 0.25, reward=5.0, terminated=True)
    assert row_of(model.mdp, 2) == pytest.approx({3: 0.5}), "half of the probability ends with value 0"
    assert model.mdp.arrays.reward[2] == pytest.approx(2.0)


@pytest.mark.parametrize(("margin", "edge"), [(0, 4), (1, 6)])
def test_successors_beyond_the_grid_count_as_its_edge(margin, edge):
    model = model_of_one_variable(margin)
    add_twice(model, 0.75, 3.0)
    assert row_of(model.mdp, 3 + margin) == pytest.approx({edge: 1.0})


def test_a_margin_gives_states_outside_the_box_a_point_of_their_own():
    model = model_of_one_variable(margin=1)
    add_twice(model, 1.0, 0.25)
    assert row_of(model.mdp, 5) == pytest.approx({6: 1.0})


@pytest.mark.parametrize("gamma", [1.0, 0.8])
def test_staying_is_summed_as_a_geometric_series(gamma):
    model = model_of_one_variable(gamma=gamma)
    add_twice(model, 0.5, 0.05)  # a fifth of a cell: stays with probability 0.8
    leave = 1.0 - gamma * 0.8
    assert row_of(model.mdp, 2) == pytest.approx({3: gamma * 0.2 / leave})
    assert model.mdp.arrays.reward[2] == pytest.approx(-1.0 / leave)


@pytest.mark.parametrize(("reward", "expected"), [(-1.0, -np.inf), (2.0, np.inf), (0.0, 0.0)])
def test_a_pair_that_never_leaves_has_an_infinite_return(reward, expected):
    model = model_of_one_variable()
    add_twice(model, 0.5, 0.0, reward)
    assert model.mdp.arrays.reward[2] == expected
    assert row_of(model.mdp, 2) == {}


def test_lists_rows_and_instances_are_complete_after_their_arrays_have_grown():
    grid, kernel = ((4, 4), 0), dict(breadth=0.4, min_weight=0.01, min_fraction=0.001)
    model, naive = model_and_definition(grid, kernel)
    lists, rows = len(model.arrays.lists.item), len(model.mdp.arrays.rows.item)
    capacity = model.instances.capacity
    transitions = random_transitions(3, 2, 700)
    learn(model, transitions)
    assert len(model.arrays.lists.item) > lists
    assert len(model.mdp.arrays.rows.item) > rows
    assert model.instances.capacity > capacity
    add_instances(naive, transitions)
    rng = np.random.default_rng(0)
    for point in rng.choice(naive.n_points, 12, replace=False).tolist():
        for action in range(N_ACTIONS):
            pair = action * naive.n_points + point
            index, _ = model.arrays.lists.entries(pair)
            assert list(index) == [number for number, _ in naive.list_of(action, point)]
            reward, successors = without_staying(*naive.row(action, point), point, gamma=1.0)
            assert model.mdp.arrays.reward[pair] == pytest.approx(reward, abs=1e-9)
            assert_same_row(row_of(model.mdp, point, action), successors)


@slow_and_repeatable
@given(problems, st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3))
def test_predict_gives_the_kernel_average_at_any_state(problem, at):
    grid, kernel, seed, n, _ = problem
    model, naive = model_and_definition(grid, kernel)
    transitions = random_transitions(seed, len(grid[0]), n)
    learn(model, transitions)
    add_instances(naive, transitions)
    state = np.array(at[: len(grid[0])])
    found = model.predict(np.array([state] * N_ACTIONS), np.arange(N_ACTIONS))
    for action in range(N_ACTIONS):
        kept = naive.kept_at(state, action)
        total = sum(w for _, w in kept)
        instances = [naive.instances[action][number] for number, _ in kept]
        shares = [w / total for _, w in kept]
        known_before = total < naive.threshold and naive.known_at(state, action)
        assert found.weight[action] == pytest.approx(naive.threshold if known_before else total, rel=1e-9)
        expected = sum(p * instance.reward for p, instance in zip(shares, instances, strict=True))
        assert found.reward[action] == pytest.approx(expected, abs=1e-9)
        going_on = [(p, instance.effect) for p, instance in zip(shares, instances, strict=True) if not instance.terminated]
        used = found.probability[action] > 0.0
        assert used.sum() == len(going_on)
        for p, effect, (share, own_effect) in zip(
            found.probability[action, used], found.effect[action, used], going_on, strict=True
        ):
            assert p == pytest.approx(share, rel=1e-9)
            np.testing.assert_allclose(effect, own_effect, atol=1e-12)


@slow_and_repeatable
@given(problems, st.floats(0.05, 0.9))
def test_a_lower_threshold_makes_those_pairs_known_whose_weight_reaches_it(problem, threshold):
    grid, kernel, seed, n, _ = problem
    model, _ = model_and_definition(grid, kernel)
    learn(model, random_transitions(seed, len(grid[0]), n))
    before = model.known.copy()
    newly_known = model.lower_threshold(threshold)
    np.testing.assert_array_equal(newly_known, np.flatnonzero(~before & (model.own_weight >= threshold)))
    np.testing.assert_array_equal(model.known, before | (model.own_weight >= threshold))
    model.update_rows(newly_known)
    np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)


class NoInstances:
    """A transfer method that transfers nothing."""

    def transferred(self, states, actions, own_weight):
        return TransferredInstances.empty(*states.shape)

    def transferred_to_sample(self, points, actions, own_weight):
        return TransferredInstances.empty(len(points), 2)


@pytest.mark.parametrize("kernel", KERNELS, ids=str)
def test_with_transfer_known_pairs_are_updated_at_once_and_others_once_their_weight_has_changed_enough(kernel):
    grid = ((2, 2), 1)
    model = make_model(grid, kernel, transfer=NoInstances())
    naive = model_and_definition(grid, kernel)[1]
    last, waited = np.zeros(len(model.known)), 0
    # Without states that repeat: of equal weights the last may enter a list only to be cut again.
    for transition in {tuple(transition[0]): transition for transition in random_transitions(8, 2, 40)}.values():
        changed = model.add(*transition)
        naive.add(*transition)
        action, newest = transition[1], len(naive.instances[transition[1]]) - 1
        gained = [newest in [number for number, _ in naive.list_of(action, point)] for point in range(naive.n_points)]
        pairs = action * naive.n_points + np.flatnonzero(gained)
        due = model.known[pairs] | (np.abs(model.own_weight[pairs] - last[pairs]) >= MIN_CHANGE)
        np.testing.assert_array_equal(np.sort(changed), pairs[due])
        model.update_rows(changed)
        last[changed] = model.own_weight[changed]
        np.testing.assert_array_equal(model.outdated(), np.flatnonzero(~model.known & (model.own_weight != last)))
        waited += len(model.outdated())
    assert waited > 0 and model.known.any()
    model.update_rows(model.outdated())
    assert len(model.outdated()) == 0
