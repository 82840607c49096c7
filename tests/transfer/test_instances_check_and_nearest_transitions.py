"""When transferred instances are contradicted: by effects and ends that the agent finds to be others, not by time limits."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, changed_pairs, show, transferred_at
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL, TIMBREL, InterTaskMapping, SourceInstances
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.instances.instances_check import EPISODES_IN_VAIN, MIN_COMPARED, WINDOW, InstancesCheck
from sb3_combrel.transfer.instances.nearest_transitions import ComplianceCache, add_to_sample, choose, select

POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
STEP = np.array([[0.05, 0.0], [0.0, -0.05]])


def steady_source(direction=1.0, n=200, ends=False):
    """Action 0 moves along the first variable, action 1 along the second, the same everywhere."""
    states, actions = np.random.default_rng(0).uniform(0.1, 0.9, (n, 2)), np.arange(n) % 2
    after = states + direction * STEP[actions]
    return SourceInstances(states, actions, np.full(n, -1.0), after, np.full(n, ends), [0.0, 0.0], [1.0, 1.0], 2)


def check_of(source=None):
    return InstancesCheck([steady_source() if source is None else source])


def given_to(rng, n_actions=3, room=4, d=2):
    given = TransferredInstances.empty(n_actions + 2, d, room)
    given.length[:] = rng.integers(0, room + 1, n_actions + 2)
    for name in ("weight", "effect", "reward"):
        getattr(given, name)[:] = rng.random(getattr(given, name).shape) + 0.1
    given.terminated[:] = rng.random(given.terminated.shape) < 0.5
    return given


def one_instance(effect, end=False):
    """The same instance for either action."""
    given = TransferredInstances.empty(2, 2, 1)
    given.length[:], given.weight[:], given.effect[:], given.reward[:], given.terminated[:] = 1, 1.0, effect, -1.0, end
    return given


def step(check, given, effect, reward=-1.0, terminated=False, state=None):
    state = np.random.default_rng(check.n_compared).random(2) if state is None else state
    if given is not None:
        check.note_use(state, given, 2)
    check.observe(state, 0, reward, np.asarray(effect), terminated)


def act(method, state, action, effect, terminated=False):
    """One step of an agent that has no instances of its own."""
    method.note_use(transferred_at(method, state, np.zeros(2)))
    method.observe(state, action, -1.0, state + effect, terminated)


def breadths(source, n_episodes, effect_of, n_steps=30, **kwargs):
    """Breadth after each of so many episodes that run into their time limit."""
    kwargs = dict(breadth_decay=0.5) | kwargs
    method = bound(TIMBREL(source, InterTaskMapping([0, 1], [0, 1]), **kwargs), naive.target_task(POINTS, 2))
    rng, found = np.random.default_rng(1), []
    for _ in range(n_episodes):
        for _ in range(n_steps):
            state, action = rng.uniform(0.2, 0.8, 2), int(rng.integers(2))
            act(method, state, action, effect_of(action, rng))
        method.end_episode(True)
        found.append(method.statistics()["transfer/breadth"])
    return found, method


def test_the_error_is_that_of_the_weighted_means_where_something_was_transferred():
    rng, check = np.random.default_rng(0), check_of()
    wrong, moved, ages = [], [], 0
    for _ in range(60):
        given, state, action, effect = given_to(rng), rng.random(2), int(rng.integers(3)), rng.normal(size=2)
        check.note_use(state, given, 3)
        n = given.length[action]
        if n:
            mean = sum(given.weight[action, k] * given.effect[action, k] for k in range(n)) / sum(given.weight[action, :n])
            wrong.append(sum((effect - mean) ** 2))
            moved.append(sum(effect**2))
            ages += 1
        # The arrays are used again by the next call.
        given.effect[:], given.weight[:] = np.nan, np.nan
        check.observe(state, action, -1.0, effect, False)
    assert 10 < ages == check.n_compared < 60
    weights = (1.0 - 1.0 / WINDOW) ** np.arange(ages)[::-1]
    assert check.error() == pytest.approx(np.dot(weights, wrong) / np.dot(weights, moved))


def test_environments_that_act_before_either_has_moved_are_told_apart():
    check, states = check_of(), np.array([[0.1, 0.2], [0.3, 0.4]])
    effects = [0.05, 0.0], [0.0, -0.07]
    for state, effect in zip(states, effects, strict=True):
        check.note_use(state, one_instance(effect), 2)
    for state, effect in zip(states, effects, strict=True):
        check.observe(state, 0, -1.0, np.array(effect), False)
    assert (check.n_compared, check.error()) == (2, 0.0)
    check.observe(states[0], 0, -1.0, np.array(effects[1]), False)
    assert check.n_compared == 2, "each step of the agent counts once"


def test_a_right_source_keeps_its_breadth_and_one_of_the_other_direction_narrows_with_each_episode_that_reaches_its_limit():
    found, method = breadths(steady_source(), 8, lambda action, rng: STEP[action] + 0.01 * rng.normal(size=2))
    assert found == [0.3] * len(found) and 0.0 < method.statistics()["transfer/prediction_error"] < 0.2
    # Of a narrower kernel than the third's too few states get instances at all.
    found, method = breadths(steady_source(-1.0), 3, lambda action, rng: STEP[action])
    np.testing.assert_allclose(found, 0.3 * 0.5 ** np.arange(1, 4))
    assert method.statistics()["transfer/prediction_error"] == pytest.approx(4.0)
    assert breadths(steady_source(-1.0), 4, lambda action, rng: STEP[action], breadth_decay=1.0)[0] == [0.3] * 4


def test_the_same_evidence_narrows_once_only():
    check = check_of()
    for _ in range(MIN_COMPARED - 1):
        step(check, one_instance([-0.05, 0.0]), [0.05, 0.0])
    assert not check.end_episode(True)
    step(check, one_instance([-0.05, 0.0]), [0.05, 0.0])
    assert not check.end_episode(False), "an episode that ends by itself narrows nothing"
    assert check.end_episode(True)
    for _ in range(2 * MIN_COMPARED):
        step(check, None, [0.05, 0.0])
    assert not check.end_episode(True)
    for _ in range(MIN_COMPARED):
        step(check, one_instance([-0.05, 0.0]), [0.05, 0.0])
    assert check.end_episode(True)


def visit_to_a_predicted_end(check, comes=False):
    step(check, one_instance([0.05, 0.0], end=True), [0.05, 0.0], terminated=comes)
    if not comes:
        step(check, None, [0.05, 0.0])


def test_ends_that_never_come_contradict_a_source_whose_effects_are_right():
    check = check_of()
    for _ in range(2):
        visit_to_a_predicted_end(check)
    assert not check.end_episode(True)
    visit_to_a_predicted_end(check)
    assert check.end_episode(True) and check.error() == 0.0 and not check.end_episode(True)


def test_ends_that_came_once_outweigh_those_that_did_not():
    check = check_of()
    visit_to_a_predicted_end(check, comes=True)
    check.end_episode(False)
    for _ in range(10):
        visit_to_a_predicted_end(check)
    assert not check.end_episode(True)


@pytest.mark.parametrize(
    ("rewards", "narrows"), [((-1.0, -1.0), True), ((0.0, 0.0), True), ((1.0, 1.0), False), ((-1.0, 0.0), False)]
)
def test_episodes_in_which_nothing_is_tried_count_where_no_reward_tells_states_apart(rewards, narrows):
    check, found = check_of(), []
    for _ in range(EPISODES_IN_VAIN + 1):
        for reward in rewards:
            step(check, None, [0.05, 0.0], reward=reward)
        found.append(check.end_episode(True))
    assert found == [False] * (EPISODES_IN_VAIN - 1) + [narrows] * 2
    check.end_episode(False)
    assert not check.end_episode(True)


def test_wrong_effects_are_warned_of_once():
    with pytest.warns(UserWarning, match=r"worse than that nothing changes: .* 4\.00 times as large") as caught:
        breadths(steady_source(-1.0), 20, lambda action, rng: STEP[action], breadth_decay=1.0)
    [warning] = caught
    assert "tests" in Path(warning.filename).parts
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        breadths(steady_source(), 19, lambda action, rng: STEP[action])


# Drawn choices: each candidate in proportion to its mean compliance, the same however often one asks.
N_DRAWS = 4000
NOT_PERIODIC = np.zeros(2, dtype=bool)


def random_cache(rng, n_transitions, n_candidates, least=0.4):
    cache = ComplianceCache.empty(n_candidates + 2, n_transitions)
    cache.compliance[:] = rng.random(cache.compliance.shape)
    cache.required[:] = least
    cache.measured[:] = True
    return cache


def shares(near, cache, n_candidates, n_before=5):
    """The fraction of evenly spread draws that chooses each candidate of the second of two actions; the last entry: none."""
    draws, choice = (np.arange(N_DRAWS) + 0.5) / N_DRAWS, np.full(2 * N_DRAWS, -7)
    first, actions = np.array([0, n_before, n_before + n_candidates]), np.ones(N_DRAWS, dtype=np.int64)
    rows, each_near = np.arange(N_DRAWS, 2 * N_DRAWS), np.tile(near, (2 * N_DRAWS, 1))
    choose.call(rows, actions, each_near, tuple(cache), first, draws, choice)
    assert (choice[:N_DRAWS] == -7).all()
    chosen = np.where(choice[N_DRAWS:] < 0, n_candidates, choice[N_DRAWS:] - n_before)
    return np.bincount(chosen, minlength=n_candidates + 1) / N_DRAWS


@settings(deadline=None, derandomize=True, max_examples=20)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from([0.0, 0.4, 0.6, 2.0]))
def test_each_candidate_is_drawn_in_proportion_to_its_mean_compliance(seed, n_candidates, least):
    rng = np.random.default_rng(seed)
    cache, near = random_cache(rng, 6, n_candidates, least), rng.permutation(6)[:3]
    near[rng.integers(1, 4) :] = -1
    means = cache.compliance[near[near >= 0], :n_candidates].mean(axis=0)
    enough = np.where(means > least, means, 0.0)
    expected = np.append(enough / enough.sum(), 0.0) if enough.any() else np.eye(n_candidates + 1)[-1]
    np.testing.assert_allclose(shares(near, cache, n_candidates), expected, atol=1.5 / N_DRAWS)


@settings(deadline=None, derandomize=True, max_examples=20)
@given(st.integers(0, 10**6), st.booleans(), st.sampled_from([(False, False), (True, False), (True, True)]))
def test_at_a_sample_state_the_choice_is_the_same_as_on_the_grid(seed, drawn, periodic):
    rng = np.random.default_rng(seed)
    n_actions, n_candidates, n, first = 2, 4, 20, np.array([0, 4, 8])
    cache, states, actions = random_cache(rng, n, n_candidates), rng.random((n, 2)), rng.integers(n_actions, size=n)
    draws = rng.random(n_actions) if drawn else np.empty(0)
    limit = 0.3**2
    near, distance = np.full((n_actions, len(POINTS), 3), -1), np.full((n_actions, len(POINTS), 3), limit)
    due = np.zeros((n_actions, len(POINTS)), dtype=bool)
    sample = np.ascontiguousarray(POINTS.T), np.array(periodic)
    for i, action in enumerate(actions):
        add_to_sample.call(i, states[i], sample, near[action], distance[action], due[action], np.empty(len(POINTS)))
    np.testing.assert_array_equal(due, near[:, :, 0] >= 0)
    on_grid, each = np.full(n_actions * len(POINTS), -1), np.repeat(np.arange(n_actions), len(POINTS))
    of_pairs = draws[each] if drawn else draws
    choose.call(np.arange(len(on_grid)), each, near.reshape(-1, 3), tuple(cache), first, of_pairs, on_grid)
    recorded = states, *by_action(actions, n_actions), np.array(periodic)
    for p, state in enumerate(POINTS):
        asked = np.tile(state, (n_actions, 1)), np.arange(n_actions), np.zeros(n_actions)
        found = room_for(n_actions)
        assert select.call(asked, recorded, (1.0, limit), tuple(cache), first, draws, found)
        np.testing.assert_array_equal(found[0], near[:, p])
        np.testing.assert_array_equal(np.sort(found[0], axis=1), nearest(state, states, actions, periodic, limit))
        np.testing.assert_array_equal(candidates_of(found), on_grid.reshape(n_actions, -1)[:, p])


def nearest(state, states, actions, periodic, limit):
    """The three nearest transitions of each action, one by one, in the order of their numbers; -1 for none."""
    rows = []
    for action in range(2):
        near = []
        for i in np.flatnonzero(actions == action):
            apart = np.abs(states[i] - state)
            apart = [min(a, 1.0 - a) if wraps else a for a, wraps in zip(apart, periodic, strict=True)]
            near.append((sum(a * a for a in apart), i))
        kept = [i for distance, i in sorted(near)[:3] if distance < limit]
        rows.append([-1] * (3 - len(kept)) + sorted(kept))
    return rows


def room_for(n, k=3):
    """Arrays that receive what is found at exact states: nearest transitions, distances, ranges of candidates."""
    return np.empty((n, k), dtype=np.int64), np.empty((n, k)), np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)


def candidates_of(found):
    """The candidate selected for each state, -1 for none."""
    _, _, first, last = found
    assert np.isin(last - first, [0, 1]).all()
    return np.where(first < last, first, -1)


def by_action(actions, n_actions):
    """The transitions of each action, as the selector lists them."""
    listed = np.zeros((n_actions, len(actions)), dtype=np.int64)
    for action in range(n_actions):
        rows = np.flatnonzero(actions == action)
        listed[action, : len(rows)] = rows
    return listed, np.bincount(actions, minlength=n_actions)


def test_nothing_is_selected_before_all_neighbors_have_been_measured():
    query = np.zeros((2, 2)), np.arange(2), np.zeros(2)
    recorded = np.zeros((3, 2)), *by_action(np.array([0, 1, 1]), 2), NOT_PERIODIC
    found, cache = room_for(2), random_cache(np.random.default_rng(0), 3, 2, least=0.0)
    found[2][:], found[3][:] = 7, 7
    for i, complete in ((2, False), (0, True)):
        cache.measured[:] = [True, True, i != 2]
        assert select.call(query, recorded, (1.0, 1.0), tuple(cache), np.array([0, 2, 4]), np.empty(0), found) == complete
        assert found[0].tolist() == [[0, -1, -1], [1, 2, -1]], "what is to be measured"
        assert (found[2] == 7).all() != complete


@settings(deadline=None, derandomize=True, max_examples=25)
@given(st.integers(0, 10**6), st.integers(1, 8), st.sampled_from([0.0, 0.375, 0.625, 2.0]))
def test_the_best_candidate_is_the_best_mapping_of_algorithm_1(seed, n_candidates, least):
    rng = np.random.default_rng(seed)
    cache, sample = random_cache(rng, 20, n_candidates, least), rng.random((20, 2))
    actions, k = rng.integers(2, size=20), int(rng.integers(1, 6))
    # Some equal, some 0: of equal ones the first is chosen, and a mapping without any evidence is not. Sums are exact.
    cache.compliance[:] = np.round(8.0 * cache.compliance) / 8.0
    transitions = equations.Transitions(sample, actions, np.zeros((20, 2)), np.zeros(20), np.zeros(20, dtype=bool))
    query, first = (rng.random((8, 2)), np.tile(np.arange(2), 4), np.zeros(8)), np.array([0, n_candidates, 2 * n_candidates])
    found, recorded = room_for(8, k), (sample, *by_action(actions, 2), NOT_PERIODIC)
    assert select.call(query, recorded, (1.0, np.inf), tuple(cache), first, np.empty(0), found)
    for state, action, chosen in zip(query[0], query[1], candidates_of(found), strict=True):
        near = equations.nearest_transitions(state, action, transitions, k)
        best = equations.best_mapping(cache.compliance[near, :n_candidates], least)
        assert chosen == (-1 if best is None else first[action] + best)


def test_to_ask_leaves_no_trace():
    rng = np.random.default_rng(1)
    method = COMBREL(naive.random_source(rng, 100, 2, 2), choice="drawn", min_compliance=0.0)
    bound(method, naive.target_task(POINTS, 2))
    for _ in range(15):
        show(method, naive.random_transition(rng, 2, 2))
    changed_pairs(method)
    before = method.rng.bit_generator.state, {name: array.copy() for name, array in method.get_state().items()}
    for state in np.random.default_rng(3).random((10, 2)):
        asked = np.tile(state, (2, 1)), np.arange(2)
        assert method.selected(*asked).tolist() == method.selected(*asked).tolist()
    assert method.rng.bit_generator.state == before[0]
    for name, array in method.get_state().items():
        np.testing.assert_array_equal(array, before[1][name])
