"""Mountain Car as a dm_control domain: an underpowered car that must first drive away from its goal.

``climb_2d`` is the car in a valley between two hills (Singh and Sutton 1996), ``climb_4d`` the car on a surface with hills
along two axes, ``climb_6d`` has a third. A control step is one second, so the default time limit, 4000, is in steps too.
:mod:`combrel_envs.mountain_car_dynamics` steps the car; MuJoCo stores the state and draws it.
"""

import collections
from typing import Any

import numpy as np

from combrel_envs import mountain_car_dynamics as dynamics
from combrel_envs import rendering
from combrel_envs.checks import check_choice, check_number

rendering.import_dm_control()

import dm_env  # noqa: E402
import mujoco as mujoco_bindings  # noqa: E402
from dm_control import mujoco  # noqa: E402
from dm_control.rl import control  # noqa: E402
from dm_control.suite import base  # noqa: E402
from dm_control.utils import containers  # noqa: E402

from combrel_envs import mountain_car_scene as scene  # noqa: E402
from combrel_envs.environment import TerminatingEnvironment  # noqa: E402

SUITE = containers.TaggedTasks()


@SUITE.add("benchmarking")
def climb_2d(**kwargs: Any) -> control.Environment:
    """Returns the Mountain Car task with state (x, v): climb the right hill; see `make_environment`."""
    return make_environment(1, **kwargs)


@SUITE.add("benchmarking")
def climb_4d(**kwargs: Any) -> control.Environment:
    """Returns the Mountain Car task with state (x, y, vx, vy): climb the hill in the north-east corner."""
    return make_environment(2, **kwargs)


@SUITE.add("benchmarking")
def climb_6d(**kwargs: Any) -> control.Environment:
    """Returns the Mountain Car task with state (x, y, z, vx, vy, vz): reach the upper end of all three axes together."""
    return make_environment(3, **kwargs)


def make_environment(
    n_axes: int,
    time_limit: float = dynamics.MAX_EPISODE_STEPS,
    random: np.random.RandomState | int | None = None,
    start: str = "offset",
    action_noise: float = 0.0,
    environment_kwargs: dict[str, Any] | None = None,
) -> control.Environment:
    """Returns a Mountain Car environment.

    Args:
      n_axes: Number of axes along which the car moves: 1 in 2D, 2 in 4D, 3 in 6D.
      time_limit: Steps until an episode is cut off.
      environment_kwargs: Arguments of `control.Environment`; for all others see `Climb`.
    """
    check_number("time_limit", time_limit, "a number of steps above 0", lambda steps: steps > 0)
    task = Climb(start=start, random=random, action_noise=action_noise)
    return TerminatingEnvironment(make_physics(n_axes), task, time_limit=time_limit, **(environment_kwargs or {}))


def make_physics(n_axes: int) -> "Physics":
    """Returns the `Physics` of a car on one axis (2D), on two (4D) or on three (6D)."""
    return Physics.from_xml_string(*scene.model_and_assets(n_axes))


class Physics(mujoco.Physics):
    """The car's state in MuJoCo's joints, moved by the task's own equations instead of MuJoCo's."""

    @property
    def n_axes(self) -> int:
        """Number of axes along which the car moves: 1 in 2D, 2 in 4D, 3 in 6D."""
        return self.model.nq

    def car_position(self) -> np.ndarray:
        """Returns the car's position on each axis."""
        return self.data.qpos.copy()

    def car_velocity(self) -> np.ndarray:
        """Returns the car's velocity on each axis."""
        return self.data.qvel.copy()

    def at_goal(self) -> bool:
        """Returns whether the car is at the goal."""
        return dynamics.at_goal(tuple(self.data.qpos.tolist()))

    def set_car(self, positions: dynamics.Axes, velocities: dynamics.Axes) -> None:
        """Sets the car's position and velocity on each axis. As always, a call of `forward` must follow."""
        self.data.qpos[:] = positions
        self.data.qvel[:] = velocities

    def step(self, nstep: int = 1) -> None:
        """Advances the car by `nstep` steps of its equations, with the control that was set last."""
        state = tuple(self.data.qpos.tolist()), tuple(self.data.qvel.tolist())
        pushes = tuple(self.data.ctrl.tolist())
        for _ in range(nstep):
            state = dynamics.step_car(*state, pushes)
        self.set_car(*state)
        self.data.time += nstep * self.timestep()
        self.forward()

    def forward(self) -> None:
        """Moves the drawn cars, one a ground, to the position of the state, and updates MuJoCo's derived quantities."""
        positions, velocities = tuple(self.data.qpos.tolist()), tuple(self.data.qvel.tolist())
        for i, (body, axes) in enumerate(scene.GROUNDS[self.n_axes].items()):
            position, rotation = scene.car_pose(positions[axes], velocities[axes])
            self.data.mocap_pos[i] = position + self.model.body_pos[self.model.name2id(body, "body")]
            mujoco_bindings.mju_mat2Quat(self.data.mocap_quat[i], rotation.ravel())
        super().forward()

    def render(self, *args: Any, **kwargs: Any) -> np.ndarray:
        """Returns a camera view, see `mujoco.Physics.render`; raises `RenderingError` when there is no OpenGL."""
        rendering.open_gl(self)
        return super().render(*args, **kwargs)


class Climb(base.Task):
    """A Mountain Car `Task`: reach the goal. The reward is -1 on every step, the last included."""

    def __init__(self, start: str = "offset", random: np.random.RandomState | int | None = None, action_noise: float = 0.0):
        """Initializes an instance of `Climb`.

        Args:
          start: "offset" (at rest at the bottom, moved by a random offset in [-0.005, 0.005], the same on every axis), "fixed"
            (at rest at the bottom) or "random" (anywhere but at the goal, at any velocity).
          random: A `numpy.random.RandomState`, a seed for one, or None to select a seed.
          action_noise: Probability with which a random action, drawn from all, is executed instead of the one chosen.
        """
        self._start = check_choice("start", start, dynamics.STARTS)
        self._action_noise = dynamics.check_action_noise(action_noise)
        super().__init__(random=random)

    def initialize_episode(self, physics: Physics) -> None:
        """Sets the state according to the start option."""
        physics.set_car(*dynamics.sample_start(self._start, physics.n_axes, self.random.uniform))
        super().initialize_episode(physics)

    def action_spec(self, physics: Physics) -> dm_env.specs.DiscreteArray:
        """Returns the spec of the discrete action; `dynamics.ACTION_NAMES` names the actions."""
        return dm_env.specs.DiscreteArray(len(dynamics.ACTION_NAMES[physics.n_axes]), dtype=np.int64, name="action")

    def before_step(self, action: Any, physics: Physics) -> None:
        """Sets the control to what the engine does: what the action stands for, or something else by the noise."""
        physics.set_control(dynamics.executed_push(action, physics.n_axes, self._action_noise, self.random.uniform))

    def get_observation(self, physics: Physics) -> "collections.OrderedDict[str, np.ndarray]":
        """Returns the state: the car's position and velocity."""
        return collections.OrderedDict(position=physics.car_position(), velocity=physics.car_velocity())

    def get_reward(self, physics: Physics) -> float:
        """Returns the reward of a step, -1."""
        return -1.0

    def get_termination(self, physics: Physics) -> float | None:
        """Returns a discount of 0 at the goal."""
        return 0.0 if physics.at_goal() else None
