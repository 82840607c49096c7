"""What is learned of a periodic variable does not depend on where its origin is; it is saved, loaded, and found by itself."""

import io

import gymnasium as gym
import numpy as np
import pytest
from helpers.agents import assert_same_state, make_agent
from helpers.ring import PERIODIC, Ring, ring_transitions, shifted
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_combrel import FittedRMax
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.fitted_rmax.loop_detection import small_cell
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
@pytest.mark.parametrize(("cells", "max_instances"), [(1, 30), (5, None), (15, None)])
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
            assert small_cell(elsewhere, agent.grid) == small_cell(state, agent.grid)


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
    overruled = FittedRMax(wrap(TellingRing()), seed=0, resolution=4, periodic=[False, False])
    assert overruled.agent.periodic == (False, False)
    buffer = io.BytesIO()
    model.save(buffer)
    buffer.seek(0)
    assert FittedRMax.load(buffer).agent.periodic == tuple(PERIODIC), "without the environment as well"


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
