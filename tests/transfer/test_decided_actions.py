"""Transfer methods that decide actions: asked at each step of learning, never for predictions, and checked."""

import numpy as np
import pytest
from helpers.agents import make_agent
from helpers.walk import OBSERVATIONS, Walk, same_parameters, small
from stable_baselines3.common.env_util import make_vec_env

from sb3_combrel.transfer.base import Transfer


class Silent(Transfer):
    """Transfers nothing, and decides nothing."""

    use = "actions"

    def transferred(self, states, actions, own_weight):
        raise AssertionError("a method that decides actions only is not asked for instances")

    def observe(self, state, action, reward, next_state, terminated):
        self.observed = [*getattr(self, "observed", []), (self.environment, state.copy(), action, reward)]


class Deciding(Silent):
    """Decides on every other action: that of its constructor."""

    def __init__(self, what=1, every=2):
        self.what, self.every = what, every
        self.asked = []

    def action(self, state):
        self.asked.append((self.environment, state.copy()))
        return self.what if len(self.asked) % self.every == 0 else None


class Undecided(Silent):
    """Is asked, and leaves all to the agent."""

    def action(self, state):
        return None


def test_the_agent_does_what_is_decided_and_else_what_it_would():
    agent = make_agent(1, 3, Deciding(2, every=1))
    assert [agent.act(np.array([at])) for at in (0.1, 0.5, 0.9)] == [2, 2, 2]
    assert {make_agent(1, 3, Deciding(2, every=9), rng=seed).act(np.array([0.5])) for seed in range(20)} == {0, 1, 2}


def test_it_is_asked_once_at_each_step_of_learning_with_the_state_that_is_observed_next():
    model = small(transfer=Deciding()).learn(70)
    method = model.policy.transfer
    assert len(method.asked) == len(method.observed) == 70
    for (_, asked), (_, state, *_) in zip(method.asked, method.observed, strict=True):
        np.testing.assert_array_equal(asked, state)
    assert {action for *_, action, _ in method.observed[1::2]} == {1}
    assert {action for *_, action, _ in method.observed[::2]} == {0, 1}
    assert model.agent.model.n_instances == 70
    for deterministic in (True, False):
        model.predict(OBSERVATIONS, deterministic=deterministic)
    model.agent.q_values(np.array([0.5, 0.5]))
    assert len(method.asked) == 70, "it is not asked for predictions"


@pytest.mark.parametrize("method", [Silent, Undecided])
def test_one_that_decides_nothing_leaves_learning_as_it_is_without_transfer(method):
    alone, with_it = small().learn(100), small(transfer=method()).learn(100)
    assert same_parameters(alone, with_it)


def test_each_environment_has_its_number():
    model = small(make_vec_env(Walk, n_envs=3), transfer=Deciding()).learn(60)
    method = model.policy.transfer
    assert [environment for environment, _ in method.asked] == [0, 1, 2] * 20
    assert [environment for environment, *_ in method.observed] == [0, 1, 2] * 20
    assert Deciding.environment == 0


@pytest.mark.parametrize("what", [-1, 3, 1.0, True, "left", np.nan, [1]], ids=repr)
def test_whatever_is_no_action_is_refused(what):
    agent = make_agent(1, 3, Deciding(what, every=1))
    with pytest.raises(ValueError, match=r"Deciding\.action must return None or a whole number from 0 to 2, got"):
        agent.act(np.array([0.5]))
