"""Fitted R-Max as an algorithm of Stable-Baselines3: the learning loop, nothing numerical."""

from __future__ import annotations

import copy
import io
import math
import sys
import time
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_combrel.common.checks import check_count, check_finite, check_positive, check_resolution
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.serialisation import to_plain
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.fitted_rmax.saving import read_model, write_model
from sb3_combrel.fitted_rmax.vec_envs import names_of, refuse_normalized_observations, true_outcomes
from sb3_combrel.tensorboard.callback import with_dashboard
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.by_name import describe_transfer, make_transfer, restore_transfer

SelfFittedRMax = TypeVar("SelfFittedRMax", bound="FittedRMax")

DEFAULT_TIMESTEPS = 20_000
# The constructor's arguments that only this algorithm has.
_ARGUMENTS = (
    "model_breadth",
    "min_fraction",
    "min_weight",
    "exploration_threshold",
    "resolution",
    "max_value",
    "planning_tolerance",
    "max_backups",
    "max_instances",
    "bounds",
)


class FittedRMax(BaseAlgorithm):
    """
    Fitted R-Max: model-based exploration in continuous state spaces.

    Paper: Jong & Stone, "Model-based exploration in continuous state spaces" (SARA 2007). Transfer: Taylor, Jong &
    Stone 2008 (TIMBREL); Fachantidis et al. (COMBREL). For small Box observation spaces (up to about five state
    variables) and Discrete actions, where every environment step counts.

    Every state variable is divided by its range. A kernel model per action predicts rewards and relative effects from
    the instances near a state; a state-action pair with too little data is optimistic, its value is ``max_value``;
    dynamic programming on a uniform grid of states, after every step, turns this into a value function that leads to
    where things are unknown or good. Deviations from the original, and why:

    - Successors are cut at the edge of the grid, one cell beyond the box for up to two state variables and the box
      itself for more: far fewer states, and no worse learning.
    - A pair that was known once stays known (the original falls back when a nearer instance shortens its list).
    - Planning is bounded by ``max_backups`` a step, what is around the agent first; the rest is done as time comes, most
      of it at an episode's end. Staying in a grid point is summed in closed form.
    - Where the agent comes back to the same place again and again, a wrong promise of the interpolated value is
      corrected (see ``sb3_combrel.planning.corrections``): a plain implementation can stick there for ever.
    - A time limit is not a terminal state. After ten of them each further one lowers the threshold by 2%: with a narrow
      kernel all that is within reach cannot become known, and exploration would not end.

    ``predict(obs, deterministic=True)`` takes the best known action, or, where none is known, the best of those that have a
    model from transferred instances; ``deterministic=False`` takes the optimistic ones first, as in learning. Hand the state
    that it returns to the next call, as ``evaluate_policy`` does, and it notices when it goes round in circles.

    Cost: a step's time grows with the instances near it and in a slow line with all instances (a look at one box for
    every 8 of them); memory is about 400 bytes an instance, and per state-action pair of the grid, once known, some
    800 bytes. Both are bounded, by ``max_instances`` and by the grid.

    :param policy: "FittedRMaxPolicy" (or "MlpPolicy", for habit's sake); may be left out: ``FittedRMax(env)``
    :param env: the environment to learn from (if registered in Gymnasium, can be a str)
    :param transfer: a transfer method, such as ``COMBREL(source)``; or a dict, as in RL-Zoo's YAML files, from the
        method's name to its arguments. A copy of it is used.
    :param model_breadth: breadth b of the kernel exp(-d^2 / b^2), in unit coordinates. None: 0.09 for one or two state
        variables, 0.15 for three, 0.2 for more. Smaller is more exact and explores more.
    :param min_fraction: an instance counts while it has this part of the weight of the nearer ones; 0.1 keeps at most
        11 instances a pair, 0.01 (the original's) 101
    :param min_weight: instances of less weight do not count; with the breadth it sets the kernel's reach
    :param exploration_threshold: weight of instances that makes a state-action pair known, before it is lowered
    :param resolution: the grid has 2**resolution cells a variable; one number, or one for each variable. None: at
        least 6 for one or two variables, 4 for three, 3 for more, and finer if the breadth needs it and memory allows.
    :param max_value: an upper bound on the return from any state, the value of what is unknown
    :param gamma: discount factor, in (0, 1]
    :param planning_tolerance: changes of value up to this are not passed on
    :param max_backups: grid points backed up in a step at most, besides those whose model changed; 400 times as many when an
        episode ends. None: 400 / 2^d with d state variables, as a backup costs the more the more of them there are.
    :param max_instances: of one action; beyond, the instance that fewest grid points rely on gives way. None: no limit.
    :param bounds: ``(low, high)`` in place of the observation space's bounds, each one number or one a variable; needed
        where those are infinite
    :param stats_window_size: window size for the rollout logging, in episodes
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation
    :param verbose: verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: seed of all chance
    :param device: where the tensors of a saved policy go; the work is done on the CPU
    :param _init_setup_model: whether or not to build the model at the creation of the instance
    :raises ValueError: if an argument is out of its range or does not fit the environment
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "FittedRMaxPolicy": FittedRMaxPolicy,
        "MlpPolicy": FittedRMaxPolicy,
    }
    policy: FittedRMaxPolicy  # type: ignore[assignment]

    def __init__(
        self,
        policy: str | type[FittedRMaxPolicy] | GymEnv = "FittedRMaxPolicy",
        env: GymEnv | str | type[FittedRMaxPolicy] | None = None,
        transfer: Transfer | dict[str, Any] | str | None = None,
        model_breadth: float | None = None,
        min_fraction: float = 0.1,
        min_weight: float = 0.01,
        exploration_threshold: float = 1.0,
        resolution: int | Sequence[int] | None = None,
        max_value: float = 0.0,
        gamma: float = 1.0,
        planning_tolerance: float = 0.001,
        max_backups: int | None = None,
        max_instances: int | None = 20_000,
        bounds: tuple[Any, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        policy_class, environment = _policy_first(policy, env)
        super().__init__(
            policy_class,
            environment,
            learning_rate=0.0,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
        )
        self.transfer = transfer
        self.model_breadth = model_breadth
        self.min_fraction = min_fraction
        self.min_weight = min_weight
        self.exploration_threshold = exploration_threshold
        self.resolution = resolution
        self.max_value = max_value
        self.gamma = gamma
        self.planning_tolerance = planning_tolerance
        self.max_backups = max_backups
        self.max_instances = max_instances
        self.bounds = bounds
        self._warned_of_max_value = False
        self._chance: dict[str, Any] | None = None
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._check_arguments()
        self.transfer = restore_transfer(self.transfer)
        if self.env is not None:
            refuse_normalized_observations(self.env)
        if self.seed is None:
            # A script that seeds numpy is then reproducible, as with the other algorithms.
            self._rng = np.random.default_rng(np.random.randint(2**31))
        self.set_random_seed(self.seed)
        if self._chance is not None:
            self._rng.bit_generator.state, self._chance = self._chance, None
        names = names_of(self.env)
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space,
            self.action_space,
            model_breadth=self._breadth(),
            min_fraction=self.min_fraction,
            min_weight=self.min_weight,
            exploration_threshold=self.exploration_threshold,
            resolution=self.resolution,
            max_value=self.max_value,
            gamma=self.gamma,
            planning_tolerance=self.planning_tolerance,
            max_backups=self.max_backups,
            max_instances=self.max_instances,
            bounds=self.bounds,
            transfer=make_transfer(self.transfer),
            rng=self._rng,
            **names,
            **self.policy_kwargs,
        )
        self.policy = self.policy.to(self.device)
        self._episode_rewards: list[list[float]] = []
        self._backups = 0

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None:
            self._rng = np.random.default_rng(seed)
            if getattr(self, "policy", None) is not None:
                self.policy.rng = self._rng

    def _breadth(self) -> float:
        if self.model_breadth is not None:
            return self.model_breadth
        n_variables = StateScaling.from_space(self.observation_space, self.bounds).n_variables
        return {1: 0.09, 2: 0.09, 3: 0.15}.get(n_variables, 0.2)

    def _check_arguments(self) -> None:
        if not isinstance(self.action_space, spaces.Discrete):
            raise ValueError(f"FittedRMax needs Discrete actions, the environment has {self.action_space}")
        n_variables = StateScaling.from_space(self.observation_space, self.bounds).n_variables
        if self.model_breadth is not None:
            check_positive("model_breadth", self.model_breadth)
        check_positive("min_fraction", self.min_fraction, largest=1.0)
        check_positive("min_weight", self.min_weight, largest=0.99)
        check_positive("exploration_threshold", self.exploration_threshold)
        check_positive("gamma", self.gamma, largest=1.0)
        check_positive("planning_tolerance", self.planning_tolerance)
        check_finite("max_value", self.max_value)
        check_count("max_backups", self.max_backups, least=0, none_allowed=True)
        check_count("max_instances", self.max_instances, none_allowed=True)
        check_resolution(self.resolution, n_variables)

    def learn(
        self: SelfFittedRMax,
        total_timesteps: int = DEFAULT_TIMESTEPS,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "FittedRMax",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfFittedRMax:
        """
        Learn, and return the trained model.

        :param total_timesteps: environment steps, of all environments together
        :param callback: callback(s) called at every step
        :param log_interval: episodes between two logs; None for none
        :param tb_log_name: the name of the run for TensorBoard logging
        :param reset_num_timesteps: whether to start the count of steps anew (what was learned stays in any case)
        :param progress_bar: display a progress bar using tqdm and rich
        :raises ValueError: if ``total_timesteps`` is below 1 or the environment returns something that is not finite
        """
        if isinstance(total_timesteps, float) and float(total_timesteps).is_integer():
            total_timesteps = int(total_timesteps)  # 1e5, as many write it
        check_count("total_timesteps", total_timesteps)
        if self.env is None:
            raise ValueError("there is no environment to learn from: call set_env(env) first, or load(..., env=env)")
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        callback.on_rollout_start()
        self._episode_rewards = [[] for _ in range(self.n_envs)]
        self._episode_tags = np.arange(self.n_envs)
        self._last_states = self.policy.to_unit(np.asarray(self._last_obs))
        self._backups += self.policy.prepare()
        try:
            while self.num_timesteps < total_timesteps:
                if not self._step(callback, log_interval):
                    break
                self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
        finally:
            callback.on_training_end()
        return self

    def _step(self, callback: BaseCallback, log_interval: int | None) -> bool:
        """One step of every environment; False if a callback wants to stop."""
        assert self.env is not None and isinstance(self._last_obs, np.ndarray)
        states = self._last_states
        choices = [self.policy.explore(state, int(tag)) for state, tag in zip(states, self._episode_tags, strict=True)]
        actions = np.array(choices) + self.policy._first_action
        new_obs, rewards, dones, infos = self.env.step(actions)
        self.num_timesteps += self.env.num_envs
        self._update_info_buffer(infos, dones)
        raw_rewards = self._raw_rewards(rewards)
        ended = [e for e, done in enumerate(dones.tolist()) if done]
        next_obs, terminated = true_outcomes(new_obs, dones, infos, ended)
        next_states = self.policy.to_unit(next_obs)
        for e, choice in enumerate(choices):
            self._backups += self.policy.learn_from(states[e], choice, raw_rewards[e], next_states[e], bool(terminated[e]))
            self._episode_rewards[e].append(raw_rewards[e])
        self._last_obs = new_obs  # type: ignore[assignment]
        self._last_states = self.policy.to_unit(np.asarray(new_obs)) if ended else next_states
        self._last_episode_starts = dones
        callback.update_locals(locals())
        # An episode that ended is ended, and planned through, whether or not a callback stops at this very step.
        going_on = callback.on_step()
        for e in ended:
            self._end_episode(e, bool(terminated[e]))
            if log_interval is not None and self._episode_num % log_interval == 0:
                callback.on_rollout_end()
                self.dump_logs()
                callback.on_rollout_start()
        return going_on

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        # By now the logger is set up, so it is known whether there is a log to write to.
        return super()._init_callback(with_dashboard(callback, self.logger), progress_bar)

    def _raw_rewards(self, rewards: np.ndarray) -> list[float]:
        """The environment's own rewards: a normalization that drifts would mix scales in one model."""
        raw = self._vec_normalize_env.get_original_reward() if self._vec_normalize_env is not None else rewards
        as_floats = raw.tolist()
        if not all(map(math.isfinite, as_floats)):
            raise ValueError(f"the environment returned a reward that is not finite: {raw}")
        return as_floats

    def _end_episode(self, env_index: int, terminated: bool) -> None:
        self._episode_num += 1
        self._episode_tags[env_index] += self.n_envs
        self._backups += self.policy.end_episode(not terminated)
        rewards = self._episode_rewards[env_index]
        self._episode_rewards[env_index] = []
        if terminated or min(rewards) >= 0.0:
            self._compare_with_max_value(rewards)

    def _compare_with_max_value(self, rewards: list[float]) -> None:
        """Warn, once, of a ``max_value`` that is no upper bound: optimism then fails, and exploration with it."""
        best, value = -np.inf, 0.0
        for reward in reversed(rewards):
            value = reward + self.gamma * value
            best = max(best, value)
        if not self._warned_of_max_value and best > self.max_value + 1e-6 * max(1.0, abs(self.max_value)):
            self._warned_of_max_value = True
            warnings.warn(
                f"max_value={self.max_value:g} must be an upper bound on the return (discounted with gamma={self.gamma:g}), "
                f"but a return of {best:g} was observed; pass a larger max_value, or the agent will stop exploring too soon",
                stacklevel=2,
            )

    def dump_logs(self) -> None:
        """Write log data."""
        assert self.ep_info_buffer is not None and self.ep_success_buffer is not None
        elapsed = max((time.time_ns() - self.start_time) / 1e9, sys.float_info.epsilon)
        self.logger.record("time/episodes", self._episode_num, exclude="tensorboard")
        if len(self.ep_info_buffer) > 0:
            self.logger.record("rollout/ep_rew_mean", safe_mean([info["r"] for info in self.ep_info_buffer]))
            self.logger.record("rollout/ep_len_mean", safe_mean([info["l"] for info in self.ep_info_buffer]))
        if len(self.ep_success_buffer) > 0:
            self.logger.record("rollout/success_rate", safe_mean(self.ep_success_buffer))
        self.logger.record("time/fps", int((self.num_timesteps - self._num_timesteps_at_start) / elapsed))
        self.logger.record("time/time_elapsed", int(elapsed), exclude="tensorboard")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        if self.logger.output_formats and self.policy.reporting:
            for name, value in self.policy.statistics().items():
                self.logger.record(name, value)
        self.logger.record("planner/backups", self._backups)
        self.logger.dump(step=self.num_timesteps)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        if isinstance(env, VecEnv):
            refuse_normalized_observations(env)
        super().set_env(env, force_reset)
        assert self.env is not None
        self._vec_normalize_env = unwrap_vec_normalize(self.env)

    def save(
        self,
        path: str | Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save all the attributes of the object and the model parameters in a zip-file, which appears complete or not at all.

        A transfer method is saved as plain data, with its source instances; one of your own by what ``Transfer.arguments``
        says. What cannot be written so is left out, with a warning, and must be passed to :meth:`load`.

        Saved at the end of an episode, a loaded model learns to the last bit what this one would learn on. In the middle of
        an episode it has the rest of the planning done sooner. Always renewed are ``TIMBREL``'s random draws, the order of
        ``relevance``, and lists that an instance had cut short which ``max_instances`` has since displaced.

        :param path: path to the file where the rl agent should be saved
        :param exclude: name of parameters that should be excluded in addition to the default ones
        :param include: name of parameters that might be excluded but should be included anyway
        """
        written, content = copy.copy(self), io.BytesIO()
        for name in (*_ARGUMENTS, "gamma", "seed"):
            setattr(written, name, to_plain(getattr(self, name)))
        written.transfer = describe_transfer(self.policy.transfer)
        written._chance = dict(self._rng.bit_generator.state)
        super(FittedRMax, written).save(content, exclude, include)
        write_model(path, content)

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfFittedRMax],
        path: str | Path | io.BufferedIOBase,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfFittedRMax:
        """
        Load the model from a zip-file.

        :param path: path to the file (or a file-like) where to load the agent from
        :param env: the new environment to run the loaded model on (if registered in Gymnasium, can be a str; can be None
            if you only need prediction from a trained model)
        :param device: device on which the tensors of the policy go
        :param custom_objects: objects that replace those of the file
        :param print_system_info: whether to print system info from the saved model and the current system info
        :param force_reset: force a call to ``reset()`` before training
        :param kwargs: arguments of the constructor to change; ``transfer=`` where a transfer method could not be saved.
            Without ``seed=`` the generator goes on where it was.
        :return: new model instance with loaded parameters
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if the file is damaged or was not saved by this class
        """
        content = read_model(path, names=_ARGUMENTS)
        environment = maybe_make_env(env, verbose=0) if isinstance(env, str) else env
        if "seed" in kwargs:
            kwargs["_chance"] = None
        try:
            return super().load(content, environment, device, custom_objects, print_system_info, force_reset, **kwargs)
        except (RuntimeError, KeyError) as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"{path} cannot be loaded as a model of FittedRMax: {reason}") from error

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_rng", "_episode_rewards", "_episode_tags", "_last_states"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy"], []


def _policy_first(policy: Any, env: Any) -> tuple[Any, Any]:
    """Policy and environment, whichever was given first."""
    if _is_policy(policy):
        return policy, env
    return (env if _is_policy(env) else "FittedRMaxPolicy"), policy


def _is_policy(thing: Any) -> bool:
    if isinstance(thing, str):
        return thing in FittedRMax.policy_aliases or (thing.endswith("Policy") and thing.isidentifier())
    return isinstance(thing, type) and issubclass(thing, BasePolicy)
