"""The iCub's ball-striking tasks for Gymnasium; the class docstrings document them."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from combrel_envs import icub, icub_tasks
from combrel_envs.gym_env import DmControlEnv


class ICubStrikeEnv(DmControlEnv):
    """Common base class, arguments as :class:`ICubTorsoStrikeEnv`; else `ValueError`, `ModuleNotFoundError` without meshes."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - as Gymnasium declares it
    cameras = ("front", "top")
    task: ClassVar[str]

    def __init__(
        self,
        look: str = "primitives",
        *,
        start: Sequence[float] | None = None,
        extent: float = icub_tasks.EXTENT,
        motor_noise: float = 0.0,
        encoder_noise: float = 0.0,
        **picture: Any,
    ) -> None:
        # The step limit belongs to the `TimeLimit` wrapper, as for every environment of Gymnasium.
        environment = icub.make_environment(self.task, float("inf"), None, look, start, extent, motor_noise, encoder_noise)
        super().__init__(environment, **picture)
        self._start = environment.task.start

    def _apply_options(self, options: dict[str, Any]) -> None:
        if set(options) - {"start"}:
            raise ValueError(f"options of reset must be empty or have a 'start', got {options!r}")
        strike, start = self._environment.task, options.get("start")
        start = self._start if start is None else start
        if not np.array_equal(start, strike.start):
            # The check moves the robot: it ends a running episode even if the start isn't possible.
            self._running = False
            strike.set_start(start, self._environment.physics)

    def _flatten(self, observation: Any) -> np.ndarray:
        # The task clips it to the limits; rounding both to float32 is monotonic and keeps it within them.
        return observation["encoders"].astype(np.float32)


class ICubTorsoStrikeEnv(ICubStrikeEnv):
    """## Description

    The iCub humanoid sits at a table on which a ball lies. It is blind, and must find the ball with the fingertips of its
    stretched right arm by bending and turning its torso: lean forward, then turn left. Everything else of the robot stands
    still. This is the source task of Section 4.2 in Fachantidis, Partalas, Taylor and Vlahavas, *Transfer learning with
    probabilistic mapping selection* (Adaptive Behavior, 2015); the target task is `combrel/ICubArmStrike-v0`.

    ## Observation Space

    A `Box` of float32 with shape (2,): the encoders of the joints, in degrees. The bounds are the limits of the real robot.

    | Num | Observation                                  | Name        | Min | Max |
    |-----|----------------------------------------------|-------------|-----|-----|
    | 0   | S1: bends the torso, forward is positive     | torso_pitch | -20 | 70  |
    | 1   | S2: turns the torso, to its right is positive| torso_yaw   | -50 | 50  |

    ## Action Space

    `Discrete(4)`: S1-, S1+, S2-, S2+, as in the paper's Table 4: joint (S1: torso_pitch, S2: torso_yaw) and direction, 2
    degrees each.

    ## Transition Dynamics

    MuJoCo simulates the robot (kinematics, inertias and limits of iCubGazeboV2_5), the table and the ball. An action moves the
    target angle of one joint by the extent, within the joint's limits; position controllers follow the targets for 0.1 s, in
    which a free joint comes to within about 0.1 degrees of its target. The hand, which alone collides, can be blocked by the
    table: before each action every target is brought to within one extent of its joint.

    The same actions lead to the same observations, bit by bit. `combrel/ICubTorsoStrikeNoisy-v0` adds noise: the extent of
    each action is drawn from N(2, 0.2) degrees, and each encoder reading is off by N(0, 0.2) degrees.

    ## Rewards

    -1 on every step, and +100 on the step that moves the ball: 99 on the last step of a successful episode.

    ## Starting State

    Always the same: upright and turned to the right, at (0, 40) degrees, the arm stretched forward. The ball lies 0.45 m
    before the waist and 0.02 m to the right of it, on a table 0.62 m high.

    ## Episode End

    - Termination: the ball has been moved by more than 2 mm; `info["is_success"]` is True then.
    - Truncation: after 400 steps, by the `TimeLimit` wrapper of `gymnasium.make`, whose argument `max_episode_steps` changes
      this; a hit on the very last step is reported as both: treat it as terminated. The class itself has no limit.

    The tests replay a plan of 26 actions that hits; random actions hit in about 6 % of the episodes.

    ## Arguments

    - `start`: two angles in degrees, in the order of the observation. The hand must not touch the ball there, nor be inside
      the table.
    - `extent`: degrees by which an action moves a joint, 2 by default.
    - `motor_noise`: standard deviation of an action's extent, as a fraction of it; 0 by default, 0.1 in the noisy variant.
    - `encoder_noise`: standard deviation of an encoder reading in degrees; 0 by default, 0.2 in the noisy variant.
    - `look`: `"primitives"` (the default) or `"meshes"`, the robot's true shape, for which the package `icub-models` is needed
      (`pip install 'sb3-combrel[icub]'`). The dynamics are the same.
    - `render_mode`: `None` or `"rgb_array"`; needs OpenGL (`MUJOCO_GL=egl` without a display).
    - `width`, `height` of the pictures, 640 x 480 by default; `camera`: `"front"` (the default) or `"top"`.

    The seed of `reset` decides the noise; its option `{"start": [...]}` overrides `start` for one episode.
    """

    task = "torso_strike"
    state_names = icub_tasks.TASKS[task].state_names
    action_names = icub_tasks.TASKS[task].action_names


class ICubArmStrikeEnv(ICubStrikeEnv):
    """## Description

    `combrel/ICubArmStrike-v0`: as in `combrel/ICubTorsoStrike-v0` the iCub must strike the ball, but by moving four joints of
    its right arm; its torso leans forward and stands still. This is the target task of the same paper.

    ## Observation Space

    A `Box` of float32 with shape (4,): the encoders of the joints, in degrees. The bounds are the limits of the real robot.

    | Num | Observation                                        | Name             | Min   | Max   |
    |-----|----------------------------------------------------|------------------|-------|-------|
    | 0   | T1: swings the arm, backward is positive           | r_shoulder_pitch | -95.5 | 10    |
    | 1   | T2: lifts the arm sideways, up is positive         | r_shoulder_roll  | 0     | 160.8 |
    | 2   | T3: turns the upper arm, inward is positive        | r_shoulder_yaw   | -37   | 80    |
    | 3   | T4: bends the elbow, more is positive              | r_elbow          | 15    | 106   |

    ## Action Space

    `Discrete(8)`: T1-, T1+, T2-, T2+, T3-, T3+, T4-, T4+, as in the paper's Table 4: joint and direction, 2 degrees each.

    ## Starting State

    Always the same: at (-40, 40, -10, 60) degrees, the torso bent forward by 15; table and ball as for the torso.

    ## Everything Else

    Dynamics, rewards, ends and arguments as in `combrel/ICubTorsoStrike-v0`, but a `start` has four angles; the variant with
    noise is `combrel/ICubArmStrikeNoisy-v0`. The tests replay a plan of 29 actions that hits, and Fitted R-Max finds some of
    27; random actions hit in about 2 % of the episodes.
    """

    task = "arm_strike"
    state_names = icub_tasks.TASKS[task].state_names
    action_names = icub_tasks.TASKS[task].action_names
