"""The kernel average with ``max_instances``: which instance is replaced, and what remains of it."""

import numpy as np
import pytest
from helpers.kernel_models import (
    KERNELS,
    assert_same_row,
    learn,
    model_and_definition,
    pairs_of,
    random_transitions,
    row_of,
    without_staying,
)
from helpers.naive_fitted_rmax import kept_instances
from hypothesis import given, settings
from hypothesis import strategies as st


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
            self.remove(slot)
            self.instances[slot] = instance
        for point in range(self.naive.n_points):
            candidates = [*self.lists[point], slot]
            ordered = sorted(candidates, key=lambda s, point=point: (-self.weight(point, s), s))
            kept = kept_instances(
                self.naive.grid.unit(point), [self.instances[s] for s in ordered], *self.naive.kernel, self.naive.grid.periodic
            )
            self.lists[point] = [ordered[number] for number, _ in kept]
            self.known[point] |= sum(w for _, w in kept) >= self.naive.threshold

    def weight(self, point, slot):
        breadth, periodic = self.naive.kernel[0], self.naive.grid.periodic
        kept = kept_instances(self.naive.grid.unit(point), [self.instances[slot]], breadth, 0.0, 1.0, periodic)
        return kept[0][1]

    def n_lists(self, slot):
        return sum(slot in one for one in self.lists)

    def remove(self, slot):
        for point, one in enumerate(self.lists):
            if slot in one:
                one.remove(slot)
                self.known[point] &= len(one) > 0


@settings(deadline=None, derandomize=True, max_examples=12)
@given(
    st.sampled_from([((3,), 1), ((2, 2), 0), ((1, 1, 1), 0), ((3,), 0, (True,)), ((2, 2), 1, (False, True))]),
    st.sampled_from(KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 12),
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
            np.testing.assert_allclose(weight, [expected.weight(point, s) for s in expected.lists[point]], rtol=1e-9)
            assert model.own_weight[point] == pytest.approx(weight.sum(), rel=1e-9, abs=1e-12)
        assert list(model.arrays.n_lists[0, :count]) == [expected.n_lists(s) for s in range(count)]
        np.testing.assert_array_equal(model.known[: naive.n_points], expected.known)
        np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
    for slot, instance in enumerate(expected.instances):
        np.testing.assert_array_equal(model.instances.state[0, slot], instance.state)
        np.testing.assert_allclose(model.instances.effect[0, slot], instance.effect, atol=1e-12)


def test_beyond_max_instances_rows_are_those_of_the_instances_left():
    grid, kernel = ((3, 2), 0), KERNELS[0]
    model, naive = model_and_definition(grid, kernel, max_instances=6)
    learn(model, random_transitions(11, 2, 80))
    checked = 0
    for action, point, pair in pairs_of(naive):
        if not model.known[pair]:
            continue
        index, weight = model.arrays.lists.entries(pair)
        share = weight / weight.sum()
        plain_reward = float(share @ model.instances.reward[action, index])
        plain = {}
        for i, p in zip(index, share, strict=True):
            if not model.instances.terminated[action, i]:
                corners = naive.grid.corners(naive.grid.unit(point) + model.instances.effect[action, i])
                for to, fraction in corners.items():
                    plain[to] = plain.get(to, 0.0) + p * fraction
        reward, successors = without_staying(plain_reward, plain, point, gamma=1.0)
        assert model.mdp.arrays.reward[pair] == pytest.approx(reward, abs=1e-9)
        assert_same_row(row_of(model.mdp, point, action), successors)
        checked += 1
    assert checked > 10
