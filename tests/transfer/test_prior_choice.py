"""The sums by which copies are judged, and the division that is chosen by them, against the equations and a full search."""

import itertools

import numpy as np
import pytest
from helpers import factored as f
from helpers.factored import measured, predicted_by
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.transfer.equations import division_score, prediction_compliances, running_scales
from sb3_combrel.transfer.prior import prior_choice
from sb3_combrel.transfer.prior.copy_sums import CopySums


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
    scores, stays = rng.normal(size=n_copies), rng.normal(size=n_variables)

    def total(chosen):
        left = ~members[list(chosen)].any(axis=0) if chosen else np.ones(n_variables, dtype=bool)
        return scores[list(chosen)].sum() + stays[left].sum()

    found = prior_choice.best_division(members, scores, stays)
    assert (members[found].sum(axis=0) <= 1).all()
    assert total(tuple(found)) == pytest.approx(max(map(total, all_divisions(members))))


def test_the_division_found_has_the_highest_score_of_all():
    _, copies, sums, (states, actions, effects) = f.measured(2, 30, noise=0.02)
    scales = running_scales(effects)
    parts, stays = {}, {}
    for copy in range(len(copies)):
        has = copies.state[copy] >= 0
        found = [f.predicted_by(copies, copy, u, states)[:, has] for u in range(3)]
        each = np.array([prediction_compliances(effects[:, has], p, scales[:, has]) for p in found])
        # The best source action of each target action, on its own.
        part = np.empty(len(actions))
        for a in np.unique(actions):
            rows = actions == a
            part[rows] = each[each[:, rows].mean(axis=1).argmax()][rows]
        parts[copy] = part
    for v in range(4):
        stays[v] = prediction_compliances(effects[:, [v]], np.zeros((len(actions), 1)), scales[:, [v]])

    def score(chosen):
        left = [v for v in range(4) if not (copies.state[list(chosen), v] >= 0).any()]
        return division_score(
            [*(parts[c] for c in chosen), *(stays[v] for v in left)], actions, 4 - len(left), prior_choice.MIN_GAIN
        )

    found = prior_choice.choose_factored(copies, sums)
    chosen = tuple(sorted({c for c in found.copies[0].tolist() if c >= 0}))
    assert score(chosen) == pytest.approx(max(score(d) for d in all_divisions(copies.state >= 0)), rel=1e-6)


@pytest.mark.parametrize(("n_copies", "order"), [(1, None), (2, (0, 2, 1, 3)), (2, (3, 0, 2, 1)), (3, (4, 1, 0, 5, 3, 2))])
def test_copies_of_exact_dynamics_are_found_with_their_actions(n_copies, order):
    mapping, copies, sums, _ = f.measured(n_copies, 100 * n_copies, order=order)
    choice = prior_choice.choose_factored(copies, sums)
    chosen = {tuple(copies.state[c].tolist()): u.tolist() for c, u in zip(choice.copies[0], choice.actions.T, strict=True)}
    assert chosen == {tuple(copy.state_index.tolist()): list(copy.action) for copy in mapping.copies}


def test_an_action_that_was_never_taken_has_no_source_action():
    _, copies, _, (states, actions, effects) = f.measured(2, 200)
    fresh = CopySums.zero(len(copies), 3, 5, 4)
    for state, action, effect in zip(states, actions.tolist(), effects, strict=True):
        if action != 3:
            copies.measure(state, action, effect, fresh, False)
    choice = prior_choice.choose_factored(copies, fresh)
    assert (choice.actions[3] == -1).all() and (np.delete(choice.actions, 3, axis=0) >= 0).all()
    assert copies.uses(*choice).complete.tolist() == [True, True, True, False, True]
    single = prior_choice.choose_mapping(copies, fresh, np.ones((len(copies), 5, 3), dtype=bool))
    assert (single.copies[3], single.actions[3]) == (-1, -1)


