"""Mappings that TIMBREL is given: a known mapping is found, and errors are those of a plain loop."""

import numpy as np
import pytest
from helpers.paper_results import from_equations

from sb3_combrel import InterTaskMapping, MappingSet, SourceInstances
from sb3_combrel.experiments.paper import mappings as of_paper
from sb3_combrel.experiments.paper.mappings import BREADTH, best_mappings, most_frequent_mapping

SOURCE = (("pitch", "yaw"), ("S1-", "S1+", "S2-", "S2+"))
TARGET = (("a", "b", "c"), ("T1-", "T1+"))
USES = [
    *[("T1-", "S1-", "a<-pitch, c<-(-yaw)", "", 4), ("T1-", "S2+", "a<-pitch, c<-(-yaw)", "", 2)],
    *[("T1-", "S2+", "a<-yaw, b<-pitch", "", 5), ("T1+", "S1+", "a<-yaw, b<-pitch", "", 1)],
    # Of another run.
    ("T1-", "S1-", "a<-pitch, c<-(-yaw)", "", 2),
]


class TestMostFrequent:
    def test_it_is_the_state_mapping_used_most_with_its_own_actions(self):
        # T1+ was never seen through it: what stood for it otherwise takes its place.
        expected = InterTaskMapping(state=(0, None, 1), action=(0, 1), sign=(1, 1, -1))
        assert most_frequent_mapping(USES, SOURCE, TARGET) == expected

    def test_an_action_never_seen_through_it_is_counted_over_all_state_mappings(self):
        others = [("T1+", "S1+", "a<-yaw", "", 2), ("T1+", "S2-", "b<-yaw", "", 3), ("T1+", "S1+", "c<-yaw", "", 2)]
        for uses in ([*USES, *others], [*USES, *reversed(others)]):
            # S1+ stood for it 1 + 2 + 2 times.
            assert most_frequent_mapping(uses, SOURCE, TARGET).action == (0, 1)


def of_the_source(states, actions):
    """The first action moves along the slope of the first variable, the second turns both."""
    first = np.stack([0.1 * states[:, 0], np.zeros(len(states))], axis=1)
    return np.where(actions[:, None] == 0, first, np.stack([0.05 - 0.1 * states[:, 1], 0.08 * states[:, 0]], axis=1))


def seen_through(mapping, n, seed):
    """Transitions of a target that is the source seen through a mapping; what is not mapped stays as it is."""

    def effects(states, actions):
        moves = of_the_source(mapping.target_to_source(states, 2), np.array(mapping.action)[actions])
        return mapping.displacement_to_target(moves)

    return from_equations(n, seed, len(mapping.action), len(mapping.state), effects)


@pytest.fixture(scope="module")
def source():
    return from_equations(800, 0, effects=of_the_source)


class TestBest:
    @pytest.mark.parametrize(
        "mapping",
        [
            InterTaskMapping(state=(0, None, 1), action=(0, 1, 1)),
            InterTaskMapping(state=(1, 0, None), action=(1, 1, 0), sign=(-1, 1, 1)),
            InterTaskMapping(state=(None, 0, 1), action=(1, 1, 1), sign=(1, -1, -1)),
        ],
    )
    def test_a_target_that_is_the_source_seen_through_a_mapping_reveals_it(self, source, mapping, monkeypatch):
        # Predictions in several parts are those of all at once.
        monkeypatch.setattr(of_paper, "_CHUNK", 37)
        found = best_mappings(source, seen_through(mapping, 600, 1), MappingSet.from_name("signed_injective", 2, 3, 2, 3))
        assert len(found) == 3
        for action, one in enumerate(found):
            assert one.action[action] == mapping.action[action]
            if mapping.action[action] == 1:
                assert (one.state, one.sign) == (mapping.state, mapping.sign)
            else:
                # This source action moves one variable: where the other is mapped to makes no difference to what is moved.
                moved = mapping.state.index(0)
                assert (one.state[moved], one.sign[moved]) == (0, mapping.sign[moved])

    def test_it_is_that_of_the_least_error_of_a_plain_loop(self):
        rng = np.random.default_rng(3)

        def anything(states, actions):
            # Of different size in each variable: errors are in parts of it.
            size = np.array([0.1, 0.03, 0.003])[: states.shape[1]]
            return size * (np.sin(7.0 * states + actions[:, None]) + 0.2 * rng.normal(size=states.shape))

        source = from_equations(60, 4, effects=anything)
        unit = from_equations(50, 5, n_actions=3, d=3, effects=anything)
        # Raw units of their own: errors are of unit coordinates.
        states, next_states = 4.0 * unit.states - 1.0, 4.0 * unit.next_states - 1.0
        rest = unit.terminated, -np.ones(3), 3.0 * np.ones(3), 3
        target = SourceInstances(states, unit.actions, unit.rewards, next_states, *rest)
        mappings = MappingSet.from_name("signed_injective", 2, 3, 2, 3)
        for action, one in enumerate(best_mappings(source, target, mappings)):
            errors = {}
            for mapping in mappings:
                # The error of an action depends on the source action of that action alone.
                key = mapping.state, mapping.sign, mapping.action[action]
                if key not in errors:
                    errors[key] = plain_error(source, unit, mapping, action)
                if len(errors) == len(mappings.candidates(action)[0]):
                    break
            assert (one.state, one.sign, one.action[action]) == min(errors, key=errors.get)

    def test_a_source_action_without_instances_is_never_best(self, source):
        rows = source.actions == 0
        columns = (getattr(source, name)[rows] for name in ("states", "actions", "rewards", "next_states", "terminated"))
        only_first = SourceInstances(*columns, source.low, source.high, 2)
        target = seen_through(InterTaskMapping(state=(0, None, 1), action=(1, 1, 1)), 90, 2)
        found = best_mappings(only_first, target, MappingSet.from_name("injective", 2, 3, 2, 3))
        assert [one.action[action] for action, one in enumerate(found)] == [0, 0, 0]


def plain_error(source, target, mapping, action):
    """The error of a mapping's predictions of one action, transition by transition; all in unit coordinates."""
    errors, squares = np.zeros(target.n_variables), np.zeros(target.n_variables)
    for t in np.flatnonzero(target.actions == action):
        effect = target.next_states[t] - target.states[t]
        total, moved = 0.0, np.zeros(target.n_variables)
        for i in np.flatnonzero(source.actions == mapping.action[action]):
            start, move = source.states[i], source.next_states[i] - source.states[i]
            square, translated = 0.0, np.zeros(target.n_variables)
            for v, (w, sign) in enumerate(zip(mapping.state, mapping.sign, strict=True)):
                if w is not None:
                    square += (target.states[t][v] - (start[w] if sign > 0 else 1.0 - start[w])) ** 2
                    translated[v] = sign * move[w]
            weight = np.exp(-square / BREADTH**2)
            total += weight
            moved += weight * translated
        errors += (effect - moved / total) ** 2
        squares += effect**2
    return np.mean(errors / squares)
