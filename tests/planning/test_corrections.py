"""Exploration ends: wrong promises of the interpolated value are corrected where the agent makes no progress."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from stable_baselines3.common.callbacks import BaseCallback

import sb3_combrel.fitted_rmax.policies as policies
from sb3_combrel import FittedRMax
from sb3_combrel.planning import corrections as c
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.q_values import QueryScratch

STEP_LIMIT = 100
# Only compiled code calls them; here they are compiled for Python as well.
cell_key, find_cell = njit(c.cell_key.py_func), njit(c.find_cell.py_func)


class TwoJoints(gym.Env):
    """Two joints, each action moves one of them a little; a block that they can't enter stands between start and goal.

    The way round takes 34 steps. With resolution 3 a cell is wider than the kernel's reach at breadth 0.04: grid points
    inside the block stay optimistic for ever, and from the states before it they promise a short way through.
    """

    observation_space = spaces.Box(0.0, 1.0, (2,), dtype=np.float64)
    action_space = spaces.Discrete(4)

    def __init__(self, step=0.05):
        self.step_length = step

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.joints = np.zeros(2)
        return self.joints.copy(), {}

    def step(self, action):
        to = self.joints.copy()
        to[action // 2] += self.step_length if action % 2 else -self.step_length
        to = np.clip(to, 0.0, 1.0)
        if not (0.4 < to[0] < 0.6 and to[1] < 0.75):
            self.joints = to
        return self.joints.copy(), -1.0, bool((np.abs(self.joints - 0.9) <= 0.06).all()), False, {}


class EpisodeLengths(BaseCallback):
    """The lengths of episodes; ends the learning after some of them."""

    def __init__(self, n_episodes):
        super().__init__()
        self.n_episodes = n_episodes
        self.lengths = []

    def _on_step(self):
        for info in self.locals["infos"]:
            if "episode" in info:
                self.lengths.append(info["episode"]["l"])
        return len(self.lengths) < self.n_episodes


def lengths_of_episodes(seed, n_episodes, step=0.05):
    env = gym.wrappers.TimeLimit(TwoJoints(step), STEP_LIMIT)
    with pytest.warns(UserWarning, match="coarse"):
        model = FittedRMax(env, model_breadth=0.04, resolution=3, min_fraction=0.1, seed=seed)
    episodes = EpisodeLengths(n_episodes)
    model.learn(n_episodes * STEP_LIMIT, callback=episodes)
    return np.array(episodes.lengths)


@pytest.mark.parametrize("seed", range(3))
def test_without_corrections_every_episode_runs_into_its_limit(seed, monkeypatch):
    """The trap is real; otherwise the next test would say nothing."""
    monkeypatch.setattr(policies, "PATIENCE", 10**9)
    assert (lengths_of_episodes(seed, 40)[-30:] == STEP_LIMIT).all()


@pytest.mark.parametrize("seed", range(3))
def test_it_never_gets_stuck(seed):
    lengths = lengths_of_episodes(seed, 80)
    assert (lengths[-20:] < STEP_LIMIT).all()
    assert lengths[-20:].mean() < 60


@pytest.mark.slow
@pytest.mark.parametrize("step", [0.05, 1 / 24, 0.043])
def test_it_never_gets_stuck_whatever_the_step_length(step):
    """Also where steps and cells are commensurate, so that states lie on the cells' edges."""
    for seed in range(3):
        lengths = lengths_of_episodes(seed, 120, step)
        assert (lengths[-20:] < STEP_LIMIT).all(), (seed, lengths)


# ---------------------------------------------------------------------- the parts

GRID = StateGrid(2, 3, 0)


# Compiled again, to be called from here: as it is, only compiled code can call them.
visit, corrected_value = njit(c.visit.py_func), njit(c.corrected_value.py_func)


def scratch():
    return QueryScratch.empty(1, 2, 4)


def visit_often(values, memory, state, best_q, episode=0, times=1, tolerance=0.05):
    for _ in range(times):
        memory = memory.with_room()
        visitor = (episode, tolerance, c.PATIENCE)
        visit(values, memory, np.asarray(state, dtype=float), best_q, visitor, GRID.arrays, scratch())
    return memory


