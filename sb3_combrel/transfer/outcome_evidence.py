"""Whether the target's own transitions bear out what a source predicts: ends and rewards, and a warning of wrong effects."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np

from sb3_combrel.sources.source_instances import SourceInstances

# Above the first probability a transition is predicted to end the episode, below the second not to: between them, at the
# border of where episodes end, a kernel average decides nothing.
ENDS, GOES_ON = 0.5, 0.1
# So many steps in a row where an end is predicted, and none comes, contradict it once.
STEPS_OF_A_VISIT = 10
# So many episodes that ran into their time limit, and never an end where one is predicted.
EPISODES_IN_VAIN = 3
# Rewards from which on wrong ones count.
MIN_REWARDS = 10
# So many visits to where an end is predicted, and none has come yet: one or two may be near misses.
MIN_ABSENT = 3
# What is counted, in the order in which it is saved.
COUNTS = ("confirmed", "unpredicted", "absent", "rewards_right", "rewards_wrong", "in_vain", "steps_of_visit")
# Transitions from which on predictions worse than "no change" are warned of.
TRANSITIONS_BEFORE_WARNING = 300


def warn_of_error(sources: Sequence[SourceInstances], n: int, error: float) -> None:
    """Warn that what was transferred predicts ``n`` transitions worse than "no change", by ``error`` times."""
    names = ", ".join(str(source.origin.get("env", source)) for source in sources)
    warnings.warn(
        f"what was transferred from {names} predicts the target worse than that nothing changes: on {n} "
        f"transitions its mean squared error is {error:.2f} times as large; try another mapping or source",
        stacklevel=3,
    )


class OutcomeEvidence:
    """Counts what confirms and what contradicts the ends and rewards that a source predicts, where it has data.

    *Ends.* An episode that ends where that is predicted confirms it. An episode that ends where none is predicted contradicts
    it, and so does each visit to where one is predicted that leaves without an end or stays for long. Visits are counted, not
    steps: the border of where episodes end is blurred in a kernel average.

    *Rewards.* Each transition confirms or contradicts the predicted reward, by whether it is off by more than half a standard
    deviation of the source's rewards plus a tenth of their mean size.

    Both are :attr:`doubted` while ends that were not predicted outnumber those that were by two, or wrong rewards right ones;
    while no predicted end has come but ``MIN_ABSENT`` have failed to; and after ``EPISODES_IN_VAIN`` episodes that ran into
    their time limit without a confirmed end, if all rewards were alike, so that nothing but an end tells states apart.
    Predicted ends are :attr:`ends_believed` once they have come, unless those that did not outnumber them.

    :param rewards: of the source's instances, shape (n,)
    :param threshold: weight from which on the source has data
    :param no_end: weight from which on it says that there is no end; None: the same
    """

    def __init__(self, rewards: np.ndarray, threshold: float, no_end: float | None = None):
        self.tolerance = 0.5 * float(rewards.std()) + 0.1 * float(np.abs(rewards).mean()) + 1e-9
        self.threshold = threshold
        self.no_end = threshold if no_end is None else no_end
        self.forget()

    def forget(self) -> None:
        """Forget all transitions."""
        self.confirmed = 0
        #: Ends that were not predicted.
        self.unpredicted = 0
        #: Visits to where an end is predicted that have left without one, or lasted for long.
        self.absent = 0
        self.rewards_right = 0
        self.rewards_wrong = 0
        self.in_vain = 0
        self.steps_of_visit = 0
        self.reward_range = (np.inf, -np.inf)

    def note(self, weight: float, end: float, predicted_reward: float, reward: float, terminated: bool) -> None:
        """Take in a transition; ``weight``: of the source's data there, ``end``: probability of termination it predicts."""
        self.reward_range = min(self.reward_range[0], reward), max(self.reward_range[1], reward)
        has_data = weight >= self.threshold
        if has_data:
            if abs(reward - predicted_reward) > self.tolerance:
                self.rewards_wrong += 1
            else:
                self.rewards_right += 1
        if terminated:
            if end >= GOES_ON or self.steps_of_visit:
                self.confirmed += 1
            elif weight >= self.no_end:
                self.unpredicted += 1
            self.steps_of_visit = 0
        elif (has_data and end > ENDS) or (self.steps_of_visit and end >= GOES_ON):
            self.steps_of_visit += 1
            self.absent += self.steps_of_visit % STEPS_OF_A_VISIT == 0
        else:
            self._leave()

    def end_episode(self, truncated: bool) -> None:
        """Take in the end of an episode; ``truncated``: by its time limit."""
        if truncated:
            self._leave()
            self.in_vain += self.confirmed == 0

    def _leave(self) -> None:
        self.absent += 0 < self.steps_of_visit < STEPS_OF_A_VISIT
        self.steps_of_visit = 0

    @property
    def contradicted(self) -> int:
        """How often a predicted end did not come, or one came that was not predicted."""
        return self.unpredicted + self.absent

    @property
    def ends_believed(self) -> bool:
        """Whether predicted ends come more often than not, as far as has been seen."""
        return self.confirmed > 0 and self.absent <= self.confirmed

    @property
    def doubted(self) -> bool:
        """Whether the source's ends and rewards are not to be used."""
        low, high = self.reward_range
        rewards = self.rewards_right + self.rewards_wrong
        return (
            self.unpredicted > self.confirmed + 1
            or (self.confirmed == 0 and self.absent >= MIN_ABSENT)
            or (rewards >= MIN_REWARDS and self.rewards_wrong > self.rewards_right)
            or (self.confirmed == 0 and self.in_vain >= EPISODES_IN_VAIN and not high - low > 1e-9)
        )

    def get_state(self) -> np.ndarray:
        """What was counted, float64, shape (9,)."""
        counts = [getattr(self, name) for name in COUNTS]
        return np.array([*counts, *np.clip(self.reward_range, -1e300, 1e300)], dtype=np.float64)

    def set_state(self, state: np.ndarray) -> None:
        """Take over what :meth:`get_state` returned."""
        for name, value in zip(COUNTS, state.tolist(), strict=False):
            setattr(self, name, int(value))
        self.reward_range = float(state[-2]), float(state[-1])
