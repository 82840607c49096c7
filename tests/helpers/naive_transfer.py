"""Transfer as the paper's equations read: plain loops, one mapping and one instance at a time, nothing shared or stored.

Written from the equations and from the text, not from the package's compiled loops; states are translated by
``InterTaskMapping.source_to_target`` throughout. Everything is in unit coordinates.
"""

import math
from typing import NamedTuple

import numpy as np

from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.mappings.named_sets import InterTaskMapping
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.base import TargetTask

LEAST_EVIDENCE = 0.1
"""The package's guard: a mapping whose instances weigh less than this in sum counts for nothing."""


class Transition(NamedTuple):
    """A transition of the target task."""

    state: np.ndarray
    action: int
    reward: float
    next_state: np.ndarray


class Translated(NamedTuple):
    """A source instance as it appears in the target task, to an agent in a certain state."""

    start: np.ndarray
    reward: float
    end: np.ndarray
    terminated: bool
    number: int


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


def distance(a, b):
    """Euclidean."""
    return math.sqrt(sum((x - y) ** 2 for x, y in zip(a, b, strict=True)))


def phi(x, delta):
    """The Gaussian kernel of Section 2.3."""
    return math.exp(-(x**2) / delta)


def translated(source, mapping, action, state, numbers=None):
    """The virtual source task's instances with a target action (Section 5.1), seen from ``state``.

    :param numbers: of the only instances that are looked at; None for all
    """
    found = []
    for j in range(len(source)) if numbers is None else numbers:
        if mapping.action[action] == source.actions[j]:
            start, end = (
                mapping.source_to_target((raw - source.low) / (source.high - source.low), state)
                for raw in (source.states[j], source.next_states[j])
            )
            found.append(Translated(start, float(source.rewards[j]), end, bool(source.terminated[j]), j))
    return found


def compliance(transition, source, mapping, bandwidths):
    """Eqs. 2 and 5, without Z^P and Z^R, which all mappings share."""
    s, a, r, s_next = transition
    instances = translated(source, mapping, a, s)
    phis = [phi(distance(s, one.start), bandwidths.start) for one in instances]
    if sum(phis) < LEAST_EVIDENCE:
        return 0.0
    of_transitions = of_rewards = 0.0
    for weight, one in zip(phis, instances, strict=True):
        w = weight / sum(phis)
        of_transitions += w * phi(distance(s_next, s + (one.end - one.start)), bandwidths.outcome)
        of_rewards += w * phi(abs(r - one.reward), bandwidths.reward)
    return of_transitions * of_rewards


def whole_compliance(transitions, source, mapping, bandwidths):
    """Eq. 6, but for the prior, which all mappings share."""
    return sum(compliance(t, source, mapping, bandwidths) for t in transitions) / len(transitions)


def relevance(source, j, mapping, action, transitions, bandwidths, mu):
    """Eqs. 4 and 7 for source instance j, translated for target action ``action``."""
    seen = []
    for transition in transitions:
        if transition.action == action:
            [one] = translated(source, mapping, action, transition.state, [j])
            apart = distance(transition.state, one.start)
            seen.append((phi(apart, bandwidths.start), apart, transition, one))
    total = sum(weight for weight, *_ in seen)
    if total == 0.0:
        return 1.0
    of_transitions = of_rewards = gathered = 0.0
    for weight, _, (s, _, r, s_next), one in seen:
        of_transitions += weight / total * phi(distance(s_next, s + (one.end - one.start)), bandwidths.outcome)
        of_rewards += weight / total * phi(abs(r - one.reward), bandwidths.reward)
    apart = []
    for weight, along, *_ in sorted(seen, key=lambda entry: -entry[0]):
        gathered += weight
        if apart and gathered >= mu * total * (1.0 - 1e-12):
            break
        apart.append(along)
    off, d = of_transitions * of_rewards - 1.0, sum(apart) / len(apart)
    return 1.0 if off == 0.0 else 0.0 if d == 0.0 else math.exp(-((off / d) ** 2))


def near_relevances(source, mapping, action, transitions, bandwidths):
    """The relevance that does not favour distant instances, of all instances translated for a target action, by number."""
    evidence, complied = {}, {}
    for j in np.flatnonzero(source.actions == mapping.action[action]).tolist():
        weights, of_transitions, of_rewards = [], [], []
        for s, a, r, s_next in transitions:
            if a == action:
                [one] = translated(source, mapping, action, s, [j])
                weights.append(phi(distance(s, one.start), bandwidths.start))
                of_transitions.append(phi(distance(s_next, s + (one.end - one.start)), bandwidths.outcome))
                of_rewards.append(phi(abs(r - one.reward), bandwidths.reward))
        evidence[j] = sum(weights)
        complied[j] = 0.0
        if evidence[j] > 0.0:
            mean = [sum(w * x for w, x in zip(weights, of, strict=True)) for of in (of_transitions, of_rewards)]
            complied[j] = mean[0] / evidence[j] * mean[1] / evidence[j]
    everything = sum(evidence.values())
    typical = sum(evidence[j] * complied[j] for j in evidence) / everything if everything > 0.0 else 1.0
    return {j: (evidence[j] * complied[j] + typical) / (evidence[j] + 1.0) for j in evidence}


def transferred(state, own, drawn_from, task, breadth, relevance=None, times_weight=False):
    """What is transferred to a pair: (weight, effect, reward, terminal flag) of each instance, best first; or nothing.

    :param drawn_from: (source, mapping, target action) of each translation that may be drawn from
    :param relevance: function of (place in ``drawn_from``, number of the instance); None: nearest first
    :param times_weight: whether they come in the order of relevance times weight
    """
    gathered = []
    for place, (source, mapping, action) in enumerate(drawn_from):
        for one in translated(source, mapping, action, state):
            weight = math.exp(-(distance(state, one.start) ** 2) / breadth**2)
            if weight >= task.min_weight:
                rank = weight if relevance is None else relevance(place, one.number)
                rank *= weight if times_weight else 1.0
                gathered.append((rank, weight, one.end - one.start, one.reward, one.terminated))
    chosen, total = [], own
    for _, weight, *what in sorted(gathered, key=lambda entry: -entry[0]):
        if total >= task.exploration_threshold or (relevance is None and weight < task.min_fraction * total):
            break
        chosen.append((weight, *what))
        total += weight
    return chosen if total >= task.exploration_threshold else []
