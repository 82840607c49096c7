"""The mappings that predict best: a control that no learner could have, as it needs the target's transitions beforehand."""

from __future__ import annotations

import numpy as np

from sb3_combrel import InterTaskMapping, MappingSet, SourceInstances

#: Kernel breadth of the predictions that are compared, unit coordinates.
BREADTH = 0.1
# Target transitions whose distances to all instances are held at once.
_CHUNK = 500


def best_mappings(source: SourceInstances, target: SourceInstances, mappings: MappingSet) -> list[InterTaskMapping]:
    """
    Find for each target action the mapping of a set through which the source predicts the target's effects best.

    Predicted is the kernel average of the translated effects, breadth :data:`BREADTH`; a variable that is not mapped keeps its
    value. The error is the mean over transitions and variables of the squared error in parts of the variable's mean squared
    effect, so that a variable counts as much as another.

    :param source: instances of the source task
    :param target: transitions of the target task
    :param mappings: the set
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
        found.append(mappings[mappings.find(int(state_index), action, int(source_action))])
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
