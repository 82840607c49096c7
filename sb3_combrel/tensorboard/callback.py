"""The dashboard of a learning run in TensorBoard: scalars, pictures, tables, settings."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, EventCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_combrel.common.checks import check_count, check_positive
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.tensorboard import readings
from sb3_combrel.tensorboard.explain import planes_of
from sb3_combrel.tensorboard.history import ChoiceHistory
from sb3_combrel.tensorboard.hyperparameters import METRICS, USUALLY_DIFFER, all_settings, hyperparameters
from sb3_combrel.tensorboard.layout import LAYOUT
from sb3_combrel.tensorboard.mapping_table import mapping_table
from sb3_combrel.tensorboard.plane import Plane, VariablePair
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer

if TYPE_CHECKING:
    # TensorBoard's writer and matplotlib take a second to import: only where there is a log.
    from torch.utils.tensorboard import SummaryWriter

# A set takes half a second: a few per cent of the time where a step takes a third of a millisecond.
DEFAULT_PICTURE_FREQ = 50_000
# Of a dashboard that the user did not ask for. Matplotlib is loaded with the first set, which took up to two seconds.
DEFAULT_PICTURE_SHARE = 0.05
FIRST_PICTURES_SECONDS = 1.5
# Half for the algorithm's logs, half for points between them.
DEFAULT_SCALAR_SHARE = 0.03
# Between logs, in a run that is not stopped early; fewer where they would take more than their share of the time.
MAX_POINTS = 500


class DashboardCallback(BaseCallback):
    """
    Shows in TensorBoard what Fitted R-Max has learned and what was transferred.

    ``FittedRMax.learn`` adds one where there is a TensorBoard log (``tensorboard_log``, or a logger of the
    user's with that format) and none was given. Its pictures come at the end, which takes half a second, and before where
    they take less than a twentieth of the time. Pass one to choose what is shown. Without such a log it does nothing; what is
    learned is the same in any case.

    - Scalars: ``rollout/`` and ``time/`` with every log of the algorithm (``log_interval``); ``model/``, ``planner/`` and
      ``transfer/`` with these and between them, up to 500 times in a run; and a page of custom scalars on which runs with
      and without transfer can be compared. With ``log_interval=None`` there are none.
    - Pictures: V and the greedy policy over two state variables; the source action that each target action is
      mapped to (Figure 4 of the COMBREL paper); which state mappings were chosen when. They need matplotlib.
    - Text: the mappings used most (Table 2 of that paper). HPARAMS: the settings, those first in which runs usually differ.

    :param picture_freq: environment steps between two sets of pictures and tables; the last set comes at the end of
        ``learn``. None: no pictures, and a table at the end only.
    :param variables: pairs of state variables, by number or name, over which V, policy and source actions are drawn;
        None for the first two
    :param at: state (raw units) through which the pictures' plane goes: the values of all other variables; None for the
        middle of the state space
    :param scalar_share: fraction of the time that scalars may take, half of it between logs. A log that would exceed it has
        ``rollout/`` and ``time/`` only; 1 for all of them in every log.
    :param picture_share: the same for pictures, each set complete or not at all, but for the last, which always comes; 1 for
        one every ``picture_freq`` steps
    :param verbose: verbosity level, as in any callback
    :raises ValueError: if ``picture_freq`` is below 1 or a share not in (0, 1]; when learning starts, if variables or state
        do not fit the task
    :raises ModuleNotFoundError: when learning starts, if pictures are wanted and matplotlib is not installed
    """

    def __init__(
        self,
        picture_freq: int | None = DEFAULT_PICTURE_FREQ,
        variables: Sequence[VariablePair] | None = None,
        at: ArrayLike | None = None,
        scalar_share: float = DEFAULT_SCALAR_SHARE,
        picture_share: float = 1.0,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        check_count("picture_freq", picture_freq, none_allowed=True)
        check_positive("scalar_share", scalar_share, max=1.0)
        check_positive("picture_share", picture_share, max=1.0)
        self.picture_freq = picture_freq
        self.variables = variables
        self.at = at
        self.scalar_share = scalar_share
        self.picture_share = picture_share
        self._writer: SummaryWriter | None = None

    model: FittedRMax  # type: ignore[assignment]

    @property
    def agent(self) -> FittedRMaxAgent:
        """The agent of the algorithm."""
        return self.model.agent

    def _on_training_start(self) -> None:
        self._writer = tensorboard_writer(self.logger)
        if self._writer is None:
            return
        self._check_pictures()
        self._planes = self._make_planes()
        self._transfer = _with_mappings(self.agent)
        self._history = _new_history(self._transfer)
        self._shown_at = self._drawn_at = self.model.num_timesteps
        self._next_pictures = self._following_pictures()
        self.agent.timed = True
        self._mark_time()
        self._started = time.perf_counter()
        self._log_began: float | None = None
        self._spent = self._last_log = 0.0
        # Of the points between logs. Nobody wants scalars who wants no logs.
        self._spent_between = self._last_between = 0.0
        n_steps = self.model._total_timesteps - self.model.num_timesteps
        self._scalar_freq = max(1, n_steps // MAX_POINTS) if self.locals.get("log_interval") is not None else None
        self._scalars_at = self.model.num_timesteps
        self._spent_on_pictures, self._last_pictures = 0.0, FIRST_PICTURES_SECONDS
        self._write_settings()

    def _check_pictures(self) -> None:
        if self.picture_freq is not None and find_spec("matplotlib") is None:
            raise ModuleNotFoundError(
                "DashboardCallback needs matplotlib for pictures: install it, or pass picture_freq=None", name="matplotlib"
            )

    def _make_planes(self) -> list[Plane]:
        return planes_of(self.model, self.variables, self.at)

    def _write_settings(self) -> None:
        from sb3_combrel.tensorboard.summaries import settings_summaries

        assert self._writer is not None
        self._writer.add_custom_scalars(LAYOUT)
        for summary in settings_summaries(hyperparameters(self.model), all_settings(self.model), USUALLY_DIFFER, METRICS):
            self._writer._get_file_writer().add_summary(summary)

    def _on_rollout_end(self) -> None:
        """Add scalars to the log that the algorithm writes after this."""
        if self._writer is None:
            return
        self._log_began = time.perf_counter()
        self.model.logs_statistics = self._can_afford(self._spent + self._last_log)
        if self.model.logs_statistics:
            self._scalars_at = self.num_timesteps
            for name, value in self._readings().items():
                self.logger.record(name, value)

    def _on_rollout_start(self) -> None:
        """Note the time that the log has taken."""
        if self._writer is not None and self._log_began is not None:
            # The time of a log without these scalars depends on the user's log_interval, and does not count.
            if self.model.logs_statistics:
                self._last_log = time.perf_counter() - self._log_began
                self._spent += self._last_log

    def _can_afford(self, seconds: float) -> bool:
        """Return whether scalars of so many seconds, since the start, are within half of their share of the time."""
        return self.scalar_share == 1.0 or seconds <= 0.5 * self.scalar_share * (time.perf_counter() - self._started)

    def _scalars_are_due(self) -> bool:
        if self._scalar_freq is None or self.num_timesteps < self._scalars_at + self._scalar_freq:
            return False
        # Where an episode ends there may be a log, which has them too.
        return not np.any(self.locals["dones"]) and self._can_afford(self._spent_between + self._last_between)

    def _write_scalars(self) -> None:
        """Write what a log would have, between logs, in one piece: twenty single scalars would take several times as long."""
        from sb3_combrel.tensorboard.summaries import scalars_summary

        assert self._writer is not None
        began = time.perf_counter()
        scalars = {**self.agent.statistics(), **self._readings(), "planner/backups": self.agent.n_backups}
        self._writer._get_file_writer().add_summary(scalars_summary(scalars), self.num_timesteps)
        self._scalars_at = self.num_timesteps
        self._last_between = time.perf_counter() - began
        self._spent_between += self._last_between

    def _readings(self) -> dict[str, float]:
        found = {
            "planner/residual": readings.bellman_residual(self.agent),
            "planner/time_share": self._planning_share(),
        }
        if self.agent.transfer is not None:
            modelled = self.agent.mdp.arrays.modelled & ~self.agent.model.known
            found["transfer/pairs_modelled"] = int(modelled.sum())
        if self._transfer is not None and self._history is not None:
            self._history.note(self.num_timesteps, self._transfer.choices())
            compliance = readings.mean_compliance(self._transfer)
            if compliance is not None:
                found["transfer/compliance"] = compliance
        return found

    def _mark_time(self) -> None:
        self._marked = time.perf_counter(), self.agent.planning_seconds

    def _planning_share(self) -> float:
        """Compute the fraction of the time since the last log that planning took, transferred instances included."""
        since, planning_before = self._marked
        self._mark_time()
        now, planning = self._marked
        return (planning - planning_before) / max(now - since, 1e-9)

    def _on_step(self) -> bool:
        if self._writer is None:
            return True
        if self._scalars_are_due():
            self._write_scalars()
        if self.num_timesteps >= self._next_pictures:
            self._show(at_end=False)
        return True

    def _following_pictures(self) -> float:
        """Return the next multiple of ``picture_freq``."""
        if self.picture_freq is None:
            return float("inf")
        return (self.model.num_timesteps // self.picture_freq + 1) * self.picture_freq

    def _on_training_end(self) -> None:
        if self._writer is None:
            return
        self.agent.timed, self.model.logs_statistics = False, True
        if self._scalar_freq is not None and self.model.num_timesteps > self._scalars_at:
            self._write_scalars()
        self._show(at_end=True)
        self._writer.flush()
        self._writer = None

    def _show(self, at_end: bool) -> None:
        """Write table and pictures, unless there are some of this step."""
        now = self.model.num_timesteps
        self._next_pictures = self._following_pictures()
        if now > self._shown_at and self._transfer is not None:
            self._write_table(self._transfer, now)
        self._shown_at = now
        if self.picture_freq is not None and now > self._drawn_at and (at_end or self._can_afford_pictures()):
            began = time.perf_counter()
            self._write_pictures(now)
            self._drawn_at = now
            self._last_pictures = time.perf_counter() - began
            self._spent_on_pictures += self._last_pictures

    def _can_afford_pictures(self) -> bool:
        affordable = self.picture_share * (time.perf_counter() - self._started)
        return self.picture_share == 1.0 or self._spent_on_pictures + self._last_pictures <= affordable

    def _write_table(self, transfer: MappingTransfer, step: int) -> None:
        assert self._writer is not None
        table = mapping_table(transfer, self.agent.task.action_names)
        self._writer.add_text("transfer/most_chosen_mappings", table, step)

    def _write_pictures(self, step: int) -> None:
        from sb3_combrel.tensorboard import pictures

        for plane in self._planes:
            over = "_".join(name for name in plane.names if name)
            self._write_picture(f"value_and_policy/{over}", pictures.value_and_policy(self.agent, plane), step)
            if self._history is not None:
                assert self._transfer is not None
                picture = pictures.source_actions(self.agent, self._transfer, plane)
                self._write_picture(f"source_action/{over}", picture, step)
        if self._history is not None:
            assert self._transfer is not None
            self._history.note(step, self._transfer.choices())
            self._write_picture("state_mappings/chosen", pictures.state_mappings(self._history, self._transfer), step)

    def _write_picture(self, tag: str, picture: np.ndarray, step: int) -> None:
        assert self._writer is not None
        self._writer.add_image(tag, picture, step, dataformats="HWC")


def tensorboard_writer(logger: Logger) -> SummaryWriter | None:
    """Return the writer of a logger's TensorBoard format; None if it has no such format."""
    for output in logger.output_formats:
        if isinstance(output, TensorBoardOutputFormat):
            return output.writer
    return None


def with_dashboard(callback: MaybeCallback, logger: Logger) -> MaybeCallback:
    """
    Add a :class:`DashboardCallback` to callbacks where there is a TensorBoard log and none is among them.

    :param callback: what the user gave to ``learn``
    :param logger: the algorithm's logger
    :return: what ``learn`` uses in place of ``callback``
    """
    if tensorboard_writer(logger) is None or _has_dashboard(callback):
        return callback
    picture_freq = DEFAULT_PICTURE_FREQ if find_spec("matplotlib") is not None else None
    dashboard = DashboardCallback(picture_freq, picture_share=DEFAULT_PICTURE_SHARE)
    if callback is None:
        return dashboard
    given: list[Any] = callback if isinstance(callback, list) else [callback]
    return CallbackList([*(_as_callback(one) for one in given), dashboard])


def _as_callback(callback: BaseCallback | Callable[..., Any]) -> BaseCallback:
    return callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)


def _has_dashboard(callback: Any) -> bool:
    if isinstance(callback, list):
        return any(map(_has_dashboard, callback))
    if isinstance(callback, CallbackList):
        return _has_dashboard(callback.callbacks)
    if isinstance(callback, EventCallback) and callback.callback is not None:
        return _has_dashboard(callback.callback)
    return isinstance(callback, DashboardCallback)


def _with_mappings(agent: FittedRMaxAgent) -> MappingTransfer | None:
    """Return the transfer method, if it is one of those whose mappings can be shown."""
    return agent.transfer if isinstance(agent.transfer, MappingTransfer) else None


def _new_history(transfer: MappingTransfer | None) -> ChoiceHistory | None:
    """Make a history of the choices; None for a method that does not choose one mapping."""
    return ChoiceHistory() if transfer is not None and transfer.makes_choices else None
