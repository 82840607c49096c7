"""Bandwidths of compliance and relevance, and the evidence that compliance demands."""

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, choices_of, show
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import COMBREL
from sb3_combrel.mappings.named_sets import InterTaskMapping
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.candidates import Candidates, stacked_instances
from sb3_combrel.transfer.instances.bandwidths import default_bandwidths, start_bandwidths


def line(states, effects, rewards=None, actions=None):
    """Source instances of a task with the variables of ``states``, in the unit box."""
    states, effects = np.array(states, dtype=float), np.array(effects, dtype=float)
    n, d = states.shape
    return SourceInstances(
        states,
        np.zeros(n, dtype=int) if actions is None else np.array(actions),
        -np.ones(n) if rewards is None else np.array(rewards, dtype=float),
        states + effects,
        np.zeros(n, dtype=bool),
        np.zeros(d),
        np.ones(d),
        1 if actions is None else max(actions) + 1,
    )


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 80), st.integers(1, 3))
def test_default_bandwidths_are_what_they_are_said_to_be(seed, n, n_actions):
    source = naive.random_source(np.random.default_rng(seed), n, 2, n_actions)
    units, _, effects, rewards, _ = naive.as_transitions(source)
    to_the_20th = []
    for a in range(n_actions):
        of_action = units[source.actions == a]
        for state in of_action:
            apart = sorted(np.linalg.norm(of_action - state, axis=1))
            if len(apart) > 1:
                to_the_20th.append(apart[min(20, len(apart) - 1)])
    found = default_bandwidths(stacked_instances([source]))
    if to_the_20th:
        assert found.start == pytest.approx(np.median(to_the_20th) ** 2, rel=1e-9)
    assert found.outcome == pytest.approx((effects**2).sum(axis=1).mean(), rel=1e-9)
    if rewards.var() > 0:
        assert found.reward == pytest.approx(rewards.var(), rel=1e-9)


@pytest.mark.parametrize(
    "source",
    [
        line([[0.5]], [[0.0]]),
        line([[0.5]] * 30, [[0.0]] * 30),
        line([[0.1], [0.9]], [[0.0], [0.0]], actions=[0, 2]),
        line([[0.1], [0.9], [0.2]], [[1e-12], [0.0], [1e-12]], rewards=[-1e9, 1e9, 0.0]),
    ],
    ids=["one", "all alike", "one an action", "extremes"],
)
def test_default_bandwidths_are_usable_whatever_the_source(source):
    bandwidths = default_bandwidths(stacked_instances([source]))
    assert all(np.isfinite(b) and b > 0.0 for b in bandwidths)
    transition = naive.Transition(source.states[0], 0, float(source.rewards[0]), source.next_states[0])
    assert 0.0 < naive.compliance(transition, source, InterTaskMapping([0], [0]), bandwidths) <= 1.0


@pytest.mark.parametrize("state", [(0, 0, None), (0, 1, 0), (0, 0, 1), (1, None, None), (0, 1, None)], ids=str)
@pytest.mark.parametrize("given", [0.02, None])
def test_an_instance_as_far_along_each_variable_weighs_the_same_whatever_their_number(state, given):
    rng = np.random.default_rng(0)
    source, n_mapped = naive.random_source(rng, 100, 2, 2), len(state) - state.count(None)
    candidates = Candidates(source, [InterTaskMapping(state, [0])], naive.target_task(np.zeros((1, 3)), 1))
    usual = default_bandwidths(candidates.instances).start if given is None else given
    [found] = start_bandwidths(candidates, usual)
    for along in (0.01, 0.1):
        two, all_mapped = (along * np.sqrt(n) for n in (2, n_mapped))
        assert equations.phi(all_mapped, found) == pytest.approx(equations.phi(two, usual), rel=1e-12)
    assert n_mapped != 2 or found == usual, "to the last bit"


def test_start_bandwidths_are_those_of_each_source():
    rng = np.random.default_rng(1)
    sources, task = [naive.random_source(rng, 30, n, 2) for n in (1, 3)], naive.target_task(np.zeros((1, 3)), 1)
    candidates = Candidates(sources, "all", task)
    n_mapped, [first, second] = (candidates.table.variable >= 0).sum(axis=1), candidates.sets
    expected = 0.3 * n_mapped / np.repeat([1.0, 3.0], [first.n_state_mappings, second.n_state_mappings])
    np.testing.assert_allclose(start_bandwidths(candidates, 0.3), expected, rtol=1e-12)


def test_min_evidence_is_the_sum_of_kernels_below_which_nothing_counts():
    source, transition = line([[0.3], [0.3]], [[0.1], [0.1]]), naive.Transition(np.array([0.4]), 0, -1.0, np.array([0.5]))
    evidence = 2 * np.exp(-0.01 / 0.005)
    task = naive.target_task(np.array([[0.4]]), 1)
    for least, expected in ((0.0, 1.0), (0.99 * evidence, 1.0), (1.01 * evidence, np.nan)):
        arguments = dict(bandwidths=(0.005, 0.01, 1.0), min_evidence=least, min_compliance=0.0)
        method = bound(COMBREL(source, InterTaskMapping([0], [0]), **arguments), task)
        show(method, transition)
        choices_of(method)
        np.testing.assert_allclose(method.chosen_compliance(np.zeros(1, dtype=int)), [expected], rtol=1e-9)
