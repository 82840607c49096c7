"""A cart, a pendulum, and a cart that carries the pendulum: two source tasks that are one target task together."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded

MAX_EPISODE_STEPS = 300
PARTS = ("cart", "pendulum", "both")
#: Velocity that a push adds to the cart in a step, and what is left of a velocity after a step: at most 0.05 a step.
PUSH, KEPT = 0.005, 0.9
GOAL_POSITION = 0.8
#: Seconds of a step; gravity and torque of the pendulum, in radians per square second. The torque alone cannot lift it.
STEP_SECONDS, GRAVITY, TORQUE = 0.05, 15.0, 5.0
MAX_ANGULAR_VELOCITY = 8.0
#: The pendulum is up where the cosine of its angle is at least this.
UP = 0.9
#: How much a push of the cart accelerates an upright pendulum the other way, in radians per square second.
COUPLING = 0.3


class CartWithPendulumEnv(gym.Env[np.ndarray, np.int64]):
    """A cart on a track of two metres that must be near its right end, and a pendulum with a motor that must be up.

    ``parts="both"``: the cart carries the pendulum, and an episode terminates when the cart is at its goal while the pendulum
    is up; ``"cart"`` and ``"pendulum"`` are one of them alone. The reward is -1 a step. Observations, of the parts in this
    order:

    | variable | range | at the start | goal |
    | --- | --- | --- | --- |
    | position | -1 to 1 | -0.55 to -0.45 | at least 0.8 |
    | velocity of the wheels, a step | -0.05 to 0.05 | 0 | |
    | angle, 0 is up | -pi to pi, periodic | hanging, within 0.1 | a cosine of at least 0.9 |
    | angular velocity, a second | -8 to 8 | 0 | |

    Actions: nothing; then, if there is a cart, a push to the left and one to the right; then, if there is a pendulum, a torque
    in the negative and one in the positive direction. With both, a push also accelerates the pendulum a little, which neither
    part alone does.

    :raises ValueError: if ``parts`` is another
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, parts: str = "both"):
        if parts not in PARTS:
            raise ValueError(f"parts must be one of {', '.join(PARTS)}, got {parts!r}")
        self._has = np.repeat([parts != "pendulum", parts != "cart"], 2)
        most = KEPT * PUSH / (1.0 - KEPT) + PUSH
        high = np.array([1.0, most, np.pi, MAX_ANGULAR_VELOCITY])[self._has].astype(np.float32)
        self.observation_space = spaces.Box(-high, high, dtype=np.float32)
        self.state_names = tuple(np.array(["position", "velocity", "angle", "angular_velocity"])[self._has].tolist())
        self.periodic = tuple(np.array([False, False, True, False])[self._has].tolist())
        # Of each action, what it does to the cart and to the pendulum.
        pushes, torques = [(-1, 0), (1, 0)] * bool(self._has[0]), [(0, -1), (0, 1)] * bool(self._has[2])
        self._effects = [(0, 0), *pushes, *torques]
        names = {(0, 0): "nothing", (-1, 0): "left", (1, 0): "right", (0, -1): "torque-", (0, 1): "torque+"}
        self.action_names = tuple(names[effect] for effect in self._effects)
        self.action_space = spaces.Discrete(len(self._effects))
        self._state: np.ndarray | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode."""
        super().reset(seed=seed)
        position, angle = self.np_random.uniform(-0.55, -0.45), np.pi + self.np_random.uniform(-0.1, 0.1)
        self._state = np.array([position, 0.0, _wrapped(angle), 0.0])
        return self._observation(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Push the cart, turn the pendulum, or let both be; see :class:`CartWithPendulumEnv`."""
        if self._state is None:
            raise ResetNeeded("call reset() before the first step")
        if not self.action_space.contains(action):
            raise ValueError(f"action must be in {self.action_space}, got {action!r}")
        push, torque = self._effects[int(action)]
        position, velocity, angle, turning = self._state
        velocity = KEPT * velocity + PUSH * push
        turning += STEP_SECONDS * (GRAVITY * np.sin(angle) + TORQUE * torque - COUPLING * push * np.cos(angle))
        turning = float(np.clip(turning, -MAX_ANGULAR_VELOCITY, MAX_ANGULAR_VELOCITY))
        # At an end of the track the cart stays, and its wheels turn on.
        position = float(np.clip(position + velocity, -1.0, 1.0))
        self._state = np.array([position, velocity, _wrapped(angle + STEP_SECONDS * turning), turning])
        reached = np.array([self._state[0] >= GOAL_POSITION, np.cos(self._state[2]) >= UP])
        terminated = bool(reached[self._has[::2]].all())
        return self._observation(), -1.0, terminated, False, {"is_success": terminated}

    def _observation(self) -> np.ndarray:
        assert self._state is not None
        return self._state[self._has].astype(np.float32)


def make_cart_with_pendulum(parts: str = "both") -> gym.Env:
    """Make a :class:`CartWithPendulumEnv` whose episodes are cut off after 300 steps."""
    return gym.wrappers.TimeLimit(CartWithPendulumEnv(parts), MAX_EPISODE_STEPS)


def _wrapped(angle: float) -> float:
    """The angle in [-pi, pi)."""
    return float((angle + np.pi) % (2.0 * np.pi) - np.pi)
