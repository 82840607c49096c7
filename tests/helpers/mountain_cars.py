"""The equations of the Mountain Cars, written down a second time."""

import gymnasium
import numpy as np
from hypothesis import strategies as st

import combrel_envs  # noqa: F401 - registers the tasks


def expected_step(state, action):
    """The next state, by arrays."""
    state = np.asarray(state, dtype=np.float64)
    n = len(state) // 2
    force = np.zeros(n)
    if action > 0:
        axis, direction = (action - 1) // 2, (action - 1) % 2
        force[axis] = 0.001 if direction else -0.001
    v = np.clip(state[n:] + force - 0.0025 * np.cos(3.0 * state[:n]), -0.07, 0.07)
    x = np.clip(state[:n] + v, -1.2, 0.6)
    return np.concatenate([x, np.where(((x == -1.2) & (v < 0)) | ((x == 0.6) & (v > 0)), 0.0, v)])


def possible_states(n_axes):
    """All states of a task with so many axes."""
    positions = st.lists(st.floats(-1.2, 0.6), min_size=n_axes, max_size=n_axes)
    return st.builds(lambda x, v: x + v, positions, st.lists(st.floats(-0.07, 0.07), min_size=n_axes, max_size=n_axes))


def env_in(env_id, state, **kwargs):
    """An environment whose episode starts in ``state``."""
    env = gymnasium.make(env_id, **kwargs)
    env.reset(options={"state": state})
    return env
