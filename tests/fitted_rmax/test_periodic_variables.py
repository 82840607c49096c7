"""What is learned of a periodic variable does not depend on where its origin is; it is saved, loaded, and found by itself."""

import io
import warnings

import gymnasium as gym
import numpy as np
import pytest
from helpers.agents import assert_same_state, make_agent
from helpers.dashboard import events, run_folder
from helpers.ring import PERIODIC, Ring, ring_transitions, shifted
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.callbacks import DashboardCallback
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.fitted_rmax.loop_detection import small_cell
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings
from sb3_combrel.planning.grid import StateGrid, fitting_grid
from sb3_combrel.tensorboard.plane import plane_through

N_CELLS = 16


def agent_after(transitions, cells=0, **settings):
    """An agent that has seen the transitions, their origin moved by some cells, and acted in each state."""
    settings = dict(periodic=PERIODIC, resolution=[4, 3], model_breadth=0.15, planning_tolerance=1e-10, gamma=0.95) | settings
    agent = make_agent(2, 2, **settings)
    for n, (state, action, reward, after, terminated) in enumerate(transitions):
        state, after = shifted(state, cells, N_CELLS), shifted(after, cells, N_CELLS)
        for _ in range(12 if n % 20 == 19 else 1):
            agent.act(state, episode=n // 20)
        agent.update(state, action, reward, after, terminated)
    for _ in range(5):
        agent.end_episode(False)
    return agent


@pytest.mark.parametrize("degree, rtol", [(0, 1e-7), (1, 5e-3)])
@pytest.mark.parametrize("cells", [1, 5, 8, 15])
@pytest.mark.parametrize("max_instances", [None, 30])
def test_with_another_origin_the_same_is_learned(cells, max_instances, degree, rtol):
    """With degree 1 up to what may wait until the end of an episode, which rounding decides."""
    transitions = ring_transitions(0, 160)
    one, other = (agent_after(transitions, moved, max_instances=max_instances, degree=degree) for moved in (0, cells))
    assert one.planner.n_queued == other.planner.n_queued == 0
    assert one.corrections.n_states[0] == other.corrections.n_states[0]
    states = np.random.default_rng(1).random((60, 2))
    q = np.array([one.q_values(state) for state in states])
    assert (q < 0.0).any(axis=1).mean() > 0.5, "most of it is known"
    np.testing.assert_allclose([other.q_values(s) for s in shifted(states, cells, N_CELLS)], q, atol=1e-6, rtol=rtol)
    for of_agent in (lambda a: a.planner.values, lambda a: a.planner.exploitation_values()):
        by_variable = of_agent(one).reshape(one.grid.arrays.shape)
        moved = of_agent(other).reshape(one.grid.arrays.shape)
        np.testing.assert_allclose(moved, np.roll(by_variable, cells, axis=0), atol=1e-6, rtol=rtol)


def test_without_the_flag_the_origin_matters():
    transitions = ring_transitions(0, 160)
    one, other = (agent_after(transitions, moved, periodic=None) for moved in (0, 5))
    states = np.random.default_rng(1).random((60, 2))
    q, moved = ([agent.q_values(s) for s in at] for agent, at in ((one, states), (other, shifted(states, 5, N_CELLS))))
    assert np.abs(np.array(q) - moved).max() > 0.1


def test_flags_of_no_periodic_variable_change_nothing():
    transitions = ring_transitions(3, 60)
    agents = [agent_after(transitions, periodic=periodic) for periodic in (None, [False, False])]
    assert_same_state(*agents)


def test_a_restored_agent_is_the_same():
    agent = agent_after(ring_transitions(2, 120))
    again = make_agent(2, 2, **{**vars(agent.settings)})
    again.set_state(agent.get_state())
    for _ in range(5):
        again.end_episode(False)
    np.testing.assert_array_equal(again.model.instances.rows(), agent.model.instances.rows())
    np.testing.assert_array_equal(again.model.own_weight, agent.model.own_weight)
    np.testing.assert_allclose(again.planner.values, agent.planner.values, atol=1e-6)


def test_coordinates_outside_the_unit_interval_are_the_same_angle():
    agent = agent_after(ring_transitions(0, 120))
    for state in np.random.default_rng(4).random((20, 2)):
        for turns in (-1.0, 1.0, 3.0):
            elsewhere = state + np.array([turns, 0.0])
            np.testing.assert_allclose(agent.q_values(elsewhere), agent.q_values(state), atol=1e-9)
            assert small_cell(elsewhere, agent.grid) == small_cell(state, agent.grid)


@pytest.mark.parametrize("origin", [0.0, 0.37])
def test_the_ring_is_learned_wherever_its_origin_is(origin):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = FittedRMax(Ring(origin), periodic=PERIODIC, seed=0, resolution=4, model_breadth=0.12).learn(1500)
    assert np.mean([info["l"] for info in model.ep_info_buffer][-5:]) < 25, "half of the ring in fewer steps is not possible"
    env, lengths = Ring(origin), []
    for _ in range(2):
        obs, _ = env.reset()
        done, state = False, None
        while not done:
            action, state = model.predict(obs, state, deterministic=True)
            obs, _, terminated, truncated, _ = env.step(int(action))
            done = terminated or truncated
        lengths.append(env.steps)
    assert max(lengths) < 25


def test_a_saved_model_knows_its_periodic_variables(tmp_path):
    model = FittedRMax(Ring(), periodic=np.array(PERIODIC), seed=0, resolution=4, model_breadth=0.12).learn(400)
    model.save(tmp_path / "ring")
    model.policy.save(tmp_path / "policy")
    loaded, policy = FittedRMax.load(tmp_path / "ring"), type(model.policy).load(tmp_path / "policy")
    assert loaded.periodic == PERIODIC and loaded.agent.periodic == policy.agent.periodic == tuple(PERIODIC)
    observations = np.random.default_rng(0).uniform([-9.0, -1.0], [9.0, 1.0], (50, 2))
    expected = model.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], expected)
    np.testing.assert_array_equal(policy.predict(observations, deterministic=True)[0], expected)
    loaded.set_env(Ring())
    loaded.learn(200)


