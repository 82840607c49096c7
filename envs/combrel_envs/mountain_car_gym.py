"""Mountain Car for Gymnasium: the equations stepped directly, without MuJoCo, which is loaded for pictures only."""

from typing import TYPE_CHECKING, Any, ClassVar, SupportsIndex

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from combrel_envs import mountain_car_dynamics as dynamics
from combrel_envs.checks import check_choice
from combrel_envs.gym_env import RenderedEnv

if TYPE_CHECKING:
    from combrel_envs.mountain_car import Physics


class MountainCarEnv(RenderedEnv):
    """Common base class of the three cars, arguments as :class:`MountainCar2DEnv` says; `ValueError` for others."""

    n_axes: ClassVar[int]

    def __init__(self, start: str = "offset", *, action_noise: float = 0.0, **picture: Any) -> None:
        super().__init__(**picture)
        self._start = check_choice("start", start, dynamics.STARTS)
        self._action_noise = dynamics.check_action_noise(action_noise)
        self._state: dynamics.State | None = None
        self._physics: Physics | None = None
        self._low = np.repeat([dynamics.MIN_POSITION, -dynamics.MAX_SPEED], self.n_axes)
        self._high = np.repeat([dynamics.MAX_POSITION, dynamics.MAX_SPEED], self.n_axes)
        self.observation_space = spaces.Box(self._low.astype(np.float32), self._high.astype(np.float32))
        self.action_space = spaces.Discrete(len(self.action_names))

    @property
    def state(self) -> np.ndarray:
        """The present state in float64, in the order of ``state_names``; the observation is its rounding to float32."""
        positions, velocities = self._running_state()
        return np.array(positions + velocities)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; ``seed`` is that of the following ones too, None continues.

        :param options: ``{"start": ...}`` overrides the environment's start option for this episode, ``{"state": [...]}``
            begins in exactly that state, in the order of ``state_names``
        :raises ValueError: when an option is unknown or its value isn't possible
        """
        super().reset(seed=seed)
        options = options or {}
        if not options.keys() <= {"start", "state"} or len(options) > 1:
            raise ValueError(f"options of reset must be either 'start' or 'state', got {options!r}")
        if "state" in options:
            self._state = self._checked_state(options["state"])
        else:
            start = check_choice("start", options.get("start", self._start), dynamics.STARTS)
            self._state = dynamics.sample_start(start, self.n_axes, self.np_random.uniform)
        return self._observation(self._state), {}

    def step(self, action: SupportsIndex) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        """Take the action of a number; ``ValueError`` if there is none. ``TimeLimit`` has the step limit."""
        push = dynamics.executed_push(action, self.n_axes, self._action_noise, self.np_random.uniform)
        self._state = state = dynamics.step_car(*self._running_state(), push)
        terminated = dynamics.at_goal(state[0])
        return self._observation(state), -1.0, terminated, False, {"is_success": terminated}

    def close(self) -> None:
        """Free MuJoCo's memory and the OpenGL context, if a picture was drawn."""
        if self._physics is not None:
            self._physics.free()
            self._physics = None

    def _running_state(self) -> dynamics.State:
        if self._state is None:
            raise ResetNeeded("call reset() before the first step")
        return self._state

    def _observation(self, state: dynamics.State) -> np.ndarray:
        # Rounding to float32 is monotonic, so a state within the bounds stays within the space's rounded bounds.
        return np.array(state[0] + state[1], dtype=np.float32)

    def _checked_state(self, state: Any) -> dynamics.State:
        names = ", ".join(self.state_names)
        try:
            values = np.asarray(state, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise ValueError(f"options['state'] must be numbers ({names}), got {state!r}") from error
        # Compared in float32: every observation can be given back as a state, though float32(0.6) is more than 0.6.
        if values.shape != self._low.shape or not self.observation_space.contains(values.astype(np.float32)):
            raise ValueError(
                f"options['state'] must be the {len(self._low)} numbers ({names}) between {self._low.tolist()} and "
                f"{self._high.tolist()}, got {state!r}"
            )
        entries = tuple(np.clip(values, self._low, self._high).tolist())
        return entries[: self.n_axes], entries[self.n_axes :]

    def _drawn_physics(self) -> "Physics":
        if self._physics is None:
            from combrel_envs.mountain_car import make_physics

            self._physics = make_physics(self.n_axes)
        self._physics.set_car(*self._running_state())
        self._physics.forward()
        return self._physics


class MountainCar2DEnv(MountainCarEnv):
    """## Description

    A car stands in a valley. Its engine is weaker than gravity, so it can't just drive up the hill on the right: it must first
    go left, away from the goal, and swing up. This is the task of Singh and Sutton, *Reinforcement Learning with Replacing
    Eligibility Traces* (Machine Learning, 1996).

    ## Observation Space

    A `Box` of float32 with shape (2,); `env.unwrapped.state` is the same in float64.

    | Num | Observation | Name | Min   | Max  |
    |-----|-------------|------|-------|------|
    | 0   | position    | x    | -1.2  | 0.6  |
    | 1   | velocity    | v    | -0.07 | 0.07 |

    ## Action Space

    `Discrete(3)`: Neutral, Left, Right; they push by 0, -1 and +1. (In Gymnasium's own `MountainCar-v0` 0 is left, 1 none, 2
    right.)

    ## Transition Dynamics

    v' = v + 0.001 push - 0.0025 cos(3x), clipped to [-0.07, 0.07]

    x' = x + v', clipped to [-1.2, 0.6]

    At either wall a velocity that points into the wall becomes 0.

    ## Rewards

    -1 on every step, the last included.

    ## Starting State

    At rest at the bottom of the valley, x = -pi/6, moved by an offset that is drawn from [-0.005, 0.005] at every reset.

    ## Episode End

    - Termination: x >= 0.5; `info["is_success"]` is True then. From the bottom it can be reached in 103 steps.
    - Truncation: after 4000 steps, by the `TimeLimit` wrapper of `gymnasium.make`, whose argument `max_episode_steps` changes
      this; a car at the goal on the very last step is reported as both: treat it as terminated. The class itself has no limit.

    ## Arguments

    - `start`: `"offset"` (the default), `"fixed"` (exactly at the bottom, at rest), or `"random"` (any position that isn't the
      goal, any velocity, uniformly).
    - `action_noise`: probability with which a random action, drawn from all, is executed instead of the one that was chosen; 0
      by default. The seed of `reset` decides it.
    - `render_mode`: `None` or `"rgb_array"`; MuJoCo draws the pictures and needs OpenGL (`MUJOCO_GL=egl` without a display).
    - `width`, `height` of the pictures, 640 x 480 by default; `camera`: `"side"` (the default) or `"close"`: follows the car.

    `reset` takes the options `{"start": ...}`, to override `start` for one episode, and `{"state": [x, v]}`, to begin in
    exactly that state.
    """

    n_axes = 1
    state_names = dynamics.STATE_NAMES[1]
    action_names = dynamics.ACTION_NAMES[1]
    cameras = ("side", "close")


class MountainCar4DEnv(MountainCarEnv):
    """## Description

    `combrel/MountainCar4D-v0`: a car stands at the bottom of a basin with hills along two axes, of height sin(3x) + sin(3y).
    Its engine is weaker than gravity and pushes along one axis at a time; the goal is the hill in the north-east corner. The
    two axes move independently, each as in `combrel/MountainCar2D-v0`, but must be at the goal together.

    ## Observation Space

    A `Box` of float32 with shape (4,); `env.unwrapped.state` is the same in float64. Some other versions of this task order it
    (x, vx, y, vy).

    | Num | Observation             | Name | Min   | Max  |
    |-----|-------------------------|------|-------|------|
    | 0   | position, west to east  | x    | -1.2  | 0.6  |
    | 1   | position, south to north| y    | -1.2  | 0.6  |
    | 2   | velocity along x        | vx   | -0.07 | 0.07 |
    | 3   | velocity along y        | vy   | -0.07 | 0.07 |

    ## Action Space

    `Discrete(5)`: Neutral, West, East, South, North; West and East push by -1 and +1 along x, South and North along y.

    ## Everything Else

    As in `combrel/MountainCar2D-v0`, on every axis; gravity acts on both on every step. The offset of the start is the same
    for x and y. Termination: x >= 0.5 and y >= 0.5; from the bottom the goal can be reached in 146 steps, which the tests
    replay; whether fewer are possible isn't known. `camera` is `"perspective"` (the default), `"top"`, or `"close"`, which
    follows the car; the option of `reset` is `{"state": [x, y, vx, vy]}`.
    """

    n_axes = 2
    state_names = dynamics.STATE_NAMES[2]
    action_names = dynamics.ACTION_NAMES[2]
    cameras = ("perspective", "top", "close")


class MountainCar6DEnv(MountainCarEnv):
    """## Description

    `combrel/MountainCar6D-v0`: `combrel/MountainCar4D-v0` with one axis more, hills of height sin(3x) + sin(3y) + sin(3z); the
    goal is the upper end of all three axes together. Pictures show x and y as in 4D, and z as a second car on a strip in front
    of it.

    ## Observation Space

    A `Box` of float32 with shape (6,), x, y, z, vx, vy, vz: the positions (west to east, south to north, down to up) from -1.2
    to 0.6, and the velocities from -0.07 to 0.07. `env.unwrapped.state` is the same in float64.

    ## Action Space

    `Discrete(7)`: Neutral, West, East, South, North, Down, Up; each pushes by -1 or +1 along one axis, or not at all.

    ## Everything Else

    As in `combrel/MountainCar2D-v0`, on every axis; gravity acts on all three on every step. The offset of the start is the
    same for all. Termination: x >= 0.5, y >= 0.5 and z >= 0.5; from the bottom the goal can be reached in 200 steps, which the
    tests replay; whether fewer are possible isn't known. `camera` is `"perspective"` (the default), `"top"`, or `"close"`,
    which follows the car of x and y; the option of `reset` is `{"state": [x, y, z, vx, vy, vz]}`.
    """

    n_axes = 3
    state_names = dynamics.STATE_NAMES[3]
    action_names = dynamics.ACTION_NAMES[3]
    cameras = ("perspective", "top", "close")
