"""The local linear model with ``max_instances``: which instance is replaced, and what remains of it."""

import numpy as np
import pytest
from helpers.kernel_models import N_ACTIONS, random_transitions
from helpers.linear_models import (
    LINEAR_KERNELS,
    assert_same_fits,
    assert_same_sums,
    finish_episode,
    learn_linear,
    linear_model_and_definition,
    make_linear_model,
)
from helpers.naive_fitted_rmax import Instance
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.models.base import ModelSettings
from sb3_combrel.models.local_linear import LocalLinear
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.mdp import FiniteMDP

SMALL_GRIDS = [((3,), 1), ((2, 2), 0), ((1, 1, 1), 0), ((3,), 0, (True,)), ((2, 2), 1, (False, True))]


class NaiveReplacement:
    """The definition with ``max_instances``: the nearest instance of the action goes, and pairs that have none left with it."""

    def __init__(self, naive, max_instances):
        self.naive, self.max_instances = naive, max_instances

    def add(self, state, action, reward, next_state, terminated):
        naive = self.naive
        number = len(naive.instances[action])
        if number == self.max_instances:
            number = naive.distances(state, action)[0][1]
            self.remove(action, number)
        naive.put(number, Instance(state, action, reward, next_state, terminated, naive.grid.periodic))

    def remove(self, action, number):
        naive = self.naive
        for point in range(naive.n_points):
            if [n for _, n in naive.counted(action, point)] == [number]:
                naive.known[action, point], naive.total[action, point] = False, 0.0
                naive.reach[action, point] = naive.full_reach
                naive.limit[action, point] = naive.n_neighbors + naive.n_neighbors // 2
        naive.instances[action][number].state = np.full(naive.d, np.inf)


@settings(deadline=None, derandomize=True, max_examples=15)
@given(
    st.sampled_from(SMALL_GRIDS),
    st.sampled_from(LINEAR_KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 15),
    st.sampled_from([0.3, 1.0]),
)
def test_beyond_max_instances_the_nearest_instance_of_the_action_is_replaced_everywhere(
    grid, kernel, seed, max_instances, threshold
):
    model, naive = linear_model_and_definition(grid, kernel, max_instances=max_instances, threshold=threshold)
    expected = NaiveReplacement(naive, max_instances)
    for transition in random_transitions(seed, len(grid[0]), 5 * max_instances + 10):
        learn_linear(model, expected, [transition])
        np.testing.assert_array_equal(model.known.reshape(N_ACTIONS, -1), naive.known)
        np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
        assert model.instances.size.tolist() == [len(some) for some in naive.instances]
    for action, some in enumerate(naive.instances):
        for slot, instance in enumerate(some):
            np.testing.assert_array_equal(model.instances.state[action, slot], instance.state)
            np.testing.assert_allclose(model.instances.effect[action, slot], instance.effect, atol=1e-12)
    assert_same_sums(model, naive)
    finish_episode(model)
    assert_same_fits(model, naive)


@pytest.mark.parametrize("grid", SMALL_GRIDS, ids=str)
def test_sums_and_rows_stay_right_over_hundreds_of_replacements(grid):
    model, naive = linear_model_and_definition(grid, LINEAR_KERNELS[1], max_instances=12)
    learn_linear(model, NaiveReplacement(naive, 12), random_transitions(4, len(grid[0]), 700))
    assert_same_sums(model, naive)
    finish_episode(model)
    assert assert_same_fits(model, naive) > 0


@pytest.mark.parametrize("n_states", [1, 3])
def test_sums_and_rows_stay_right_where_many_instances_have_the_same_state(n_states):
    rng = np.random.default_rng(n_states)
    states = rng.random((n_states, 2))
    model, naive = linear_model_and_definition(((2, 2), 0), LINEAR_KERNELS[1], max_instances=20)
    expected = NaiveReplacement(naive, 20)
    for _ in range(400):
        state = states[rng.integers(n_states)]
        learn_linear(model, expected, [(state, 0, rng.normal(), state + 0.1 * rng.normal(size=2), rng.random() < 0.2)])
    assert_same_sums(model, naive)
    finish_episode(model)
    assert assert_same_fits(model, naive) > 0


def test_pairs_that_lose_all_their_instances_become_unknown_and_can_be_known_again():
    kernel = dict(breadth=0.1, min_weight=0.05, n_neighbors=2, outcome_breadth=0.05)
    model = make_linear_model(((3,), 0), kernel, max_instances=3, n_actions=1)
    point = 4  # at 0.5

    def add(at):
        model.update_rows(model.add(np.array([at]), 0, -1.0, np.array([at + 0.1]), False))

    for _ in range(3):
        add(0.5)
    assert model.known[point] and model.mdp.arrays.modelled[point]
    for at in (0.95, 0.95, 0.95, 0.95):
        add(at)
    # The nearest to 0.95 were those at 0.5, then the first at 0.95.
    assert model.known[point]
    model_all_away = [0.7, 0.9, 0.72, 0.92, 0.1, 0.88]
    for at in model_all_away:
        add(at)
    while model.known[point]:
        nearest = model.instances.state[0, : model.instances.size[0], 0]
        assert np.abs(nearest - 0.5).min() < 0.2
        add(float(nearest[np.abs(nearest - 0.5).argmin()] + 0.3))
    assert not model.mdp.arrays.modelled[point] and model.own_weight[point] == 0.0
    assert (model.fits.sums[point] == 0.0).all()
    for at in (0.51, 0.49):
        add(at)
    assert model.known[point], "a narrow kernel of former times is forgotten"
