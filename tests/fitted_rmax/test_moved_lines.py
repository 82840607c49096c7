"""A learner whose grid is coarse moves the lines of its grid where a task goes on for ever."""

import io
import json

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import DiscretizeAction
from helpers.agents import interrupted_after
from scipy.interpolate import RegularGridInterpolator

from sb3_combrel import COMBREL, FittedRMax
from sb3_combrel.common.serialisation import from_plain, to_plain
from sb3_combrel.fitted_rmax import agent as agent_module
from sb3_combrel.pages.snapshot import snapshot_of

N = 200


class Oscillators(gym.Env):
    """Two, at rest at 0, of which each action pushes one; the nearer to 0 they are, the more it pays, and it never ends.

    :param ends: whether an episode ends where one is too far away
    :param cost: of a step in place of what pays
    """

    action_space = gym.spaces.Discrete(3)
    observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), dtype=np.float64)

    def __init__(self, ends=False, cost=None):
        self.ends, self.cost = ends, cost

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.n_steps = self.np_random.normal(0.0, 1.0, 4), 0
        return self.state.copy(), {}

    def step(self, action):
        place, speed = self.state[:2], self.state[2:]
        speed = 0.99 * speed - 0.1 * place
        if action < 2:
            speed[action] += 0.1
        self.state = np.concatenate([place + 0.1 * speed, speed])
        self.n_steps += 1
        reward = float(np.exp(-(place**2).sum())) if self.cost is None else -self.cost
        return self.state.copy(), reward, bool(self.ends and np.abs(place).max() > 1.0), self.n_steps == 50, {}


def learned(n=N, env=None, **arguments):
    return FittedRMax(Oscillators() if env is None else env, seed=0, **arguments).learn(n, log_interval=None)


@pytest.fixture(scope="module")
def model():
    return learned()


def saved_and_loaded(model):
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    return FittedRMax.load(file, env=Oscillators())


def assert_both_learn_on_alike(one, other, n):
    for each in (one, other):
        each.set_env(Oscillators())
        each.env.seed(5)
        each.learn(n, reset_num_timesteps=False, log_interval=None)
    np.testing.assert_array_equal(one.agent.grid.arrays.lines, other.agent.grid.arrays.lines)
    np.testing.assert_array_equal(one.agent.planner.values, other.agent.planner.values)


def actions_of(model, n=60):
    states = np.random.default_rng(0).normal(0.0, 0.5, (n, 4))
    return model.predict(states, deterministic=True)[0]


def test_lines_have_moved_and_their_ends_and_middle_have_not(model):
    lines = model.agent.grid.arrays.lines
    assert not model.agent.grid.arrays.even
    np.testing.assert_array_equal(lines[:, [0, 4, 8]], [[0.0, 0.5, 1.0]] * 4)
    assert (np.diff(lines) > 0.0).all() and np.ptp(np.diff(lines[:, :9], axis=1), axis=1).min() > 0.01


def test_errors_are_what_interpolated_values_differ_by_from_the_best_actions(monkeypatch):
    model, seen = FittedRMax(Oscillators(), seed=0), []

    def noted(grid, states, errors):
        agent, n = model.agent, model.agent.model.n_instances
        np.testing.assert_array_equal(states, [state for state, *_ in agent.model.transitions()[n // 2 :]])
        lines = [grid.arrays.lines[k, :9] for k in range(4)]
        between = RegularGridInterpolator(lines, agent.planner.values.reshape(9, 9, 9, 9))
        best = [agent.q_values(state).max() for state in states]
        seen.append((n, np.abs(between(np.clip(states, 0.0, 1.0)) - best) - errors))
        return grid.arrays.lines

    monkeypatch.setattr(agent_module, "moved_lines", noted)
    model.learn(145, log_interval=None)
    assert [n for n, _ in seen] == [90, 113, 142]
    for _, differences in seen:
        np.testing.assert_allclose(differences, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("env", "arguments"),
    [
        (lambda: Oscillators(ends=True), {}),
        (lambda: Oscillators(cost=1.0), {}),  # Nothing to collect.
        (lambda: DiscretizeAction(gym.make("Pendulum-v1"), 3), {}),  # Three variables, and a finer grid.
        (Oscillators, {"resolution": (3, 3, 4, 3)}),
    ],
)
def test_lines_stay_where_there_is_an_end_to_come_to_or_nothing_to_collect_or_the_grid_is_fine(env, arguments):
    assert learned(130, env(), **arguments).agent.grid.arrays.even


def test_they_move_whether_or_not_bounds_are_given_and_with_kernel_averages():
    assert not learned(130, bounds=(-3.0, 3.0)).agent.grid.arrays.even
    assert not learned(130, degree=0).agent.grid.arrays.even


def test_past_data_move_them_too():
    data = learned(120).source_instances()
    assert not FittedRMax(Oscillators(), instances=data, seed=0).agent.grid.arrays.even


def test_what_is_saved_predicts_the_same_and_learns_on_as_the_model_would(model):
    again = saved_and_loaded(model)
    np.testing.assert_array_equal(again.agent.grid.arrays.lines, model.agent.grid.arrays.lines)
    np.testing.assert_array_equal(again.agent.planner.values, model.agent.planner.values)
    np.testing.assert_array_equal(actions_of(again), actions_of(model))
    one = learned()
    assert_both_learn_on_alike(one, saved_and_loaded(one), 60)


@pytest.mark.parametrize("after", [0, 3, 60])
def test_an_interrupt_while_lines_move_leaves_the_model_as_it_was(monkeypatch, after):
    model = learned(89)
    agent = model.agent
    agent._lines_due = 89
    state = {name: array.copy() for name, array in agent.get_state().items()}
    with interrupted_after(monkeypatch, agent, after):
        agent._move_lines()
    assert agent.grid.arrays.even
    for name, array in agent.get_state().items():
        np.testing.assert_array_equal(array, state[name], err_msg=name)
    agent._move_lines()
    assert not agent.grid.arrays.even and agent._lines_due > 89


def test_an_interrupt_after_a_step_has_been_learned_from_does_not_keep_lines_from_moving(monkeypatch):
    model = learned(89)

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(agent_module, "moved_lines", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model.learn(5, reset_num_timesteps=False, log_interval=None)
    assert model.agent.model.n_instances == 90 and model.agent.grid.arrays.even
    model.learn(5, reset_num_timesteps=False, log_interval=None)
    assert not model.agent.grid.arrays.even


def test_snapshots_of_uneven_grids_come_back(model):
    shown = snapshot_of(model.agent)
    again = from_plain(json.loads(json.dumps(to_plain(shown))))
    np.testing.assert_array_equal(again.grid.arrays.lines, shown.grid.arrays.lines)
    assert not again.grid.arrays.even


def test_pictures_and_pages_show_uneven_lines(model, tmp_path):
    from sb3_combrel import explain

    explain(model, tmp_path, variables=[(0, 2)])
    assert any(tmp_path.glob("*.png")) and any(tmp_path.glob("*.html"))


@pytest.mark.parametrize("how", [dict(mappings="factored"), dict(use="instances")], ids=["prior", "instances"])
def test_with_a_source_lines_move_as_well_and_what_is_saved_learns_on_as_the_model_would(how):
    source = FittedRMax(Oscillators(), seed=3).learn(150, log_interval=None).source_instances()
    model = learned(120, transfer=COMBREL(source, **how))
    assert not model.agent.grid.arrays.even
    again = saved_and_loaded(model)
    np.testing.assert_array_equal(again.agent.planner.values, model.agent.planner.values)
    assert_both_learn_on_alike(model, again, 30)
