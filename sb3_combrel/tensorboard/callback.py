"""The dashboard of a learning run in TensorBoard: scalars, pictures, tables, settings."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, EventCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import safe_mean
from stable_baselines3.common.vec_env import VecEnv

from sb3_combrel.common.checks import check_count, check_positive
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.fitted_rmax.vec_envs import refuse_running_means
from sb3_combrel.pages.plane import VariablePair, check_matplotlib, has_matplotlib, planes_of
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.runs.episodes import EVALUATION_SEED
from sb3_combrel.tensorboard import readings
from sb3_combrel.tensorboard.history import ChoiceHistory
from sb3_combrel.tensorboard.mapping_table import mapping_table
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer

if TYPE_CHECKING:
    # TensorBoard's writer and matplotlib take a second to import: only where there is a log.
    from torch.utils.tensorboard import SummaryWriter

AUTO = "auto"
DEFAULT_PICTURE_FREQ = AUTO
# Sets of pictures in a run, and evaluations, where their frequency is left open.
TIMES_A_RUN = 8
# Of the time, for a dashboard that the user did not ask for. Matplotlib is loaded with the first set.
DEFAULT_PICTURE_SHARE = 0.15
FIRST_PICTURES_SECONDS = 1.0
DEFAULT_SCALAR_SHARE = 0.03
# Points between logs, in a run that is not stopped early.
MAX_POINTS = 500


class DashboardCallback(BaseCallback):
    """Shows in TensorBoard what Fitted R-Max has learned and what was transferred; what is learned is the same without it.

    ``FittedRMax.learn`` adds one where there is a TensorBoard log and none was given; its pictures come at the end, and before
    where all of them take at most 15% of the time. Without such a log it does nothing.

    - Scalars: ``rollout/`` at the end of every episode, ``time/`` with every log of the algorithm (``log_interval``; None: no
      scalars); ``model/``, ``planner/``, ``transfer/`` and, of a source as prior, ``evidence/``, as how many instances it
      counts for each action, with these and between them, up to 500 times in a run; and a page of custom scalars to compare
      runs.
    - Pictures: V, what the source bounds it by, and the greedy policy over two state variables; of a source as prior the
      evidence over time; else the source action that each target action is mapped to (Figure 4 of the COMBREL paper), and
      which state mappings were chosen when. They need matplotlib.
    - Evaluation, with ``eval_env``: episodes without exploration, ``eval/mean_reward`` and ``eval/mean_ep_length`` as of
      Stable-Baselines3's ``EvalCallback``.
    - Text: the mappings used most (Table 2 of that paper). HPARAMS: the settings.

    :param picture_freq: environment steps between two sets of pictures and tables; the last comes at the end of ``learn``.
        "auto": an eighth of the run; None: no pictures, and a table at the end only
    :param variables: pairs of state variables, by number or name, over which is drawn; None for a variable beside its own
        velocity, told by their names, or else the first two
    :param at: state (raw units) through which the pictures' plane goes; None for the middle of the state space
    :param scalar_share: fraction of the time that scalars may take, half of it between logs; a log that would exceed it has
        ``rollout/`` and ``time/`` only. 1 for all of them in every log
    :param picture_share: the same for pictures, each set complete or not at all, but for the last, which always comes
    :param verbose: verbosity level, as in any callback
    :param eval_env: environment, or its id, in which the policy is evaluated without exploration; None: it is not. It must be
        another than the one that is learned; one made from an id begins with a seed that no run has learned with
    :param eval_freq: environment steps between two evaluations. "auto": an eighth of the run
    :param n_eval_episodes: episodes of an evaluation
    :raises ValueError: if a frequency or a number is below 1 or a share not in (0, 1]; when learning starts, if variables,
        state or ``eval_env`` do not fit the task
    :raises ModuleNotFoundError: when learning starts, if pictures are wanted and matplotlib is not installed
    """

    model: FittedRMax  # type: ignore[assignment]

    def __init__(
        self,
        picture_freq: int | str | None = DEFAULT_PICTURE_FREQ,
        variables: Sequence[VariablePair] | None = None,
        at: ArrayLike | None = None,
        scalar_share: float = DEFAULT_SCALAR_SHARE,
        picture_share: float = 1.0,
        verbose: int = 0,
        eval_env: GymEnv | str | None = None,
        eval_freq: int | str = AUTO,
        n_eval_episodes: int = 5,
    ):
        super().__init__(verbose)
        for name, freq in (("picture_freq", picture_freq), ("eval_freq", eval_freq)):
            if isinstance(freq, str) and freq != AUTO:
                raise ValueError(f'{name} must be a whole number of at least 1 or "{AUTO}", got {freq!r}')
            if freq != AUTO:
                check_count(name, freq, none_allowed=name == "picture_freq")
        check_count("n_eval_episodes", n_eval_episodes)
        check_positive("scalar_share", scalar_share, max=1.0)
        check_positive("picture_share", picture_share, max=1.0)
        self.picture_freq = picture_freq
        self.variables = variables
        self.at = at
        self.scalar_share = scalar_share
        self.picture_share = picture_share
        self.eval_env = eval_env
        self.eval_freq = eval_freq
        self.n_eval_episodes = n_eval_episodes
        self._writer: SummaryWriter | None = None

    @property
    def agent(self) -> FittedRMaxAgent:
        """The agent of the algorithm."""
        return self.model.agent

    def _on_training_start(self) -> None:
        self._writer = tensorboard_writer(self.logger)
        if self._writer is None:
            warn_user("DashboardCallback does nothing without a TensorBoard log: pass the model tensorboard_log='logs'")
            return
        if self.picture_freq is not None:
            check_matplotlib("pass picture_freq=None")
        transfer = self.agent.transfer
        self._transfer = transfer if isinstance(transfer, MappingTransfer) else None
        self._scaling: StateScaling | None = None
        self._grid: StateGrid | None = None
        self._follow_scales()
        self._shown_at = self._drawn_at = self._scalars_at = self.model.num_timesteps
        n_steps = self.model._total_timesteps - self.model.num_timesteps
        self._picture_freq = _steps_between(self.picture_freq, n_steps)
        self._next_pictures = self._following(self._picture_freq)
        self._eval_freq = None if self.eval_env is None else _steps_between(self.eval_freq, n_steps)
        self._next_evaluation = self._following(self._eval_freq)
        self._played = None if self.eval_env is None else self._env_to_play(self.eval_env)
        # Nobody wants scalars between logs who wants no logs.
        self._scalar_freq = max(1, n_steps // MAX_POINTS) if self.locals.get("log_interval") is not None else None
        half = 1.0 if self.scalar_share == 1.0 else 0.5 * self.scalar_share
        self._of_logs, self._between_logs = _Allowance(half), _Allowance(half)
        self._of_pictures = _Allowance(self.picture_share, FIRST_PICTURES_SECONDS)
        self._log_began: float | None = None
        self._marked = time.perf_counter(), self.agent.planning_seconds
        self._write_settings(self._writer)

    def _write_settings(self, writer: SummaryWriter) -> None:
        from sb3_combrel.tensorboard.summaries import LAYOUT, hyperparameters, settings_summaries

        writer.add_custom_scalars(LAYOUT)
        for summary in settings_summaries(hyperparameters(self.model)):
            writer._get_file_writer().add_summary(summary)

    def _on_rollout_end(self) -> None:
        """Add scalars to the log that the algorithm writes after this."""
        self._log_began = None
        if self._writer is None or not self.locals["logs"]:
            return
        self.model.logs_statistics = self._of_logs.suffices()
        # The time of a log without these scalars depends on the user's log_interval, and does not count.
        self._log_began = time.perf_counter() if self.model.logs_statistics else None
        if self.model.logs_statistics:
            self._scalars_at = self.num_timesteps
            for name, value in self._readings().items():
                self.logger.record(name, value)

    def _on_rollout_start(self) -> None:
        if self._writer is not None and self._log_began is not None:
            self._of_logs.spend_since(self._log_began)

    def _on_step(self) -> bool:
        if self._writer is None:
            return True
        ended = int(np.sum(self.locals["dones"]))
        if ended and self._scalar_freq is not None and not self._log_follows(ended):
            self._write_rollout(self._writer)
        due = self._scalar_freq is not None and self.num_timesteps >= self._scalars_at + self._scalar_freq
        # Where an episode ends there may be a log, which has them too.
        if due and not ended and self._between_logs.suffices():
            self._write_scalars(self._writer)
        if self.num_timesteps >= self._next_pictures:
            self._show(self._writer, at_end=False)
        if self.num_timesteps >= self._next_evaluation:
            self._evaluate(self._writer)
        return True

    def _log_follows(self, n_ended: int) -> bool:
        """Return whether the algorithm writes a log once it has taken in that so many episodes have ended."""
        interval, before = self.locals["log_interval"], self.model._episode_num
        return any((before + k) % interval == 0 for k in range(1, n_ended + 1))

    def _write_rollout(self, writer: SummaryWriter) -> None:
        """Write what logs say of episodes at the end of one that has no log."""
        from sb3_combrel.tensorboard.summaries import scalars_summary

        episodes = self.model.ep_info_buffer or ()
        names = {"r": "rollout/ep_rew_mean", "l": "rollout/ep_len_mean"}
        scalars = {tag: safe_mean([info[key] for info in episodes]) for key, tag in names.items() if episodes}
        if self.model.ep_success_buffer:
            scalars["rollout/success_rate"] = safe_mean(self.model.ep_success_buffer)
        writer._get_file_writer().add_summary(scalars_summary(scalars), self.num_timesteps)

    def _on_training_end(self) -> None:
        if self._writer is None:
            return
        self.model.logs_statistics = True
        if self._scalar_freq is not None and self.model.num_timesteps > self._scalars_at:
            self._write_scalars(self._writer)
        self._show(self._writer, at_end=True)
        self._writer.flush()
        self._writer = None
        if isinstance(self.eval_env, str) and self._played is not None:
            self._played.close()

    def _follow_scales(self) -> None:
        """Begin anew with planes and history if the agent has other scales or grid lines: candidates are numbered anew."""
        if self.agent.task.scaling is self._scaling and self.agent.grid is self._grid:
            return
        self._scaling, self._grid = self.agent.task.scaling, self.agent.grid
        task = self.agent.task
        self._planes = planes_of(self.agent.grid, task.scaling, task.state_names, self.variables, self.at)
        self._history = ChoiceHistory() if self._transfer is not None and self._transfer.makes_choices else None

    def _write_scalars(self, writer: SummaryWriter) -> None:
        """Write what a log would have, between logs, in one piece: single scalars would take several times as long."""
        from sb3_combrel.tensorboard.summaries import scalars_summary

        began = time.perf_counter()
        scalars = {**self.agent.statistics(), **self._readings(), "planner/sweeps": self.agent.n_sweeps}
        writer._get_file_writer().add_summary(scalars_summary(scalars), self.num_timesteps)
        self._scalars_at = self.num_timesteps
        self._between_logs.spend_since(began)

    def _readings(self) -> dict[str, float]:
        self._follow_scales()
        found = {
            "planner/residual": readings.bellman_residual(self.agent),
            "planner/time_share": self._planning_share(),
        }
        if self.agent.transfer is not None:
            modelled = self.agent.mdp.arrays.modelled & ~self.agent.model.known
            found["transfer/pairs_modelled"] = int(modelled.sum())
            found |= readings.evidence(self.agent)
        if self._transfer is not None and self._history is not None:
            self._history.note(self.num_timesteps, self._transfer.choices())
            compliance = readings.mean_compliance(self._transfer)
            if compliance is not None:
                found["transfer/compliance"] = compliance
        return found

    def _planning_share(self) -> float:
        """Compute the fraction of the time since the last call that planning took, transferred instances included."""
        since, planning_before = self._marked
        self._marked = now, planning = time.perf_counter(), self.agent.planning_seconds
        return (planning - planning_before) / max(now - since, 1e-9)

    def _following(self, freq: int | None) -> float:
        """Return the next step that is a multiple of ``freq``; None: never."""
        return float("inf") if freq is None else float((self.model.num_timesteps // freq + 1) * freq)

    def _env_to_play(self, given: GymEnv | str) -> VecEnv:
        """Prepare the environment of evaluations."""
        learned, env = self.training_env, self.model._wrap_env(gym.make(given) if isinstance(given, str) else given)
        if _objects_of(env) & _objects_of(learned):
            raise ValueError(f"eval_env must be another environment than the one that is learned, or an id, got {given!r}")
        refuse_running_means(env)
        spaces, wanted = ((each.observation_space, each.action_space) for each in (env, learned))
        if spaces != wanted:
            raise ValueError(f"eval_env must have the spaces of the environment that is learned, {wanted}, got {spaces}")
        if isinstance(given, str) and self.model.seed is not None:
            env.seed(EVALUATION_SEED + self.model.seed)
        return env

    def _evaluate(self, writer: SummaryWriter) -> None:
        """Write how the policy does without exploration."""
        from sb3_combrel.tensorboard.summaries import scalars_summary

        assert self._played is not None
        played: Any = evaluate_policy(self.model, self._played, self.n_eval_episodes, return_episode_rewards=True, warn=False)
        tags = ("eval/mean_reward", "eval/mean_ep_length")
        scalars = {tag: float(np.mean(each)) for tag, each in zip(tags, played, strict=True)}
        writer._get_file_writer().add_summary(scalars_summary(scalars), self.num_timesteps)
        self._next_evaluation = self._following(self._eval_freq)

    def _show(self, writer: SummaryWriter, at_end: bool) -> None:
        """Write table and pictures, unless there are some of this step."""
        now = self.model.num_timesteps
        self._next_pictures = self._following(self._picture_freq)
        if now > self._shown_at and self._transfer is not None:
            writer.add_text("transfer/most_chosen_mappings", mapping_table(self._transfer, self.agent.task.action_names), now)
        self._shown_at = now
        if self.picture_freq is not None and now > self._drawn_at and (at_end or self._of_pictures.suffices()):
            began = time.perf_counter()
            for tag, picture in self._draw(now).items():
                writer.add_image(tag, picture, now, dataformats="HWC")
            self._drawn_at = now
            self._of_pictures.spend_since(began)

    def _draw(self, step: int) -> dict[str, np.ndarray]:
        from sb3_combrel.tensorboard import pictures

        self._follow_scales()
        drawn = pictures.over_planes(self.agent, self._planes)
        if self._history is not None and self._transfer is not None and pictures.varies_by_state(self._transfer):
            self._history.note(step, self._transfer.choices())
            drawn["state_mappings/chosen"] = pictures.state_mappings(self._history, self._transfer)
        return drawn


class _Allowance:
    """A share of the time since it was made; 1 for all. The next piece of work is expected to take as long as the last."""

    def __init__(self, share: float, next_seconds: float = 0.0) -> None:
        self.share, self.next_seconds, self.spent = share, next_seconds, 0.0
        self.made_at = time.perf_counter()

    def suffices(self) -> bool:
        """Return whether there is time for the next piece of work."""
        return self.share == 1.0 or self.spent + self.next_seconds <= self.share * (time.perf_counter() - self.made_at)

    def spend_since(self, began: float) -> None:
        self.next_seconds = time.perf_counter() - began
        self.spent += self.next_seconds


def _steps_between(freq: int | str | None, n_steps: int) -> int | None:
    return max(1, n_steps // TIMES_A_RUN) if isinstance(freq, str) else freq


def _objects_of(env: VecEnv) -> set[int]:
    """What a vectorized environment is made of below all wrappers."""
    return {id(env.unwrapped), *(id(each.unwrapped) for each in getattr(env.unwrapped, "envs", ()))}


def tensorboard_writer(logger: Logger) -> SummaryWriter | None:
    """Return the writer of a logger's TensorBoard format; None if it has no such format."""
    return next((each.writer for each in logger.output_formats if isinstance(each, TensorBoardOutputFormat)), None)


def with_dashboard(callback: MaybeCallback, logger: Logger) -> MaybeCallback:
    """Add a :class:`DashboardCallback` to callbacks where there is a TensorBoard log and none is among them."""
    if tensorboard_writer(logger) is None or _has_dashboard(callback):
        return callback
    picture_freq = DEFAULT_PICTURE_FREQ if has_matplotlib() else None
    dashboard = DashboardCallback(picture_freq, picture_share=DEFAULT_PICTURE_SHARE)
    if isinstance(callback, list):
        return [*callback, dashboard]
    if callback is None or isinstance(callback, BaseCallback):
        return [dashboard] if callback is None else [callback, dashboard]
    return [ConvertCallback(callback), dashboard]


def _has_dashboard(callback: Any) -> bool:
    if isinstance(callback, list):
        return any(map(_has_dashboard, callback))
    if isinstance(callback, CallbackList):
        return _has_dashboard(callback.callbacks)
    if isinstance(callback, EventCallback) and callback.callback is not None:
        return _has_dashboard(callback.callback)
    return isinstance(callback, DashboardCallback)