class TellingRing(Ring):
    """A ring that says by itself that its angle is periodic."""

    periodic = tuple(PERIODIC)


@pytest.mark.parametrize("wrap", [lambda env: env, lambda env: gym.wrappers.TimeLimit(env, 50)])
def test_the_environment_may_say_which_variables_are_periodic(wrap):
    model = FittedRMax(wrap(TellingRing()), seed=0, resolution=4)
    assert model.agent.periodic == tuple(PERIODIC) and model.periodic == PERIODIC
    overruled = FittedRMax(wrap(TellingRing()), seed=0, resolution=4, periodic=[False, False])
    assert overruled.agent.periodic == (False, False)
    buffer = io.BytesIO()
    model.save(buffer)
    buffer.seek(0)
    assert FittedRMax.load(buffer).agent.periodic == tuple(PERIODIC), "without the environment as well"


@pytest.mark.integration
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


@pytest.mark.parametrize("flags", [True, [True], [True, 0], "ab"])
def test_wrong_flags_are_refused(flags):
    with pytest.raises(ValueError, match="periodic must be None or 2 booleans"):
        FittedRMax(Ring(), periodic=flags)
    with pytest.raises(ValueError, match="periodic must be None or 2 booleans"):
        make_agent(2, 2, periodic=flags)


def test_a_grid_has_no_end_and_no_margin_along_a_periodic_variable():
    grid = fitting_grid(2, 2, 3, 0.2, 0.01, (True, False))
    assert grid.arrays.shape.tolist() == [8, 8 + 1 + 2] and grid.arrays.margin.tolist() == [0.0, 1.0]
    assert grid.points()[:, 0].max() == 7 / 8


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
    assert plane.held == "a = 0"
    assert (grid.states_of(plane.points.ravel())[:, 0] == 0.0).all()


@pytest.mark.parametrize("transfers", [False, True])
def test_the_dashboard_shows_periodic_variables(transfers, tmp_path):
    source = SourceInstances.record(None, TellingRing(), 200, seed=0)
    transfer = COMBREL(source) if transfers else None
    arguments = dict(seed=0, resolution=4, model_breadth=0.12, transfer=transfer, tensorboard_log=str(tmp_path))
    FittedRMax(TellingRing(), **arguments).learn(300, DashboardCallback(picture_freq=150), log_interval=1)
    found = events(run_folder(tmp_path))
    assert len(found.Images("value_and_policy/angle_speed")) == 2
    assert ("source_action/angle_speed" in found.Tags()["images"]) == transfers


def test_settings_know_the_default():
    assert FittedRMaxSettings().periodic is None and FittedRMaxSettings().periodic_for(3) == (False, False, False)
