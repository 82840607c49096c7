"""The iCub's ball-striking tasks with a Gymnasium face; the class docstrings are their manuals."""

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from combrel_envs import icub, icub_tasks
from combrel_envs.gym_env import DmControlEnv


class ICubStrikeEnv(DmControlEnv):
    """
    What both tasks share; see :class:`ICubTorsoStrikeEnv` and :class:`ICubArmStrikeEnv`.

    :param look: ``"primitives"`` or ``"meshes"``
    :param start: angles of the joints, in degrees, at which an episode begins; None for those of the task
    :param extent: degrees by which a command moves a joint
    :param motor_noise: standard deviation of the extent, as a share of it
    :param encoder_noise: standard deviation of an observed angle, in degrees
    :param render_mode: ``"rgb_array"`` or None
    :param width: width of a frame in pixels
    :param height: height of a frame in pixels
    :param camera: name of one of ``cameras``; the first of them if None
    :raises ValueError: when an argument isn't possible
    :raises ModuleNotFoundError: when the meshes aren't installed
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - as Gymnasium declares it
    cameras = ("front", "top")
    task: ClassVar[str]

    def __init__(
        self,
        look: str = "primitives",
        start: Sequence[float] | None = None,
        extent: float = icub_tasks.EXTENT,
        motor_noise: float = 0.0,
        encoder_noise: float = 0.0,
        render_mode: str | None = None,
        width: int = 640,
        height: int = 480,
        camera: str | None = None,
    ) -> None:
        # The step limit is a wrapper's, as for every environment of Gymnasium.
        environment = icub.make_environment(
            self.task,
            time_limit=float("inf"),
            look=look,
            start=start,
            extent=extent,
            motor_noise=motor_noise,
            encoder_noise=encoder_noise,
        )
        super().__init__(environment, render_mode=render_mode, width=width, height=height, camera=camera)
        self._start = environment.task.start

    def _apply_options(self, options: dict[str, Any]) -> None:
        if set(options) - {"start"}:
            raise ValueError(f"options of reset must be empty or have a 'start', got {options!r}")
        strike, start = self._environment.task, options.get("start")
        start = self._start if start is None else start
        if not np.array_equal(start, strike.start):
            strike.set_start(start, self._environment.physics)

    def _flatten(self, observation: Any) -> np.ndarray:
        # The task keeps to the limits, and all of them are the same in float32 or round outwards with the space's.
        return observation["encoders"].astype(np.float32)


class ICubTorsoStrikeEnv(ICubStrikeEnv):
    """MANUAL"""

    task = "torso_strike"
    state_names = icub_tasks.TASKS[task].state_names
    action_names = icub_tasks.TASKS[task].action_names


class ICubArmStrikeEnv(ICubStrikeEnv):
    """MANUAL"""

    task = "arm_strike"
    state_names = icub_tasks.TASKS[task].state_names
    action_names = icub_tasks.TASKS[task].action_names
