"""The iCub strikes a ball: a dm_control domain with the tasks of Section 4.2 of the COMBREL paper.

``torso_strike`` moves two joints of the torso (its source task), ``arm_strike`` four of the right arm (its target task); the
``_noisy`` variants are stochastic. The robot observes only the encoders of these joints, in degrees; a command takes 0.1 s.
"""

import collections
import math
from typing import Any

import numpy as np

from combrel_envs import icub_tasks, rendering
from combrel_envs.checks import check_action, check_choice, check_number

rendering.import_dm_control()

import dm_env  # noqa: E402
import mujoco as mujoco_bindings  # noqa: E402
from dm_control import mujoco  # noqa: E402
from dm_control.mujoco import wrapper  # noqa: E402
from dm_control.rl import control  # noqa: E402
from dm_control.utils import containers  # noqa: E402

from combrel_envs import icub_model  # noqa: E402
from combrel_envs.environment import TerminatingEnvironment  # noqa: E402

_CONTROL_TIMESTEP = 0.1  # (Seconds).
#: Degrees in a radian, MuJoCo's unit.
_DEGREES = math.degrees(1.0)
#: How far the hand may overlap the table at the start, in metres: contacts are soft.
_START_OVERLAP = 0.0005
SUITE = containers.TaggedTasks()


@SUITE.add("benchmarking")
def torso_strike(**kwargs: Any) -> control.Environment:
    """Returns the task of striking the ball by turning and bending the torso; see `make_environment`."""
    return make_environment("torso_strike", **kwargs)


@SUITE.add("benchmarking")
def arm_strike(**kwargs: Any) -> control.Environment:
    """Returns the task of striking the ball with the arm; see `make_environment`."""
    return make_environment("arm_strike", **kwargs)


@SUITE.add("noisy")
def torso_strike_noisy(**kwargs: Any) -> control.Environment:
    """Returns `torso_strike` with noisy motors and encoders."""
    return make_environment("torso_strike", **(icub_tasks.NOISE | kwargs))


@SUITE.add("noisy")
def arm_strike_noisy(**kwargs: Any) -> control.Environment:
    """Returns `arm_strike` with noisy motors and encoders."""
    return make_environment("arm_strike", **(icub_tasks.NOISE | kwargs))


def make_environment(
    task: str,
    time_limit: float = icub_tasks.MAX_EPISODE_STEPS * _CONTROL_TIMESTEP,
    random: np.random.RandomState | int | None = None,
    look: str = "primitives",
    start: Any = None,
    extent: float = icub_tasks.EXTENT,
    motor_noise: float = 0.0,
    encoder_noise: float = 0.0,
    environment_kwargs: dict[str, Any] | None = None,
) -> control.Environment:
    """Returns a ball-striking environment.

    Args:
      task: "torso_strike" or "arm_strike".
      time_limit: Seconds until an episode is cut off; a command takes 0.1 s.
      look: "primitives" or "meshes".
      environment_kwargs: Arguments of `control.Environment`; for all others see `Strike`.
    """
    check_choice("look", look, icub_tasks.LOOKS)
    check_number("time_limit", time_limit, "a number of seconds above 0", lambda seconds: seconds > 0)
    strike = Strike(icub_tasks.TASKS[task], start, extent, motor_noise, encoder_noise, random)
    physics = Physics.from_model(wrapper.MjModel(icub_model.make_model(icub_tasks.TASKS[task], look)))
    strike.check_free(physics)
    kwargs = {"legacy_step": False} | (environment_kwargs or {})
    if "n_sub_steps" not in kwargs:
        kwargs.setdefault("control_timestep", _CONTROL_TIMESTEP)
    # 3 * 0.1 is a little more than 0.3: without rounding that would be a fourth step.
    return TerminatingEnvironment(physics, strike, time_limit=round(time_limit, 6), **kwargs)


