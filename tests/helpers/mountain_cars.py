"""Ids, known plans and the equations of the Mountain Cars."""

import math

import gymnasium
import numpy as np
from hypothesis import strategies as st

import combrel_envs  # noqa: F401 - registers the tasks

ID_2D, ID_4D, ID_6D = IDS = tuple(f"combrel/MountainCar{n}D-v0" for n in (2, 4, 6))
TASKS = {ID_2D: "climb_2d", ID_4D: "climb_4d", ID_6D: "climb_6d"}
N_AXES = {ID_2D: 1, ID_4D: 2, ID_6D: 3}
BOTTOM = -math.pi / 6

# Found by search over the equations, from rest at the bottom; "19 Right" is 19 steps of Right.
PLAN_2D = "19 Right, 36 Left, 2 Neutral, 45 Right, 1 Neutral"
PLAN_4D = "9 West, 21 North, 16 East, 21 South, 20 West, 25 North, 27 East, 6 North, 1 Neutral"
PLAN_6D = (
    "10 East, 11 Up, 14 South, 12 West, 9 Down, 17 North, 10 East, 15 Up, 12 South, 14 West, 10 Down, 20 North, 15 East, 31 Up"
)
PLANS = {ID_2D: PLAN_2D, ID_4D: PLAN_4D, ID_6D: PLAN_6D}


def actions_of(plan, env):
    """The numbers of the actions of a plan."""
    runs = (run.split() for run in plan.split(", "))
    return [env.unwrapped.action_names.index(name) for count, name in runs for _ in range(int(count))]


def expected_step(state, action):
    """The equations of the task, written down a second time, with arrays."""
    state = np.asarray(state, dtype=np.float64)
    n = len(state) // 2
    force = np.zeros(n)
    if action > 0:
        axis, direction = (action - 1) // 2, (action - 1) % 2
        force[axis] = 0.001 if direction else -0.001
    v = np.clip(state[n:] + force - 0.0025 * np.cos(3.0 * state[:n]), -0.07, 0.07)
    x = np.clip(state[:n] + v, -1.2, 0.6)
    into_wall = ((x == -1.2) & (v < 0)) | ((x == 0.6) & (v > 0))
    return np.concatenate([x, np.where(into_wall, 0.0, v)])


def possible_states(n_axes):
    """All states of a task with so many axes."""
    positions = st.lists(st.floats(-1.2, 0.6), min_size=n_axes, max_size=n_axes)
    velocities = st.lists(st.floats(-0.07, 0.07), min_size=n_axes, max_size=n_axes)
    return st.builds(lambda x, v: x + v, positions, velocities)


def env_in(env_id, state, **kwargs):
    """An environment whose episode starts in ``state``."""
    env = gymnasium.make(env_id, **kwargs)
    env.reset(options={"state": state})
    return env
