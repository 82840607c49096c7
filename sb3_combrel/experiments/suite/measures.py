"""What is measured of the episodes of a run: steps, returns, failures."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sb3_combrel.comparison.measures import steps_to_reach
from sb3_combrel.runs.episodes import Episodes

#: So many episodes at the end of learning are what the frozen policy is compared with.
LAST = 10
#: So many episodes, at least, must stay below a limit for a task to count as learnt for good.
SHORTEST_TAIL = 5
#: The frozen policy is as good as the learning agent if its mean return is lower by at most this fraction.
TOLERATED_LOSS = 0.05


class Measure(NamedTuple):
    """A number that describes the learning of a task."""

    name: str  # its column in tables
    of: Callable[[Episodes], float]  # NaN if there were too few episodes, inf if a limit was never reached
    higher_is_better: bool = False  # whether more of it is better


def steps_in(first: int, last: int) -> Measure:
    """Measure the steps of episodes ``first`` to ``last``, counted from 1, together."""
    return Measure(f"steps_{first}_to_{last}", lambda episodes: _of_range(episodes.steps, first, last, np.sum))


def mean_steps_in(first: int, last: int) -> Measure:
    """Measure the mean steps of episodes ``first`` to ``last``, counted from 1."""
    return Measure(f"mean_steps_{first}_to_{last}", lambda episodes: _of_range(episodes.steps, first, last, np.mean))


def mean_return_in(first: int, last: int) -> Measure:
    """Measure the mean return of episodes ``first`` to ``last``, counted from 1: of the first ones, the jumpstart."""
    return Measure(
        f"mean_return_{first}_to_{last}",
        lambda episodes: _of_range(episodes.returns, first, last, np.mean),
        higher_is_better=True,
    )


def steps_until_always(limit: int) -> Measure:
    """Measure the steps until all further episodes (:data:`SHORTEST_TAIL` or more) have at most ``limit``, or inf."""
    return Measure(f"steps_until_always_{limit}", lambda episodes: settled_after(episodes.steps, limit))


def steps_until_first_end() -> Measure:
    """Measure after how many steps of learning a terminal state ended an episode for the first time; inf if none did."""

    def steps(episodes: Episodes) -> float:
        ended = np.flatnonzero(episodes.terminated)
        return float(episodes.steps[: ended[0] + 1].sum()) if len(ended) else np.inf

    return Measure("steps_until_first_end", steps)


def steps_until_median(limit: int, window: int = 5) -> Measure:
    """Measure after how many steps of learning the median of ``window`` episodes is at most ``limit``; inf if it never is."""

    def steps(episodes: Episodes) -> float:
        return float(steps_to_reach(episodes.steps[None], limit, window)[0])

    return Measure(f"steps_until_median_{limit}", steps)


def settled_after(steps: np.ndarray, limit: int) -> float:
    """Count the steps up to the end of the last episode that has more than ``limit``; inf if too few follow."""
    too_long = np.flatnonzero(steps > limit)
    n_before = int(too_long[-1]) + 1 if len(too_long) else 0
    return float(steps[:n_before].sum()) if len(steps) - n_before >= SHORTEST_TAIL else np.inf


def failures(episodes: Episodes, failure_return: float | None) -> np.ndarray:
    """Tell which episodes failed: return at most ``failure_return``; None: those that a time limit ended."""
    return ~episodes.terminated if failure_return is None else episodes.returns <= failure_return


def summary_of_learning(episodes: Episodes, failure_return: float | None) -> dict[str, float]:
    """Return what is recorded of the last ten episodes of learning; NaN if there was none."""
    last = episodes.last(LAST)
    if not len(last.steps):
        return {"last10_return": np.nan, "last10_failed": np.nan}
    failed = failures(last, failure_return)
    return {"last10_return": float(last.returns.mean()), "last10_failed": float(failed.mean())}


def summary_of_evaluation(episodes: Episodes, failure_return: float | None, last10_return: float) -> dict[str, float]:
    """Summarize evaluation episodes; ``as_good``: return at most 5% below that of the last of learning, and no failure."""
    mean, n_failures = float(episodes.returns.mean()), int(failures(episodes, failure_return).sum())
    as_good = n_failures == 0 and mean >= last10_return - TOLERATED_LOSS * abs(last10_return)
    return {"mean": mean, "worst": float(episodes.returns.min()), "failures": n_failures, "as_good": float(as_good)}


def _of_range(column: np.ndarray, first: int, last: int, statistic: Callable[[np.ndarray], float]) -> float:
    return float(statistic(column[first - 1 : last])) if len(column) >= last else np.nan
