"""Arguments of the constructor that Stable-Baselines3 defines: order and checks."""

from __future__ import annotations

import inspect
import math
import reprlib
from collections.abc import Container, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy

from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy

DEFAULT_POLICY = "FittedRMaxPolicy"
# NumPy's and PyTorch's generators take no larger seeds.
MAX_SEED = 2**32 - 1


def policy_and_env(policy: Any, env: Any, aliases: Container[str]) -> tuple[Any, Any]:
    """Policy and environment: of the constructor's first two arguments the policy may be the first, the second or none.

    :raises ValueError: if none of two is a policy
    """
    if _is_policy(policy, aliases):
        return policy, env
    if env is None or _is_policy(env, aliases):
        return (DEFAULT_POLICY if env is None else env), policy
    raise ValueError(
        "the first arguments must be an environment, or a policy and an environment, and others be given by name, such as "
        f"transfer=COMBREL(source), got {reprlib.repr(policy)} and {reprlib.repr(env)}"
    )


def _is_policy(thing: Any, aliases: Container[str]) -> bool:
    if isinstance(thing, str):
        return thing in aliases or (thing.endswith("Policy") and thing.isidentifier())
    return isinstance(thing, type) and issubclass(thing, BasePolicy)


def check_actions(action_space: spaces.Space[Any]) -> None:
    """:raises ValueError: if actions are not discrete; for continuous ones it says how to make them discrete"""
    if isinstance(action_space, spaces.Discrete):
        return
    message = f"FittedRMax needs Discrete actions, the environment has {action_space}"
    if isinstance(action_space, spaces.Box) and len(action_space.shape) == 1:
        n = action_space.shape[0]
        bins = "5" if n == 1 else f"({', '.join('3' * n)})"
        message += f"; take a few of the continuous ones: env = gymnasium.wrappers.DiscretizeAction(env, bins={bins})"
    if isinstance(action_space, spaces.MultiDiscrete | spaces.MultiBinary) and len(action_space.shape) == 1:
        sizes = np.broadcast_to(getattr(action_space, "nvec", 2), action_space.shape).tolist()
        start = np.broadcast_to(getattr(action_space, "start", 0), action_space.shape).tolist()
        message += (
            "; number the combinations: env = gymnasium.wrappers.TransformAction(env, lambda action: "
            f"numpy.array(numpy.unravel_index(action, {tuple(sizes)})){f' + {start}' if any(start) else ''}, "
            f"gymnasium.spaces.Discrete({math.prod(sizes)}))"
        )
    raise ValueError(message)


def check_type(name: str, value: object, types: tuple[type, ...], right: str) -> None:
    """:raises ValueError: unless ``value`` is of one of the types, which the message calls ``right``"""
    if not isinstance(value, types):
        raise ValueError(f"{name} must be {right}, got {value!r}")


def check_policy(policy: type[BasePolicy], policy_kwargs: object, taken: Sequence[str]) -> None:
    """:param taken: arguments of the policy that the algorithm itself passes
    :raises ValueError: if it is no policy of this algorithm, or ``policy_kwargs`` are no dict of arguments that it takes
    """
    if not issubclass(policy, FittedRMaxPolicy):
        raise ValueError(f"policy must be FittedRMaxPolicy or a subclass, got {policy.__name__}")
    check_type("policy_kwargs", policy_kwargs, (Mapping,), "a dict of arguments of the policy or None")
    parameters = {**inspect.signature(policy).parameters, **inspect.signature(FittedRMaxPolicy).parameters}
    known = [name for name, each in parameters.items() if each.kind is not each.VAR_KEYWORD and name not in taken]
    for name in policy_kwargs:  # type: ignore[attr-defined]
        if name in taken:
            raise ValueError(f"policy_kwargs must not have {name!r}: pass {name}=... to FittedRMax itself")
        if name not in known:
            close = did_you_mean(name, known)
            raise ValueError(f"policy_kwargs must have names out of {', '.join(known)}, got {name!r}{close}")
