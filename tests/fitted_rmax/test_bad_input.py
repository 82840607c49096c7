"""Arguments, environments and files that cannot work are refused in time, with an error that names what to change."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_combrel import FittedRMax
from sb3_combrel.common.checks import check_resolution


class Scripted(gym.Env):
    """A line to walk along; what it returns can be spoilt from step ``spoilt_from`` on.

    :param spoil: called with (observation, reward) and returns what the environment returns instead
    """

    def __init__(self, n_variables=2, spoil=None, spoilt_from=5, reward=-1.0, action_space=None, space=None):
        self.observation_space = space or spaces.Box(-1.0, 1.0, (n_variables,), dtype=np.float64)
        self.action_space = action_space or spaces.Discrete(2)
        self.n_variables = n_variables
        self.spoil, self.spoilt_from, self.reward = spoil, spoilt_from, reward

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = np.zeros(self.n_variables)
        self.steps = 0
        return self.at.copy(), {}

    def step(self, action):
        self.steps += 1
        self.at[0] = np.clip(self.at[0] + (0.2 if action else -0.2), -1.0, 1.0)
        observation, reward = self.at.copy(), self.reward
        if self.spoil is not None and self.steps >= self.spoilt_from:
            observation, reward = self.spoil(observation, reward)
        return observation, reward, bool(self.at[0] >= 0.99), self.steps >= 12, {}


@pytest.mark.parametrize("actions", [spaces.Box(-1.0, 1.0, (1,)), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)])
def test_fitted_rmax_refuses_actions_that_are_not_discrete(actions):
    with pytest.raises(ValueError, match="Discrete"):
        FittedRMax(Scripted(action_space=actions))


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Dict({"a": spaces.Box(0.0, 1.0, (2,))}), "FlattenObservation"),
        (spaces.Box(0, 255, (64, 64, 3), dtype=np.uint8), "images"),
        (spaces.Box(0.0, 1.0, (2, 2)), "shape"),
        (spaces.Discrete(4), "Box"),
    ],
)
def test_fitted_rmax_refuses_observations_that_are_no_vector(space, message):
    with pytest.raises(ValueError, match=message):
        FittedRMax(Scripted(space=space))


def test_infinite_observation_bounds_need_the_bounds_argument():
    with pytest.raises(ValueError, match=r"bounds=\(low, high\)"):
        FittedRMax("CartPole-v1")
    model = FittedRMax("CartPole-v1", bounds=([-2.6, -3.0, -0.23, -3.2], [2.6, 3.0, 0.23, 3.2]), resolution=3, seed=0)
    assert model.agent.grid.n_points == 9**4


@pytest.mark.parametrize(
    "bounds",
    [([0.0], [1.0]), ([1.0, 1.0], [0.0, 2.0]), ([0.0, 0.0], [np.inf, 1.0]), 3.0, ("low", "high"), ([0.0, np.nan], [1.0, 1.0])],
)
def test_bounds_that_do_not_fit_are_refused(bounds):
    with pytest.raises(ValueError, match="bounds"):
        FittedRMax(Scripted(), bounds=bounds)


def states_and_effects(model):
    """Of all instances, unit coordinates."""
    rows = model.agent.model.instances.rows()
    d = (rows.shape[1] - 3) // 2
    return rows[:, 1 : 1 + d], rows[:, 1 + d : 1 + 2 * d]


def test_observations_outside_the_bounds_count_as_the_boundary_with_one_warning():
    model = FittedRMax(Scripted(spoil=lambda obs, reward: (obs + 5.0, reward)), seed=0)
    with pytest.warns(UserWarning, match="outside the bounds") as caught:
        model.learn(40)
    assert sum("outside the bounds" in str(w.message) for w in caught) == 1
    states, effects = states_and_effects(model)
    assert len(states) == 40
    assert ((states >= 0.0) & (states <= 1.0)).all()
    assert (np.abs(states + effects - 0.5) <= 0.5 + 1e-12).all()


def test_observations_within_the_bounds_give_no_warning():
    model = FittedRMax(Scripted(), seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(40)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_observations_that_are_not_finite_are_refused(value):
    def spoil(observation, reward):
        observation[1] = value
        return observation, reward

    model = FittedRMax(Scripted(spoil=spoil), seed=0)
    with pytest.raises(ValueError, match=r"observation.*not finite"):
        model.learn(40)
    assert model.agent.model.n_instances == 4, "what came before is kept"
    assert all(np.isfinite(array).all() for array in states_and_effects(model))
    with pytest.raises(ValueError, match=r"observation.*not finite"):
        model.predict(np.array([0.0, value]))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_rewards_that_are_not_finite_are_refused(value):
    model = FittedRMax(Scripted(spoil=lambda obs, reward: (obs, value)), seed=0)
    with pytest.raises(ValueError, match=r"reward.*not finite"):
        model.learn(40)
    assert model.agent.model.n_instances == 4, "what came before is kept"
    assert np.isfinite(model.agent.planner.values).all()


BAD_ARGUMENTS = [
    ("model_breadth", 0.0),
    ("model_breadth", -0.1),
    ("model_breadth", np.nan),
    ("model_breadth", np.inf),
    ("model_breadth", "wide"),
    ("min_fraction", 0.0),
    ("min_fraction", 1.1),
    ("min_fraction", None),
    ("min_weight", 0.0),
    ("min_weight", 1.0),
    ("degree", 2),
    ("degree", -1),
    ("degree", True),
    ("degree", np.True_),
    ("degree", 0.5),
    ("degree", "linear"),
    ("degree", None),
    ("degree", [1]),
    ("degree", np.array([1])),
    ("n_neighbors", 1),
    ("n_neighbors", 7.5),
    ("n_neighbors", True),
    ("n_neighbors", "all"),
    ("max_model_steps", 0),
    ("max_model_steps", True),
    ("outcome_breadth", 0.0),
    ("outcome_breadth", -0.1),
    ("outcome_breadth", np.nan),
    ("outcome_breadth", None),
    ("exploration_threshold", 0.0),
    ("exploration_threshold", -1.0),
    ("resolution", 0),
    ("resolution", -2),
    ("resolution", 2.5),
    ("resolution", [2, 2, 2]),
    ("resolution", [2, 0]),
    ("resolution", "fine"),
    ("resolution", True),
    ("max_value", np.inf),
    ("max_value", np.nan),
    ("max_value", None),
    ("gamma", 0.0),
    ("gamma", 1.5),
    ("gamma", -0.5),
    ("planning_tolerance", 0.0),
    ("planning_tolerance", -1.0),
    ("max_backups", -1),
    ("max_backups", 1.5),
    ("max_instances", 0),
    ("max_instances", 10.5),
]


@pytest.mark.parametrize(("name", "value"), BAD_ARGUMENTS)
def test_an_argument_out_of_its_range_is_refused_at_once_by_name_and_value(name, value):
    with pytest.raises(ValueError, match=f"{name} must be") as error:
        FittedRMax(Scripted(), **{name: value})
    assert repr(value) in str(error.value)


@pytest.mark.parametrize("steps", [0, -5, 2.5, 0.0, float("inf"), float("nan"), None])
def test_total_timesteps_must_be_at_least_1(steps):
    model = FittedRMax(Scripted(), seed=0)
    with pytest.raises(ValueError, match="total_timesteps must be a whole number of at least 1"):
        model.learn(steps)


@pytest.mark.parametrize("degree", [0, 1])
def test_arguments_may_be_numpy_numbers(degree):
    model = FittedRMax(
        Scripted(),
        model_breadth=np.float32(0.2),
        resolution=np.int64(3),
        gamma=np.float64(0.9),
        max_backups=np.int32(5),
        max_instances=np.int64(100),
        degree=np.int64(degree),
        n_neighbors=np.int32(8),
        outcome_breadth=np.float32(0.1),
        seed=0,
    )
    model.learn(20)
    check_resolution(np.array([3, 4]), 2)


def test_learn_without_an_environment_names_set_env(tmp_path):
    FittedRMax(Scripted(), seed=0).learn(20).save(tmp_path / "model")
    model = FittedRMax.load(tmp_path / "model")
    with pytest.raises(ValueError, match="set_env"):
        model.learn(10)


def test_a_grid_that_does_not_fit_in_memory_is_refused_with_its_size_and_one_that_fits():
    with pytest.raises(ValueError, match=r"resolution=12 .*GiB.*resolution=(\d+) fits") as error:
        FittedRMax(Scripted(n_variables=4), resolution=12)
    assert "4097" in str(error.value) or f"{4097**4:,}" in str(error.value)
    with pytest.raises(ValueError, match=r"GiB"):
        FittedRMax(Scripted(n_variables=4), resolution=[12, 12, 12, 12])


@pytest.mark.parametrize(("degree", "fine"), [(0, 4), (1, 5)])
def test_a_resolution_too_coarse_for_the_breadth_gives_a_warning_that_names_better_ones(degree, fine):
    better = rf"resolution=2 is coarse for model_breadth=0.05.*resolution={fine} or model_breadth="
    with pytest.warns(UserWarning, match=better):
        FittedRMax(Scripted(), model_breadth=0.05, resolution=2, degree=degree)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FittedRMax(Scripted(), model_breadth=0.05, resolution=fine, degree=degree)


@pytest.mark.parametrize(("reward", "max_value", "warns"), [(1.0, 3.0, True), (1.0, 12.0, False), (-1.0, 0.0, False)])
def test_returns_above_max_value_give_one_warning(reward, max_value, warns):
    model = FittedRMax(Scripted(reward=reward), max_value=max_value, seed=0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(100)
    about = [w for w in caught if "max_value" in str(w.message)]
    assert len(about) == int(warns)
    if warns:
        assert f"max_value={max_value:g}" in str(about[0].message)


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "model.zip"
    FittedRMax(Scripted(), resolution=3, seed=0).learn(20).save(path)
    return path


@pytest.mark.parametrize(
    ("name", "spoil", "message"),
    [
        ("instances", lambda t: t[:, :-1], "instances"),
        ("instances", lambda t: t[0], "instances"),
        ("values", lambda t: t[:-1], "values"),
        ("known", lambda t: t[1:], "known"),
    ],
)
def test_parameters_of_the_wrong_shape_are_refused_and_change_nothing(saved, name, spoil, message):
    model = FittedRMax.load(saved)
    before = model.get_parameters()
    damaged = {"policy": {**before["policy"], name: spoil(before["policy"][name])}}
    with pytest.raises(RuntimeError, match=message):
        model.set_parameters(damaged)
    after = model.get_parameters()
    for key, value in before["policy"].items():
        np.testing.assert_array_equal(after["policy"][key].numpy(), value.numpy())


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("corrections", lambda t: t.new_zeros((3, 2))),
        ("corrections", lambda t: t.new_zeros(4)),
        ("lowest_value", lambda t: t.new_zeros(0)),
        ("values", lambda t: t * float("nan")),
        ("instances", lambda t: t * float("nan")),
    ],
)
def test_parameters_that_make_no_sense_are_refused_and_change_nothing(saved, name, spoil):
    model = FittedRMax.load(saved)
    before = model.get_parameters()
    damaged = {"policy": {**before["policy"], name: spoil(before["policy"][name])}}
    with pytest.raises(RuntimeError, match=name):
        model.set_parameters(damaged)
    after = model.get_parameters()
    for key, value in before["policy"].items():
        np.testing.assert_array_equal(after["policy"][key].numpy(), value.numpy())


def test_parameters_that_are_missing_or_too_many_are_refused(saved):
    model = FittedRMax.load(saved)
    parameters = model.get_parameters()["policy"]
    without = {k: v for k, v in parameters.items() if k != "instances"}
    with pytest.raises(RuntimeError, match="instances"):
        model.set_parameters({"policy": without})
    with pytest.raises(RuntimeError, match="stranger"):
        model.set_parameters({"policy": {**parameters, "stranger": parameters["values"]}})


def test_an_environment_with_other_spaces_is_refused(saved):
    with pytest.raises(ValueError, match="spaces do not match"):
        FittedRMax.load(saved, env=DummyVecEnv([lambda: Scripted(n_variables=3)]))
