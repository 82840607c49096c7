"""Made-up results of the paper's experiments, and what their tests share."""

import io

import numpy as np
from rich.console import Console

from sb3_combrel import SourceInstances
from sb3_combrel.experiments.paper.runs import Result


def quiet():
    """A console that writes nothing."""
    return Console(file=io.StringIO())


def made_up(domain, method, seed, steps, **others):
    """A result: each step costs 1, and an episode of fewer steps than the longest has ended in a terminal state."""
    steps = [int(n) for n in steps]
    returns = others.pop("returns", [-float(n) for n in steps])
    terminated = [n < max(steps) for n in steps]
    name = f"{domain}_{method}_seed{seed}"
    return Result(name, domain, method, seed, steps, returns, terminated, **others)


def from_equations(n, seed, n_actions=2, d=2, effects=None):
    """Transitions from random states in [0, 1]^d whose effects are given by a function of states and actions."""
    rng = np.random.default_rng(seed)
    states = rng.uniform(0.2, 0.8, size=(n, d))
    actions = np.arange(n) % n_actions
    moves = effects(states, actions)
    return SourceInstances(
        states, actions, -np.ones(n), states + moves, np.zeros(n, dtype=bool), np.zeros(d), np.ones(d), n_actions
    )
