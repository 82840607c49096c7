"""The kernel model on the grid against its definition: lists of kept instances, what is known, rows."""

import numpy as np
import pytest
from helpers.naive_fitted_rmax import NaiveFittedRMax, kept_instances
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.models.kernel_average import KernelModel
from sb3_combrel.planning.grid import StateGrid

N_ACTIONS = 2

slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=30)

# (resolution by variable, margin): a few hundred points at most, or the naive loops take for ever.
GRIDS = [((3,), 1), ((4,), 0), ((2, 2), 1), ((3, 2), 0), ((2, 1), 1), ((1, 2, 1), 0), ((1, 1, 1), 1)]
KERNELS = [
    dict(breadth=0.3, min_weight=0.01, min_fraction=0.13),
    dict(breadth=0.15, min_weight=0.01, min_fraction=0.02),
    dict(breadth=0.5, min_weight=0.1, min_fraction=0.37),
    dict(breadth=0.8, min_weight=0.3, min_fraction=0.9),
]


def random_transitions(seed, n_variables, n):
    """States that repeat now and then, effects that leave the box now and then, some of them nothing at all."""
    rng = np.random.default_rng(seed)
    transitions = []
    for _ in range(n):
        state = rng.random(n_variables)
        if transitions and rng.random() < 0.15:
            state = transitions[rng.integers(len(transitions))][0]
        effect = rng.normal(0.0, 0.2, n_variables) * (rng.random(n_variables) < 0.8)
        transitions.append(
            (state, int(rng.integers(N_ACTIONS)), float(rng.normal()), state + effect, bool(rng.random() < 0.15))
        )
    return transitions


def model_and_definition(grid, kernel, gamma=1.0, max_instances=None):
    resolution, margin = grid
    model = KernelModel(
        StateGrid(len(resolution), resolution, margin),
        N_ACTIONS,
        model_breadth=kernel["breadth"],
        min_weight=kernel["min_weight"],
        min_fraction=kernel["min_fraction"],
        exploration_threshold=1.0,
        gamma=gamma,
        max_instances=max_instances,
    )
    return model, NaiveFittedRMax(resolution, margin, N_ACTIONS, gamma=gamma, **kernel)


def feed(model, naive, transitions):
    for transition in transitions:
        model.settle(model.add(*transition))
        naive.add(*transition)


def pairs_of(naive):
    for action in range(naive.n_actions):
        for point in range(naive.n_points):
            yield action, point, action * naive.n_points + point


problems = st.tuples(
    st.sampled_from(GRIDS), st.sampled_from(KERNELS), st.integers(0, 10**6), st.integers(1, 40), st.sampled_from([1.0, 0.9])
)


@slow_and_repeatable
@given(problems)
def test_the_grid_is_the_one_of_the_definition(problem):
    model, naive = model_and_definition(*problem[:2])
    np.testing.assert_allclose(model.grid.points(), [naive.grid.unit(p) for p in range(naive.n_points)], atol=1e-15)


@slow_and_repeatable
@given(problems)
def test_every_list_holds_the_instances_that_min_weight_and_min_fraction_keep(problem):
    grid, kernel, seed, n, _ = problem
    model, naive = model_and_definition(grid, kernel)
    feed(model, naive, random_transitions(seed, len(grid[0]), n))
    for action, point, pair in pairs_of(naive):
        expected = naive.list_of(action, point)
        index, weight = model.arrays.lists.entries(pair)
        assert list(index) == [number for number, _ in expected]
        np.testing.assert_allclose(weight, [w for _, w in expected], rtol=1e-9)
        assert model.arrays.total[pair] == pytest.approx(sum(w for _, w in expected), rel=1e-9)


@slow_and_repeatable
@given(problems)
def test_a_pair_is_known_from_the_first_time_that_its_weights_reach_the_threshold(problem):
    grid, kernel, seed, n, _ = problem
    model, naive = model_and_definition(grid, kernel)
    for transition in random_transitions(seed, len(grid[0]), n):
        feed(model, naive, [transition])
        np.testing.assert_array_equal(model.arrays.known.reshape(N_ACTIONS, -1), naive.known)
    np.testing.assert_array_equal(model.arrays.settled, model.arrays.known)
    np.testing.assert_array_equal(model.arrays.n_optimistic, (~naive.known).sum(axis=0))


def test_a_pair_stays_known_when_a_nearer_instance_shortens_its_list_below_the_threshold():
    model, naive = model_and_definition(((1,), 0), dict(breadth=0.5, min_weight=0.01, min_fraction=0.6))
    pair = 1  # the grid point 0.5, action 0
    feed(model, naive, [(np.array([0.1]), 0, -1.0, np.array([0.2]), False)] * 2)
    assert model.arrays.known[pair] and model.arrays.total[pair] > 1.0
    feed(model, naive, [(np.array([0.45]), 0, -2.0, np.array([0.95]), False)])
    assert model.arrays.total[pair] < 1.0, "the case that this test is about"
    assert model.arrays.known[pair] and model.arrays.settled[pair]
    assert model.arrays.reward[pair] == pytest.approx(-2.0), "and its model is that of the instance now kept"


