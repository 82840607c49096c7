"""Arguments, environments and observations that cannot work are refused in time, with an error that names what to change."""

import re
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
from helpers.agents import assert_same_state, make_agent
from helpers.ring import PERIODIC, Ring, ring_transitions, shifted
from helpers.walk import Walk, small
from stable_baselines3.common.vec_env import SubprocVecEnv
from stable_baselines3.dqn.policies import DQNPolicy

from sb3_combrel import FittedRMax
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.pages.plane import plane_through
from sb3_combrel.planning.grid import StateGrid


class Scripted(gym.Env):
    """A line to walk along; what it returns can be spoilt from step ``spoilt_from`` on.

    :param spoil: called with (observation, reward) and returns what the environment returns instead
    """

    def __init__(self, n_variables=2, spoil=None, spoilt_from=5, reward=-1.0, action_space=None, space=None):
        self.observation_space = space or gym.spaces.Box(-1.0, 1.0, (n_variables,), dtype=np.float64)
        self.action_space = action_space or gym.spaces.Discrete(2)
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


# What is refused as a space or as bounds is tested in common/test_scaling.py; here that it is refused from here as well.
def test_fitted_rmax_refuses_observations_that_are_no_vector_of_real_numbers():
    with pytest.raises(ValueError, match="images"):
        FittedRMax(Scripted(space=gym.spaces.Box(0, 255, (64, 64, 3), dtype=np.uint8)))


@pytest.mark.parametrize(("n", "n_discrete"), [(1, 5), (2, 9)])
def test_continuous_actions_are_refused_with_the_line_that_makes_them_discrete(n, n_discrete):
    env = Scripted(action_space=gym.spaces.Box(-2.0, 2.0, (n,)))
    with pytest.raises(ValueError, match="needs Discrete actions, the environment has Box") as caught:
        FittedRMax(env)
    [line] = re.findall(r"env = (gymnasium\.wrappers\..*)$", str(caught.value))
    model = FittedRMax(eval(line, {"gymnasium": gym, "env": env}), resolution=2, model_breadth=0.3)
    assert model.action_space == gym.spaces.Discrete(n_discrete)


@pytest.mark.parametrize(
    "actions", [gym.spaces.MultiDiscrete([2, 3]), gym.spaces.MultiBinary(2), gym.spaces.Box(0.0, 1.0, (2, 2))], ids=str
)
def test_other_actions_are_refused(actions):
    with pytest.raises(ValueError, match="needs Discrete actions, the environment has") as caught:
        FittedRMax(Scripted(action_space=actions))
    assert "DiscretizeAction" not in str(caught.value)


def states_and_effects(model):
    """Of all instances, unit coordinates."""
    rows = model.agent.model.instances.rows()
    d = (rows.shape[1] - 3) // 2
    return rows[:, 1 : 1 + d], rows[:, 1 + d : 1 + 2 * d]


def test_observations_outside_given_bounds_count_as_the_boundary_with_one_warning():
    model = FittedRMax(Scripted(spoil=lambda obs, reward: (obs + 5.0, reward)), bounds=(-1.0, 1.0), seed=0)
    with pytest.warns(UserWarning, match="outside the bounds") as caught:
        model.learn(40)
    assert sum("counts as the nearest state inside" in str(w.message) for w in caught) == 1
    states, effects = states_and_effects(model)
    assert len(states) == 40 and ((states >= 0.0) & (states <= 1.0)).all()
    assert (np.abs(states + effects - 0.5) <= 0.5 + 1e-12).all()


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("what", ["observation", "reward"])
def test_what_is_not_finite_is_refused(what, value):
    model = FittedRMax(
        Scripted(spoil=lambda obs, reward: ([obs[0], value], reward) if what == "observation" else (obs, value)), seed=0
    )
    with pytest.raises(ValueError, match=rf"{what} .*finite"):
        model.learn(40)
    assert model.agent.model.n_instances == 4, "what came before is kept"
    assert np.isfinite(model.agent.planner.values).all()
    assert np.isfinite(model.policy.scales.observed).all(), "and learning can go on"
    with pytest.raises(ValueError, match=r"an observation must be finite, got .*(nan|inf)"):
        model.predict(np.array([0.0, value]))


