"""Arguments of the constructor and of ``learn`` that Stable-Baselines3 defines: order and checks."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Container, Mapping, Sequence
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy

from sb3_combrel.common.checks import as_count, check_count, count_text
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy

DEFAULT_POLICY = "FittedRMaxPolicy"
# NumPy's and PyTorch's generators take no larger seeds.
MAX_SEED = 2**32 - 1
# Thousands of years: larger numbers, such as 1e308, are mistakes.
MAX_TIMESTEPS = 10**15


def policy_and_env(policy: Any, env: Any, aliases: Container[str]) -> tuple[Any, Any]:
    """
    Find out which of two arguments is the policy: it may be given first, second or not at all.

    :param policy: the first argument of the constructor
    :param env: the second
    :param aliases: names of policies
    :return: policy and environment
    """
    if _is_policy(policy, aliases):
        return policy, env
    return (env if _is_policy(env, aliases) else DEFAULT_POLICY), policy


def _is_policy(thing: Any, aliases: Container[str]) -> bool:
    if isinstance(thing, str):
        return thing in aliases or (thing.endswith("Policy") and thing.isidentifier())
    return isinstance(thing, type) and issubclass(thing, BasePolicy)


def check_actions(action_space: spaces.Space[Any]) -> int:
    """
    Check that actions are discrete.

    :return: how many there are
    :raises ValueError: if they are not; for continuous ones it says how to make them discrete
    """
    if isinstance(action_space, spaces.Discrete):
        return int(action_space.n)
    message = f"FittedRMax needs Discrete actions, the environment has {action_space}"
    if isinstance(action_space, spaces.Box) and len(action_space.shape) == 1:
        n = action_space.shape[0]
        bins = "5" if n == 1 else f"({', '.join('3' * n)})"
        message += f"; take a few of the continuous ones: env = gymnasium.wrappers.DiscretizeAction(env, bins={bins})"
    raise ValueError(message)


def check_seed(seed: object) -> None:
    """
    :raises ValueError: unless ``seed`` is a whole number that all generators take, or None
    """
    check_count("seed", seed, min=0, max=MAX_SEED, none_allowed=True)


def check_type(name: str, value: object, types: tuple[type, ...], right: str) -> None:
    """
    :param right: what the argument must be, for the message
    :raises ValueError: unless ``value`` is of one of the types
    """
    if not isinstance(value, types):
        raise ValueError(f"{name} must be {right}, got {value!r}")


def check_total_timesteps(total_timesteps: object) -> int:
    """
    Check a number of steps, which may have been written as a float, such as 1e5.

    :return: the number as an int
    :raises ValueError: unless it is a whole number of at least 1, and not absurdly large
    """
    number = as_count("total_timesteps", total_timesteps)
    if number > MAX_TIMESTEPS:
        raise ValueError(f"total_timesteps must be at most {MAX_TIMESTEPS:,}, got {count_text(number)}")
    return number


def check_policy_kwargs(policy_kwargs: object, policy: type[BasePolicy], taken: Sequence[str]) -> None:
    """
    Check arguments for the policy.

    :param policy_kwargs: what the user gave
    :param policy: the class of the policy
    :param taken: arguments of the policy that the algorithm itself passes
    :raises ValueError: if it is no dict, or has arguments that the policy does not take or that the algorithm passes
    """
    if not isinstance(policy_kwargs, Mapping):
        raise ValueError(f"policy_kwargs must be a dict of arguments of the policy or None, got {policy_kwargs!r}")
    policies: tuple[type[BasePolicy], ...] = (policy, FittedRMaxPolicy)
    known = [
        name
        for each in policies
        for name, parameter in inspect.signature(each).parameters.items()
        if parameter.kind is not inspect.Parameter.VAR_KEYWORD and name not in taken
    ]
    for name in policy_kwargs:
        if name in taken:
            raise ValueError(f"policy_kwargs must not have {name!r}: pass {name}=... to FittedRMax itself")
        if name not in known:
            raise ValueError(f"policy_kwargs must have names out of {', '.join(dict.fromkeys(known))}, got {name!r}")


def warn_of_max_value(max_value: float, rewards: Sequence[float], gamma: float) -> bool:
    """
    Warn if a return exceeds ``max_value``: then it is no upper bound, and exploration ends too soon.

    :param max_value: the upper bound on returns that the user gave
    :param rewards: rewards of an episode, or of the end of one
    :param gamma: discount factor
    :return: whether there was anything to warn of
    """
    best, value = -float("inf"), 0.0
    for reward in reversed(rewards):
        value = reward + gamma * value
        best = max(best, value)
    if best <= max_value + 1e-6 * max(1.0, abs(max_value)):
        return False
    warnings.warn(
        f"max_value={max_value:g} must be an upper bound on the return (discounted with gamma={gamma:g}), "
        f"but a return of {best:g} was observed; pass a larger max_value, or the agent will stop exploring too soon",
        stacklevel=3,
    )
    return True
