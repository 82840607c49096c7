"""Three tasks of bsuite with a Gymnasium face, seen by a few state variables or by bsuite's own observation.

They need the extra ``benchmarks``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.wrappers import TimeLimit

#: Steps of an episode, as in bsuite, and the side of the sea.
CAR_STEPS, CART_STEPS, SEA = 1000, 1000, 10
#: The sea's actions are named by chance in each cell: bsuite's own draw.
SEA_MAPPING_SEED = 42
#: The clock, which bsuite's observations tell, stands still: time limits are Gymnasium's.
NEVER = 10**9


class Face(NamedTuple):
    """A task: how bsuite makes it with a seed, its state variables, read from bsuite's observation, and their bounds."""

    make: Callable[[int], Any]
    read: Callable[[np.ndarray], np.ndarray]
    low: tuple[float, ...]
    high: tuple[float, ...]
    periodic: tuple[bool, ...]
    n_steps: int


def _make_car(seed: int) -> Any:
    from bsuite.environments.mountain_car import MountainCar

    return MountainCar(max_steps=NEVER, seed=seed)


def _make_cart_pole(seed: int) -> Any:
    from bsuite.experiments.cartpole_swingup.cartpole_swingup import CartpoleSwingup

    return CartpoleSwingup(max_time=float(NEVER), seed=seed)


def _make_sea(seed: int) -> Any:
    from bsuite.environments.deep_sea import DeepSea

    return DeepSea(SEA, seed=seed, mapping_seed=SEA_MAPPING_SEED)


def _car(observation: np.ndarray) -> np.ndarray:
    return observation.ravel()[:2]


def _cart_pole(observation: np.ndarray) -> np.ndarray:
    position, speed, sine, cosine, turning, *_ = observation.ravel()
    return np.array([position, np.arctan2(sine, cosine), speed, turning])


def _sea(observation: np.ndarray) -> np.ndarray:
    """Row and column; the end, where nothing is seen, is below the last row."""
    [where] = np.argwhere(observation) if observation.any() else [np.array([SEA, 0])]
    return where.astype(np.float64)


# Speeds are bounded far beyond what is reached, but for the car's, which bsuite clips.
_CART_BOUNDS = (1.1, np.pi, 10.0, 60.0)
FACES: dict[str, Face] = {
    "mountain_car": Face(_make_car, _car, (-1.2, -0.07), (0.6, 0.07), (False, False), CAR_STEPS),
    "cartpole_swingup": Face(
        _make_cart_pole,
        _cart_pole,
        tuple(-bound for bound in _CART_BOUNDS),
        _CART_BOUNDS,
        (False, True, False, False),
        CART_STEPS,
    ),
    "deep_sea": Face(_make_sea, _sea, (0.0, 0.0), (float(SEA), float(SEA)), (False, False), SEA),
}


class Bsuite(gym.Env):
    """A task of bsuite.

    :param name: in :data:`FACES`
    :param observed: whether the state is bsuite's own observation, flattened, and not a few state variables
    """

    def __init__(self, name: str, observed: bool = False):
        self._face, self._observed = FACES[name], observed
        self._environment = self._face.make(0)
        self.action_space = Discrete(self._environment.action_spec().num_values)
        if observed:
            size = int(np.prod(self._environment.observation_spec().shape))
            self.observation_space = Box(-np.inf, np.inf, (size,), np.float64)
        else:
            self.periodic = list(self._face.periodic)
            self.observation_space = Box(np.array(self._face.low), np.array(self._face.high), dtype=np.float64)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; a seed decides this one and all that follow."""
        super().reset(seed=seed)
        if seed is not None:
            self._environment = self._face.make(int(self.np_random.integers(2**31)))
        return self._state(self._environment.reset().observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take one step."""
        step = self._environment.step(int(action))
        return self._state(step.observation), float(step.reward), bool(step.last()), False, {}

    def _state(self, observation: np.ndarray) -> np.ndarray:
        return observation.ravel().astype(np.float64) if self._observed else self._face.read(observation).astype(np.float64)


def make_bsuite(name: str, observed: bool = False) -> gym.Env:
    """Make a task whose episodes have bsuite's limit of steps."""
    return TimeLimit(Bsuite(name, observed), FACES[name].n_steps)
