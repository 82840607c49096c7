"""Sources that mislead: what a transfer method must not lose by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from sb3_combrel.sources.source_instances import SourceInstances

#: Standard deviations of random effects, in parts of the range of each variable. True effects have 0.012 to 0.020, in both
#: sources: the first is a fifth of that, the others twice and twenty times as much.
NOISE: dict[str, float] = {"noise-small": 0.003, "noise": 0.03, "noise-large": 0.3}


def noise(source: SourceInstances, size: float) -> SourceInstances:
    """Effects are random, of a size in parts of each variable's range, and say nothing; successors stay in bounds."""
    rng = np.random.default_rng(0)
    scale = size * (source.scaling.high - source.scaling.low)
    after = source.states + scale * rng.standard_normal(source.states.shape)
    return replace(source, next_states=np.clip(after, source.scaling.low, source.scaling.high))


def shuffled(source: SourceInstances) -> SourceInstances:
    """Each transition has the effect, the reward and the end of another one."""
    order = np.random.default_rng(0).permutation(len(source))
    effect = (source.next_states - source.states)[order]
    after = np.clip(source.states + effect, source.scaling.low, source.scaling.high)
    return replace(source, next_states=after, rewards=source.rewards[order], terminated=source.terminated[order])


def mirrored(source: SourceInstances) -> SourceInstances:
    """Every effect has the other sign."""
    after = np.clip(2.0 * source.states - source.next_states, source.scaling.low, source.scaling.high)
    return replace(source, next_states=after)


def wrong_goal(source: SourceInstances) -> SourceInstances:
    """The dynamics are right; episodes end where the first variable is low instead of where they do."""
    low = np.quantile(source.next_states[:, 0], 0.1)
    return replace(source, terminated=source.next_states[:, 0] <= low)


def wrong_rewards(source: SourceInstances) -> SourceInstances:
    """The dynamics are right, rewards have the other sign."""
    return replace(source, rewards=-source.rewards)


def scaled_rewards(source: SourceInstances) -> SourceInstances:
    """The dynamics are right, rewards are ten times as large."""
    return replace(source, rewards=10.0 * source.rewards)


def few(source: SourceInstances) -> SourceInstances:
    """Twenty instances only."""
    return source.subset(20, seed=0)


#: By name; each makes a misleading source of a good one.
MISLEADING: dict[str, Callable[[SourceInstances], SourceInstances]] = {
    **{name: partial(noise, size=size) for name, size in NOISE.items()},
    "shuffled": shuffled,
    "mirrored": mirrored,
    "wrong-goal": wrong_goal,
    "wrong-rewards": wrong_rewards,
    "scaled-rewards": scaled_rewards,
    "few": few,
}