# What is refused is tested in test_settings.py; here that it is refused from here as well.
@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("model_breadth", -0.1), ("gamma", "three"), ("degree", 2), ("max_value", "high"), ("resolution", [2, 2, 2])],
        *[("periodic", [True]), ("seed", 2**32), ("seed", -1), ("stats_window_size", 0), ("stats_window_size", 1.5)],
        *[("verbose", "loud"), ("verbose", None), ("tensorboard_log", 3)],
        *[("bounds", (False, True)), ("bounds", ([-1.0, False], [1.0, 2.0]))],
    ],
)
def test_wrong_arguments_of_the_constructor_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        FittedRMax(Scripted(), **{name: value})


@pytest.fixture(scope="module")
def unlearned():
    return small()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("total_timesteps", value) for value in (-1, 0.5, 1e16, np.nan, True, "many", None)],
        *[("log_interval", value) for value in (0, -4, True, 2.5)],
        *[("tb_log_name", 3), ("reset_num_timesteps", "False"), ("progress_bar", 1)],
    ],
)
def test_wrong_arguments_of_learn_are_refused_by_name(unlearned, name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        unlearned.learn(**{"total_timesteps": 10, name: value})
    assert unlearned.num_timesteps == 0


@pytest.mark.parametrize("policy", [DQNPolicy, "NoSuchPolicy"])
def test_policies_of_other_kinds_are_refused(policy):
    with pytest.raises(ValueError, match="Policy"):
        FittedRMax(policy, Walk())


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (7, "policy_kwargs must be a dict"),
        ({"net_arch": [64]}, "policy_kwargs must have names out of .*model_class.*, got 'net_arch'"),
        ({3: 4}, "policy_kwargs must have names out of .*, got 3"),
        ({"gamma": 0.9}, r"policy_kwargs must not have 'gamma': pass gamma=\.\.\. to FittedRMax itself"),
        ({"model_class": FittedRMaxPolicy}, "model_class must be a subclass of Model or None"),
        ({"state_names": 3}, "state_names must hold"),
        ({"action_names": ["one"]}, "action_names must hold 2 names"),
    ],
)
def test_wrong_policy_kwargs_are_refused_by_name(wrong, message):
    with pytest.raises(ValueError, match=message):
        small(policy_kwargs=wrong)


def test_names_for_display_can_be_given_as_policy_kwargs():
    task = small(policy_kwargs=dict(state_names=("place", "height"), action_names=["back", "forth"])).agent.task
    assert (task.state_names, task.action_names) == (("place", "height"), ("back", "forth"))


@pytest.mark.parametrize("resolution", [12, [12] * 4])
def test_a_grid_that_does_not_fit_in_memory_is_refused_with_its_size(resolution):
    with pytest.raises(ValueError, match="GiB") as error:
        FittedRMax(Scripted(n_variables=4), resolution=resolution)
    assert f"{4097**4:,}" in str(error.value)


@pytest.mark.parametrize(("degree", "fine"), [(0, 4), (1, 5)])
def test_a_resolution_too_coarse_for_the_breadth_gives_a_warning_that_names_better_ones(degree, fine):
    better = rf"resolution=2 is coarse for model_breadth=0.05.*resolution={fine} or model_breadth="
    with pytest.warns(UserWarning, match=better):
        FittedRMax(Scripted(), model_breadth=0.05, resolution=2, degree=degree)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        FittedRMax(Scripted(), model_breadth=0.05, resolution=fine, degree=degree)


class Anywhere(Scripted):
    """Every step leads somewhere in the space."""

    def reset(self, *, seed=None, options=None):
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), -1.0, False, bool(self.np_random.random() < 0.1), {}


@pytest.mark.parametrize(
    ("space", "actions"),
    [
        (gym.spaces.Box(-2.0, 1.0, (2,), dtype=np.float32), gym.spaces.Discrete(1)),
        (gym.spaces.Box(0.0, 5.0, (1,), dtype=np.float64), gym.spaces.Discrete(4, start=-2)),
        (gym.spaces.Box(np.float32([0, -1, 5]), np.float32([1, 1, 500])), gym.spaces.Discrete(3)),
    ],
    ids=str,
)
def test_learning_predicting_and_saving_with_every_space(space, actions, tmp_path):
    model = FittedRMax(Anywhere(space=space, action_space=actions), resolution=2, model_breadth=0.3, seed=0).learn(40)
    assert model.agent.model.n_instances == 40
    states = np.stack([space.sample() for _ in range(10)])
    chosen, _ = model.predict(states, deterministic=True)
    assert all(actions.contains(np.int64(action)) for action in chosen)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model")
    assert (loaded.observation_space, loaded.action_space) == (space, actions)
    np.testing.assert_array_equal(loaded.predict(states, deterministic=True)[0], chosen)
    with pytest.raises(ValueError, match="set_env"):
        loaded.learn(10)
    with pytest.raises(ValueError, match="spaces do not match"):
        FittedRMax.load(tmp_path / "model", env=Walk())


