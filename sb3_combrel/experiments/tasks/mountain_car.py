"""The experiment of Section 5.1: Mountain Car in two dimensions is the source of Mountain Car in four."""

from __future__ import annotations

from typing import Any

from sb3_combrel import COMBREL, TIMBREL, FactoredMapping, InterTaskMapping, SourceInstances
from sb3_combrel.transfer.base import Transfer

SOURCE_ID = "combrel/MountainCar2D-v0"
TARGET_ID = "combrel/MountainCar4D-v0"
N_INSTANCES = 1000

# All defaults.
LEARNER: dict[str, Any] = {}

NO_TRANSFER, RANDOM = "no transfer", "random mapping"


def intuitive_mapping() -> list[InterTaskMapping]:
    """Return what a person would choose: Neutral, West and East map the variables of x, South and North those of y."""
    to_source_action = (0, 1, 2, 1, 2)
    along_x = InterTaskMapping(state=(0, None, 1, None), action=to_source_action)
    along_y = InterTaskMapping(state=(None, 0, None, 1), action=to_source_action)
    return [along_x, along_x, along_x, along_y, along_y]


def factored_mapping(n_axes: int) -> FactoredMapping:
    """Return the mapping that a person would choose with ``use="prior"``: for each axis a car of the source."""
    copies = []
    for axis in range(n_axes):
        state: list[int | None] = [None] * (2 * n_axes)
        state[axis], state[n_axes + axis] = 0, 1
        # Actions of the target: Neutral, then to either side along each axis.
        actions = [0] * (1 + 2 * n_axes)
        actions[1 + 2 * axis], actions[2 + 2 * axis] = 1, 2
        copies.append(InterTaskMapping(tuple(state), tuple(actions)))
    return FactoredMapping(tuple(copies))


def methods(source: SourceInstances) -> dict[str, Transfer | None]:
    """Make the transfer methods that are compared, by name: none, with a random mapping, with the right one, and COMBREL."""
    return {
        NO_TRANSFER: None,
        RANDOM: TIMBREL(source, mapping="random", mappings="factored", use="prior"),
        "TIMBREL": TIMBREL(source, mapping=factored_mapping(2), use="prior"),
        "COMBREL": COMBREL(source),
    }


def learn_source(seed: int = 0) -> SourceInstances:
    """Learn the source task by Q-learning and keep 1000 instances of its experience."""
    import combrel_envs  # noqa: F401 - registers the tasks

    return SourceInstances.from_q_learning(SOURCE_ID, n_instances=N_INSTANCES, seed=seed)
