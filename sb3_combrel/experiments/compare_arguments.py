"""Checks of the arguments of :func:`~sb3_combrel.experiments.compare.compare`, before any run."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Any

from gymnasium.envs.registration import EnvSpec

from sb3_combrel.common.checks import as_count
from sb3_combrel.experiments.compared_runs import MakeEnv
from sb3_combrel.fitted_rmax.arguments import MAX_SEED
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.sources.recipes import task_spec
from sb3_combrel.transfer.base import Transfer

# What ``compare`` passes to the learner itself.
_TAKEN = ("env", "transfer", "seed", "_init_setup_model")


def check_methods(methods: Any, baseline: Any) -> str:
    """
    Return the baseline's name.

    :param methods: should be a dict from names to transfer methods or None
    :param baseline: one of its names; None: the one without transfer
    :raises ValueError: if they are not
    """
    if not isinstance(methods, Mapping) or not all(isinstance(name, str) for name in methods):
        raise ValueError(f"methods must be a dict from names to transfer methods, got {methods!r}")
    if len(methods) < 2:
        raise ValueError(
            f'methods must have at least two, such as {{"none": None, "COMBREL": COMBREL(source)}}, got {methods!r}'
        )
    for name, transfer in methods.items():
        if not (transfer is None or isinstance(transfer, Transfer | dict | str)):
            raise ValueError(f"methods must be transfer methods or None for no transfer, got {transfer!r} for {name!r}")
    without = [name for name, transfer in methods.items() if transfer is None]
    if baseline is None:
        if len(without) != 1:
            raise ValueError(f"baseline must be one of {', '.join(methods)}, as {len(without)} methods are without transfer")
        return without[0]
    if baseline not in methods:
        raise ValueError(f"baseline must be one of {', '.join(methods)}, got {baseline!r}")
    return str(baseline)


def check_seeds(seeds: Any) -> list[int]:
    """
    Return the seeds.

    :param seeds: their number, or the seeds themselves
    :raises ValueError: if they are neither
    """
    if isinstance(seeds, Sequence) and not isinstance(seeds, str):
        numbers = [as_count("seeds", seed, min=0, max=MAX_SEED) for seed in seeds]
        if not numbers or len(set(numbers)) < len(numbers):
            raise ValueError(f"seeds must be different whole numbers, at least one, got {list(seeds)!r}")
        return numbers
    return list(range(as_count("seeds", seeds)))


def check_learner(learner: Any) -> dict[str, Any]:
    """
    Return further arguments of the learner.

    :param learner: should be a dict of them, or None
    :raises ValueError: if it is not, or has others
    """
    if learner is None:
        return {}
    known = [name for name in inspect.signature(FittedRMax).parameters if name not in _TAKEN]
    if not isinstance(learner, Mapping):
        raise ValueError(f"learner must be a dict of arguments of FittedRMax, got {learner!r}")
    for name in learner:
        if name not in known:
            raise ValueError(f"learner must have arguments out of {', '.join(known)}, got {name!r}")
    return dict(learner)


def task_of(env: Any) -> EnvSpec | MakeEnv:
    """
    Return what makes the environment of each run.

    :param env: id of an environment, or a function that makes one
    :raises ValueError: if it is neither
    """
    if isinstance(env, str):
        spec = task_spec(env)
        if spec is None:
            raise ValueError(f"env must be the id of an environment or a function that makes one; there is no {env!r}")
        return spec
    if not callable(env):
        raise ValueError(
            f"env must be the id of an environment or a function that makes one, as each run has its own, got {env!r}; "
            "for example env=lambda: MyEnv()"
        )
    return env  # type: ignore[no-any-return]
