"""``max_value`` and ``gamma`` follow from the rewards seen, unless the user gives them."""

import numpy as np
import pytest
from helpers.agents import make_agent
from hypothesis import given
from hypothesis import strategies as st

from sb3_combrel.fitted_rmax.optimism import DEFAULT_GAMMA, RewardRange

SIZES = st.floats(1e-3, 1e3)
REWARDS = st.floats(-1e3, 1e3)
STEPS = st.lists(st.tuples(REWARDS, st.booleans()), max_size=12)


def after(steps, n_truncated=0, gamma=None, max_value=None):
    """A range that has seen steps (reward, terminated), and so many time limits."""
    rewards = RewardRange(gamma, max_value)
    for reward, terminated in steps:
        rewards.note(reward, terminated)
    rewards.n_truncated += n_truncated
    return rewards


@given(st.lists(SIZES, min_size=1, max_size=8), REWARDS, st.integers(0, 3))
def test_where_every_step_costs_and_episodes_end_nothing_is_discounted(costs, at_end, n_truncated):
    rewards = after([*((-cost, False) for cost in costs), (at_end, True)], n_truncated)
    assert rewards.gamma == 1.0 and rewards.max_value == max(0.0, at_end)


@given(st.lists(SIZES, min_size=1, max_size=8))
def test_where_no_episode_ends_but_by_its_time_limit_the_future_is_discounted(costs):
    steps = [(-cost, False) for cost in costs]
    assert after(steps).gamma == 1.0 and after(steps, n_truncated=1).gamma == DEFAULT_GAMMA
    assert after([*steps, (0.0, True)], n_truncated=1).gamma == 1.0
    assert after(steps, n_truncated=1).max_value == 0.0


@given(STEPS, SIZES, REWARDS)
def test_what_is_paid_at_every_step_may_be_collected_for_ever(steps, reward, at_end):
    rewards = after([*steps, (reward, False), (at_end, True)])
    paid, ends = (max(r for r, t in [*steps, (reward, False), (at_end, True)] if t == of) for of in (False, True))
    assert rewards.gamma == DEFAULT_GAMMA
    assert rewards.max_value == pytest.approx(max(paid / (1.0 - DEFAULT_GAMMA), ends))


@given(st.lists(SIZES, max_size=6), st.lists(st.floats(-1e3, 0.0), max_size=3))
def test_where_the_most_is_nothing_the_unknown_is_worth_what_the_worst_costs_for_ever(costs, ends):
    rewards = after([(0.0, False), *((-cost, False) for cost in costs), *((end, True) for end in ends)])
    worst = max([*costs, *(-end for end in ends), 0.0])
    assert rewards.gamma == DEFAULT_GAMMA
    assert rewards.max_value == pytest.approx(worst / (1.0 - DEFAULT_GAMMA) if worst > 0.0 else 1.0)
    assert rewards.max_value > 0.0, "more than what costs nothing, or nothing would draw the agent on"
    undiscounted = after([(0.0, False), *((-cost, False) for cost in costs), *((end, True) for end in ends)], gamma=1.0)
    assert undiscounted.max_value == rewards.max_value


@given(STEPS, REWARDS, st.floats(0.1, 1.0), st.integers(0, 3))
def test_what_the_user_gives_stays(steps, max_value, gamma, n_truncated):
    rewards = after(steps, n_truncated, gamma, max_value)
    assert (rewards.gamma, rewards.max_value) == (gamma, max_value)


@given(STEPS, st.one_of(st.none(), st.floats(0.1, 1.0)))
def test_no_discounted_return_of_rewards_seen_is_above_the_value_of_the_unknown(steps, gamma):
    """But for a gamma of the user's that discounts nothing: then no bound exists."""
    rewards = after(steps, n_truncated=1, gamma=gamma)
    if rewards.gamma == 1.0 and rewards.largest > 0.0:
        return
    value = 0.0
    for reward, _ in reversed([step for step in steps if not step[1]]):
        value = reward + rewards.gamma * value
        assert value <= rewards.max_value + 1e-6 * max(1.0, abs(value))


@given(STEPS, STEPS, st.integers(0, 3))
def test_it_comes_back_from_its_state_and_goes_on(before, later, n_truncated):
    rewards, restored = after(before, n_truncated), RewardRange(None, None)
    state = rewards.get_state()
    assert state.shape == (5,) and np.isfinite(state).all()
    restored.set_state(state)
    for each in (rewards, restored):
        for reward, terminated in later:
            each.note(reward, terminated)
    assert vars(restored) == vars(rewards)
    assert (restored.gamma, restored.max_value) == (rewards.gamma, rewards.max_value)


def test_an_agent_follows_the_rewards_that_it_sees():
    agent = make_agent(1, 2, model_breadth=0.1, resolution=3)
    here, there = np.array([0.3]), np.array([0.4])
    optimum = {agent.q_values(here)[0]}
    for reward, terminated, max_value, gamma in [
        *[(-1.0, False, 0.0, 1.0), (5.0, True, 5.0, 1.0), (0.0, False, 5.0, DEFAULT_GAMMA)],
        (2.0, False, 200.0, DEFAULT_GAMMA),
        (0.5, False, 200.0, DEFAULT_GAMMA),
    ]:
        agent.update(here, 0, reward, there, terminated)
        assert agent.planner.bounds[1] == pytest.approx(max_value) and agent.mdp.gamma == gamma
        untried = agent.q_values(here)[1]
        if agent.rewards.differ:
            assert untried == pytest.approx(max_value), "the action that nobody has tried"
            optimum.add(untried)
        else:
            assert max_value - 1.0 < untried < max_value, "where one has been and found nothing"
    assert len(optimum) == 3


def test_an_agent_whose_episodes_reach_their_time_limit_discounts():
    agent = make_agent(1, 1, model_breadth=0.1, resolution=3)
    for _ in range(4):
        agent.update(np.array([0.5]), 0, -1.0, np.array([0.5]), False)
    assert agent.mdp.gamma == 1.0
    for _ in range(3):
        agent.end_episode(truncated=True)
    assert agent.mdp.gamma == DEFAULT_GAMMA
    assert agent.q_values(np.array([0.5]))[0] == pytest.approx(-1.0 / (1.0 - DEFAULT_GAMMA), rel=0.01)
