"""The kernel average on the grid against its definition: lists of kept instances, what is known, rows."""

import numpy as np
import pytest
from helpers import kernel_models
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.kernel_average import MIN_CHANGE

slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=8)
problems = st.tuples(
    st.sampled_from(kernel_models.GRIDS),
    st.sampled_from(kernel_models.KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 20),
    st.sampled_from([1.0, 0.9]),
)


def assert_same_as_definition(model, naive, gamma, pairs):
    """Lists, weights and rows of some pairs."""
    for action, point, pair in pairs:
        expected = naive.list_of(action, point)
        index, weight = model.arrays.lists.entries(pair)
        assert list(index) == [number for number, _ in expected]
        np.testing.assert_allclose(weight, [w for _, w in expected], rtol=1e-9)
        assert model.own_weight[pair] == pytest.approx(sum(w for _, w in expected), rel=1e-9)
        if model.known[pair]:
            reward, successors = kernel_models.without_staying(*naive.row(action, point), point, gamma)
            assert model.mdp.arrays.reward[pair] == pytest.approx(reward, rel=1e-9, abs=1e-9)
            kernel_models.assert_same_row(kernel_models.row_of(model.mdp, point, action), successors)
        else:
            assert kernel_models.row_of(model.mdp, point, action) == {}


@slow_and_repeatable
@given(problems)
def test_lists_what_is_known_and_rows_are_those_of_the_definition(problem):
    grid, kernel, seed, n, gamma = problem
    model, naive = kernel_models.model_and_definition(grid, kernel, gamma)
    np.testing.assert_allclose(model.grid.points(), [naive.grid.unit(p) for p in range(naive.n_points)], atol=1e-15)
    for transition in kernel_models.random_transitions(seed, len(grid[0]), n):
        kernel_models.learn_both(model, naive, [transition])
        np.testing.assert_array_equal(model.known.reshape(kernel_models.N_ACTIONS, -1), naive.known)
    np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
    np.testing.assert_array_equal(model.mdp.arrays.n_optimistic, (~naive.known).sum(axis=0))
    assert_same_as_definition(model, naive, gamma, kernel_models.pairs_of(naive))


@slow_and_repeatable
@given(problems, st.floats(0.05, 0.9))
def test_a_transition_or_a_lower_threshold_changes_the_rows_of_the_pairs_that_are_returned_and_of_no_others(problem, low):
    grid, kernel, seed, n, gamma = problem
    model, _ = kernel_models.model_and_definition(grid, kernel, gamma)
    *before, last = kernel_models.random_transitions(seed, len(grid[0]), n + 1)
    kernel_models.learn(model, before)
    changed = model.add(*last)
    assert len(np.unique(changed)) == len(changed) and (changed // model.grid.n_points == last[1]).all()
    known, newly_known = model.known.copy(), model.lower_threshold(low)
    np.testing.assert_array_equal(newly_known, np.flatnonzero(~known & (model.own_weight >= low)))
    np.testing.assert_array_equal(model.known, known | (model.own_weight >= low))
    model.update_rows(changed)
    model.update_rows(newly_known)
    partial = [(model.mdp.arrays.reward[pair], kernel_models.row_of(model.mdp, pair)) for pair in range(len(model.known))]
    model.update_all_rows()
    assert partial == [
        (model.mdp.arrays.reward[pair], kernel_models.row_of(model.mdp, pair)) for pair in range(len(model.known))
    ]


BREADTH, MIN_FRACTION = 0.2, 0.1
STATE = np.array([0.5, 0.5])


def new_model():
    return kernel_models.make_model(((2, 2), 0), dict(breadth=BREADTH, min_weight=0.01, min_fraction=MIN_FRACTION))


def add_weighing(model, weight, angle=0.0):
    """An instance of action 0 that weighs so much at ``STATE``."""
    start = STATE + BREADTH * np.sqrt(-np.log(weight)) * np.array([np.cos(angle), np.sin(angle)])
    model.add(start, 0, -weight, start + 0.05, False)


@settings(deadline=None, derandomize=True, max_examples=50)
@given(st.lists(st.one_of(st.floats(0.011, 0.999), st.floats(0.09, 0.12), st.floats(0.8, 0.9)), min_size=2, max_size=14))
def test_an_exact_state_is_known_for_ever_once_some_of_its_instances_alone_reach_the_threshold(weights):
    model, known = new_model(), False
    for number, weight in enumerate(weights):
        add_weighing(model, weight, angle=float(number))
        known_now = bool(model.predict_at(STATE)[0].modelled[0])
        assert known_now or not known
        known = known_now
        total = sum(w for w in weights[: number + 1] if w >= MIN_FRACTION / (1.0 + MIN_FRACTION))
        assert known_now == (total >= 1.0) or abs(total - 1.0) < 1e-9


def test_lists_rows_and_instances_are_complete_after_their_arrays_have_grown():
    grid, kernel = ((4, 4), 0), dict(breadth=0.4, min_weight=0.01, min_fraction=0.001)
    model, naive = kernel_models.model_and_definition(grid, kernel)
    lists, rows = len(model.arrays.lists.item), len(model.mdp.arrays.rows.item)
    capacity, transitions = model.instances.capacity, kernel_models.random_transitions(3, 2, 500)
    kernel_models.learn(model, transitions)
    assert len(model.arrays.lists.item) > lists and len(model.mdp.arrays.rows.item) > rows
    assert model.instances.capacity > capacity
    kernel_models.add_instances(naive, transitions)
    chosen = np.random.default_rng(0).choice(len(model.known), 12, replace=False)
    assert_same_as_definition(model, naive, 1.0, [(*divmod(int(pair), naive.n_points), int(pair)) for pair in chosen])


class NoInstances:
    """A transfer method that transfers nothing."""

    def transferred(self, states, actions, own_weight):
        return TransferredInstances.empty(*states.shape)

    def transferred_to_sample(self, points, actions, own_weight):
        return TransferredInstances.empty(len(points), 2)


@pytest.mark.parametrize("kernel", kernel_models.KERNELS[:2], ids=str)
def test_with_transfer_known_pairs_are_updated_at_once_and_others_once_their_weight_has_changed_enough(kernel):
    grid = ((2, 2), 1)
    model = kernel_models.make_model(grid, kernel, transfer=NoInstances())
    naive = kernel_models.model_and_definition(grid, kernel)[1]
    last, waited = np.zeros(len(model.known)), 0
    # Without states that repeat: of equal weights the last may enter a list only to be cut again.
    for transition in {tuple(transition[0]): transition for transition in kernel_models.random_transitions(8, 2, 40)}.values():
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
