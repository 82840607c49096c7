"""The local linear model with ``max_instances``, saved and restored."""

import numpy as np
import pytest
from helpers import linear_models
from helpers.kernel_models import GRIDS, KERNELS, N_ACTIONS, learn, make_model, model_and_definition, random_transitions
from helpers.naive_fitted_rmax import kept_instances
from helpers.naive_local_linear import NaiveReplacement
from hypothesis import given, settings
from hypothesis import strategies as st


def assert_same_as_definition(model, naive):
    linear_models.assert_same_sums(model, naive)
    linear_models.finish_episode(model)
    return linear_models.assert_same_fits(model, naive)


@settings(deadline=None, derandomize=True, max_examples=5)
@given(
    st.sampled_from(linear_models.SMALL_GRIDS),
    st.sampled_from(linear_models.LINEAR_KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 8),
    st.sampled_from([0.3, 1.0]),
)
def test_beyond_max_instances_the_nearest_instance_of_the_action_is_replaced_everywhere(
    grid, kernel, seed, max_instances, threshold
):
    model, naive = linear_models.linear_model_and_definition(grid, kernel, max_instances=max_instances, threshold=threshold)
    expected = NaiveReplacement(naive, max_instances)
    for transition in random_transitions(seed, len(grid[0]), 3 * max_instances + 8):
        linear_models.learn_linear(model, expected, [transition])
        np.testing.assert_array_equal(model.known.reshape(N_ACTIONS, -1), naive.known)
        np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
        assert model.instances.size.tolist() == [len(some) for some in naive.instances]
    for action, some in enumerate(naive.instances):
        for slot, instance in enumerate(some):
            np.testing.assert_array_equal(model.instances.state[action, slot], instance.state)
            np.testing.assert_allclose(model.instances.effect[action, slot], instance.effect, atol=1e-12)
    assert_same_as_definition(model, naive)


def test_sums_and_rows_stay_right_where_many_instances_have_the_same_state():
    rng = np.random.default_rng(1)
    states = rng.random((3, 2))
    model, naive = linear_models.linear_model_and_definition(((2, 2), 0), linear_models.LINEAR_KERNELS[1], max_instances=20)
    expected = NaiveReplacement(naive, 20)
    for _ in range(120):
        state = states[rng.integers(3)]
        linear_models.learn_linear(
            model, expected, [(state, 0, rng.normal(), state + 0.1 * rng.normal(size=2), rng.random() < 0.2)]
        )
    assert assert_same_as_definition(model, naive) > 0


def test_rewards_are_those_of_the_instances_left_however_little_these_weigh():
    kernel = dict(breadth=0.5, min_weight=0.01, n_neighbors=8, outcome_breadth=0.05)
    model, naive = linear_models.linear_model_and_definition(((2,), 0), kernel, max_instances=2, n_actions=1)
    expected, point = NaiveReplacement(naive, 2), 2  # at 0.5
    for at, reward in ((0.5, 100.0), (0.0, -3.0), (0.6, 50.0), (0.7, 20.0), (0.85, 10.0), (0.98, -1.0)):
        linear_models.learn_linear(model, expected, [(np.array([at]), 0, reward, np.array([at + 0.05]), False)])
    assert_same_as_definition(model, naive)
    assert model.fits.row[point, 1] == pytest.approx(-1.0, abs=0.01), "0.98 is a little nearer than 0"


@pytest.mark.parametrize("outcome_breadth", [1e-3, 1e-2])
def test_rewards_far_from_all_instances_are_numbers_however_narrow_their_kernel_is(outcome_breadth):
    kernel = dict(breadth=0.5, min_weight=0.05, n_neighbors=8, outcome_breadth=outcome_breadth)
    model = linear_models.make_linear_model(((3,), 0), kernel, n_actions=1)
    learn(model, [(np.array([0.0]), 0, reward, np.array([0.05]), False) for reward in (-1.0, -2.0, -3.0)])
    linear_models.finish_episode(model)
    assert model.known[4]
    np.testing.assert_allclose(model.fits.row[model.known], [[0.05, -2.0, 0.0]] * model.known.sum(), atol=1e-12)
    assert model.predict_at(np.array([0.5]))[0].reward[0] == pytest.approx(-2.0)


