"""Transfer to a task with an angle: what is transferred does not depend on where the angle's origin is."""

import dataclasses

import numpy as np
import pytest
from helpers.asking import bound, transferred_at, transferred_to_pairs
from helpers.ring import PERIODIC, Ring, ring_transitions, shifted

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, SourceInstances
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.transfer.base import TargetTask
from sb3_combrel.transfer.candidates import stacked_instances

N_CELLS = 16
SAME = [InterTaskMapping([0, 1], [0, 1]), InterTaskMapping([0, None], [0, 1]), InterTaskMapping([0, 1], [1, 0])]
METHODS = {
    "TIMBREL": lambda source: TIMBREL(source, SAME[0], breadth=0.15),
    "TIMBREL, pool, relevance": lambda source: TIMBREL(source, "pool", mappings=SAME, breadth=0.15, relevance=True),
    "COMBREL": lambda source: COMBREL(source, SAME, breadth=0.15, neighbor_radius=0.3),
    "COMBREL, relevance": lambda source: COMBREL(source, SAME, breadth=0.15, relevance=True),
}


def ring_source(cells, n=150):
    """Instances of the ring, the origin moved by some cells."""
    states, actions, rewards, after, terminated = map(np.array, zip(*ring_transitions(7, n), strict=True))
    states, after = shifted(states, cells, N_CELLS), shifted(after, cells, N_CELLS)
    return SourceInstances(states, actions, rewards, after, terminated, [0.0, 0.0], [1.0, 1.0], 2, periodic=tuple(PERIODIC))


def target(periodic=PERIODIC):
    grid = StateGrid(2, (4, 2), 0, periodic)
    return TargetTask(StateScaling([0.0, 0.0], [1.0, 1.0]), 2, grid.points(), 1.0, 0.01, 0.1, ("a", "v"), ("l", "r"), periodic)


def bound_and_shown(method, cells, periodic=PERIODIC):
    """A method, bound to the ring with its origin moved, which has observed some transitions."""
    made = bound(METHODS[method](ring_source(cells)), target(periodic))
    for state, action, reward, after, terminated in ring_transitions(3, 60):
        made.observe(shifted(state, cells, N_CELLS), action, reward, shifted(after, cells, N_CELLS), terminated)
    made.end_episode(False)
    made.changed(np.zeros((2, len(made.task.sample_states)), dtype=bool))
    return made


def given_at(method, states):
    """Lengths, weights in all, and mean effects and rewards for every state and action."""
    rows = []
    for state in states:
        found = transferred_at(method, state, np.zeros(2))
        for row, n in enumerate(found.length[:2]):
            weight = found.weight[row, :n]
            rows.append([n, weight.sum(), *(weight @ found.effect[row, :n]), weight @ found.reward[row, :n]])
    return np.array(rows)


@pytest.mark.parametrize("method", METHODS)
def test_with_another_origin_the_same_is_transferred(method, cells=11):
    one, other = bound_and_shown(method, 0), bound_and_shown(method, cells)
    states = np.random.default_rng(0).random((40, 2))
    expected = given_at(one, states)
    assert (expected[:, 0] > 0).mean() > 0.3
    np.testing.assert_allclose(given_at(other, shifted(states, cells, N_CELLS)), expected, atol=1e-6)
    points = np.arange(len(one.task.sample_states)).reshape(N_CELLS, -1)
    lengths = [transferred_to_pairs(m, p.ravel(), np.zeros(p.size)).length for m, p in ((one, points), (other, points))]
    by_point = [length[: points.size].reshape(points.shape) for length in lengths]
    np.testing.assert_array_equal(by_point[1], np.roll(by_point[0], cells, axis=0))
    one, other = (bound_and_shown(method, each, (False, False)) for each in (0, cells))
    assert np.abs(given_at(one, states) - given_at(other, shifted(states, cells, N_CELLS))).max() > 1e-3


def test_effects_of_a_periodic_source_go_the_short_way():
    source = ring_source(0)
    instances = stacked_instances([source])
    for action, n in enumerate(instances.size):
        assert np.abs(instances.effect[action, :n, 0]).max() < 0.3
    flat = stacked_instances([dataclasses.replace(source, periodic=())])
    assert max(np.abs(flat.effect[action, :n, 0]).max() for action, n in enumerate(flat.size)) > 0.7


def test_the_flags_of_source_instances_are_kept_and_wrong_ones_refused(tmp_path):
    source = ring_source(0)
    assert SourceInstances.load(source.save(tmp_path / "ring")).periodic == tuple(PERIODIC)
    assert source.subset(20, "covering", 0).periodic == tuple(PERIODIC)
    assert dataclasses.replace(source, periodic=()).periodic == (False, False)
    for flags in (True, (True,), (1, 0), "ab"):
        with pytest.raises(ValueError, match="periodic must be None or 2 booleans"):
            dataclasses.replace(source, periodic=flags)


class TellingRing(Ring):
    """A ring that says by itself that its angle is periodic."""

    periodic = tuple(PERIODIC)


def test_recorded_sources_have_the_flags_of_their_task():
    learner = dict(seed=0, resolution=3, model_breadth=0.15)
    of_rmax = SourceInstances.from_fitted_rmax(Ring(), 50, n_episodes=1, periodic=PERIODIC, **learner)
    recorded = SourceInstances.record(None, TellingRing(), 20, seed=0)
    for source in (of_rmax, recorded, SourceInstances.from_q_learning(TellingRing(), 20, seed=0, total_timesteps=30)):
        assert source.periodic == tuple(PERIODIC)
    assert SourceInstances.record(None, Ring(), 20, seed=0).periodic == (False, False)


def test_learning_with_transfer_is_saved_and_goes_on(tmp_path):
    source = SourceInstances.record(None, TellingRing(), 300, seed=0)
    arguments = dict(seed=0, resolution=4, model_breadth=0.12)
    model = FittedRMax(TellingRing(0.2), transfer=METHODS["COMBREL"](source), **arguments).learn(150)
    assert model.agent.transfer.task.periodic == tuple(PERIODIC)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=TellingRing(0.2))
    assert loaded.agent.transfer.sources[0].periodic == loaded.agent.transfer.task.periodic == tuple(PERIODIC)
    loaded.learn(20, reset_num_timesteps=False)