class Physics(mujoco.Physics):
    """The robot, the table and the ball. The joints of the task come first in MuJoCo's arrays, then the ball's."""

    #: Of the class, as a copy of a physics has nothing but its data.
    legacy_step = False

    def _reload_from_data(self, data: wrapper.MjData) -> None:
        super()._reload_from_data(data)
        n = self.model.nu
        # Views of the state, taken once: they are read at every step.
        self._angles = self.data.qpos[:n]
        self._ball = self.data.qpos[n : n + 2]
        self._ball_start = self.model.qpos0[n : n + 2].tolist()
        self._targets = self.data.ctrl
        self._limits = self.model.jnt_range[:n].tolist()
        self._warnings_since_reset = self.data.warning.number
        self._hand = [self.model.name2id(name, "geom") for name in icub_model.HAND]

    def encoders(self) -> np.ndarray:
        """Returns the angles of the task's joints in degrees."""
        return self._angles * _DEGREES

    def targets(self) -> np.ndarray:
        """Returns the angles in degrees to which the joints are being moved."""
        return self._targets * _DEGREES

    def set_joints(self, degrees: Any) -> None:
        """Puts the task's joints at angles and keeps them there. As always, a call of `forward` must follow."""
        self._angles[:] = self._targets[:] = np.deg2rad(degrees)

    def move_joint(self, joint: int, step: float, max_lag: float) -> None:
        """Moves one joint's target by `step` degrees, after bringing all targets to within `max_lag` degrees of their joints.

        The controller of a blocked joint would otherwise exert an ever larger force.
        """
        max_lag /= _DEGREES
        # Single numbers: for a handful of them NumPy takes several times as long.
        near = zip(self._targets.tolist(), self._angles.tolist(), strict=True)
        targets = [min(max(target, angle - max_lag), angle + max_lag) for target, angle in near]
        low, high = self._limits[joint]
        targets[joint] = min(max(targets[joint] + step / _DEGREES, low), high)
        self._targets[:] = targets

    def step(self, nstep: int = 1) -> None:
        """Advances the physics by `nstep` steps; as dm_control does, with a cheaper check of the result."""
        if self.legacy_step:
            super().step(nstep)
            return
        mujoco_bindings.mj_step(self.model.ptr, self.data.ptr, nstep)
        if self._warnings_since_reset.any():
            warnings = np.array(list(mujoco_bindings.mjtWarning.__members__))[: len(self._warnings_since_reset)]
            found = ", ".join(warnings[self._warnings_since_reset > 0])
            raise control.PhysicsError(f"the simulation became unstable ({found}); a smaller extent may help")

    def ball_displacement(self) -> float:
        """Returns the horizontal distance in metres from the ball to where it lay."""
        return math.dist(self._ball.tolist(), self._ball_start)

    def hand_distance(self, geom: str) -> float:
        """Returns the distance in metres from the hand to a geom; negative if they overlap."""
        other, model, data = self.model.name2id(geom, "geom"), self.model.ptr, self.data.ptr
        return min(mujoco_bindings.mj_geomDistance(model, data, hand, other, 1.0, None) for hand in self._hand)

    def render(self, *args: Any, **kwargs: Any) -> np.ndarray:
        """Returns a camera view, see `mujoco.Physics.render`; raises `RenderingError` when there is no OpenGL."""
        rendering.open_gl(self)
        # After a step the poses of the bodies are one substep older than the state, of which they are not a part.
        mujoco_bindings.mj_kinematics(self.model.ptr, self.data.ptr)
        mujoco_bindings.mj_camlight(self.model.ptr, self.data.ptr)
        return super().render(*args, **kwargs)


