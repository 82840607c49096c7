"""The experiment of Section 5.2: the iCub's torso is the source of its arm, both striking a ball."""

from __future__ import annotations

from typing import Any

from sb3_combrel import SourceInstances

SOURCE_ID = "combrel/ICubTorsoStrike-v0"
TARGET_ID = "combrel/ICubArmStrike-v0"
N_INSTANCES = 1000
MAX_EPISODE_STEPS = 400

#: Defaults but for the bound of the return: a hit by the first command returns 99.
LEARNER: dict[str, Any] = {"max_value": 100.0}


def learn_source(seed: int = 0) -> SourceInstances:
    """Learn the source task by Fitted R-Max and keep 1000 instances that cover the visited states, hits included."""
    return SourceInstances.from_fitted_rmax(SOURCE_ID, N_INSTANCES, seed, **LEARNER)