def value_at(values, memory, state):
    return corrected_value(values, memory, np.asarray(state, dtype=float) * 8, GRID.arrays, scratch())


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.lists(st.integers(0, 2**62), unique=True, max_size=700))
def test_the_table_finds_every_key_as_it_grows_and_no_other(keys):
    memory = c.CorrectionArrays.empty(2, capacity=8)
    for n, key in enumerate(keys):
        memory = memory.with_room()
        at = find_cell(memory, key)
        assert memory.table[at] == -1, "not there yet"
        memory.table[at], memory.key[n], memory.value[n] = n, key, float(n)
        memory.count[0] = n + 1
    for n, key in enumerate(keys):
        assert memory.table[find_cell(memory, key)] == n
        assert memory.value[n] == n
    assert memory.count[0] == len(keys) <= len(memory.key) < len(memory.table)


def test_cells_are_smaller_than_grid_cells_and_do_not_share_numbers():
    axis = np.linspace(0.0, 8.0, 8 * 3 * 8 + 1)
    keys = {(x, y): cell_key(np.array([x, y]), GRID.arrays.shape) for x in axis for y in axis}
    by_cell = {}
    for position, key in keys.items():
        by_cell.setdefault(key, []).append(position)
    assert 24**2 <= len(by_cell) <= 25**2
    for positions in by_cell.values():
        assert np.ptp(np.array(positions), axis=0).max() < 1 / 3 + 1e-9
    assert cell_key(np.array([-5.0, 9.0]), GRID.arrays.shape) == cell_key(np.array([0.0, 8.0]), GRID.arrays.shape)


@pytest.mark.parametrize("at", [0.0, 1.0, 2.0, 7.0, 8.0, 1 / 3, 0.4, 0.5, 2.4])
def test_a_rounding_error_at_a_round_number_leads_to_the_same_cell(at):
    keys = {cell_key(np.array([at + error, 1.0]), GRID.arrays.shape) for error in (-1e-12, 0.0, 1e-12)}
    assert len(keys) == 1


def test_nothing_is_corrected_until_patience_is_at_an_end():
    values, state = np.zeros(GRID.n_points), (0.3, 0.4)
    memory = visit_often(values, c.CorrectionArrays.empty(2), state, -3.0, times=c.PATIENCE)
    assert value_at(values, memory, state) == 0.0
    memory = visit_often(values, memory, state, -3.0)
    assert value_at(values, memory, state) == pytest.approx(-3.0)


def test_patience_is_counted_by_episode_and_cell():
    values, memory = np.zeros(GRID.n_points), c.CorrectionArrays.empty(2)
    for episode in range(4 * c.PATIENCE):
        memory = visit_often(values, memory, (0.3, 0.4), -3.0, episode)
    assert memory.count[0] == 0
    for k in range(4 * c.PATIENCE):
        memory = visit_often(values, memory, (0.3, k / (4 * c.PATIENCE)), -3.0, episode=1000)
    assert memory.count[0] == 0


def test_a_promise_that_is_kept_is_not_corrected():
    values = np.full(GRID.n_points, -2.0)
    memory = visit_often(values, c.CorrectionArrays.empty(2), (0.3, 0.4), -2.04, times=5 * c.PATIENCE)
    assert memory.count[0] == 0
    memory = visit_often(values, memory, (0.3, 0.4), -1.0, times=5 * c.PATIENCE)
    assert memory.count[0] == 0


def test_each_visit_renews_what_is_remembered():
    values = np.zeros(GRID.n_points)
    memory = visit_often(values, c.CorrectionArrays.empty(2), (0.3, 0.4), -3.0, times=c.PATIENCE + 1)
    for best_q in (-4.0, -7.5, -5.0):
        memory = visit_often(values, memory, (0.3, 0.4), best_q)
        assert value_at(values, memory, (0.3, 0.4)) == pytest.approx(best_q)
    assert memory.count[0] == 1


def test_a_correction_counts_in_its_cell_only_and_never_raises_a_value():
    rng = np.random.default_rng(0)
    values = -10.0 * rng.random(GRID.n_points)
    memory = visit_often(values, c.CorrectionArrays.empty(2), (0.3, 0.4), -30.0, times=c.PATIENCE + 1)
    own_cell = cell_key(np.array([0.3, 0.4]) * 8, GRID.arrays.shape)
    lowered = 0
    for state in rng.random((500, 2)):
        plain = GRID.interpolate(values, state)
        if cell_key(state * 8, GRID.arrays.shape) == own_cell:
            assert value_at(values, memory, state) == pytest.approx(
                plain - 30.0 - GRID.interpolate(values, np.array([0.3, 0.4]))
            )
            lowered += 1
        else:
            assert value_at(values, memory, state) == pytest.approx(plain)
    assert lowered > 0
    # Once the grid's own value is lower than what is remembered, the memory has nothing to add.
    values[:] = -50.0
    assert value_at(values, memory, (0.3, 0.4)) == pytest.approx(-50.0)
