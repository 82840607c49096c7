"""What environments say of themselves in attributes, their own or those of a wrapper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_combrel.common.user_warnings import warn_user


def attribute(env: Any, name: str) -> Any:
    """An attribute of an environment, of a vectorised one the first's; None if there is none."""
    if not hasattr(env, "get_wrapper_attr"):
        # Asking a SubprocVecEnv for an attribute that is not there would end its worker.
        return env.get_attr(name, 0)[0] if env.has_attr(name) else None
    try:
        return env.get_wrapper_attr(name)
    except AttributeError:
        return None


def names_of(env: Any) -> dict[str, list[str]]:
    """Names of state variables and of actions, where an environment has as many of them as it must have."""
    return {name: names for name in ("state_names", "action_names") if (names := list_of(env, name, str))}


def periodic_of(env: Any) -> list[bool] | None:
    """Which state variables are periodic, where an environment says so in its attribute ``periodic``."""
    return [bool(flag) for flag in list_of(env, "periodic", bool, np.bool_) or ()] or None


def list_of(env: Any, name: str, *types: type) -> list[Any] | None:
    """An attribute, if it is a value for each state variable, or for each action; a warning if it is something else."""
    what = "action" if name == "action_names" else "variable"
    n = int(getattr(env.action_space, "n", 0) if what == "action" else (env.observation_space.shape or (0,))[0])
    value = attribute(env, name) if n > 0 else None
    is_list = isinstance(value, Sequence | np.ndarray) and not isinstance(value, str)
    if value is None or (is_list and len(value) == 0):
        return None
    if is_list and len(value) == n and all(isinstance(each, types) for each in value):
        return list(value)
    warn_user(
        f"the environment's {name}={value!r} is not one {types[0].__name__} for each of the {n} {what}s, and is ignored: an "
        f"environment may leave it out{', and FittedRMax(env, periodic=[...]) says it' if name == 'periodic' else ''}"
    )
    return None
