"""When transferred instances are contradicted: by effects and ends that the agent finds to be others, not by time limits."""

import warnings

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, transferred_at

from sb3_combrel import TIMBREL, InterTaskMapping, SourceInstances
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.transfer.instances.instances_check import EPISODES_IN_VAIN, MIN_COMPARED, WINDOW, InstancesCheck

POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 4)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
STEP = np.array([[0.05, 0.0], [0.0, -0.05]])


def steady_source(direction=1.0, n=200, ends=False):
    """Action 0 moves along the first variable, action 1 along the second, the same everywhere."""
    states, actions = np.random.default_rng(0).uniform(0.1, 0.9, (n, 2)), np.arange(n) % 2
    after = states + direction * STEP[actions]
    return SourceInstances(states, actions, np.full(n, -1.0), after, np.full(n, ends), [0.0, 0.0], [1.0, 1.0], 2)


def check_of(source=None):
    return InstancesCheck([steady_source() if source is None else source], 1.0)


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
    assert found == [0.3] * len(found)
    assert 0.0 < method.statistics()["transfer/prediction_error"] < 0.2
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
    assert check.end_episode(True) and check.error() == 0.0
    assert not check.end_episode(True)


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
    check = check_of()
    found = []
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
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        breadths(steady_source(), 19, lambda action, rng: STEP[action])
