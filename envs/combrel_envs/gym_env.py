"""Gymnasium environments: the common base class, the adapter for dm_control environments, and the registration."""

from typing import TYPE_CHECKING, Any, ClassVar, SupportsIndex

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, ResetNeeded

from combrel_envs import icub_tasks, mountain_car_dynamics
from combrel_envs.checks import check_choice

if TYPE_CHECKING:
    from dm_control import mujoco
    from dm_control.rl import control


def register_envs() -> None:
    """Register the environments with Gymnasium; a second call changes nothing."""
    for name in ("MountainCar2D", "MountainCar4D", "MountainCar6D"):
        _register(name, f"mountain_car_gym:{name}Env", mountain_car_dynamics.MAX_EPISODE_STEPS, {})
    for name in ("ICubTorsoStrike", "ICubArmStrike"):
        _register(name, f"icub_gym:{name}Env", icub_tasks.MAX_EPISODE_STEPS, {})
        _register(f"{name}Noisy", f"icub_gym:{name}Env", icub_tasks.MAX_EPISODE_STEPS, icub_tasks.NOISE)


def _register(name: str, entry_point: str, max_episode_steps: int, kwargs: dict[str, Any]) -> None:
    if f"combrel/{name}-v0" not in gymnasium.registry:
        gymnasium.register(
            f"combrel/{name}-v0",
            f"combrel_envs.{entry_point}",
            max_episode_steps=max_episode_steps,
            # A check of every single call costs more than the dynamics of Mountain Car; the tests run `check_env` instead.
            disable_env_checker=True,
            kwargs=dict(kwargs),
        )


class RenderedEnv(gymnasium.Env[np.ndarray, np.int64]):
    """An environment with flat float32 observations and discrete actions, drawn by MuJoCo; a wrong argument is a ValueError.

    :param render_mode: ``"rgb_array"`` or None
    :param width: of a frame in pixels, as ``height``
    :param camera: name of one of ``cameras``; the first of them if None
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012 - as Gymnasium declares it
    cameras: ClassVar[tuple[str, ...]] = ()
    #: Names of the observation's entries and of the actions, in their order.
    state_names: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    observation_space: spaces.Box
    action_space: spaces.Discrete

    def __init__(self, render_mode: str | None = None, width: int = 640, height: int = 480, camera: str | None = None) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or 'rgb_array', got {render_mode!r}")
        for name, value in (("width", width), ("height", height)):
            if not (isinstance(value, int | np.integer) and value > 0):
                raise ValueError(f"{name} must be a positive number of pixels, got {value!r}")
        if camera is not None:
            check_choice("camera", camera, self.cameras)
        self.render_mode = render_mode
        self._width, self._height = width, height
        self._camera: str | int = camera or (self.cameras[0] if self.cameras else -1)

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Draw the state, uint8, shape (height, width, 3), or None without a render mode; `RenderingError` without OpenGL."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() needs a render mode, for instance gymnasium.make(..., render_mode='rgb_array')")
            return None
        physics = self._drawn_physics()
        # MuJoCo fixes the largest frame when it draws the first one.
        limits = physics.model.vis.global_
        limits.offwidth, limits.offheight = max(limits.offwidth, self._width), max(limits.offheight, self._height)
        return physics.render(height=self._height, width=self._width, camera_id=self._camera)

    def _drawn_physics(self) -> "mujoco.Physics":
        """Give the physics in the state to be drawn."""
        raise NotImplementedError


class DmControlEnv(RenderedEnv):
    """A dm_control environment as a Gymnasium environment.

    The observations, in the order of the environment's specification, become one flat float32 vector. The episode terminates
    when the task gives a discount of 0 and is truncated at the environment's time limit; a task that ends on the very last
    step is terminated. ``info["is_success"]`` is True if it terminated.

    :param environment: the environment; its actions must be discrete
    :param low: least value of each entry of the observation, ``high``: the greatest; None takes the specification's
    :param picture: ``render_mode``, ``width``, ``height`` and ``camera``, see :class:`RenderedEnv`
    :raises ValueError: when the actions aren't discrete or an argument isn't one of these
    """

    def __init__(
        self,
        environment: "control.Environment",
        low: np.ndarray | None = None,
        high: np.ndarray | None = None,
        **picture: Any,
    ) -> None:
        super().__init__(**picture)
        self._environment = environment
        self._running = self._closed = False
        observations = environment.observation_spec().values()
        low = _bounds(observations, "minimum", -np.inf) if low is None else np.asarray(low, np.float32)
        high = _bounds(observations, "maximum", np.inf) if high is None else np.asarray(high, np.float32)
        self.observation_space = spaces.Box(low, high, dtype=np.float32)
        n_actions = getattr(environment.action_spec(), "num_values", None)
        if n_actions is None:
            raise ValueError(f"environment must have discrete actions, got {environment.action_spec()!r}")
        self.action_space = spaces.Discrete(n_actions)

    @property
    def environment(self) -> "control.Environment":
        """The dm_control environment."""
        return self._environment

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; ``seed`` is that of the following ones too. For ``options`` see :meth:`_apply_options`."""
        self._check_open("reset")
        super().reset(seed=seed)
        if seed is not None:
            self._environment.task.random.seed(int(self.np_random.integers(2**32)))
        self._apply_options(options or {})
        self._running = True
        return self._flatten(self._environment.reset().observation), {}

    def step(self, action: SupportsIndex) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:  # type: ignore[override]
        """Take the action of a number; returns observation, reward, terminated, truncated and info."""
        # dm_control would silently begin a new episode.
        if not self._running:
            raise ResetNeeded("call reset() before the first step and after the end of each episode")
        time_step = self._environment.step(action)
        self._running = not time_step.last()
        # On the last step of the time limit dm_control doesn't ask the task whether it has ended.
        terminated = bool(time_step.last() and self._environment.task.get_termination(self._environment.physics) == 0.0)
        observation, truncated = self._flatten(time_step.observation), time_step.last() and not terminated
        return observation, float(time_step.reward), terminated, truncated, {"is_success": terminated}

    def close(self) -> None:
        """Free MuJoCo's memory and the OpenGL context; the environment can't be used afterwards."""
        self._running = False
        if not self._closed:
            self._closed = True
            self._environment.close()
            self._environment.physics.free()

    def _check_open(self, call: str) -> None:
        if self._closed:
            raise ClosedEnvironmentError(f"{call}() must come before close(), which has freed the simulation: make a new one")

    def _drawn_physics(self) -> "mujoco.Physics":
        self._check_open("render")
        return self._environment.physics

    def _apply_options(self, options: dict[str, Any]) -> None:
        """Prepare the task for the options of a reset; environments with options override this."""
        if options:
            raise ValueError(f"options of reset must be empty, got {options!r}")

    def _flatten(self, observation: Any) -> np.ndarray:
        values = np.concatenate([np.ravel(value) for value in observation.values()]).astype(np.float32)
        return np.clip(values, self.observation_space.low, self.observation_space.high)


def _bounds(specs: Any, side: str, otherwise: float) -> np.ndarray:
    parts = [np.broadcast_to(getattr(spec, side, otherwise), spec.shape).ravel() for spec in specs]
    return np.concatenate(parts).astype(np.float32)
