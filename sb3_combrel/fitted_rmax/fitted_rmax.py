"""Fitted R-Max as an algorithm of Stable-Baselines3: learning loop, logs, saving and loading."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_combrel.common.attributes import names_of, periodic_of
from sb3_combrel.common.checks import as_count, check_boolean, check_count
from sb3_combrel.common.interrupts import Interrupts
from sb3_combrel.common.observations import with_own_arrays
from sb3_combrel.common.serialisation import to_plain
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.arguments import DEFAULT_POLICY, MAX_SEED, check_actions, check_policy, check_type, policy_and_env
from sb3_combrel.fitted_rmax.past_data import PastData
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.fitted_rmax.progress import ProgressWatch
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings
from sb3_combrel.fitted_rmax.vec_envs import (
    joined_names,
    refuse_running_means,
    true_outcomes,
    warn_of_shared,
)
from sb3_combrel.sources.transitions import full_id
from sb3_combrel.transfer.base import Transfer
from sb3_combrel.transfer.by_name import make_transfer, restore_transfer

DEFAULT_TIMESTEPS = 20_000
# Thousands of years: larger numbers, such as 1e308, are mistakes.
MAX_TIMESTEPS = 10**15
DEFAULTS = FittedRMaxSettings()
PASSED_TO_POLICY = ("observation_space", "action_space", "transfer", "rng")


class FittedRMax(PastData):
    """Fitted R-Max: model-based exploration in continuous state spaces.

    Paper: Jong & Stone, "Model-based exploration in continuous state spaces" (SARA 2007). Transfer: Taylor, Jong &
    Stone 2008 (TIMBREL); Fachantidis et al. (COMBREL). For small Box observation spaces (up to six state
    variables) and Discrete actions, where every environment step counts.

    Every state variable is divided by its range. A kernel model per action predicts rewards and relative effects from
    the instances near a state; a state-action pair with too little data is optimistic, its value is ``max_value``;
    dynamic programming on a grid of states, after every step, computes the value function of this model.
    Deviations from the original, and why:

    - Successors are moved to the edge of the grid, one cell beyond the box for up to two state variables, the box for more.
    - What was known once stays known (the original falls back when a nearer instance shortens the list).
    - Planning is Gauss-Seidel sweeps over the grid, two a step, and until little changes when an episode ends. With
      ``degree=0`` they leave points out on which no change of more than ``planning_tolerance`` bears. Staying in a grid point
      is summed in closed form.
    - With ``degree=1`` the planner's model holds an action until a cell of the grid is left: values that are interpolated at
      every step spread over the grid.
    - With ``degree=1`` whether an episode ends depends on where one arrives (see ``sb3_combrel.models.ends``); unless the
      action foretells it clearly better, as in a bandit (:func:`~sb3_combrel.models.ends_by_action.evidence_for_action`).
    - With ``degree=1``, until an episode has ended or rewards have differed, each visit to a place makes it, and an action not
      tried there, worth less by a step (:func:`~sb3_combrel.fitted_rmax.optimism.worth_after_visits`).
    - With four state variables or more, in a task that goes on for ever, the lines of the grid move to where values between
      them are wrong (:func:`~sb3_combrel.planning.lines.moved_lines`).
    - A time limit is not a terminal state.
    - Where an agent stays although its values promise otherwise it holds an action drawn at random
      (:class:`~sb3_combrel.fitted_rmax.promises.Promises`).

    ``predict(obs, deterministic=True)`` takes the best known action, or, where there is none, the best that has a model from
    transferred instances. Without a source it plans without optimism, where the lines of the grid move on a grid twice as
    fine, for seconds once more has been learned, if that has at most a million pairs; and it holds an action until a cell of
    the grid is left. A grid of only eight cells a variable or fewer is too coarse for holding, and, where a state variable
    has no bounds, for planning without optimism. ``deterministic=False`` takes optimistic actions first, as in learning.

    ::

        model = FittedRMax("MountainCar-v0", seed=0).learn(total_timesteps=5_000)
        model.save("car")
        action, _ = model.predict(np.array([-0.5, 0.0]), deterministic=True)

    A step's time is mostly that of two sweeps over the grid and of fitting pairs anew. Memory, with four state variables about
    160 bytes for an instance and 500 for a state-action pair of the grid, is bounded by ``max_instances`` and by the grid, and
    by a finer one while a frozen policy plans on that.

    :param policy: "FittedRMaxPolicy" (or "MlpPolicy", which means the same); may be left out: ``FittedRMax(env)``
    :param env: the environment to learn from (if registered in Gymnasium, can be a str)
    :param transfer: a transfer method, such as ``COMBREL(source)``; or a dict, as in RL-Zoo's YAML files, from the
        method's name to its arguments. A copy of it is used: ``model.transfer``, with its results
    :param model_breadth: breadth b of the kernel exp(-d^2 / b^2), in unit coordinates; a smaller one is more exact, and
        explores more. None: with ``degree=1`` 0.15 for one or two state variables, 0.25 for three, 0.4 for four or five, 0.5
        for more; with ``degree=0`` 0.09, 0.15 and 0.2.
    :param min_fraction: with ``degree=0``, an instance counts while it has this fraction of the weight of the nearer ones; 0.1
        keeps at most 11 instances a pair, 0.01 (the original's) 101
    :param min_weight: instances of less weight do not count; with the breadth it sets the kernel's reach. With ``degree=1`` a
        fit's kernel is narrowed until the last of ``n_neighbors`` weighs this. None: 0.05 with ``degree=1``, 0.01 with
        ``degree=0``
    :param exploration_threshold: weight of instances that makes a state-action pair known
    :param resolution: the grid has 2**resolution cells a variable; one number, or one for each variable. None: 6
        for one or two variables, 4 for three, 3 for more, finer if the breadth needs it, and coarser where there would be more
        than a million state-action pairs
    :param max_value: an upper bound on the return from any state, the value of what is unknown. None: found from the rewards
        seen so far, as the largest return that they allow, see :class:`~sb3_combrel.fitted_rmax.optimism.RewardRange`
    :param gamma: discount factor, in (0, 1]. None: found as well: 0.99, or 1 where every step costs and episodes end
    :param planning_tolerance: sweeps end when no value changes by more
    :param max_instances: of one action; beyond, the nearest instance is replaced. None: no limit.
    :param bounds: ``(low, high)`` in place of the observation space's bounds, each one number or one a variable.
        None: found from the observations where those are infinite or far too wide, see
        :class:`~sb3_combrel.fitted_rmax.scales.FoundScales`
    :param degree: of the local model: 1, effects are fitted as linear functions of the state to the instances near it
        (:class:`~sb3_combrel.models.local_linear.LocalLinear`); or 0, their kernel average, Jong & Stone's, which needs more
        instances (:class:`~sb3_combrel.models.kernel_average.KernelAverage`)
    :param n_neighbors: with ``degree=1``, instances that a fit is made to; more (50, 100) where effects or rewards are random,
        as they average that out. None: 16 for one or two state variables, 24 for three, 30 for four, 40 for five, 60 for more
    :param outcome_breadth: with ``degree=1``, the broadest that the kernel is by which arrivals decide on ends
    :param periodic: one bool for each state variable: whether it is periodic, as an angle is, and its bounds one period apart.
        Distances, effects and the grid go around; an observation outside the bounds is wrapped. None: what the environment
        says in its attribute ``periodic`` (see :class:`~sb3_combrel.wrappers.AngleObservation`), otherwise none is.
    :param instances: past data of the same task, which count as the agent's own experience: what :meth:`load_instances` takes
    :param stats_window_size: window size for the rollout logging, in episodes
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation; ``dict(model_class=...)`` for another
        model of the dynamics, a subclass of :class:`~sb3_combrel.models.base.Model`
    :param verbose: verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: random seed, of the environment as well; None: the state of NumPy's own generator decides
    :param device: where the tensors of a saved policy go; the work is done on the CPU
    :param _init_setup_model: whether or not to build the model at the creation of the instance
    :raises ValueError: if an argument is out of its range or does not fit the environment
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "FittedRMaxPolicy": FittedRMaxPolicy,
        "MlpPolicy": FittedRMaxPolicy,
    }
    policy: FittedRMaxPolicy  # type: ignore[assignment]
    # Functions from (callbacks, logger) to callbacks that ``learn`` applies; packages above this one add theirs.
    default_callbacks: ClassVar[list[Callable[[MaybeCallback, Logger], MaybeCallback]]] = []
    # Whether logs have the agent's statistics, which take a moment to compute.
    logs_statistics = True

    def __init__(
        self,
        policy: str | type[FittedRMaxPolicy] | GymEnv = DEFAULT_POLICY,
        env: GymEnv | str | type[FittedRMaxPolicy] | None = None,
        transfer: Transfer | dict[str, Any] | str | None = None,
        model_breadth: float | None = DEFAULTS.model_breadth,
        min_fraction: float = DEFAULTS.min_fraction,
        min_weight: float | None = DEFAULTS.min_weight,
        exploration_threshold: float = DEFAULTS.exploration_threshold,
        resolution: int | Sequence[int] | None = DEFAULTS.resolution,
        max_value: float | None = DEFAULTS.max_value,
        gamma: float | None = DEFAULTS.gamma,
        planning_tolerance: float = DEFAULTS.planning_tolerance,
        max_instances: int | None = DEFAULTS.max_instances,
        bounds: tuple[Any, Any] | None = DEFAULTS.bounds,
        degree: int = DEFAULTS.degree,
        n_neighbors: int | None = DEFAULTS.n_neighbors,
        outcome_breadth: float = DEFAULTS.outcome_breadth,
        periodic: Sequence[bool] | None = DEFAULTS.periodic,
        instances: Any = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        check_type("verbose", verbose, (int,), "0, 1 or 2")
        policy_class, environment = policy_and_env(policy, env, self.policy_aliases)
        super().__init__(
            policy_class,
            full_id(environment),
            learning_rate=0.0,
            policy_kwargs=policy_kwargs,
            stats_window_size=int(stats_window_size) if isinstance(stats_window_size, np.integer) else stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed.item() if isinstance(seed, np.integer) else seed,
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
        self.max_instances = max_instances
        self.bounds = bounds
        self.degree = degree
        self.n_neighbors = n_neighbors
        self.outcome_breadth = outcome_breadth
        self.periodic = periodic
        self.instances = instances
        self._names: dict[str, Any] = {}
        self._generator_state: dict[str, Any] | None = None
        self._prediction_state: dict[str, Any] | None = None
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._check_arguments()
        if self.env is not None:
            refuse_running_means(self.env)
            # Saved with the model, for one that is loaded without an environment.
            self._names = joined_names(self._names, names_of(self.env))
            self.periodic = periodic_of(self.env) if self.periodic is None else self.periodic
        if self.seed is None:
            # A script that seeds numpy is then reproducible, as with the other algorithms.
            self._rng = np.random.default_rng(np.random.randint(2**31))
        self.set_random_seed(self.seed)
        if self._generator_state is not None:
            self._rng.bit_generator.state = self._generator_state
        self.policy = self.policy_class(  # type: ignore[assignment]
            self.observation_space,
            self.action_space,
            transfer=make_transfer(restore_transfer(self.transfer)),
            rng=self._rng,
            **{name: getattr(self, name) for name in FittedRMaxSettings.names()},
            **{**self._names, **self.policy_kwargs},
        )
        if self._generator_state is not None and self._prediction_state is not None:
            # A method may have drawn something when it was bound.
            self._rng.bit_generator.state = self._generator_state
            self.agent.prediction_rng.bit_generator.state = self._prediction_state
        self._generator_state = self._prediction_state = None
        self.policy = self.policy.to(self.device)
        # What the user gave was a description: results are on the method in use. ``save`` writes a description again.
        self.transfer = self.policy.transfer
        self._episode_rewards: list[list[float]] = []
        #: Unit coordinates of the last observations while it learns, shape (n_envs, n_variables).
        self._last_states: np.ndarray | None = None
        self._interrupts = Interrupts()
        self._progress = ProgressWatch(self.agent.rewards, self.planning_tolerance)
        # They are saved with what was learned from them.
        given, self.instances = self.instances, None
        if given is not None:
            self.load_instances(given)
        if self.verbose >= 1:
            print(self.agent.workload)

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None:
            rng = np.random.default_rng(seed)
            if getattr(self, "policy", None) is None:
                self._rng = rng
            else:
                self.agent.reseed(rng)

    def _check_arguments(self) -> None:
        """Refuse what the policy does not check before anything is built."""
        if not hasattr(self, "action_space"):
            raise ValueError('env is missing: FittedRMax(env), an environment or its id, "MountainCar-v0"')
        check_actions(self.action_space)
        check_count("seed", self.seed, min=0, max=MAX_SEED, none_allowed=True)
        check_count("stats_window_size", self._stats_window_size)
        check_type("tensorboard_log", self.tensorboard_log, (str, Path, type(None)), "the path of a folder or None")
        check_policy(self.policy_class, self.policy_kwargs, (*FittedRMaxSettings.names(), *PASSED_TO_POLICY))

    @property
    def settings(self) -> FittedRMaxSettings:
        """The arguments that only this algorithm has; a ValueError if one is out of its range."""
        return FittedRMaxSettings(**{name: getattr(self, name) for name in FittedRMaxSettings.names()})

    @property
    def agent(self) -> FittedRMaxAgent:
        """The agent that learns, independent of Stable-Baselines3."""
        return self.policy.agent

    def learn(
        self,
        total_timesteps: int = DEFAULT_TIMESTEPS,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """Learn, and return the trained model.

        :param total_timesteps: environment steps, of all environments together; with 0 it returns at once
        :param callback: callback(s) called at every step
        :param log_interval: episodes between two logs; None for none
        :param tb_log_name: the name of the run for TensorBoard logging, which Stable-Baselines3 numbers. None: with the
            transfer method and the seed, so that runs can be told apart, such as ``FittedRMax_COMBREL_seed3``
        :param reset_num_timesteps: whether to count steps from 0 again (what was learned is kept in any case)
        :param progress_bar: display a progress bar using tqdm and rich
        :raises ValueError: if an argument is out of its range, the environment returns something that is not finite, or an
            argument of the constructor was changed afterwards
        """
        total_timesteps = as_count("total_timesteps", total_timesteps, min=0, max=MAX_TIMESTEPS)
        check_count("log_interval", log_interval, none_allowed=True)
        check_type("tb_log_name", tb_log_name, (str, type(None)), "text or None")
        check_boolean("reset_num_timesteps", reset_num_timesteps)
        check_boolean("progress_bar", progress_bar)
        self._refuse_changes()
        if self.env is None:
            raise ValueError("there is no environment to learn from: call set_env(env) first, or load(..., env=env)")
        # By its own name: callbacks look for it among the locals.
        tb_log_name = self._run_name() if tb_log_name is None else tb_log_name
        begins_anew = reset_num_timesteps or self._last_obs is None
        total_timesteps, callback = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        callback.on_training_start(locals(), globals())
        callback.on_rollout_start()
        self._episode_rewards = [[] for _ in range(self.n_envs)]
        self._last_states = self.policy.to_unit(np.asarray(self._last_obs), note=True)
        if begins_anew:
            self.agent.break_off()
        self.agent.prepare()
        try:
            with self._interrupts.taken():
                while self.num_timesteps < total_timesteps and self._step(callback, log_interval):
                    self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
        finally:
            self._last_states = None
            callback.on_training_end()
        self.policy.scales.warn_of_share(self.agent.task.state_names)
        return self

    def _refuse_changes(self) -> None:
        """:raises ValueError: if an attribute has been given another value, which what was learned would not follow"""
        for name in FittedRMaxSettings.names():
            now, used = getattr(self, name), getattr(self.agent.settings, name)
            if not _are_alike(now, used):
                raise ValueError(
                    f"{name} must be what the model was made with, {used!r}, got {now!r}: set it back, or save the model and "
                    f"call FittedRMax.load(path, {name}={now!r}), which follows if that can be changed"
                )
        if self.transfer is not self.policy.transfer:
            raise ValueError(
                f"transfer must be what the model was made with, {self.policy.transfer!r}, got {self.transfer!r}: set it "
                "back, or make a new model with what was learned: FittedRMax(env, transfer=..., instances=model)"
            )

    def _run_name(self) -> str:
        method = "" if self.transfer is None else f"_{type(self.transfer).__name__}"
        return f"FittedRMax{method}" + ("" if self.seed is None else f"_seed{self.seed}")

    def _step(self, callback: BaseCallback, log_interval: int | None) -> bool:
        """Make one step of every environment; return False if a callback stops the learning."""
        assert self.env is not None and self._last_states is not None
        states = self._last_states
        choices = [self.agent.act(state, environment=e) for e, state in enumerate(states)]
        actions = np.array(choices) + self.policy._first_action
        # An interrupt, or a simulator's error: where the environment is now nobody knows. The next ``learn`` resets it.
        self._last_obs = None
        new_obs, rewards, dones, infos = self.env.step(actions)
        self.num_timesteps += self.env.num_envs
        self._update_info_buffer(infos, dones)
        raw_rewards = self._raw_rewards(rewards)
        ended = [e for e, done in enumerate(dones.tolist()) if done]
        next_obs, terminated = true_outcomes(new_obs, infos, ended)
        next_states = self.policy.to_unit(next_obs, note=True)
        with self._interrupts:
            for e, choice in enumerate(choices):
                self.agent.update(states[e], choice, raw_rewards[e], next_states[e], terminated[e], e)
                self._episode_rewards[e].append(raw_rewards[e])
            self._last_obs = new_obs  # type: ignore[assignment]
            self._last_states = self.policy.to_unit(np.asarray(new_obs), note=True) if ended else next_states
        self._last_episode_starts = dones
        callback.update_locals(locals())
        try:
            going_on = callback.on_step()
        finally:
            # Also if a callback stops the learning at this step, or raises.
            before = self._episode_num
            with self._interrupts:
                for e in ended:
                    self._end_episode(e, terminated[e])
        self._progress.note_step(self.env)
        if ended:
            logs = log_interval is not None and self._episode_num // log_interval > before // log_interval
            callback.update_locals({"logs": logs})
            callback.on_rollout_end()
            if logs:
                self.dump_logs()
            callback.on_rollout_start()
        if self.policy.follow_scales(episode_ended=bool(ended)):
            self._last_states = self.policy.to_unit(np.asarray(new_obs))
        return going_on

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        # Only now is the logger set up, and known whether there is a log.
        for add in self.default_callbacks:
            callback = add(callback, self.logger)
        made = super()._init_callback(callback, progress_bar)
        assert self.env is not None
        warn_of_shared(self.env, made)
        return made

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        # An environment may change the array that it has returned, and at an episode's end two observations are needed.
        return BaseAlgorithm._wrap_env(with_own_arrays(env), verbose, monitor_wrapper)

    def _raw_rewards(self, rewards: np.ndarray) -> list[float]:
        """Return the environment's own rewards: a normalization that drifts would mix scales in one model."""
        raw = self._vec_normalize_env.get_original_reward() if self._vec_normalize_env is not None else rewards
        as_floats = raw.tolist()
        if not all(map(math.isfinite, as_floats)):
            raise ValueError(f"the environment returned a reward that is not finite: {raw}")
        return as_floats

    def _end_episode(self, env_index: int, terminated: bool) -> None:
        self._episode_num += 1
        self.agent.end_episode(not terminated, env_index)
        rewards = self._episode_rewards[env_index]
        self._episode_rewards[env_index] = []
        self._progress.note(rewards, terminated, self.agent.n_optimistic_actions)

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
        if self.logger.output_formats and self.logs_statistics:
            for name, value in self.agent.statistics().items():
                self.logger.record(name, value)
        self.logger.record("planner/sweeps", self.agent.n_sweeps)
        self.logger.dump(step=self.num_timesteps)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        given = env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])
        refuse_running_means(given)
        joined_names(self._names, names_of(given))
        super().set_env(env, force_reset)


def _are_alike(one: Any, other: Any) -> bool:
    """Whether two arguments say the same, as 1 and 1.0 do, or a list and a tuple."""
    try:
        return one is other or bool(to_plain(one) == to_plain(other))
    except TypeError:
        return False
