"""A source's own local linear model against a plain computation, and in cases with a known answer."""

import numpy as np
import pytest
from helpers.factored import naive_prediction, oscillate, oscillator_source
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.common.instances import Instances
from sb3_combrel.transfer.candidates import stacked_instances
from sb3_combrel.transfer.source_model import SourceModel


def random_instances(rng, n, d, n_actions):
    return Instances.of_rows(
        n_actions,
        rng.integers(n_actions, size=n),
        rng.random((n, d)),
        0.1 * rng.normal(size=(n, d)),
        rng.normal(size=n),
        rng.random(n) < 0.3,
    )


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(1, 4),
    st.integers(1, 120),
    st.sampled_from([0.05, 0.2, 0.6]),
    st.sampled_from([3, 24]),
    st.sampled_from([0.03, 0.3]),
)
def test_predictions_are_those_of_a_weighted_regression(seed, d, n, breadth, n_neighbors, outcome_breadth):
    rng = np.random.default_rng(seed)
    instances = random_instances(rng, n, d, 2)
    model = SourceModel(instances, breadth, n_neighbors, outcome_breadth)
    states, actions = 1.4 * rng.random((20, d)) - 0.2, rng.integers(2, size=20)
    found = model.predict(states, actions)
    for i, (state, action) in enumerate(zip(states, actions, strict=True)):
        size = instances.size[action]
        if size == 0:
            assert not np.any(found.effect[i]) and found.weight[i] == found.end[i] == found.reward[i] == 0.0
            continue
        of_action = (array[action, :size] for array in instances[:4])
        expected = naive_prediction(*of_action, state, breadth, n_neighbors, outcome_breadth)
        for ours, theirs in zip((found.effect[i], found.reward[i], found.end[i], found.weight[i]), expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-9)


def test_linear_dynamics_are_predicted_almost_exactly():
    model = SourceModel(stacked_instances([oscillator_source()]))
    rng = np.random.default_rng(1)
    states, actions = 0.1 + 0.8 * rng.random((300, 2)), rng.integers(3, size=300)
    # The ridge takes a little of the slopes.
    np.testing.assert_allclose(model.predict(states, actions).effect, oscillate(states, actions), atol=1e-3)


def test_far_from_all_instances_the_nearest_predict_with_next_to_no_weight():
    model = SourceModel(stacked_instances([oscillator_source()]), breadth=0.1)
    inside, far = np.array([[0.5, 0.5]]), np.array([[40.0, -30.0]])
    assert model.predict(inside, np.array([1])).weight[0] > 3.0
    found = model.predict(far, np.array([1]))
    assert found.weight[0] < 1e-12
    assert all(np.isfinite(array).all() for array in found)
    low, high = model.plain[1][:, 1]
    assert (low <= found.effect[0]).all() and (found.effect[0] <= high).all()


def test_at_the_edge_of_its_data_a_source_knows_less_than_amid_them():
    """The same number of instances at the same distances: all around, or all on one side."""
    ring = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 16, endpoint=False)]) * 0.1
    half = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(-1.0, 1.0, 16)]) * 0.1

    def weight_amid(offsets):
        n = len(offsets)
        none = np.zeros(n)
        instances = Instances.of_rows(1, np.zeros(n, dtype=np.int64), 0.5 + offsets, np.zeros((n, 2)), none, none > 0)
        return SourceModel(instances, 0.2).predict(np.array([[0.5, 0.5]]), np.array([0])).weight[0]

    assert weight_amid(ring) == pytest.approx(16 * np.exp(-0.25), rel=1e-6)
    assert weight_amid(half) < 0.2 * weight_amid(ring)