def test_one_mapping_for_each_action_is_the_best_that_is_allowed():
    _, copies, sums, _ = f.measured(2, 200, noise=0.01, whole=True)
    rng = np.random.default_rng(0)
    for _ in range(20):
        allowed = rng.random((len(copies), 5, 3)) < 0.2
        choice = prior_choice.choose_mapping(copies, sums, allowed)
        mean = np.where(allowed, sums.compliance / sums.n[:, None], -1.0)
        for a, (copy, u) in enumerate(zip(choice.copies[:, 0], choice.actions[:, 0], strict=True)):
            assert mean[copy, a, u] == mean[:, a].max()


def test_what_is_drawn_is_allowed_and_of_every_kind():
    _, copies, _, _ = f.measured(2, 1)
    allowed = np.zeros((len(copies), 5, 3), dtype=bool)
    allowed[[2, 4], :, 1] = allowed[4, 2] = True
    rng = np.random.default_rng(0)
    drawn = [prior_choice.draw_mapping(copies, allowed, rng) for _ in range(50)]
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


def test_compliances_are_those_of_the_equations():
    _, copies, sums, (states, actions, effects) = measured(2, 40, noise=0.01)
    scales = running_scales(effects)
    for copy in (0, 3, 11, 12, 19):
        has = copies.state[copy] >= 0
        for u in range(3):
            predicted = predicted_by(copies, copy, u, states)[:, has]
            each = prediction_compliances(effects[:, has], predicted, scales[:, has])
            errors = (predicted - effects[:, has]) ** 2
            for a in range(5):
                rows = actions == a
                np.testing.assert_allclose(sums.compliance[copy, a, u], each[rows].sum(), rtol=1e-6)
                np.testing.assert_allclose(sums.error[copy, a, u, has], errors[rows].sum(axis=0), rtol=1e-5)
    for a in range(5):
        stays = [
            prediction_compliances(effects[:, [v]], np.zeros((40, 1)), scales[:, [v]])[actions == a].sum() for v in range(4)
        ]
        np.testing.assert_allclose(sums.stay[a], stays)


def test_with_whole_mappings_compliance_is_over_all_variables_those_unmapped_stay():
    _, copies, sums, (states, actions, effects) = measured(2, 25, noise=0.01, whole=True)
    scales = running_scales(effects)
    each = prediction_compliances(effects, np.nan_to_num(predicted_by(copies, 3, 1, states)), scales)
    np.testing.assert_allclose(sums.compliance[3, :, 1], [each[actions == a].sum() for a in range(5)], rtol=1e-6)


def test_what_is_unexplained_is_compared_with_what_the_target_moves_so_far_within_what_the_source_does():
    _, copies, sums, (states, actions, effects) = measured(2, 40, noise=0.01)
    [source] = copies.sources
    sizes = np.abs(source.scaling.to_unit(source.next_states) - source.scaling.to_unit(source.states))
    low = np.median(sizes, axis=0)
    high = np.max([np.median(sizes[source.actions == u], axis=0) for u in range(3)], axis=0)
    for copy, u in ((0, 0), (3, 2), (11, 1), (12, 1), (19, 0)):
        v = int(np.flatnonzero(copies.state[copy] >= 0)[-1])
        k = copies.state[copy, v]
        predicted = predicted_by(copies, copy, u, states)[:, v]
        expected = np.zeros(5)
        for i, action in enumerate(actions.tolist()):
            seen = [np.abs(effects[: i + 1, v][actions[: i + 1] == a]) for a in range(5)]
            motion = max(each.mean() for each in seen if len(each))
            compared = max(effects[i, v] ** 2, (0.25 * min(max(motion, low[k]), high[k])) ** 2)
            expected[action] += covered(copies, states[[i]], copy, u) * min(
                2.0, (effects[i, v] - predicted[i]) ** 2 / compared
            )
        np.testing.assert_allclose(sums.unexplained[copy, :, u, v], expected, rtol=1e-4, err_msg=str((copy, v, u)))


def covered(copies, state, copy, u):
    """The weight of the source's data at a state, at most 1."""
    uses = copies.uses(np.array([[copy]]), np.array([[u]]))
    return min(1.0, copies.predict(uses, copies.work_space(uses), state, np.array([0]))[3][0])