# What is learned of a periodic variable does not depend on where its origin is; it is saved, loaded, and found by itself.
N_CELLS = 16


def agent_after(transitions, cells=0, **settings):
    """An agent that has seen the transitions, their origin moved by some cells, and acted in each state."""
    settings = dict(periodic=PERIODIC, resolution=[4, 3], model_breadth=0.15, planning_tolerance=1e-10, gamma=0.95) | settings
    agent = make_agent(2, 2, **settings)
    for n, (state, action, reward, after, terminated) in enumerate(transitions):
        state, after = shifted(state, cells, N_CELLS), shifted(after, cells, N_CELLS)
        for _ in range(12 if n % 20 == 19 else 1):
            agent.act(state)
        agent.update(state, action, reward, after, terminated)
    for _ in range(5):
        agent.end_episode(False)
    return agent


@pytest.mark.parametrize("degree, rtol", [(0, 1e-7), (1, 5e-3)])
@pytest.mark.parametrize(("cells", "max_instances"), [(1, 30), (5, None), (15, None)])
def test_with_another_origin_the_same_is_learned(cells, max_instances, degree, rtol):
    """With degree 1 up to what may wait until the end of an episode, which rounding decides."""
    transitions = ring_transitions(0, 160)
    one, other = (agent_after(transitions, moved, max_instances=max_instances, degree=degree) for moved in (0, cells))
    states = np.random.default_rng(1).random((60, 2))
    q = np.array([one.q_values(state) for state in states])
    assert (q < 0.0).any(axis=1).mean() > 0.5, "most of it is known"
    np.testing.assert_allclose([other.q_values(s) for s in shifted(states, cells, N_CELLS)], q, atol=1e-6, rtol=rtol)
    for of_agent in (lambda a: a.planner.values, lambda a: a.planner.cautious_values(10_000)):
        by_variable = of_agent(one).reshape(one.grid.arrays.shape)
        moved = of_agent(other).reshape(one.grid.arrays.shape)
        np.testing.assert_allclose(moved, np.roll(by_variable, cells, axis=0), atol=1e-6, rtol=rtol)
    unflagged = [agent_after(transitions, moved, periodic=None, degree=degree) for moved in (0, cells)]
    q, moved = (
        [agent.q_values(s) for s in shifted(states, c, N_CELLS)] for agent, c in zip(unflagged, (0, cells), strict=True)
    )
    assert np.abs(np.array(q) - moved).max() > 0.1, "the flag makes the difference"


def test_flags_of_no_periodic_variable_change_nothing():
    transitions = ring_transitions(3, 60)
    assert_same_state(*(agent_after(transitions, periodic=periodic) for periodic in (None, [False, False])))


def test_coordinates_outside_the_unit_interval_are_the_same_angle():
    agent = agent_after(ring_transitions(0, 120))
    for state in np.random.default_rng(4).random((20, 2)):
        for turns in (-1.0, 1.0, 3.0):
            elsewhere = state + np.array([turns, 0.0])
            np.testing.assert_allclose(agent.q_values(elsewhere), agent.q_values(state), atol=1e-9)


class TellingRing(Ring):
    """A ring that says by itself that its angle is periodic."""

    periodic = tuple(PERIODIC)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("origin", [0.0, 0.37])
