"""Whether and where the target's own transitions bear out what a source predicts: effects, ends and rewards."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.report import MIN_IN_PART, Contradiction

# Above the first probability a transition is predicted to end the episode, below the second not to: between them, at the
# border of where episodes end, a kernel average decides nothing.
ENDS, GOES_ON = 0.5, 0.1
STEPS_OF_A_VISIT = 10  # so many steps in a row where an end is predicted, and none comes, contradict it once
# What is counted, in the order in which it is saved.
COUNTS = ("confirmed", "unpredicted", "absent", "rewards_right", "rewards_wrong")
TRANSITIONS_BEFORE_WARNING = 300  # transitions from which on predictions worse than "no change" are warned of
N_PARTS = 4  # each state variable's range is divided into so many parts
MAX_CONTRADICTIONS = 8
NO_MOVEMENT = 1e-18  # effects are squared unit coordinates; less than this is no movement
_N, _ERROR, _EFFECT, _WORSE = range(4)


def warn_of_error(sources: Sequence[SourceInstances], n: int, error: float) -> None:
    """Warn that what was transferred predicts ``n`` transitions worse than "no change", by ``error`` times."""
    names = ", ".join(str(source.origin.get("env") or "an unnamed task") for source in sources)
    warn_user(
        f"what was transferred from {names} predicts the target worse than that nothing changes: on {n} "
        f"transitions its mean squared error is {error:.2f} times as large; try another mapping or source",
    )


class OutcomeEvidence:
    """Counts what confirms and what contradicts the ends and rewards that transferred instances predict, where there are any.

    *Ends.* An episode that ends where that is predicted confirms it. An episode that ends where none is predicted contradicts
    it, and so does each visit to where one is predicted that leaves without an end or stays for long. Visits are counted, not
    steps: the border of where episodes end is blurred in a kernel average.

    *Rewards.* Each transition confirms or contradicts the predicted reward, by whether it is off by more than half a standard
    deviation of the source's rewards plus a tenth of their mean size.
    """

    def __init__(self, rewards: np.ndarray):
        self.tolerance = 0.5 * float(rewards.std()) + 0.1 * float(np.abs(rewards).mean()) + 1e-9
        # Unpredicted: ends; absent: visits to where an end is predicted that have left without one, or lasted for long.
        self.confirmed = self.unpredicted = self.absent = 0
        self.rewards_right = self.rewards_wrong = 0
        #: Number of the environment that the next transition is from; and the steps of its visit, by environment.
        self.environment = 0
        self._visits: Counter[int] = Counter()
        self.reward_range = (np.inf, -np.inf)

    @property
    def steps_of_visit(self) -> int:
        """How long the environment has been where an end is predicted."""
        return self._visits[self.environment]

    def note(self, predicted: tuple[float, float] | None, reward: float, terminated: bool) -> None:
        """Take in a transition; ``predicted``: probability of termination, and reward; None where the source has no data."""
        self.reward_range = min(self.reward_range[0], reward), max(self.reward_range[1], reward)
        end, predicted_reward = predicted or (0.0, 0.0)
        if predicted is not None:
            wrong = bool(abs(reward - predicted_reward) > self.tolerance)
            self.rewards_wrong, self.rewards_right = self.rewards_wrong + wrong, self.rewards_right + (not wrong)
        if terminated:
            if end >= GOES_ON or self.steps_of_visit:
                self.confirmed += 1
            elif predicted is not None:
                self.unpredicted += 1
            self._visits[self.environment] = 0
        elif end > ENDS or (self.steps_of_visit and end >= GOES_ON):
            self._visits[self.environment] += 1
            self.absent += self.steps_of_visit % STEPS_OF_A_VISIT == 0
        else:
            self._leave()

    def end_episode(self, truncated: bool) -> None:
        """Take in the end of an episode; ``truncated``: by its time limit."""
        if truncated:
            self._leave()

    def break_off(self) -> None:
        """Forget the visits that were going on."""
        self._visits.clear()

    def _leave(self) -> None:
        self.absent += 0 < self.steps_of_visit < STEPS_OF_A_VISIT
        self._visits[self.environment] = 0

    @property
    def contradicted(self) -> int:
        """How often a predicted end did not come, or one came that was not predicted."""
        return self.unpredicted + self.absent

    def get_state(self) -> np.ndarray:
        """What was counted, float64, shape (7,)."""
        counts = [getattr(self, name) for name in COUNTS]
        return np.array([*counts, *np.clip(self.reward_range, -1e300, 1e300)], dtype=np.float64)

    def set_state(self, state: np.ndarray) -> None:
        """Take over what :meth:`get_state` returned."""
        for name, value in zip(COUNTS, state.tolist(), strict=False):
            setattr(self, name, int(value))
        self.reward_range = float(state[-2]), float(state[-1])

    @property
    def visits(self) -> np.ndarray:
        """Each environment that is where an end is predicted, and its steps there; float64, shape (n, 2)."""
        return np.array([visit for visit in self._visits.items() if visit[1]], dtype=np.float64).reshape(-1, 2)

    @visits.setter
    def visits(self, rows: np.ndarray) -> None:
        self._visits = Counter({int(environment): int(steps) for environment, steps in rows})


class RegionErrors:
    """Sums of squared prediction errors and squared effects, by target action and by part of each state variable's range."""

    def __init__(self, task: TargetTask):
        self.task = task
        #: Number of transitions, squared errors, squared effects, and number of those whose error is the larger one; shape
        #: (n_actions, n_variables, N_PARTS, 4).
        self.sums = np.zeros((task.n_actions, task.n_variables, N_PARTS, 4))
        self._variables = np.arange(task.n_variables)

    def note(self, state: np.ndarray, action: int, effect: np.ndarray, predicted: np.ndarray) -> None:
        """Add a transition whose effect was ``predicted``; unit coordinates."""
        # At every step: for so few numbers plain Python is faster than NumPy.
        part = [min(max(int(unit * N_PARTS), 0), N_PARTS - 1) for unit in state.tolist()]
        error, moved = (sum(number * number for number in each.tolist()) for each in (effect - predicted, effect))
        self.sums[action, self._variables, part] += 1.0, error, moved, error > moved

    @property
    def of_actions(self) -> np.ndarray:
        """Sums by target action: number, squared error, squared effect, number that are worse; shape (n_actions, 4)."""
        return self.sums[:, 0].sum(axis=1)  # each transition is in one part of every variable

    def errors(self) -> np.ndarray:
        """Return the mean squared error over that of "no change", by target action, NaN where nothing moved."""
        return _ratio(self.of_actions)

    def error(self) -> float:
        """Return the same over all actions."""
        return float(_ratio(self.of_actions.sum(axis=0)))

    def contradictions(self) -> tuple[Contradiction, ...]:
        """Return the parts in which predictions are worse than "no change", the largest excess of squared error first."""
        excess = self.sums[..., _ERROR] - self.sums[..., _EFFECT]
        worse = (self.sums[..., _N] >= MIN_IN_PART) & (excess > NO_MOVEMENT)
        order = sorted(map(tuple, np.argwhere(worse).tolist()), key=lambda cell: -excess[cell])
        return tuple(self._contradiction(*cell) for cell in order[:MAX_CONTRADICTIONS])

    def by_part(self) -> np.ndarray:
        """Return the error over that of "no change" by part, shape (n_actions, n_variables, N_PARTS).

        NaN where too few transitions were compared; infinite where nothing moved and the source says that something does.
        """
        nothing_moved = np.where(self.sums[..., _ERROR] > NO_MOVEMENT, np.inf, np.nan)
        return np.where(self.sums[..., _N] >= MIN_IN_PART, _ratio(self.sums, nothing_moved), np.nan)

    def edges(self) -> dict[str, np.ndarray]:
        """Return, by state variable, where its parts begin and end, raw units, each of shape (N_PARTS + 1,)."""
        low, high = self.task.scaling.low, self.task.scaling.high
        return {name: np.linspace(low[k], high[k], N_PARTS + 1) for k, name in enumerate(self.task.state_names)}

    def report_fields(self) -> dict[str, Any]:
        """Return the fields of a report that say how the target's effects compare with what was predicted of them."""
        totals = self.of_actions.sum(axis=0)
        return {"n_compared": int(totals[_N]), "n_worse": int(totals[_WORSE]), "contradictions": self.contradictions()}

    def _contradiction(self, action: int, variable: int, part: int) -> Contradiction:
        n, error = int(self.sums[action, variable, part, _N]), float(self.by_part()[action, variable, part])
        low, high = (float(bound[variable]) for bound in (self.task.scaling.low, self.task.scaling.high))
        width = (high - low) / N_PARTS
        names = self.task.action_names[action], self.task.state_names[variable]
        return Contradiction(*names, low=low + part * width, high=low + (part + 1) * width, n_compared=n, error=error)


def _ratio(sums: np.ndarray, nothing_moved: float | np.ndarray = np.nan) -> np.ndarray:
    """The squared error over that of "no change", from :attr:`RegionErrors.sums`; where nothing moved something else."""
    moved = sums[..., _EFFECT] > NO_MOVEMENT
    return np.where(moved, sums[..., _ERROR] / np.where(moved, sums[..., _EFFECT], 1.0), nothing_moved)