class Strike(control.Task):
    """An iCub `Task`: move the ball, even slightly. The reward is -1 for each command, and 100 more for the hit."""

    def __init__(
        self,
        strike: icub_tasks.Strike,
        start: Any = None,
        extent: float = icub_tasks.EXTENT,
        motor_noise: float = 0.0,
        encoder_noise: float = 0.0,
        random: np.random.RandomState | int | None = None,
    ):
        """Initializes an instance of `Strike`.

        Args:
          start: Angles of the joints, in degrees, at which an episode begins; None for those of the task.
          extent: Degrees by which a command moves a joint.
          motor_noise: Standard deviation of the extent, as a fraction of it.
          encoder_noise: Standard deviation of an observed angle, in degrees.
          random: A `numpy.random.RandomState`, a seed for one, or None to select a seed.
        """
        self._strike, self._action_names = strike, strike.action_names
        joints = [icub_tasks.JOINTS[name] for name in strike.state_names]
        self._low, self._high = np.array([joint.low for joint in joints]), np.array([joint.high for joint in joints])
        self._start = np.array(icub_tasks.check_start(start, strike))
        self._extent = check_number("extent", extent, "a finite number above 0", lambda degrees: 0 < degrees < math.inf)
        self._motor_noise, self._encoder_noise = (
            check_number(name, noise, "a finite number of at least 0", lambda number: 0 <= number < math.inf)
            for name, noise in (("motor_noise", motor_noise), ("encoder_noise", encoder_noise))
        )
        self._hit = self._new_hit = False
        # As in dm_control's suite, whose own base class would load all of its domains.
        self._random = random if isinstance(random, np.random.RandomState) else np.random.RandomState(random)

    @property
    def random(self) -> np.random.RandomState:
        """The random state from which the noise is drawn."""
        return self._random

    @property
    def start(self) -> np.ndarray:
        """The angles in degrees at which the next episode begins."""
        return self._start.copy()

    def set_start(self, start: Any, physics: Physics) -> None:
        """Begins the next episodes at other angles; raises `ValueError` if they aren't possible."""
        previous, self._start = self._start, np.array(icub_tasks.check_start(start, self._strike))
        try:
            self.check_free(physics)
        except ValueError:
            self._start = previous
            raise

    def check_free(self, physics: Physics) -> None:
        """Raises `ValueError` if at the start the hand touches the ball or is in the table; resets the physics."""
        with physics.reset_context():
            physics.set_joints(self._start)
        angles = f"({', '.join(f'{angle:g}' for angle in self._start)}) degrees of ({', '.join(self._strike.state_names)})"
        if physics.hand_distance("ball") <= 0:
            raise ValueError(f"start must leave the ball untouched; at {angles} the hand touches it already")
        if physics.hand_distance("table") < -_START_OVERLAP:
            raise ValueError(f"start must keep the hand above the table or beside it; at {angles} it is in the table")

    def initialize_episode(self, physics: Physics) -> None:
        """Moves the joints to the start; the ball always starts at the same place."""
        physics.set_joints(self._start)
        self._hit = self._new_hit = False

    def action_spec(self, physics: Physics) -> dm_env.specs.DiscreteArray:
        """Returns the spec of the discrete action; `icub_tasks.Strike.action_names` names the actions."""
        return dm_env.specs.DiscreteArray(len(self._strike.action_names), dtype=np.int64, name="action")

    def observation_spec(self, physics: Physics) -> "collections.OrderedDict[str, dm_env.specs.BoundedArray]":
        """Returns the spec of the observation: the limits of the joints, in degrees."""
        spec = dm_env.specs.BoundedArray(self._low.shape, np.float64, self._low, self._high, name="encoders")
        return collections.OrderedDict(encoders=spec)

    def before_step(self, action: Any, physics: Physics) -> None:
        """Moves the target of one joint by the extent."""
        number = check_action(action, self._action_names)
        joint, forward = divmod(number, 2)
        step = self._extent * (1.0 + self.random.normal(0.0, self._motor_noise)) if self._motor_noise else self._extent
        physics.move_joint(joint, step if forward else -step, max_lag=self._extent)

    def after_step(self, physics: Physics) -> None:
        """Records whether the ball has been moved."""
        moved = physics.ball_displacement() > icub_tasks.HIT_DISTANCE
        self._new_hit = moved and not self._hit
        self._hit = self._hit or moved

    def get_observation(self, physics: Physics) -> "collections.OrderedDict[str, np.ndarray]":
        """Returns the encoder readings, in degrees."""
        angles = physics.encoders()
        if self._encoder_noise:
            angles += self.random.normal(0.0, self._encoder_noise, angles.shape)
        return collections.OrderedDict(encoders=np.minimum(np.maximum(angles, self._low), self._high))

    def get_reward(self, physics: Physics) -> float:
        """Returns the reward of a command: -1, and 100 more for the first hit."""
        return icub_tasks.STEP_REWARD + (icub_tasks.HIT_REWARD if self._new_hit else 0.0)

    def get_termination(self, physics: Physics) -> float | None:
        """Returns a discount of 0 when the ball has been moved."""
        return 0.0 if self._hit else None