@settings(deadline=None, derandomize=True, max_examples=8)
@given(
    st.sampled_from(linear_models.SMALL_GRIDS),
    st.sampled_from(linear_models.LINEAR_KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 60),
    st.booleans(),
    st.booleans(),
)
def test_what_is_restored_at_an_episodes_end_is_and_learns_the_same_to_the_last_bit(grid, kernel, seed, n, small, informed):
    d = len(grid[0])
    prior = linear_models.StubPrior(linear_models.LinearDynamics(0, d).effect, linear_models.left_half) if informed else None
    model, restored = (
        linear_models.make_linear_model(grid, kernel, prior=prior, max_model_steps=50 if small else 1) for _ in range(2)
    )
    if informed:
        linear_models.renew(model, prior)
    transitions = random_transitions(seed, d, n + 30)
    learn(model, linear_models.small_steps(seed, d, n, ends=True) if small else transitions[: n // 2])
    linear_models.finish_episode(model)
    # A larger effect far away widens the range that effects are kept within, and nothing else.
    learn(model, transitions[n // 2 : n])
    accepted = model.accept(np.arange(0, len(model.known), 5))
    model.update_rows(accepted)
    linear_models.assert_restored(model, restored, transitions[n:])
    assert restored.known[accepted].all()


def test_what_is_restored_is_right_after_instances_were_replaced():
    model = linear_models.make_linear_model(((2, 2), 1, (True, False)), linear_models.LINEAR_KERNELS[1], max_instances=15)
    learn(model, random_transitions(9, 2, 200))
    linear_models.finish_episode(model)
    restored = linear_models.make_linear_model(((2, 2), 1, (True, False)), linear_models.LINEAR_KERNELS[1], max_instances=15)
    restored.set_state(model.get_state())
    # Sums from which others were subtracted are the same but for rounding.
    for name in ("sums", "outcome", "reach", "limit", "known", "total"):
        of_both = getattr(model.fits, name), getattr(restored.fits, name)
        np.testing.assert_allclose(*of_both, rtol=1e-9, atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(model.fits.effect_range[:2], restored.fits.effect_range[:2])
    np.testing.assert_allclose(model.fits.row[model.known], restored.fits.row[model.known], rtol=1e-9, atol=1e-9)
    state = np.array([0.3, 0.6])
    for array, same in zip(model.predict_at(state)[0], restored.predict_at(state)[0], strict=True):
        np.testing.assert_array_equal(array, same)


# The kernel average with ``max_instances``, and restored from its instances.
class NaiveLists:
    """Lists of one action with ``max_instances``: a replaced instance leaves all lists; one cut once never returns."""

    def __init__(self, naive, max_instances):
        self.naive, self.max_instances = naive, max_instances
        self.instances = []
        self.lists = [[] for _ in range(naive.n_points)]
        self.known = [False] * naive.n_points

    def add(self, instance):
        if len(self.instances) < self.max_instances:
            slot = len(self.instances)
            self.instances.append(instance)
        else:
            slot = min(range(self.max_instances), key=self.n_lists)
            for point, one in enumerate(self.lists):
                if slot in one:
                    one.remove(slot)
                    self.known[point] &= len(one) > 0
            self.instances[slot] = instance
        for point in range(self.naive.n_points):
            ordered = sorted([*self.lists[point], slot], key=lambda s, point=point: (-self.weight(point, s), s))
            at, instances = self.naive.grid.unit(point), [self.instances[s] for s in ordered]
            kept = kept_instances(at, instances, *self.naive.kernel, self.naive.grid.periodic)
            self.lists[point] = [ordered[number] for number, _ in kept]
            self.known[point] |= sum(w for _, w in kept) >= self.naive.threshold

    def weight(self, point, slot):
        breadth, grid = self.naive.kernel[0], self.naive.grid
        return kept_instances(grid.unit(point), [self.instances[slot]], breadth, 0.0, 1.0, grid.periodic)[0][1]

    def n_lists(self, slot):
        return sum(slot in one for one in self.lists)


@settings(deadline=None, derandomize=True, max_examples=6)
@given(
    st.sampled_from([((3,), 1), ((2, 2), 0), ((1, 1, 1), 0), ((3,), 0, (True,)), ((2, 2), 0, (False, True))]),
    st.sampled_from(KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 10),
)
def test_beyond_max_instances_the_instance_in_the_fewest_lists_is_replaced_everywhere(grid, kernel, seed, max_instances):
    model, naive = model_and_definition(grid, kernel, max_instances=max_instances)
    expected = NaiveLists(naive, max_instances)
    for state, _, reward, next_state, terminated in random_transitions(seed, len(grid[0]), 3 * max_instances + 5):
        learn(model, [(state, 0, reward, next_state, terminated)])
        naive.instances[0].clear()
        naive.add(state, 0, reward, next_state, terminated)
        expected.add(naive.instances[0][0])
        count = model.n_instances
        assert count == len(expected.instances) <= max_instances
        for point in range(naive.n_points):
            index, weight = model.arrays.lists.entries(point)
            assert list(index) == expected.lists[point]
            assert model.own_weight[point] == pytest.approx(weight.sum(), rel=1e-9, abs=1e-12)
        assert list(model.arrays.n_lists[0, :count]) == [expected.n_lists(s) for s in range(count)]
        np.testing.assert_array_equal(model.known[: naive.n_points], expected.known)
        np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
    for slot, instance in enumerate(expected.instances):
        np.testing.assert_array_equal(model.instances.state[0, slot], instance.state)
        np.testing.assert_allclose(model.instances.effect[0, slot], instance.effect, atol=1e-12)


def restored(model, grid, kernel, max_instances=None):
    """A new model that takes over the state of another."""
    fresh = make_model(grid, kernel, max_instances=max_instances)
    fresh.set_state(model.get_state())
    return fresh


def assert_same_to_the_last_bit(one, other):
    for name in ("entry", "total", "last_total", "known", "n_lists"):
        np.testing.assert_array_equal(getattr(one.arrays, name), getattr(other.arrays, name), err_msg=name)
    for name in ("modelled", "reward", "n_optimistic"):
        np.testing.assert_array_equal(getattr(one.mdp.arrays, name), getattr(other.mdp.arrays, name), err_msg=name)
    for pair in range(len(one.known)):
        for lists, same in ((one.arrays.lists, other.arrays.lists), (one.mdp.arrays.rows, other.mdp.arrays.rows)):
            np.testing.assert_array_equal(lists.entries(pair), same.entries(pair))


@pytest.mark.parametrize(("grid", "kernel"), [(grid, KERNELS[i % 4]) for i, grid in enumerate(GRIDS) if i % 3 == 2], ids=str)
def test_a_restored_model_is_and_learns_on_as_the_original_to_the_last_bit(grid, kernel):
    model, transitions = make_model(grid, kernel), random_transitions(3, len(grid[0]), 130)
    learn(model, transitions[:100])
    fresh = restored(model, grid, kernel)
    assert model.arrays.lists.length.max() > 1
    assert_same_to_the_last_bit(fresh, model)
    for transition in transitions[100:]:
        changed = model.add(*transition)
        np.testing.assert_array_equal(fresh.add(*transition), changed)
        for one in (model, fresh):
            one.update_rows(changed)
    assert_same_to_the_last_bit(fresh, model)
    state, expected = fresh.get_state(), model.get_state()
    for name, array in expected.items():
        np.testing.assert_array_equal(state[name], array)


@pytest.mark.parametrize("kernel", KERNELS[:3], ids=str)
def test_a_model_that_replaced_instances_is_restored_to_what_it_is_without_them(kernel):
    grid = GRIDS[2]
    model = make_model(grid, kernel, max_instances=20)
    learn(model, random_transitions(4, 2, 200))
    fresh, n_points = restored(model, grid, kernel, max_instances=20), model.grid.n_points
    for pair in range(N_ACTIONS * n_points):
        action, at = pair // n_points, model.grid.points()[pair % n_points]
        apart = ((model.instances.state[action, :20] - at) ** 2).sum(axis=1)
        weights = np.where(model.arrays.n_lists[action, :20] > 0, np.exp(-apart / kernel["breadth"] ** 2), 0.0)
        kept, total = [], 0.0
        for i in np.argsort(-weights, kind="stable"):
            if weights[i] < kernel["min_weight"] or weights[i] < kernel["min_fraction"] * total:
                break
            kept.append(i)
            total += weights[i]
        np.testing.assert_array_equal(fresh.arrays.lists.entries(pair)[0], kept)
        assert fresh.own_weight[pair] == pytest.approx(total)
        assert fresh.known[pair] == ((len(kept) > 0) and (model.known[pair] or fresh.own_weight[pair] >= 1.0))


def test_saved_weights_that_do_not_fit_the_instances_are_not_taken_over():
    grid, kernel = GRIDS[2], KERNELS[0]
    model = make_model(grid, kernel)
    learn(model, random_transitions(5, 2, 60))
    fresh, state, n = make_model(grid, kernel), model.get_state(), len(model.known)
    state["instances"][:, -1] = 1.0
    fresh.set_state({"instances": state["instances"], "known": np.ones(n), "total": np.full(n, 1e9)})
    np.testing.assert_allclose(fresh.own_weight, model.own_weight, rtol=1e-12)
    assert not fresh.known[fresh.arrays.lists.length == 0].any()
