"""The transfer methods of the suite, by name, and the source from which each transfers.

``COMBREL@...`` is COMBREL from another recording of the source, see :mod:`~sb3_combrel.experiments.tasks.car_sources`, or from
a source that misleads: the task's own one changed, see :mod:`~sb3_combrel.experiments.tasks.misleading_sources`, or with
``COMBREL@other-domain`` one of another domain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from sb3_combrel import COMBREL, MASTER, TIMBREL, FactoredMapping, InterTaskMapping, MappingExperts, SourceInstances
from sb3_combrel.common.transferred import PriorPredictions
from sb3_combrel.experiments.suite.tasks import CAR_2D, CART_POLE, TORSO, Source, Task
from sb3_combrel.experiments.tasks import cart_pole, icub_arm
from sb3_combrel.experiments.tasks.car_sources import RECORDINGS, q_learning
from sb3_combrel.experiments.tasks.misleading_sources import MISLEADING
from sb3_combrel.experiments.tasks.mountain_car import factored_mapping, intuitive_mapping
from sb3_combrel.transfer.base import Transfer


class EffectsAlone(COMBREL):
    """COMBREL whose source does not bound values."""

    def value_bound(self) -> np.ndarray | None:
        return None


class BoundAlone(COMBREL):
    """COMBREL whose source bounds values, and says nothing of effects."""

    def prior(self, states: np.ndarray, actions: np.ndarray) -> PriorPredictions:
        return PriorPredictions.nothing(len(actions), states.shape[1])


def _misled(change: Callable[[SourceInstances], SourceInstances]) -> Callable[[SourceInstances, str], Transfer]:
    return lambda source, task: COMBREL(change(source))


def _identity(source: SourceInstances) -> InterTaskMapping:
    return InterTaskMapping(range(source.n_variables), range(source.n_actions))


#: The car in two dimensions, recorded by other means or at greater length, by the transfer method's name.
RECORDED: dict[str, Source] = {
    **{f"COMBREL@{name}": Source(f"{CAR_2D.name}-{name}", record) for name, record in RECORDINGS.items()},
    **{f"COMBREL@{n}": Source(f"{CAR_2D.name}-{n}", partial(q_learning, n=n)) for n in (3_000, 10_000)},
}
OTHER_DOMAIN, OWN_DYNAMICS = "COMBREL@other-domain", "own-dynamics"
#: By the name of a task's own source: the source of another domain.
OTHER_DOMAINS: dict[str, Source] = {CAR_2D.name: TORSO, TORSO.name: CAR_2D, CART_POLE.name: CAR_2D}
#: By task: how it moves itself, everywhere, without ends: what the best source of dynamics could tell.
DYNAMICS: dict[str, Source] = {"ICubArm": Source("icub_arm_dynamics", icub_arm.record_dynamics)}

#: The mapping that a person would choose with ``use="prior"``, by task.
ORACLES: dict[str, FactoredMapping] = {
    "MountainCar4D": factored_mapping(2),
    "MountainCar4D-60": factored_mapping(2),
    "MountainCar6D": factored_mapping(3),
    "CartPole-long": FactoredMapping((cart_pole.right_mapping(),)),
}
#: The same with ``use="instances"``: one mapping, or one for each action of the target.
INSTANCE_ORACLES: dict[str, InterTaskMapping | Sequence[InterTaskMapping]] = {
    "MountainCar4D": intuitive_mapping(),
    "MountainCar4D-60": intuitive_mapping(),
    "CartPole-long": cart_pole.right_mapping(),
}
# By the transfer method that needs them.
_ORACLES_OF: dict[str, Mapping[str, object]] = {"oracle": ORACLES, "oracle-instances": INSTANCE_ORACLES}

#: From the name on the command line to a function of (source instances, name of the task).
TRANSFERS: dict[str, Callable[[SourceInstances, str], Transfer]] = {
    "COMBREL": lambda source, task: COMBREL(source),
    "COMBREL-effects": lambda source, task: EffectsAlone(source),
    "COMBREL-bound": lambda source, task: BoundAlone(source),
    "COMBREL-instances": lambda source, task: COMBREL(source, "injective", use="instances"),
    "MASTER": lambda source, task: MASTER(source),
    "MappingExperts": lambda source, task: MappingExperts(source),
    "TIMBREL-random": lambda source, task: TIMBREL(source, "random"),
    "random": lambda source, task: TIMBREL(source, "random", mappings="factored", use="prior"),
    "oracle": lambda source, task: TIMBREL(source, ORACLES[task], use="prior"),
    "oracle-instances": lambda source, task: TIMBREL(source, INSTANCE_ORACLES[task], use="instances"),
    OWN_DYNAMICS: lambda source, task: TIMBREL(source, _identity(source), use="prior", transfer_terminals=False),
    **dict.fromkeys((*RECORDED, OTHER_DOMAIN), lambda source, task: COMBREL(source)),
    **{f"COMBREL@{name}": _misled(change) for name, change in MISLEADING.items()},
}


def source_for(name: str, task: Task) -> Source:
    """Return a transfer method's source: the task's own, another recording of it, or that of another domain.

    :raises ValueError: if there is none
    """
    if task.source is None:
        raise ValueError(f"transfer={name}: the task {task.name} has no source task")
    if name in RECORDED:
        if task.source.name != CAR_2D.name:
            raise ValueError(f"transfer={name}: {CAR_2D.name} is recorded so, and {task.name} learns from {task.source.name}")
        return RECORDED[name]
    if name == OWN_DYNAMICS:
        if task.name not in DYNAMICS:
            raise ValueError(f"transfer={name}: recorded for {', '.join(DYNAMICS)}, got the task {task.name}")
        return DYNAMICS[task.name]
    if name != OTHER_DOMAIN:
        return task.source
    if task.source.name not in OTHER_DOMAINS:
        known = f"known are those for tasks whose own source is one of {', '.join(OTHER_DOMAINS)}, got {task.source.name!r}"
        raise ValueError(f"transfer={name}: for {task.name} no source of another domain is known; {known}")
    return OTHER_DOMAINS[task.source.name]


def check_transfer(name: str, task: Task) -> None:
    """Raise ValueError if the transfer method's name is unknown, or the task has no such source task or known mapping."""
    if name not in TRANSFERS:
        raise ValueError(f"transfer must be one of {', '.join(TRANSFERS)}, got {name!r}")
    source_for(name, task)
    known = _ORACLES_OF.get(name)
    if known is not None and task.name not in known:
        raise ValueError(f"transfer={name}: nobody knows the mapping of {task.name}; known are {', '.join(known)}")
