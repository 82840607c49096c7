"""Transitions of Stable-Baselines3's replay buffers."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_combrel.common.scaling import Bounds, StateScaling
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.sources.transitions import Transitions

UNNAMED: Mapping[str, Any] = MappingProxyType({"env": None, "recorder": "replay buffer"})


def read_buffer(
    buffer: ReplayBuffer,
    bounds: Bounds | None = None,
    names: Mapping[str, Any] = MappingProxyType({}),
    origin: Mapping[str, Any] = UNNAMED,
) -> Transitions:
    """The transitions of a replay buffer, environment by environment, in the order in which they came.

    :param names: ``state_names``, ``action_names`` and ``periodic`` of its task, as far as they are known
    :raises ValueError: if it is empty, has other spaces than Box and Discrete, or does not keep where episodes ended
    """
    if buffer.optimize_memory_usage:
        raise ValueError("a replay buffer with optimize_memory_usage=True does not keep in which states episodes ended")
    if not isinstance(buffer.observations, np.ndarray) or not isinstance(buffer.action_space, spaces.Discrete):
        raise ValueError(
            f"a replay buffer must have Box observations and Discrete actions, got {buffer.observation_space} and "
            f"{buffer.action_space}"
        )
    if buffer.size() == 0:
        raise ValueError(f"a replay buffer must hold transitions, got a {type(buffer).__name__} that is empty")
    oldest = buffer.pos if buffer.full else 0
    rows = (oldest + np.arange(buffer.size())) % buffer.buffer_size

    def column(array: np.ndarray) -> np.ndarray:
        return np.concatenate([array[rows, e].reshape(len(rows), -1) for e in range(buffer.n_envs)]).astype(np.float64)

    if not buffer.handle_timeout_termination and buffer.dones.any():
        warn_user(
            "the replay buffer has handle_timeout_termination=False and does not say which episodes a time limit ended: "
            f"all {int(buffer.dones[rows].sum())} ends count as terminal states"
        )
    terminated = (column(buffer.dones)[:, 0] > 0.5) & (column(buffer.timeouts)[:, 0] < 0.5)
    actions = column(buffer.actions)[:, 0].astype(np.int64) - int(buffer.action_space.start)
    before, after = column(buffer.observations), column(buffer.next_observations)
    limits = StateScaling.limits_of(buffer.observation_space, bounds)
    columns = before, actions, column(buffer.rewards)[:, 0], after, terminated
    return Transitions.within(limits, columns, int(buffer.action_space.n), names, origin)
