"""Tasks of dm_control's suite with few state variables, seen by these or by the suite's own observation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import TimeLimit

#: Episodes: so many decisions, each of so many of dm_control's control steps.
N_DECISIONS, STEPS_A_DECISION = 500, 2
#: Bounds of positions, metres or radians, and of speeds, per second, far beyond what is reached.
FAR, FAST = 10.0, 60.0

Observation = Mapping[str, np.ndarray]


class Variables(NamedTuple):
    """The state variables of a domain: as they are read from the suite's observation, their upper bounds, which are periodic.

    The lower bounds are as far from 0 as the upper ones.
    """

    read: Callable[[Observation], np.ndarray]
    high: tuple[float, ...]
    periodic: tuple[bool, ...]


def _pendulum(observation: Observation) -> np.ndarray:
    cosine, sine = observation["orientation"]
    return np.array([np.arctan2(sine, cosine), *observation["velocity"]])


def _cart_pole(observation: Observation) -> np.ndarray:
    position, cosine, sine = observation["position"]
    return np.array([position, np.arctan2(sine, cosine), *observation["velocity"]])


def _acrobot(observation: Observation) -> np.ndarray:
    # The horizontal parts of both links, then the vertical ones: angles are against the vertical.
    horizontal, vertical = observation["orientations"].reshape(2, 2)
    return np.array([*np.arctan2(horizontal, vertical), *observation["velocity"]])


def _reacher(observation: Observation) -> np.ndarray:
    shoulder, wrist = observation["position"]
    turned = np.arctan2(np.sin(shoulder), np.cos(shoulder))
    return np.array([turned, wrist, *observation["to_target"], *observation["velocity"]])


#: By domain. The target of the reacher is seen from its finger.
VARIABLES: dict[str, Variables] = {
    "pendulum": Variables(_pendulum, (np.pi, FAST), (True, False)),
    "cartpole": Variables(_cart_pole, (FAR, np.pi, FAST, FAST), (False, True, False, False)),
    "acrobot": Variables(_acrobot, (np.pi, np.pi, FAST, FAST), (True, True, False, False)),
    "reacher": Variables(_reacher, (np.pi, np.pi, FAR, FAR, FAST, FAST), (True, False, False, False, False, False)),
}


class DmControl(gym.Env):
    """A task of dm_control's suite with its Box action, whose rewards are the means of a decision's control steps.

    :param domain: in :data:`VARIABLES`
    :param task: of the domain
    :param observed: whether the state is the suite's own observation, all of it in one vector, and not :data:`VARIABLES`
    """

    def __init__(self, domain: str, task: str, observed: bool = False):
        # Only who makes one needs MuJoCo.
        from dm_control import suite

        self._environment = suite.load(domain, task, task_kwargs={"time_limit": np.inf})
        actions = self._environment.action_spec()
        self.action_space = Box(-1.0, 1.0, actions.shape)
        if observed:
            self._read: Callable[[Observation], np.ndarray] = _all_of
            parts = self._environment.observation_spec().values()
            self.observation_space = Box(-np.inf, np.inf, (sum(int(np.prod(part.shape)) for part in parts),), np.float64)
        else:
            self._read, high, periodic = VARIABLES[domain]
            self.periodic = list(periodic)
            self.observation_space = Box(-np.array(high), np.array(high), dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; a seed decides this one and all that follow."""
        super().reset(seed=seed)
        if seed is not None:
            self._environment.task.random.seed(int(self.np_random.integers(2**32)))
        return self._read(self._environment.reset().observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take :data:`STEPS_A_DECISION` control steps with one action."""
        steps = [self._environment.step(action) for _ in range(STEPS_A_DECISION)]
        reward = float(np.mean([step.reward for step in steps]))
        return self._read(steps[-1].observation), reward, False, False, {}


def _all_of(observation: Observation) -> np.ndarray:
    return np.concatenate([np.ravel(part) for part in observation.values()])


def make_dm_control(domain: str, task: str, observed: bool = False) -> gym.Env:
    """Make a task whose episodes end after :data:`N_DECISIONS`."""
    return TimeLimit(DmControl(domain, task, observed), N_DECISIONS)