@slow_and_repeatable
@given(problems)
def test_rows_are_the_averaged_relative_effects_with_staying_summed_up(problem):
    grid, kernel, seed, n, gamma = problem
    model, naive = model_and_definition(grid, kernel, gamma)
    feed(model, naive, random_transitions(seed, len(grid[0]), n))
    for action, point, pair in pairs_of(naive):
        if not naive.known[action, point]:
            continue
        reward, successors = naive.row(action, point)
        leave = 1.0 - gamma * successors.pop(point, 0.0)
        to, chance = model.arrays.rows.entries(pair)
        if leave < 1e-9:
            assert len(to) == 0
            assert model.arrays.reward[pair] == np.sign(reward) * np.inf
            continue
        assert model.arrays.reward[pair] == pytest.approx(reward / leave, rel=1e-9, abs=1e-9)
        assert len(set(to)) == len(to)
        found = dict(zip(to.tolist(), chance.tolist(), strict=True))
        for successor in set(found) | set(successors):
            expected = gamma * successors.get(successor, 0.0) / leave
            assert found.get(successor, 0.0) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def _row(model, point, action=0):
    to, chance = model.arrays.rows.entries(action * model.grid.n_points + point)
    return dict(zip(to.tolist(), chance.tolist(), strict=True))


def model_of_one_variable(margin=0, gamma=1.0, **kernel):
    model, _ = model_and_definition(((2,), margin), dict(breadth=0.2, min_weight=0.01, min_fraction=0.01) | kernel, gamma)
    return model


def add_twice(model, state, effect, reward=-1.0, terminated=False):
    state = np.array([state])
    for _ in range(2):
        model.settle(model.add(state, 0, reward, state + effect, terminated))


def test_an_instance_that_ended_its_episode_adds_reward_and_no_successor():
    model = model_of_one_variable()
    add_twice(model, 0.5, 0.25)
    assert _row(model, 2) == pytest.approx({3: 1.0})
    add_twice(model, 0.5, 0.25, reward=5.0, terminated=True)
    assert _row(model, 2) == pytest.approx({3: 0.5}), "half of the probability mass ends with value 0"
    assert model.arrays.reward[2] == pytest.approx(2.0)


@pytest.mark.parametrize(("margin", "edge"), [(0, 4), (1, 6)])
def test_successors_beyond_the_grid_count_as_its_edge(margin, edge):
    model = model_of_one_variable(margin)
    add_twice(model, 0.75, 3.0)
    assert _row(model, 3 + margin) == pytest.approx({edge: 1.0})


def test_a_margin_gives_states_outside_the_box_a_point_of_their_own():
    model = model_of_one_variable(margin=1)
    add_twice(model, 1.0, 0.25)
    assert _row(model, 5) == pytest.approx({6: 1.0})


@pytest.mark.parametrize("gamma", [1.0, 0.8])
def test_staying_is_summed_as_a_geometric_series(gamma):
    model = model_of_one_variable(gamma=gamma)
    add_twice(model, 0.5, 0.05)  # a fifth of a cell: stays with probability 0.8
    leave = 1.0 - gamma * 0.8
    assert _row(model, 2) == pytest.approx({3: gamma * 0.2 / leave})
    assert model.arrays.reward[2] == pytest.approx(-1.0 / leave)


@pytest.mark.parametrize(("reward", "expected"), [(-1.0, -np.inf), (2.0, np.inf), (0.0, 0.0)])
def test_a_pair_that_never_leaves_has_an_endless_return(reward, expected):
    model = model_of_one_variable()
    add_twice(model, 0.5, 0.0, reward)
    assert model.arrays.reward[2] == expected
    assert _row(model, 2) == {}


def test_pools_grow_and_lose_nothing():
    grid, kernel = ((4, 4), 0), dict(breadth=0.4, min_weight=0.01, min_fraction=0.001)
    model, naive = model_and_definition(grid, kernel)
    lists, rows = len(model.arrays.lists.index), len(model.arrays.rows.index)
    capacity = model.instances.capacity
    transitions = random_transitions(3, 2, 700)
    for transition in transitions:
        model.settle(model.add(*transition))
    assert len(model.arrays.lists.index) > lists
    assert len(model.arrays.rows.index) > rows
    assert model.instances.capacity > capacity
    for state, action, reward, next_state, terminated in transitions:
        naive.instances[action].append(type("Seen", (), dict(state=state, reward=reward, effect=next_state - state))())
        naive.instances[action][-1].terminated = terminated
    rng = np.random.default_rng(0)
    for point in rng.choice(naive.n_points, 12, replace=False):
        for action in range(N_ACTIONS):
            index, _ = model.arrays.lists.entries(action * naive.n_points + point)
            assert list(index) == [number for number, _ in naive.list_of(action, point)]
            reward, successors = naive.row(action, point)
            leave = 1.0 - successors.pop(point, 0.0)
            assert model.arrays.reward[action * naive.n_points + point] == pytest.approx(reward / leave, abs=1e-9)
            assert _row(model, point, action) == pytest.approx({k: p / leave for k, p in successors.items()}, abs=1e-9)


