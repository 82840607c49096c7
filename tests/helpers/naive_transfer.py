"""Transfer by the equations (``sb3_combrel.transfer.equations``), one mapping at a time, and random problems for it."""

from typing import NamedTuple

import numpy as np

from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.mappings.named_sets import InterTaskMapping
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.equations import Bandwidths, TransferRules, Transitions, VirtualSource

LEAST_EVIDENCE = 0.1
"""The package's guard: a mapping whose instances weigh less than this in sum counts for nothing."""


class Transition(NamedTuple):
    """A transition of the target task, unit coordinates."""

    state: np.ndarray
    action: int
    reward: float
    next_state: np.ndarray


def random_source(rng, n, n_variables=2, n_actions=3, spread=1.0):
    """Source instances without any meaning, in a box that is not the unit box."""
    low = rng.uniform(-3.0, 0.0, n_variables)
    high = low + rng.uniform(0.5, 4.0, n_variables)
    states = 0.5 + spread * (rng.random((n, n_variables)) - 0.5)
    return SourceInstances(
        low + (high - low) * states,
        rng.integers(n_actions, size=n),
        np.round(rng.normal(size=n), 1),
        low + (high - low) * (states + 0.1 * rng.normal(size=(n, n_variables))),
        rng.random(n) < 0.2,
        low,
        high,
        n_actions,
    )


def source_of(seed=0, n_variables=2, n_actions=2, n=60):
    return random_source(np.random.default_rng(seed), n, n_variables, n_actions)


def transitions_of(n, n_variables=3, n_actions=2, seed=1):
    rng = np.random.default_rng(seed)
    return [random_transition(rng, n_variables, n_actions) for _ in range(n)]


def places_of(source, instances):
    """Where the package, which has instances in an order of its own, keeps each of the source's."""
    units = source.scaling.to_unit(source.states)
    return np.array(
        [np.flatnonzero((instances.state[a] == unit).all(axis=1))[0] for a, unit in zip(source.actions, units, strict=True)]
    )


def random_transition(rng, n_variables, n_actions, spread=1.0):
    """A transition without any meaning."""
    state = 0.5 + spread * (rng.random(n_variables) - 0.5)
    return Transition(
        state, int(rng.integers(n_actions)), float(np.round(rng.normal(), 1)), state + 0.1 * rng.normal(size=n_variables)
    )


def random_mapping(rng, n_source, n_target, n_source_actions, n_target_actions):
    """Any mapping at all, Nones and mirrored variables included."""
    while True:
        state = [int(i) if i >= 0 else None for i in rng.integers(-1, n_source, n_target)]
        if any(i is not None for i in state):
            break
    action = [int(a) for a in rng.integers(n_source_actions, size=n_target_actions)]
    return InterTaskMapping(state, action, [int(s) for s in rng.choice([-1, 1], n_target)])


def problem(seed, sizes, n_instances=15, n_transitions=12, spread=0.4):
    """A source, a mapping and target transitions without any meaning; ``sizes``: as of :func:`random_mapping`."""
    rng = np.random.default_rng(seed)
    source = random_source(rng, n_instances, sizes[0], sizes[2], spread)
    mapping = random_mapping(rng, *sizes)
    return source, mapping, [random_transition(rng, sizes[1], sizes[3], spread) for _ in range(n_transitions)]


def target_task(sample_states, n_actions, threshold=1.0, min_weight=0.01, min_fraction=0.1):
    """A target task in the unit box."""
    d = sample_states.shape[1]
    return TargetTask(
        scaling=StateScaling(np.zeros(d), np.ones(d)),
        n_actions=n_actions,
        sample_states=sample_states,
        exploration_threshold=threshold,
        min_weight=min_weight,
        min_fraction=min_fraction,
        state_names=tuple(f"s{k}" for k in range(d)),
        action_names=tuple(f"a{k}" for k in range(n_actions)),
    )


def as_transitions(source):
    """Source instances in unit coordinates, in their order."""
    start, end = source.scaling.to_unit(source.states), source.scaling.to_unit(source.next_states)
    return Transitions(start, source.actions, end - start, source.rewards, source.terminated)


def as_sample(transitions, n_variables):
    """Target transitions, one a row."""
    return Transitions(
        np.array([t.state for t in transitions]).reshape(-1, n_variables),
        np.array([t.action for t in transitions], dtype=np.int64),
        np.array([t.next_state - t.state for t in transitions]).reshape(-1, n_variables),
        np.array([t.reward for t in transitions]),
        np.zeros(len(transitions), dtype=bool),
    )


def compliance(transition, source, mapping, bandwidths):
    """Compliance of one transition, with the package's guard."""
    sample = as_sample([transition], len(mapping.state))
    [found] = equations.sample_compliance(sample, as_transitions(source), mapping, Bandwidths(*bandwidths), LEAST_EVIDENCE)
    return float(found)


def transferred(state, own, drawn_from, task, breadth, relevance=None, times_weight=False):
    """What is transferred to a pair: (weight, effect, reward, terminal flag) of each instance, best first; or nothing.

    :param drawn_from: (source, mapping, target action) of each translation that may be drawn from
    :param relevance: function of (place in ``drawn_from``, number of the instance); None: nearest first
    :param times_weight: whether they come in the order of relevance times weight
    """
    parts, relevances = [], []
    for place, (source, mapping, action) in enumerate(drawn_from):
        parts.append(equations.virtual_source(as_transitions(source), mapping, action, state[None]))
        numbers = np.flatnonzero(source.actions == mapping.action[action]).tolist()
        relevances += [0.0 if relevance is None else relevance(place, j) for j in numbers]
    start, *rest = zip(*parts, strict=True)
    pool = VirtualSource(np.concatenate(start, axis=1), *map(np.concatenate, rest))
    rules = TransferRules(breadth, task.exploration_threshold, task.min_weight, task.min_fraction)
    given = None if relevance is None else np.array(relevances)
    numbers, weights = equations.transferred_instances(state, own, pool, rules, given, times_weight)
    rows = zip(weights.tolist(), pool.effect[numbers], pool.reward[numbers], pool.terminated[numbers], strict=True)
    return [(weight, effect, float(reward), bool(end)) for weight, effect, reward, end in rows]