def test_the_ring_is_learned_wherever_its_origin_is_and_its_model_saved(origin, tmp_path):
    model = FittedRMax(TellingRing(origin), seed=0, resolution=4, model_breadth=0.12).learn(1500)
    assert np.mean([info["l"] for info in model.ep_info_buffer][-5:]) < 25, "half of the ring in fewer steps is not possible"
    model.save(tmp_path / "ring")
    model.policy.save(tmp_path / "policy")
    loaded, policy = FittedRMax.load(tmp_path / "ring"), type(model.policy).load(tmp_path / "policy")
    assert loaded.periodic == PERIODIC and loaded.agent.periodic == policy.agent.periodic == tuple(PERIODIC)
    observations = np.random.default_rng(0).uniform([-9.0, -1.0], [9.0, 1.0], (50, 2))
    expected = model.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], expected)
    np.testing.assert_array_equal(policy.predict(observations, deterministic=True)[0], expected)


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: gym.wrappers.TimeLimit(env, 50)])
def test_the_environment_may_say_which_variables_are_periodic(wrap):
    model = FittedRMax(wrap(TellingRing()), seed=0, resolution=4)
    assert model.agent.periodic == tuple(PERIODIC) and model.periodic == PERIODIC
    assert FittedRMax(wrap(TellingRing()), seed=0, resolution=4, periodic=[False, False]).agent.periodic == (False, False)


@pytest.mark.long
def test_an_environment_in_another_process_may_say_it_too():
    env = SubprocVecEnv([TellingRing, TellingRing])
    try:
        assert FittedRMax(env, seed=0, resolution=4).agent.periodic == tuple(PERIODIC)
    finally:
        env.close()


@pytest.mark.parametrize("of_no_use", [True, (True,), (1, 0), "periodic", None])
def test_an_attribute_of_that_name_that_means_something_else_is_not_used(of_no_use):
    env = Ring()
    env.periodic = of_no_use
    assert FittedRMax(env, seed=0, resolution=4).agent.periodic == (False, False)


@pytest.mark.parametrize(("across", "up"), [(0, 1), (1, 0)])
def test_a_plane_shows_each_point_of_a_periodic_variable_once(across, up):
    grid, scaling = StateGrid(2, 3, 1, PERIODIC), StateScaling([-np.pi, 0.0], [np.pi, 1.0])
    plane = plane_through(grid, scaling, ("angle", "speed"), (across, up))
    edges = {0: (-np.pi * (1 + 1 / 8), np.pi * (1 - 1 / 8)), 1: (-1 / 16, 1 + 1 / 16)}
    assert plane.extent == pytest.approx((*edges[across], *edges[up]))
    shape = {0: 8, 1: 9}
    assert plane.points.shape == (shape[up], shape[across])
    states = grid.states_of(plane.points.ravel()).reshape(*plane.points.shape, 2)
    np.testing.assert_allclose(states[0, :, across], np.arange(shape[across]) / 8)
    np.testing.assert_allclose(states[:, 0, up], np.arange(shape[up]) / 8)


def test_a_plane_through_the_end_of_a_periodic_variable_goes_through_its_beginning():
    grid, scaling = StateGrid(3, 2, 0, (True, False, False)), StateScaling([0.0] * 3, [1.0] * 3)
    plane = plane_through(grid, scaling, ("a", "b", "c"), (1, 2), at=[0.99, 0.5, 0.5])
    assert plane.held == "a = 0" and (grid.states_of(plane.points.ravel())[:, 0] == 0.0).all()


@pytest.mark.parametrize(
    ("returned", "message"),
    [
        (lambda *step: (step[0][:1], *step[1:]), r"an observation must have the shape \(2,\) of env.observation_space, got"),
        (lambda *step: (step[0], "-1", *step[2:]), "step must return reward as a number, not as text, got '-1'"),
        (
            lambda *step: (*step[:2], "False", *step[3:]),
            "step must return terminated as True or False, not as text, got 'False'",
        ),
    ],
)
def test_what_would_be_taken_for_something_else_is_refused(returned, message):
    class Wrong(Scripted):
        def step(self, action):
            return returned(*super().step(action))

    with pytest.raises(ValueError, match=message):
        FittedRMax(Wrong(), seed=0).learn(5)


def test_an_observation_of_another_shape_is_refused_at_once():
    env = gym.wrappers.TransformObservation(Scripted(), lambda observation: observation[:1], Scripted().observation_space)
    with pytest.raises(ValueError, match="an observation must have the shape"):
        FittedRMax(env, seed=0).learn(5)


def test_environments_of_the_project_need_no_import():
    code = "from sb3_combrel import FittedRMax; print(FittedRMax('combrel/MountainCar2D-v0', seed=0).agent.task.state_names)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "x" in found.stdout


@pytest.mark.parametrize("path", ["", 3, None])
def test_what_cannot_be_a_file_to_save_to_is_refused_by_name(path):
    with pytest.raises(ValueError, match=re.escape(f"path must be the name of a file, or an open file, got {path!r}")):
        small().save(path)
