"""The episodes of several runs of one method, as arrays."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sb3_combrel.common.checks import check_count


@dataclass(frozen=True, eq=False)
class LearningCurves:
    """
    The episodes of several runs of one method, from the first on.

    Runs may have different numbers of episodes: what is left of a row is NaN, in both arrays. :meth:`from_rows` fills it in.

    :param returns: undiscounted return of each episode, shape (n_runs, n_episodes)
    :param steps: environment steps of each episode, whole numbers of at least 1, shape (n_runs, n_episodes)
    :raises ValueError: if shapes or values are others, or a run has no episode
    """

    returns: np.ndarray
    steps: np.ndarray

    def __post_init__(self) -> None:
        returns, steps = (np.array(values, dtype=np.float64) for values in (self.returns, self.steps))
        if returns.ndim != 2 or not returns.size:
            raise ValueError(f"returns must have shape (n_runs, n_episodes), at least one of each, got {returns.shape}")
        if steps.shape != returns.shape:
            raise ValueError(f"steps must have the shape of returns, {returns.shape}, got {steps.shape}")
        played = ~np.isnan(returns)
        _refuse("returns", returns, ~played[:, :1], "a number for the first episode of every run")
        _refuse("returns", returns, played[:, 1:] & ~played[:, :-1], "NaN only after the last episode of a run")
        _refuse("returns", returns, np.isinf(returns), "finite")
        _refuse("steps", steps, np.isnan(steps) == played, "NaN where returns are, and nowhere else")
        _refuse("steps", steps, played & ~((steps >= 1) & (steps == np.floor(steps)) & ~np.isinf(steps)), "whole, at least 1")
        object.__setattr__(self, "returns", returns)
        object.__setattr__(self, "steps", steps)

    @classmethod
    def from_rows(cls, returns: Sequence[Sequence[float]], steps: Sequence[Sequence[float]]) -> LearningCurves:
        """
        Make them of runs that may have different numbers of episodes.

        :param returns: for each run, the return of each episode
        :param steps: for each run, the environment steps of each episode
        :raises ValueError: if the numbers of runs or of episodes differ, a run has no episode, or values are not allowed
        """
        lengths = [len(row) for row in returns]
        if lengths != [len(row) for row in steps]:
            raise ValueError(f"steps must have as many episodes as returns, {lengths}, got {[len(row) for row in steps]}")
        if 0 in lengths or not lengths:
            raise ValueError(f"returns must have runs of at least one episode, got {lengths} episodes")
        filled = np.full((2, len(lengths), max(lengths)), np.nan)
        for run, length in enumerate(lengths):
            filled[:, run, :length] = returns[run], steps[run]
        return cls(*filled)

    @property
    def n_episodes(self) -> np.ndarray:
        """Number of episodes of each run, shape (n_runs,)."""
        return (~np.isnan(self.returns)).sum(axis=1)

    @property
    def n_steps(self) -> np.ndarray:
        """Environment steps of each run, shape (n_runs,)."""
        return np.nansum(self.steps, axis=1)

    def first_episodes(self, n: int | None = None) -> LearningCurves:
        """
        The first episodes of each run.

        :param n: their number; None: as many as the shortest run has
        :raises ValueError: if a run has fewer
        """
        n = episodes_of_all("n", n, self)
        return LearningCurves(self.returns[:, :n], self.steps[:, :n])


class HasEpisodes(Protocol):
    """What has been kept of the episodes of a run."""

    @property
    def returns(self) -> Sequence[float]:
        """Undiscounted return of each episode."""

    @property
    def steps(self) -> Sequence[float]:
        """Environment steps of each episode."""


def curves_of(runs: Iterable[HasEpisodes]) -> LearningCurves:
    """
    Return the learning curves of some runs, in their order.

    :param runs: results that have ``returns`` and ``steps`` of their episodes
    :raises ValueError: if there is no run, or one without an episode
    """
    runs = list(runs)
    return LearningCurves.from_rows([run.returns for run in runs], [run.steps for run in runs])


def episodes_of_all(name: str, n: int | None, curves: LearningCurves) -> int:
    """
    Return a number of episodes that every run has.

    :param name: of the argument, for messages
    :param n: the number; None: as many as the shortest run has
    :param curves: the runs
    :raises ValueError: if a run has fewer
    """
    shortest = int(curves.n_episodes.min())
    if n is None:
        return shortest
    check_count(name, n, max=shortest, why_max="as many as the shortest run has")
    return n


def returns_over_steps(curves: LearningCurves, at: np.ndarray) -> np.ndarray:
    """
    Return, for each run, the return of the episode that was under way after so many environment steps.

    :param curves: the runs
    :param at: environment steps, each fewer than the shortest run has, shape (n_points,)
    :return: shape (n_runs, n_points)
    """
    ends = np.cumsum(np.nan_to_num(curves.steps), axis=1)
    rows = [
        returns[np.searchsorted(end[:n], at, side="right")]
        for returns, end, n in zip(curves.returns, ends, curves.n_episodes, strict=True)
    ]
    return np.array(rows)


def _refuse(name: str, values: np.ndarray, wrong: np.ndarray, right: str) -> None:
    """Raise an error that names the first value that is wrong."""
    if wrong.any():
        run, episode = np.argwhere(wrong)[0]
        raise ValueError(f"{name} must be {right}, got {values[run, episode]} in run {run}, episode {episode}")
