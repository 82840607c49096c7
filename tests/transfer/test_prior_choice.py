"""The choice of a mapping by evidence: against all divisions, for mirrored variables, and as drawn."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from helpers import factored as f
from helpers.factored import measured, predicted_by
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sb3_combrel.mappings.state_mappings import copies_of_source, with_mirrored
from sb3_combrel.transfer import equations
from sb3_combrel.transfer.prior import prior_choice
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.prior.evidence import SMALLEST_ERROR


def all_divisions(members):
    """Every set of disjoint copies."""
    for size in range(members.shape[1] + 1):
        for chosen in itertools.combinations(range(len(members)), size):
            if (members[list(chosen)].sum(axis=0) <= 1).all():
                yield chosen


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 9))
def test_the_best_division_is_the_best_of_all(seed, n_variables, n_copies):
    rng = np.random.default_rng(seed)
    members = rng.random((n_copies, n_variables)) < 0.4
    members[~members.any(axis=1), rng.integers(n_variables)] = True
    scores = rng.normal(size=n_copies)
    found = prior_choice.best_division(members, scores)
    assert (members[found].sum(axis=0) <= 1).all()
    assert scores[found].sum() == pytest.approx(max(scores[list(chosen)].sum() for chosen in all_divisions(members)))


def test_the_division_found_has_the_most_evidence_of_all():
    _, copies, sums, (states, actions, effects) = f.measured(2, 30, noise=0.02)
    parts = {}
    for copy in range(len(copies)):
        each = np.array([evidence_of(copies, copy, u, states, effects) for u in range(3)])
        # The best source action of each target action, on its own.
        part = np.empty_like(effects)
        for a in np.unique(actions):
            rows = actions == a
            part[rows] = each[each[:, rows].sum(axis=(1, 2)).argmax()][rows]
        parts[copy] = part

    def score(chosen):
        return equations.division_evidence([parts[c] for c in chosen], actions, [3] * len(chosen), len(copies))

    found = prior_choice.choose_factored(copies, sums)
    chosen = tuple(sorted({c for c in found.copies[0].tolist() if c >= 0}))
    assert score(chosen) == pytest.approx(max(score(d) for d in all_divisions(copies.state >= 0)), rel=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.2, 1.0, 5.0]))
def test_whole_copies_bound_values_unless_the_division_in_use_explains_a_variable_far_better(seed, advantage):
    _, copies, sums, _ = f.measured(2, 5)
    rng = np.random.default_rng(seed)
    sums.gain[:] = rng.random(sums.gain.shape) * 40.0 * (copies.state >= 0)[:, None, None]
    sums.gain[~copies.whole] *= advantage
    scores, (actions, _) = prior_choice.scores_of(copies, sums), prior_choice.best_actions(copies, sums)
    in_use = prior_choice.choose_factored(copies, sums)
    found = prior_choice.choose_whole(copies, sums, in_use)
    of_whole = [chosen for chosen in all_divisions(copies.state >= 0) if copies.whole[list(chosen)].all()]
    best, chosen = max(of_whole, key=lambda each: scores[list(each)].sum()), in_use.same_copies()

    def explained(division, v):
        return sum(sums.gain[copy, a, actions[copy, a], v] for copy in division for a in range(5) if actions[copy, a] >= 0)

    far_better = any(explained(chosen, v) > prior_choice.TELLS_APART * explained(best, v) for v in range(4))
    expected = [copy for copy in chosen if copies.whole[copy]] if far_better else best
    assert sorted(found.same_copies()) == sorted(expected)
    np.testing.assert_array_equal(found.actions, actions[found.same_copies()].T)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("own_image", "mirrored"),
    [(True, (False, False)), (True, (True, True)), *((False, each) for each in itertools.product([False, True], repeat=2))],
)
def test_variables_are_mirrored_where_that_explains_far_more(own_image, mirrored, seed):
    """The oscillator, both variables mirrored, is the same with other actions; what always moves upwards is not."""
    rng = np.random.default_rng(seed)
    effects_of = f.oscillate if own_image else lambda states, actions: 0.1 * states[:, ::-1] ** 2 + np.abs(f.PUSH[actions])
    states, actions = rng.random((60, 2)), rng.integers(3, size=60)
    effects = effects_of(states, actions) + 0.005 * rng.normal(size=states.shape)
    rows, sign = with_mirrored(copies_of_source(2, 2))
    source = f.oscillator_source(200, seed, effects=effects_of)
    copies = Copies([source], np.zeros(len(rows), dtype=np.int64), rows, sign, 0.2)
    sums = CopySums.zero(len(copies), 3, 3, 2)
    for state, action, effect in zip(np.where(mirrored, 1.0 - states, states), actions.tolist(), effects, strict=True):
        copies.measure(state, action, np.where(mirrored, -effect, effect), sums)
    choice = prior_choice.choose_factored(copies, sums)
    chosen = np.unique(choice.copies)
    found = (copies.sign[chosen[chosen >= 0]] < 0.0).any(axis=0)
    np.testing.assert_array_equal(found, (False, False) if own_image else mirrored)
    # The image that effects do not tell from it may bound values in its place.
    [whole] = [copy for copy in chosen.tolist() if copy >= 0]
    images = prior_choice.images_of(copies, prior_choice.scores_of(copies, sums), whole)
    assert [tuple(sign) for sign in copies.sign[images]] == ([(-1, -1)] if own_image else [])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 30))
def test_a_mirrored_copy_is_compared_with_the_best_of_the_same_variables(seed, n_variables, n_copies):
    rng = np.random.default_rng(seed)
    members, mirrored = rng.random((n_copies, n_variables)) < 0.5, rng.random(n_copies) < 0.5
    scores = 10.0 * rng.normal(size=n_copies)
    found = prior_choice.explains_more(members, mirrored, scores)
    for c in range(n_copies):
        same = [scores[k] for k in range(n_copies) if not mirrored[k] and (members[k] == members[c]).all()]
        assert found[c] == (scores[c] > 2.0 * max([0.0, *same]))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(1, 12))
def test_parts_in_the_place_of_a_copy_have_its_variables_alone(seed, n_variables, n_copies):
    rng = np.random.default_rng(seed)
    members, mirrored = rng.random((n_copies, n_variables)) < 0.5, rng.random(n_copies) < 0.5
    members[~members.any(axis=1), rng.integers(n_variables)] = True
    chosen = prior_choice.best_division(members, rng.normal(size=n_copies))
    found = prior_choice.made_of_parts(members, mirrored, chosen)
    for c in range(n_copies):
        touching = [k for k in chosen if (members[k] & members[c]).any()]
        inside = all((members[k] <= members[c]).all() for k in touching)
        assert found[c] == (inside and any(mirrored[k] for k in touching))


def test_a_mirrored_copy_is_chosen_rather_than_its_parts(monkeypatch):
    """Of two variables: plain, mirrored, and each on its own, one of them mirrored, which alone explains twice as much."""
    _, copies, *_ = f.measured(1, 30)
    state, sign = np.array([[0, 1], [0, 1], [0, -1], [0, -1], [-1, 1]]), np.ones((5, 2))
    sign[1], sign[3, 0] = -1.0, -1.0
    five = Copies(copies.sources, np.zeros(5, dtype=np.int64), state, sign, 0.2)
    scores = np.array([100.0, 150.0, 10.0, 90.0, 40.0])
    monkeypatch.setattr(prior_choice, "scores_of", lambda copies, sums: scores)
    fresh = CopySums.zero(5, 3, 3, 2)
    assert prior_choice.choose_factored(five, fresh).copies[0].tolist() == [1]
    # Were the parts worth less than the plain copy, that would be chosen.
    scores[3] = 50.0
    assert prior_choice.choose_factored(five, fresh).copies[0].tolist() == [0]


@pytest.mark.parametrize("n_copies", [1, 2])
def test_images_are_the_same_but_for_signs_and_have_more_than_half_the_evidence(n_copies):
    mapping, (states, actions, effects) = f.copies_mapping(n_copies), f.walk(f.copies_mapping(n_copies), 60)
    rows, sign = with_mirrored(copies_of_source(2, 2 * n_copies))
    copies = Copies([f.oscillator_source()], np.zeros(len(rows), dtype=np.int64), rows, sign, 0.2)
    sums = CopySums.zero(len(copies), 3, mapping.copies[0].n_target_actions, 2 * n_copies)
    for state, action, effect in zip(states, actions.tolist(), effects, strict=True):
        copies.measure(state, action, effect, sums)
    choice, scores = prior_choice.choose_factored(copies, sums), prior_choice.scores_of(copies, sums)
    chosen = np.unique(choice.copies[choice.copies >= 0]).tolist()
    assert len(chosen) == n_copies
    for copy in chosen:
        same = [c for c in range(len(copies)) if c != copy and (rows[c] == rows[copy]).all()]
        found = prior_choice.images_of(copies, scores, copy)
        assert len(found) == 1 and found == [c for c in same if 2.0 * scores[c] > scores[copy]]


def test_an_action_that_was_never_taken_has_no_source_action():
    _, copies, _, (states, actions, effects) = f.measured(2, 200)
    fresh = CopySums.zero(len(copies), 3, 5, 4)
    for state, action, effect in zip(states, actions.tolist(), effects, strict=True):
        if action != 3:
            copies.measure(state, action, effect, fresh)
    choice = prior_choice.choose_factored(copies, fresh)
    assert (choice.actions[3] == -1).all() and (np.delete(choice.actions, 3, axis=0) >= 0).all()
    assert copies.uses(*choice).complete.tolist() == [True, True, True, False, True]
    single = prior_choice.choose_mapping(copies, fresh, np.ones((len(copies), 5, 3), dtype=bool))
    assert (single.copies[3], single.actions[3]) == (-1, -1)


def test_an_action_that_the_sources_instances_lack_moves_nothing():
    """Its evidence is 0: often more than that of all others, if the target moves as none of them."""
    source, (_, copies, _, (states, actions, effects)) = f.oscillator_source(), f.measured(2, 200)
    rows = np.flatnonzero(source.actions > 0)
    arrays = ("states", "actions", "rewards", "next_states", "terminated")
    lacking = replace(source, **{name: getattr(source, name)[rows] for name in arrays})
    without = Copies([lacking], copies.source, copies.state, copies.sign, copies.breadth)
    sums = CopySums.zero(len(copies), 3, 5, 4)
    for state, action, effect in zip(states, actions.tolist(), -3.0 * effects, strict=True):
        without.measure(state, action, effect, sums)
    assert (sums.gain.sum(axis=3).argmax(axis=2) == 0).any()
    found, evidence = prior_choice.best_actions(without, sums)
    assert set(found.ravel().tolist()) == {1, 2}
    np.testing.assert_array_equal(evidence, sums.gain.sum(axis=3)[:, :, 1:].max(axis=2))
    assert (prior_choice.choose_factored(without, sums).actions > 0).all()


def test_one_mapping_for_each_action_is_the_best_that_is_allowed():
    _, copies, sums, _ = f.measured(2, 200, noise=0.01)
    rng = np.random.default_rng(0)
    for _ in range(20):
        allowed = rng.random((len(copies), 5, 3)) < 0.2
        choice = prior_choice.choose_mapping(copies, sums, allowed)
        gain = np.where(allowed, sums.gain.sum(axis=3), -np.inf)
        for a, (copy, u) in enumerate(zip(choice.copies[:, 0], choice.actions[:, 0], strict=True)):
            assert gain[copy, a, u] == gain[:, a].max()


def test_what_is_drawn_is_allowed_and_of_every_kind():
    _, copies, _, _ = f.measured(2, 1)
    allowed = np.zeros((len(copies), 5, 3), dtype=bool)
    allowed[[2, 4], :, 1] = allowed[4, 2] = True
    rng = np.random.default_rng(0)
    drawn = [prior_choice.draw_mapping(allowed, rng) for _ in range(50)]
    assert {(int(c), int(u)) for each in drawn for c, u in zip(each.copies[2], each.actions[2], strict=True)} == {
        *((2, 1), (4, 0), (4, 1), (4, 2))
    }
    seen = set()
    for _ in range(150):
        choice = prior_choice.draw_factored(copies, 5, rng)
        assert choice.copies.shape == choice.actions.shape == (5, 2)
        assert ((copies.state[choice.copies[0]] >= 0).sum(axis=0) == 1).all()
        seen.add(frozenset(choice.copies[0].tolist()))
        assert (choice.copies == choice.copies[0]).all() and (choice.actions >= 0).all()
    # Three ways to make pairs of four variables, and each pair either way round.
    assert len(seen) == 12


def evidence_of(copies, copy, u, states, effects):
    """The evidence for a copy with a source action of each transition and variable, 0 for variables that it does not have."""
    uses = copies.uses(np.array([[copy]]), np.array([[u]]))
    weights = copies.predict(uses, states, np.zeros(len(states), dtype=np.int64))[2]
    predicted = predicted_by(copies, copy, u, states)
    scales = equations.running_scales(effects, SMALLEST_ERROR)
    each = equations.evidence(effects, np.nan_to_num(predicted), scales, weights)
    return np.where(np.isnan(predicted), 0.0, each)


def test_evidence_is_that_of_the_equations():
    _, copies, sums, (states, actions, effects) = measured(2, 40, noise=0.01)
    for copy in (0, 3, 11, 12, 19):
        has = copies.state[copy] >= 0
        for u in range(3):
            each = evidence_of(copies, copy, u, states, effects)
            errors = (predicted_by(copies, copy, u, states)[:, has] - effects[:, has]) ** 2
            for a in range(5):
                rows = actions == a
                np.testing.assert_allclose(sums.gain[copy, a, u], each[rows].sum(axis=0), rtol=1e-4, atol=1e-6)
                np.testing.assert_allclose(sums.error[copy, a, u, has], errors[rows].sum(axis=0), rtol=1e-5)


def test_evidence_of_one_transition_is_the_logarithm_of_a_ratio_of_densities_of_students_t():
    effects, predicted, scales = np.array([[0.2, 0.0]]), np.array([[0.15, 0.1]]), np.array([[0.1, 0.05]])
    densities = [stats.t.logpdf((effects - each) / scales, df=1) for each in (predicted, 0.0)]
    for weight, part in ((1.0, 0.5), (3.0, 0.75), (0.0, 0.0)):
        found = equations.evidence(effects, predicted, scales, np.array([weight]))
        np.testing.assert_allclose(found, part * (densities[0] - densities[1]))
