"""Learning with bounded values: less is explored, and a model is saved with its bounds."""

import numpy as np
import pytest
from gymnasium.envs.classic_control import MountainCarEnv
from gymnasium.wrappers import TimeLimit
from helpers import factored as f
from helpers.oscillators import Oscillators, episodes

from sb3_combrel import COMBREL, TIMBREL, FittedRMax
from sb3_combrel.common.transferred import PriorPredictions
from sb3_combrel.transfer.base import Transfer


class Bounded(Transfer):
    """Predicts nothing; after ``n_steps`` transitions states are worth at most ``highest`` at the left."""

    use = "prior"

    def __init__(self, n_steps=50, highest=-20.0, shape=None):
        self.n_steps, self.highest, self.shape, self.n_seen = n_steps, highest, shape, 0

    def observe(self, state, action, reward, next_state, terminated):
        self.n_seen += 1

    def transferred(self, states, actions, own_weight):
        raise AssertionError("a prior is not asked for instances")

    def prior(self, states, actions):
        return PriorPredictions.nothing(len(actions), self.task.n_variables)

    def prior_version(self):
        return int(self.n_seen >= self.n_steps)

    def value_bound(self):
        if not self.prior_version():
            return None
        return self.highest * (1.0 - self.task.sample_states[:, 0]) if self.shape is None else np.zeros(self.shape)

    def get_state(self):
        return {"n_seen": np.array([float(self.n_seen)])}

    def set_state(self, state):
        self.n_seen = int(state["n_seen"][0])


def car():
    return TimeLimit(MountainCarEnv(), 200)


def test_bounds_of_a_method_of_ones_own_are_used_from_when_its_version_grows(tmp_path):
    model = FittedRMax(car(), degree=1, transfer=Bounded(), seed=0).learn(49)
    planner = model.agent.planner
    assert planner.values.max() == 0.0 and (planner.upper == 0.0).all()
    model.learn(2, reset_num_timesteps=False)
    bound = np.minimum(0.0, -20.0 * (1.0 - model.agent.grid.points()[:, 0]))  # not above max_value
    np.testing.assert_allclose(planner.upper, bound)
    assert (planner.values <= bound + 1e-9).all()
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=car())
    np.testing.assert_array_equal(loaded.agent.planner.upper, planner.upper)
    np.testing.assert_allclose(loaded.agent.planner.values, planner.values)


def test_bounds_of_a_wrong_shape_are_refused_with_what_would_be_right():
    with pytest.raises(ValueError, match=r"value_bound\(\) must return None or a finite number for each of the \d+ states"):
        FittedRMax(car(), degree=1, transfer=Bounded(shape=7), seed=0).learn(60)


class BoundOnly(TIMBREL):
    """Claims to know no outcome."""

    def prior(self, states, actions):
        predicted = super().prior(states, actions)
        return predicted._replace(weight=np.zeros(len(actions)))


class Nothing(BoundOnly):
    def value_bound(self):
        return None


@pytest.mark.long
def test_the_source_s_values_alone_shorten_learning():
    source, mapping = f.oscillator_source(800), f.copies_mapping(1)

    def steps_after_the_first_episode(method):
        return [sum(episodes(method(source, mapping, use="prior"), n=5, seed=seed)[1][1:]) for seed in range(6)]

    bounded, unbounded = (np.array(steps_after_the_first_episode(method)) for method in (BoundOnly, Nothing))
    assert bounded.mean() < 0.85 * unbounded.mean()


@pytest.mark.parametrize(
    "made", [lambda s: COMBREL(s, "factored", use="prior"), lambda s: TIMBREL(s, f.copies_mapping(1), use="prior")]
)
def test_a_model_is_saved_with_the_bounds_of_its_source_and_acts_the_same(made, tmp_path):
    model, _ = episodes(made(f.oscillator_source(800)), n=3)
    assert model.agent.transfer.value_bound() is not None
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Oscillators(1))
    np.testing.assert_array_equal(loaded.agent.planner.upper, model.agent.planner.upper)
    states = np.random.default_rng(0).random((200, 2))
    for one, other in zip(model.predict(states), loaded.predict(states), strict=True):
        if one is not None:
            np.testing.assert_array_equal(one, other)


def same_as_in_learning(model):
    """In which part of the states the frozen policy chooses the action that the agent would choose to learn."""
    space = model.observation_space
    states = np.random.default_rng(0).uniform(space.low, space.high, (300, len(space.low))).astype(np.float32)
    frozen, _ = model.predict(states, deterministic=True)
    scaling = model.policy.scaling
    learning = [int(model.agent.q_values(scaling.to_unit(state.astype(np.float64))).argmax()) for state in states]
    return float((frozen == learning).mean())


def test_a_frozen_policy_acts_on_bounded_values_as_in_learning_and_without_bounds_on_what_is_known():
    bounded = FittedRMax(car(), degree=1, transfer=Bounded(), seed=0).learn(150)
    unbounded = FittedRMax(car(), degree=1, transfer=Bounded(n_steps=1000), seed=0).learn(150)
    assert same_as_in_learning(bounded) == 1.0
    assert same_as_in_learning(unbounded) < 0.9
