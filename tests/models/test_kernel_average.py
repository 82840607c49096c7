"""The kernel average against its definition: what is known, rows, and instances that are replaced."""

import numpy as np
import pytest
from helpers import kernel_models
from helpers.naive_fitted_rmax import Instance, apart
from hypothesis import given, settings
from hypothesis import strategies as st

slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=12)
problems = st.tuples(
    st.sampled_from(kernel_models.GRIDS),
    st.sampled_from(kernel_models.KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 20),
    st.sampled_from([1.0, 0.9]),
)


def assert_same_rows(model, naive, pairs):
    """The rows of some pairs, those that are known."""
    for action, point, pair in pairs:
        assert model.mdp.arrays.modelled[pair] == model.known[pair]
        if not model.known[pair]:
            assert kernel_models.row_of(model.mdp, point, action) == {}
            continue
        reward, successors = kernel_models.without_staying(*naive.row(action, point), point, model.mdp.gamma)
        assert model.mdp.arrays.reward[point, action] == pytest.approx(reward, rel=1e-9, abs=1e-9)
        kernel_models.assert_same_row(kernel_models.row_of(model.mdp, point, action), successors)


def assert_same_as_definition(model, naive, pairs):
    """What is known, and rows, of some pairs, all of which are up to date."""
    pairs = list(pairs)
    for action, point, pair in pairs:
        assert model.known[pair] == naive.known_at(naive.grid.unit(point), action)
    assert_same_rows(model, naive, pairs)


@slow_and_repeatable
@given(problems)
def test_what_is_known_and_rows_are_those_of_the_definition_after_every_transition(problem):
    grid, kernel, seed, n, gamma = problem
    model, naive = kernel_models.model_and_definition(grid, kernel, gamma)
    np.testing.assert_allclose(model.grid.points(), [naive.grid.unit(p) for p in range(naive.n_points)], atol=1e-15)
    for transition in kernel_models.random_transitions(seed, len(grid[0]), n):
        kernel_models.learn_both(model, naive, [transition])
        assert model.known[naive.known.reshape(-1)].all(), "what its list has ever sufficed for, at the latest"
    np.testing.assert_array_equal(model.mdp.arrays.n_optimistic, (~model.known.reshape(len(naive.known), -1)).sum(axis=0))
    assert_same_rows(model, naive, kernel_models.pairs_of(naive))
    before, known = rows_of(model), model.known.copy()
    model.update_all(np.arange(len(model.known)))
    assert_same_as_definition(model, naive, kernel_models.pairs_of(naive))
    after = rows_of(model)
    assert all(before[pair] == after[pair] for pair in np.flatnonzero(known)), "rows of other pairs have not changed"


def rows_of(model):
    pairs = [divmod(pair, model.grid.n_points) for pair in range(len(model.known))]
    return [(model.mdp.arrays.reward[p, a], kernel_models.row_of(model.mdp, p, a)) for a, p in pairs]


@slow_and_repeatable
@given(problems, st.integers(1, 10))
def test_beyond_max_instances_the_nearest_instance_of_the_action_is_replaced_everywhere(problem, max_instances):
    grid, kernel, seed, n, gamma = problem
    model, naive = kernel_models.model_and_definition(grid, kernel, gamma, max_instances=max_instances)
    periodic = naive.grid.periodic
    for transition in kernel_models.random_transitions(seed, len(grid[0]), 2 * n + max_instances):
        kernel_models.learn(model, [transition])
        state, action, reward, next_state, terminated = transition
        there = naive.instances[action]
        squared = [sum(d * d for d in apart(state, i.state, periodic)) for i in there]
        slot = len(there) if len(there) < max_instances else int(np.argmin(squared))
        there[slot : slot + 1] = [Instance(state, action, reward, next_state, terminated, periodic)]
    assert model.instances.size.tolist() == [len(some) for some in naive.instances]
    assert_same_rows(model, naive, kernel_models.pairs_of(naive))
    model.update_all(np.arange(len(model.known)))
    assert_same_as_definition(model, naive, kernel_models.pairs_of(naive))


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


def test_a_known_pair_is_left_alone_by_an_instance_that_enters_no_list_of_its():
    kernel = dict(breadth=0.5, min_weight=0.01, min_fraction=0.37)
    model = kernel_models.make_model(((4,), 0), kernel)
    here, away = np.array([0.5]), np.array([0.625])
    point = int(np.flatnonzero(model.grid.points()[:, 0] == here[0])[0])
    kernel_models.learn(model, [(here, 0, 0.0, here, False)] * 30)
    # It would weigh enough to make the pair known, and less than the least of what counts at it.
    assert model.known[point] and 0.37 < np.exp(-(((away - here) / 0.5) ** 2).sum()) < 1.0
    before = [array[point].copy() for array in model.mdp.arrays[:4]]
    due = model.add(away, 0, 5.0, here, False)
    assert point not in due and len(due) > 0
    model.update_all(np.arange(len(model.known)))
    for one, other in zip(before, model.mdp.arrays[:4], strict=True):
        np.testing.assert_array_equal(one, other[point])


def test_rows_and_instances_are_complete_after_their_arrays_have_grown():
    grid, kernel = ((4, 4), 0), dict(breadth=0.4, min_weight=0.01, min_fraction=0.001)
    model, naive = kernel_models.model_and_definition(grid, kernel)
    width, capacity = model.mdp.arrays.to.shape[-1], model.instances.capacity
    transitions = kernel_models.random_transitions(3, 2, 500)
    for transition in transitions:
        model.add(*transition)
    model.update_all(np.arange(len(model.known)))
    assert model.mdp.arrays.to.shape[-1] > width and model.instances.capacity > capacity
    kernel_models.add_instances(naive, transitions)
    chosen = np.random.default_rng(0).choice(len(model.known), 12, replace=False)
    assert_same_as_definition(model, naive, [(*divmod(int(pair), naive.n_points), int(pair)) for pair in chosen])
