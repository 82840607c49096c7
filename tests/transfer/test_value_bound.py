"""An upper bound on the values of the target, from the source's: against optimal returns that can be counted."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from helpers import factored as f
from helpers.agents import make_agent
from helpers.factored import bound, show
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, SourceInstances
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.prior_choice import Choice, whole_part
from sb3_combrel.transfer.prior.value_bound import ValueBound

# A line from 0 to 1: one action goes up, the other down; an episode ends above GOAL.
STEP, GOAL = 0.05, 0.9
POINTS = np.linspace(0.0, 1.0, 21)


def line_source(low=0.0, high=1.0, reward=-1.0, goal=GOAL, n=400, seed=0):
    """Transitions from states between ``low`` and ``high``."""
    rng = np.random.default_rng(seed)
    states, actions = low + (high - low) * rng.random((n, 1)), rng.integers(2, size=n)
    after = np.clip(states + np.where(actions == 1, STEP, -STEP)[:, None], 0.0, 1.0)
    rewards = reward + np.zeros(n)
    return SourceInstances(states, actions, rewards, after, after[:, 0] > goal, [0.0], [1.0], 2, ("x",), ("down", "up"))


def task(n_variables, gamma=1.0, max_value=0.0):
    """A target whose sample of states is a line along each variable, or along all at once."""
    states = [np.repeat(POINTS[:, None], n_variables, axis=1)]
    for v in range(n_variables):
        states.append(np.full((len(POINTS), n_variables), 0.5))
        states[-1][:, v] = POINTS
    scaling = StateScaling(np.zeros(n_variables), np.ones(n_variables))
    names = tuple(f"s{k}" for k in range(n_variables))
    return TargetTask(scaling, 2, np.vstack(states), 1.0, 0.01, 0.1, names, ("a", "b"), gamma=gamma, max_value=max_value)


def value_bound(sources, target, state, sign=None, source=None):
    state = np.array(state)
    sign = np.ones_like(state) if sign is None else np.array(sign)
    source = np.zeros(len(state), dtype=np.int64) if source is None else np.array(source)
    return ValueBound(Copies(sources, source, state, sign, 0.1), target)


def all_of(*copies, n_actions=2):
    """Each target action moves the same copies."""
    return Choice(
        np.tile(np.array(copies, dtype=np.int64), (n_actions, 1)), np.zeros((n_actions, len(copies)), dtype=np.int64)
    )


def best_return(x, gamma=1.0, reward=-1.0, goal=GOAL):
    """Counted: so many steps up to the goal."""
    steps = np.maximum(1, np.ceil((goal - x) / STEP + 1e-9))
    return reward * (steps if gamma == 1.0 else (1.0 - gamma**steps) / (1.0 - gamma))


@pytest.mark.parametrize("gamma", [1.0, 0.95])
@pytest.mark.parametrize("sign", [1, -1])
def test_it_is_the_return_that_is_best_in_the_source(gamma, sign):
    target = task(2, gamma)
    found = value_bound([line_source()], target, [[-1, 0]], [[1, sign]]).through(all_of(0))
    x = target.sample_states[:, 1]
    expected = best_return(x if sign > 0 else 1.0 - x, gamma)
    # No less, as it is a bound; and by less than a step more, as a step is rounded up, and the border of ends is blurred.
    assert (found > expected - 0.1).all() and (found < expected + 1.0).all()
    assert np.corrcoef(found, expected)[0, 1] > 0.99


def test_where_the_source_has_no_data_everything_may_be_beyond():
    found = value_bound([line_source(high=0.5)], task(1, max_value=3.0), [[0]]).through(all_of(0))[: len(POINTS)]
    assert (found[POINTS > 0.65] == 3.0).all(), "nothing is known there"
    # Up to the border of what is known, and 3 beyond it.
    border = 0.5 + STEP
    low = POINTS < 0.4
    assert (found[low] >= 3.0 + best_return(POINTS[low], goal=border + 0.1) - 1.6).all()
    assert (found[low] <= 3.0 + best_return(POINTS[low], goal=border - 0.1) + 1.6).all()


def test_an_action_that_no_instance_has_taken_is_left_out_of_the_sources_plan():
    """It would be worth ``max_value`` everywhere."""
    source = line_source()
    with_idle = replace(source, n_actions=3, action_names=("down", "up", "idle"))
    numbered_on = replace(source, n_actions=3, actions=source.actions + 1, action_names=("idle", "down", "up"))
    expected = value_bound([source], task(1), [[0]]).through(all_of(0))
    np.testing.assert_array_equal(value_bound([with_idle], task(1), [[0]]).through(all_of(0)), expected)
    of_two = value_bound([with_idle, numbered_on], task(2), [[0, -1], [-1, 0]], source=[0, 1])
    assert of_two.through(all_of(0)) is not None
    assert of_two.through(all_of(0, 1)) is None, "one of the second source's is idle, of which nothing is known"


def test_of_several_copies_the_one_that_is_worth_least_bounds_the_target():
    target = task(2)
    of_two = value_bound([line_source(), line_source(goal=0.6)], target, [[0, -1], [-1, 0]], source=[0, 1])
    found, one, two = (of_two.through(all_of(*copies)) for copies in ((0, 1), (0,), (1,)))
    np.testing.assert_array_equal(found, np.minimum(one, two))
    expected = best_return(target.sample_states[:, 1], goal=0.6)
    assert (two > expected - 0.1).all() and (two < expected + 1.0).all()
    assert (found < one).any() and (found < two).any()


@pytest.mark.parametrize("rewards", [(-1.0, -2.0), (1.0, 1.0), (np.linspace(-1.0, -2.0, 400), -1.0)])
def test_nothing_bounds_several_copies_whose_steps_do_not_cost_the_same(rewards):
    sources = [line_source(reward=reward) for reward in rewards]
    of_two = value_bound(sources, task(2, gamma=0.9, max_value=20.0), [[0, -1], [-1, 0]], source=[0, 1])
    assert of_two.through(all_of(0, 1)) is None
    assert of_two.through(all_of(0)) is not None and of_two.through(all_of(1)) is not None


def test_nothing_bounds_a_target_whose_actions_are_those_of_different_copies():
    of_two = value_bound([line_source()], task(2), [[0, -1], [-1, 0]])
    assert of_two.through(Choice(np.array([[0], [1]]), np.zeros((2, 1), dtype=np.int64))) is None
    assert of_two.through(all_of(-1)) is None


def test_a_copy_that_leaves_out_variables_of_its_source_bounds_nothing():
    source, states = f.oscillator_source(), np.array([[0, 1, -1, -1], [-1, -1, 0, -1], [-1, -1, -1, 1]])
    copies = Copies([source], np.zeros(3, dtype=np.int64), states, np.ones((3, 4)), 0.2)
    assert copies.whole.tolist() == [True, False, False]
    kept, nothing = (whole_part(copies, all_of(*numbers, n_actions=5)) for numbers in ((1, 0, 2), (1, 2)))
    assert kept.same(all_of(0, n_actions=5)) and nothing.copies.shape == nothing.actions.shape == (5, 0)
    target = replace(f.target_task(4, 5), sample_states=np.random.default_rng(0).random((50, 4)))
    parts = ValueBound(copies, target)
    assert parts.through(nothing) is None
    np.testing.assert_array_equal(parts.through(kept), parts.through(all_of(0, n_actions=5)))


TWO = f.copies_mapping(2, (0, 2, 1, 3))


def prior_of(transfer, n, **outcomes):
    transfer = bound(transfer)
    show(transfer, f.walk(TWO, n), **outcomes)
    return transfer.source_prior


def test_the_source_bounds_values_once_it_explains_all_actions():
    given = bound(TIMBREL(f.oscillator_source(), TWO, use="prior"))
    assert given.value_bound() is not None, "of a given mapping from the first step on"
    transfer = bound(COMBREL(f.oscillator_source(), "factored", use="prior"))
    assert transfer.value_bound() is None, "nothing is explained yet"
    states, actions, effects = f.walk(TWO, 150)
    versions = []
    for i in range(150):
        transfer.observe(states[i], int(actions[i]), -1.0, states[i] + effects[i], False)
        versions.append((transfer.value_bound() is not None, transfer.prior_version()))
    first = [bounded for bounded, _ in versions].index(True)
    assert 9 <= first < 150 and versions[first][1] > versions[first - 1][1], "it is asked for again then"
    assert transfer.statistics()["transfer/values_bounded"] == 1.0
    assert transfer.report().bounds_values and "bounded by the source's value" in str(transfer.report())


def test_a_source_whose_ends_are_not_used_or_whose_rewards_are_others_bounds_nothing():
    source = f.oscillator_source()
    assert prior_of(TIMBREL(source, TWO, use="prior"), 150).value_bound() is not None
    without_ends = prior_of(TIMBREL(source, TWO, use="prior", transfer_terminals=False), 150)
    assert without_ends.explains and without_ends.value_bound() is None
    doubted = prior_of(TIMBREL(source, TWO, use="prior"), 150, rewards=np.ones(150))
    assert not doubted.explains and doubted.value_bound() is None
    assert doubted.statistics()["transfer/values_bounded"] == 0.0


def test_a_return_that_exceeds_the_bound_raises_it_by_as_much_everywhere():
    transfer = bound(TIMBREL(line_source(), InterTaskMapping([0], [1, 0]), use="prior"), 1, 2)
    before = transfer.value_bound()
    # As good as the source allows; then twice as fast.
    for step, excess in ((STEP, 0.0), (2.0 * STEP, 6.0)):
        at = 0.3
        while at <= GOAL:
            transfer.observe(np.array([at]), 0, -1.0, np.array([at + step]), at + step > GOAL)
            at += step
        prior, version = transfer.source_prior, transfer.prior_version()
        transfer.end_episode(truncated=False)
        # The border of where the source's episodes end is blurred.
        assert prior.excess == pytest.approx(excess, abs=2.1 if excess else 0.5)
        assert transfer.prior_version() == version + 1
    np.testing.assert_allclose(transfer.value_bound(), before + prior.excess)
    steps = prior.n_observed
    transfer.observe(np.array([0.3]), 0, -1.0, np.array([0.3 + STEP]), False)
    assert [(point.step, point.exceeded) for point in transfer.report().history][-2:] == [
        (steps, prior.excess),
        (steps + 1, prior.excess),
    ]


def test_an_episode_that_a_time_limit_ends_exceeds_nothing_where_steps_cost():
    transfer = bound(TIMBREL(line_source(), InterTaskMapping([0], [0, 0]), use="prior"), 1, 2)
    transfer.observe(np.array([0.1]), 0, -1.0, np.array([0.1 + STEP]), False)
    transfer.end_episode(truncated=True)
    assert transfer.source_prior.excess == 0.0


def test_returns_are_of_one_episode_also_where_nobody_says_that_it_ended():
    """As when all transitions are taken in once more, in other unit coordinates; and an episode of nothing exceeds nothing."""
    source = line_source(reward=1.0)
    transfer = bound(TIMBREL(source, InterTaskMapping([0], [1, 0]), use="prior"), 1, 2)
    for _ in range(2):
        for k in range(12):
            at = 0.31 + k * STEP
            transfer.observe(np.array([at]), 0, 1.0, np.array([at + STEP]), k == 11)
    assert len(transfer.source_prior._episodes[0]) == 12
    for _ in range(2):
        transfer.end_episode(truncated=False)
    assert len(transfer.source_prior._episodes) == 0


def test_found_optimism_reaches_the_source():
    """A target whose every step pays: discount and ``max_value`` are found from the first reward on."""
    source = line_source(reward=1.0, goal=0.5)
    agent = make_agent(1, 2, TIMBREL(source, InterTaskMapping((0,), (0, 1)), use="prior"))
    rng = np.random.default_rng(0)
    for _ in range(50):
        x, action = rng.random(1), int(rng.integers(2))
        after = np.clip(x + (STEP if action else -STEP), 0.0, 1.0)
        agent.update(x, action, 1.0, after, False)
    assert (agent.mdp.gamma, agent.planner.bounds[1]) == pytest.approx((0.99, 100.0))
    x = agent.grid.points()[:, 0]
    there = (x > 0.55) & (x < 0.85)
    # Whatever it does, an episode that begins near the end of the source's ends at the next step.
    assert agent.planner.upper[there].max() < 100.0
    assert agent.planner.upper[(x >= 0.0) & (x < 0.3)].min() > 90.0
    again = make_agent(1, 2, TIMBREL(source, InterTaskMapping((0,), (0, 1)), use="prior"))
    again.set_state(agent.get_state())
    np.testing.assert_array_equal(again.planner.upper, agent.planner.upper)


class Room(gym.Env):
    """A square room, one step to each side, from one corner to the opposite one."""

    observation_space, action_space = gym.spaces.Box(0.0, 1.0, (2,), np.float64), gym.spaces.Discrete(4)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.np_random.uniform(0.05, 0.15, 2)
        return self.at.copy(), {}

    def step(self, action):
        self.at = after_step(self.at, np.array(action))
        return self.at.copy(), -1.0, bool(in_corner(self.at)), False, {}


def after_step(states, actions):
    return np.clip(states + 0.08 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])[actions], 0.0, 1.0)


def in_corner(states):
    return np.abs(states - 0.9).max(axis=-1) < 0.08


def test_the_whole_task_bounds_values_where_its_parts_explain_a_little_more(tmp_path):
    """The coordinates of a room move each on its own, which says nothing of where its corner is; they can be exchanged."""
    rng = np.random.default_rng(0)
    states, actions = rng.random((800, 2)), rng.integers(4, size=800)
    after = after_step(states, actions)
    source = SourceInstances(states, actions, -np.ones(800), after, in_corner(after), [0.0, 0.0], [1.0, 1.0], 4)
    env = Monitor(gym.wrappers.TimeLimit(Room(), 100))
    model = FittedRMax(env, transfer=COMBREL(source), seed=0, model_breadth=0.1, resolution=4).learn(300)
    prior, report = model.transfer.source_prior, model.transfer.report()
    assert not prior.copies.whole[prior.choice.same_copies()].any() and not whole_part(prior.copies, prior.choice).copies.size
    assert prior.copies.state[prior.bounding.same_copies()].tolist() in ([[0, 1]], [[1, 0]]) and report.bounds_values
    assert f"seen through {prior.candidates.describe_choice(prior.bounding)}" in str(report)
    # Without a source the first end comes after hundreds of steps.
    assert env.get_episode_lengths()[0] < 100
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model").transfer.source_prior
    assert loaded.bounding.same(prior.bounding) and loaded.choice.same(prior.choice)
    np.testing.assert_array_equal(loaded.value_bound(), prior.value_bound())
