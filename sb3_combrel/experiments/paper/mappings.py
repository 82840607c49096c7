"""Mappings that TIMBREL is given: the one that COMBREL used most, and those that predict best."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from sb3_combrel import InterTaskMapping, MappingSet, SourceInstances

#: Kernel breadth of the predictions that are compared, unit coordinates.
BREADTH = 0.1
# Target transitions whose distances to all instances are held at once.
_CHUNK = 500


def most_frequent_mapping(
    uses: Iterable[Sequence[Any]], source_names: Sequence[Sequence[str]], target_names: Sequence[Sequence[str]]
) -> InterTaskMapping:
    """Find the state mapping used most, and for each target action the source action most often used with it, of ``uses``."""
    states: Counter[str] = Counter()
    # (target action, source action, state mapping); and with any state mapping.
    times: Counter[tuple[str, ...]] = Counter()
    for target_action, source_action, state_mapping, _, n in uses:
        states[state_mapping] += n
        times[target_action, source_action, state_mapping] += n
        times[target_action, source_action] += n
    ((variables, _),) = states.most_common(1)
    (source_variables, source_actions), (target_variables, target_actions) = source_names, target_names
    action = []
    for target in target_actions:
        with_these = [times[target, source, variables] for source in source_actions]
        # Never used with this state mapping: counted over all state mappings.
        counts = with_these if any(with_these) else [times[target, source] for source in source_actions]
        action.append(int(np.argmax(counts)))
    pairs = dict(pair.split("<-", 1) for pair in variables.split(", "))
    state = [source_variables.index(pairs[name].strip("()-")) if name in pairs else None for name in target_variables]
    sign = [-1 if pairs.get(name, "").startswith("(-") else 1 for name in target_variables]
    return InterTaskMapping(state=tuple(state), action=tuple(action), sign=tuple(sign))


def best_mappings(source: SourceInstances, target: SourceInstances, mappings: MappingSet) -> list[InterTaskMapping]:
    """Find for each target action the mapping of a set through which the source predicts the target's effects best.

    A control that no learner could have: it needs the target's transitions beforehand.

    Predicted is the kernel average of the translated effects, breadth :data:`BREADTH`; a variable that is not mapped keeps its
    value. The error is the mean over transitions and variables of the squared error in parts of the variable's mean squared
    effect, so that a variable counts as much as another.

    :return: one mapping for each target action; where the source predicts equally well through several, the first
    """
    found = []
    for action in range(target.n_actions):
        rows = target.actions == action
        states = target.scaling.to_unit(target.states[rows])
        effects = target.scaling.to_unit(target.next_states[rows]) - states
        candidates = zip(*mappings.candidates(action), strict=True)
        errors = {pair: _error(source, states, effects, mappings, *pair) for pair in candidates}
        state_index, source_action = min(errors, key=lambda pair: errors[pair])
        found.append(mappings.of_candidate(int(state_index), int(source_action)))
    return found


def _error(
    source: SourceInstances, states: np.ndarray, effects: np.ndarray, mappings: MappingSet, row: int, source_action: int
) -> float:
    """Mean squared error of the effects predicted through one state mapping and source action, in parts of the mean square."""
    variable, sign = mappings.state_mappings[row], mappings.state_signs[row]
    mapped = np.flatnonzero(variable >= 0)
    of_action = source.actions == source_action
    if not of_action.any():
        return np.inf
    starts = source.scaling.to_unit(source.states[of_action])
    moves = source.scaling.to_unit(source.next_states[of_action]) - starts
    mirrored = sign[mapped] < 0
    starts = np.where(mirrored, 1.0 - starts[:, variable[mapped]], starts[:, variable[mapped]])
    moves = sign[mapped] * moves[:, variable[mapped]]
    predicted = np.zeros_like(effects)
    for first in range(0, len(states), _CHUNK):
        at = states[first : first + _CHUNK, mapped]
        distance = ((at[:, None] - starts) ** 2).sum(axis=2)
        # Seen from the nearest: far from all instances the weights would be too small for a quotient.
        weight = np.exp(-(distance - distance.min(axis=1, keepdims=True)) / BREADTH**2)
        predicted[first : first + _CHUNK, mapped] = weight @ moves / weight.sum(axis=1, keepdims=True)
    square = np.maximum((effects**2).mean(axis=0), 1e-12)
    return float((((effects - predicted) ** 2).mean(axis=0) / square).mean())