class ListsByHand:
    """Lists of one action under a cap: an instance that gives way is struck out, and one cut once never comes back."""

    def __init__(self, naive, cap):
        self.naive, self.cap = naive, cap
        self.instances = []
        self.lists = [[] for _ in range(naive.n_points)]
        self.known = [False] * naive.n_points

    def add(self, instance):
        if len(self.instances) < self.cap:
            slot = len(self.instances)
            self.instances.append(instance)
        else:
            slot = min(range(self.cap), key=self.members)
            self.strike(slot)
            self.instances[slot] = instance
        for point in range(self.naive.n_points):
            candidates = [*self.lists[point], slot]
            ordered = sorted(candidates, key=lambda s, point=point: (-self.weight(point, s), s))
            kept = kept_instances(self.naive.grid.unit(point), [self.instances[s] for s in ordered], *self.naive.kernel)
            self.lists[point] = [ordered[number] for number, _ in kept]
            self.known[point] |= sum(w for _, w in kept) >= self.naive.threshold

    def weight(self, point, slot):
        kept = kept_instances(self.naive.grid.unit(point), [self.instances[slot]], self.naive.kernel[0], 0.0, 1.0)
        return kept[0][1]

    def members(self, slot):
        return sum(slot in one for one in self.lists)

    def strike(self, slot):
        for point, one in enumerate(self.lists):
            if slot in one:
                one.remove(slot)
                self.known[point] &= len(one) > 0


@settings(deadline=None, derandomize=True, max_examples=12)
@given(
    st.sampled_from([((3,), 1), ((2, 2), 0), ((1, 1, 1), 0)]),
    st.sampled_from(KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 12),
)
def test_with_a_cap_the_instance_in_fewest_lists_gives_way_everywhere(grid, kernel, seed, cap):
    model, naive = model_and_definition(grid, kernel, max_instances=cap)
    by_hand = ListsByHand(naive, cap)
    for state, _, reward, next_state, terminated in random_transitions(seed, len(grid[0]), 3 * cap + 5):
        model.settle(model.add(state, 0, reward, next_state, terminated))
        naive.instances[0].clear()
        naive.add(state, 0, reward, next_state, terminated)
        by_hand.add(naive.instances[0][0])
        count = int(model.instances.count[0])
        assert count == len(by_hand.instances) <= cap
        for point in range(naive.n_points):
            index, weight = model.arrays.lists.entries(point)
            assert list(index) == by_hand.lists[point]
            np.testing.assert_allclose(weight, [by_hand.weight(point, s) for s in by_hand.lists[point]], rtol=1e-9)
            assert model.arrays.total[point] == pytest.approx(weight.sum(), rel=1e-9, abs=1e-12)
        assert list(model.arrays.members[0, :count]) == [by_hand.members(s) for s in range(count)]
        np.testing.assert_array_equal(model.arrays.known[: naive.n_points], by_hand.known)
        np.testing.assert_array_equal(model.arrays.settled, model.arrays.known)
    for slot, instance in enumerate(by_hand.instances):
        np.testing.assert_array_equal(model.instances.state[0, slot], instance.state)
        np.testing.assert_allclose(model.instances.effect[0, slot], instance.effect, atol=1e-12)


def test_with_a_cap_rows_are_those_of_the_instances_left():
    grid, kernel = ((3, 2), 0), KERNELS[0]
    model, naive = model_and_definition(grid, kernel, max_instances=6)
    for state, action, reward, next_state, terminated in random_transitions(11, 2, 80):
        model.settle(model.add(state, action, reward, next_state, terminated))
    checked = 0
    for action, point, pair in pairs_of(naive):
        if not model.arrays.known[pair]:
            continue
        index, weight = model.arrays.lists.entries(pair)
        share = weight / weight.sum()
        expected_reward = float(share @ model.instances.reward[action, index])
        successors = {}
        for i, p in zip(index, share, strict=True):
            if not model.instances.terminated[action, i]:
                corners = naive.grid.corners(naive.grid.unit(point) + model.instances.effect[action, i])
                for to, part in corners.items():
                    successors[to] = successors.get(to, 0.0) + p * part
        leave = 1.0 - successors.pop(point, 0.0)
        assert model.arrays.reward[pair] == pytest.approx(expected_reward / leave, abs=1e-9)
        assert _row(model, point, action) == pytest.approx({k: v / leave for k, v in successors.items()}, abs=1e-9)
        checked += 1
    assert checked > 10
