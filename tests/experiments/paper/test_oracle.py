"""The mappings that predict best: a known mapping is found, and errors are those of a plain loop."""

import numpy as np
import pytest
from helpers.paper_results import from_equations

from sb3_combrel import InterTaskMapping, MappingSet, SourceInstances
from sb3_combrel.experiments.paper.oracle import BREADTH, best_mappings


def of_the_source(states, actions):
    """The first action moves along the slope of the first variable, the second turns both."""
    first = np.stack([0.1 * states[:, 0], np.zeros(len(states))], axis=1)
    second = np.stack([0.05 - 0.1 * states[:, 1], 0.08 * states[:, 0]], axis=1)
    return np.where(actions[:, None] == 0, first, second)


def seen_through(mapping, n, seed):
    """Transitions of a target that is the source seen through a mapping; what is not mapped stays as it is."""
    rng = np.random.default_rng(seed)
    d = len(mapping.state)
    states = rng.uniform(0.2, 0.8, size=(n, d))
    actions = np.arange(n) % len(mapping.action)
    source_states = mapping.target_to_source(states, 2)
    moves = of_the_source(source_states, np.array(mapping.action)[actions])
    next_states = states + mapping.displacement_to_target(moves)
    return SourceInstances(
        states, actions, -np.ones(n), next_states, np.zeros(n, dtype=bool), np.zeros(d), np.ones(d), len(mapping.action)
    )


@pytest.fixture(scope="module")
def source():
    return from_equations(800, 0, effects=of_the_source)


@pytest.mark.parametrize(
    "mapping",
    [
        InterTaskMapping(state=(0, None, 1), action=(0, 1, 1)),
        InterTaskMapping(state=(None, 1, 0), action=(1, 0, 1)),
        InterTaskMapping(state=(1, 0, None), action=(1, 1, 0), sign=(-1, 1, 1)),
        InterTaskMapping(state=(None, 0, 1), action=(1, 1, 1), sign=(1, -1, -1)),
    ],
)
def test_a_target_that_is_the_source_seen_through_a_mapping_reveals_it(source, mapping):
    target = seen_through(mapping, 600, 1)
    found = best_mappings(source, target, MappingSet.from_name("signed_injective", 2, 3, 2, 3))
    assert len(found) == 3
    for action, one in enumerate(found):
        assert one.action[action] == mapping.action[action]
        if mapping.action[action] == 1:
            assert (one.state, one.sign) == (mapping.state, mapping.sign)
        else:
            # This source action moves one variable: where the other is mapped to makes no difference to what is moved.
            moved = mapping.state.index(0)
            assert (one.state[moved], one.sign[moved]) == (0, mapping.sign[moved])


def plain_error(source, target, mapping, action):
    """The error of a mapping's predictions of one action, transition by transition and variable by variable."""
    errors, squares = np.zeros(target.n_variables), np.zeros(target.n_variables)
    for t in np.flatnonzero(target.actions == action):
        s = (target.states[t] - target.low) / (target.high - target.low)
        effect = (target.next_states[t] - target.states[t]) / (target.high - target.low)
        total, moved = 0.0, np.zeros(target.n_variables)
        for i in np.flatnonzero(source.actions == mapping.action[action]):
            u = (source.states[i] - source.low) / (source.high - source.low)
            move = (source.next_states[i] - source.states[i]) / (source.high - source.low)
            square, translated = 0.0, np.zeros(target.n_variables)
            for v, (w, sign) in enumerate(zip(mapping.state, mapping.sign, strict=True)):
                if w is not None:
                    square += (s[v] - (u[w] if sign > 0 else 1.0 - u[w])) ** 2
                    translated[v] = sign * move[w]
            weight = np.exp(-square / BREADTH**2)
            total += weight
            moved += weight * translated
        errors += (effect - moved / total) ** 2
        squares += effect**2
    return np.mean(errors / squares)


def test_the_mapping_found_is_that_of_the_least_error_of_a_plain_loop():
    rng = np.random.default_rng(3)

    def anything(states, actions):
        # Of different size in each variable: errors are in parts of it.
        size = np.array([0.1, 0.03, 0.003])[: states.shape[1]]
        return size * (np.sin(7.0 * states + actions[:, None]) + 0.2 * rng.normal(size=states.shape))

    source = from_equations(60, 4, effects=anything)
    target = from_equations(50, 5, n_actions=3, d=3, effects=anything)
    # Raw units of their own: errors are of unit coordinates.
    target = SourceInstances(
        4.0 * target.states - 1.0,
        target.actions,
        target.rewards,
        4.0 * target.next_states - 1.0,
        target.terminated,
        -np.ones(3),
        3.0 * np.ones(3),
        3,
    )
    mappings = MappingSet.from_name("signed_injective", 2, 3, 2, 3)
    found = best_mappings(source, target, mappings)
    for action, one in enumerate(found):
        errors = {}
        for mapping in mappings:
            # The error of an action depends on the source action of that action alone.
            errors.setdefault(
                (mapping.state, mapping.sign, mapping.action[action]), plain_error(source, target, mapping, action)
            )
            if len(errors) == len(mappings.candidates(action)[0]):
                break
        least = min(errors, key=errors.get)
        assert (one.state, one.sign, one.action[action]) == least


def test_many_transitions_are_predicted_in_parts(source, monkeypatch):
    target = seen_through(InterTaskMapping(state=(0, None, 1), action=(1, 0, 1)), 90, 2)
    mappings = MappingSet.from_name("injective", 2, 3, 2, 3)
    whole = best_mappings(source, target, mappings)
    monkeypatch.setattr("sb3_combrel.experiments.paper.oracle._CHUNK", 7)
    assert best_mappings(source, target, mappings) == whole


def test_a_source_action_without_instances_is_never_best(source):
    only_first = source.actions == 0
    source = SourceInstances(
        source.states[only_first],
        source.actions[only_first],
        source.rewards[only_first],
        source.next_states[only_first],
        source.terminated[only_first],
        source.low,
        source.high,
        2,
    )
    target = seen_through(InterTaskMapping(state=(0, None, 1), action=(1, 1, 1)), 90, 2)
    found = best_mappings(source, target, MappingSet.from_name("injective", 2, 3, 2, 3))
    assert [one.action[action] for action, one in enumerate(found)] == [0, 0, 0]
