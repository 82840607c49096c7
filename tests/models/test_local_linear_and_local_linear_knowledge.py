"""The local linear model against its definition in plain loops: exact states, and sums, fits and rows on the grid."""

import numpy as np
import pytest
from helpers import linear_models
from helpers.kernel_models import N_ACTIONS, learn, random_transitions
from helpers.naive_local_linear import NaiveReplacement
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.models.fit_updates import MAX_UNEXPLAINED
from sb3_combrel.models.linear_fits import TOLERANCE
from sb3_combrel.models.local_linear import CHECKED_EVERY

slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=8)
problems = st.tuples(
    st.sampled_from(linear_models.SMALL_GRIDS),
    st.sampled_from(linear_models.LINEAR_KERNELS),
    st.integers(0, 10**6),
    st.integers(1, 16),
    st.sampled_from([0.3, 1.0, 4.0]),
)
# What a prior claims, by and by; without any there is no prior.
all_claims = st.lists(
    st.sampled_from([linear_models.left_half, lambda state, action: action == 0, linear_models.nothing]), max_size=2
)


def with_some_prior(problem, claims, **kwargs):
    grid, kernel, seed, _, threshold = problem
    effect = linear_models.CurvedDynamics(seed, len(grid[0])).effect
    prior = linear_models.StubPrior(effect, claims[0], reward=0.7, end=0.0 if seed % 2 else 0.2) if claims else None
    model, naive = linear_models.linear_model_and_definition(grid, kernel, threshold=threshold, prior=prior, **kwargs)
    return model, naive, prior


@slow_and_repeatable
@given(problems, all_claims, st.lists(st.floats(-0.2, 1.2), min_size=3, max_size=3))
def test_the_prediction_at_any_state_is_that_of_the_definition(problem, claims, at):
    model, naive, prior = with_some_prior(problem, claims)
    if prior is not None:
        linear_models.renew(model, prior)
    d = len(problem[0][0])
    linear_models.learn_linear(model, naive, random_transitions(problem[2], d, problem[3]))
    for state in np.array([at[:d], model.instances.state[0, 0] if model.instances.size[0] else at[:d]]):
        linear_models.assert_same_prediction(model, naive, state)
        predictions = model.predict(np.array([state] * N_ACTIONS), np.arange(N_ACTIONS))
        prediction, given_ = model.predict_at(state)
        assert given_ is None, "instances are asked of no prior"
        np.testing.assert_array_equal(predictions.weight, prediction.weight)
        np.testing.assert_array_equal(predictions.reward, prediction.reward)
        for action in np.flatnonzero(prediction.length):
            assert predictions.probability[action, 0] == prediction.probability[action, 0]
            np.testing.assert_array_equal(predictions.effect[action, 0], prediction.effect[action, 0])


@slow_and_repeatable
@given(problems, all_claims, st.sampled_from([1.0, 0.9]), st.sampled_from([1, 3, 50]), st.booleans())
def test_what_is_known_sums_fits_and_rows_are_those_of_the_definition(problem, claims, gamma, max_model_steps, small):
    model, naive, prior = with_some_prior(problem, claims, gamma=gamma, max_model_steps=max_model_steps)
    d, seed, n = len(problem[0][0]), problem[2], problem[3]
    transitions = linear_models.small_steps(seed, d, n, ends=bool(seed % 3)) if small else random_transitions(seed, d, n)
    for part, some in enumerate((transitions[: n // 2], transitions[n // 2 :])):
        if prior is not None:
            prior.claims, prior.effect = claims[part % len(claims)], linear_models.CurvedDynamics(seed + part, d).effect
            linear_models.renew(model, prior)
        for transition in some:
            before = model.fits.reach.copy(), model.fits.limit.copy(), model.fits.n_counted.copy()
            linear_models.learn_linear(model, naive, [transition])
            np.testing.assert_array_equal(model.known.reshape(N_ACTIONS, -1), naive.known)
            narrower = np.flatnonzero(model.fits.reach != before[0])
            assert (before[2][narrower] + 1 > before[1][narrower]).all(), "kernels narrow when the limit is exceeded"
            assert (model.fits.n_counted <= model.fits.limit)[model.known].all()
        np.testing.assert_allclose(model.own_weight.reshape(N_ACTIONS, -1), naive.total, rtol=1e-9)
        np.testing.assert_array_equal(model.fits.limit.reshape(N_ACTIONS, -1), naive.limit)
        linear_models.assert_same_sums(model, naive)
        linear_models.finish_episode(model)
        linear_models.assert_same_fits(model, naive, gamma)
        assert (model.fits.unexplained[model.known] == 0.0).all()
    modelled = (model.known | model.fits.claimed).reshape(N_ACTIONS, -1)
    np.testing.assert_array_equal(model.mdp.arrays.n_optimistic, (~modelled).sum(axis=0))
    assert len(model.end_episode()) == 0, "nothing has happened since"


@slow_and_repeatable
@given(problems, st.floats(0.05, 0.9))
def test_a_lower_threshold_and_what_is_accepted_make_pairs_known(problem, threshold):
    model, naive, _ = with_some_prior(problem, [])
    linear_models.learn_linear(model, naive, random_transitions(problem[2], len(problem[0][0]), problem[3]))
    before, newly_known = model.known.copy(), model.lower_threshold(threshold)
    naive.lower_threshold(threshold)
    np.testing.assert_array_equal(newly_known, np.flatnonzero(~before & naive.known.reshape(-1)))
    model.update_rows(newly_known)
    asked = np.arange(0, len(model.known), 2)
    accepted = model.accept(asked)
    np.testing.assert_array_equal(accepted, [p for p in asked if not naive.known.flat[p] and naive.total.flat[p] > 0.0])
    model.update_rows(accepted)
    naive.known.flat[accepted] = True
    linear_models.finish_episode(model)
    linear_models.assert_same_fits(model, naive)


@slow_and_repeatable
@given(problems)
def test_within_an_episode_pairs_are_fitted_again_before_too_much_is_left_unexplained(problem):
    model, naive, _ = with_some_prior(problem, [])
    fits, d = model.fits, len(problem[0][0])
    for transition in random_transitions(problem[2], d, problem[3]):
        known_before, unexplained_before = model.known.copy(), fits.unexplained.copy()
        linear_models.learn_linear(model, naive, [transition])
        assert (fits.unexplained[model.known] <= MAX_UNEXPLAINED).all()
        for pair in np.flatnonzero(((fits.unexplained != unexplained_before) & model.known) & (fits.unexplained == 0.0)):
            action, point = divmod(int(pair), naive.n_points)
            expected = naive.at_pair(action, point)
            assert (np.abs(fits.row[pair, :d] - expected.effect) <= TOLERANCE * fits.effect_scale[action] + 1e-8).all()
            assert abs(fits.row[pair, d] - expected.reward) <= TOLERANCE * abs(expected.reward) + 1e-8
            assert abs(fits.row[pair, d + 1] - expected.end) <= TOLERANCE + 1e-8
        assert (fits.unexplained[model.known & ~known_before] == 0.0).all(), "the first fit is made at once"


def test_most_instances_that_agree_with_the_fit_change_no_row():
    model = linear_models.make_linear_model(((3, 3), 0), linear_models.LINEAR_KERNELS[0], n_actions=1)
    rng, n_changed = np.random.default_rng(0), []
    for state in rng.random((400, 2)):
        n_changed.append(len(model.add(state, 0, -1.0, state + 0.1 + 0.05 * state, False)))
    assert np.mean(n_changed[200:]) < 0.2 * np.mean(n_changed[:20])


# What decides what the local linear model knows narrows as long as no outcome has told states apart.
GRID, KERNEL, THRESHOLD = ((3,), 0), linear_models.LINEAR_KERNELS[0], 3.0
AN_END, ANOTHER_REWARD = (-1.0, True), (-2.0, False)


def uninformative(seed, n, reward=-1.0):
    """Transitions from everywhere, with one and the same reward and no end."""
    rng = np.random.default_rng(seed)
    states = rng.random((n, 1))
    return [(state, i % N_ACTIONS, reward, state + rng.normal(0.0, 0.1, 1), False) for i, state in enumerate(states)]


def outcome_at(state, reward, terminated):
    return np.array([state]), 0, reward, np.array([state + 0.1]), terminated


def narrowing_of(model):
    return model.get_state()["narrowing"][0]


def assert_same_knowledge(model, naive):
    np.testing.assert_array_equal(model.known.reshape(naive.known.shape), naive.known)
    np.testing.assert_array_equal(model.mdp.arrays.modelled, model.known)
    np.testing.assert_allclose(model.own_weight.reshape(naive.known.shape), naive.total, rtol=1e-9)
    assert narrowing_of(model) == naive.narrowing and model.exploration_threshold == naive.threshold


@pytest.mark.parametrize(
    ("threshold", "outcome", "max_instances"), [(0.3, AN_END, None), (3.0, ANOTHER_REWARD, 25), (3.0, AN_END, 10)]
)
def test_what_is_known_is_that_of_the_definition_before_and_after_the_first_outcome(threshold, outcome, max_instances):
    # At 25 there are 50 instances for ever, at 10 never so many: transitions count, not instances.
    model, naive = linear_models.linear_model_and_definition(GRID, KERNEL, threshold=threshold, max_instances=max_instances)
    learner = naive if max_instances is None else NaiveReplacement(naive, max_instances)
    highest = 1.0
    for transition in [*uninformative(2, 120), outcome_at(0.5, *outcome), *uninformative(3, 20)]:
        linear_models.learn_linear(model, learner, [transition])
        assert_same_knowledge(model, naive)
        highest = max(highest, naive.narrowing)
    assert 2.0 <= highest <= 64.0 and naive.narrowing == 1.0
    linear_models.assert_same_sums(model, naive)
    linear_models.finish_episode(model)
    assert linear_models.assert_same_fits(model, naive) > 0


@pytest.mark.parametrize("n", [CHECKED_EVERY - 5, CHECKED_EVERY + 5, 2 * CHECKED_EVERY + 30])
def test_how_narrow_it_is_is_saved_and_restored(n):
    model, restored = (linear_models.make_linear_model(GRID, KERNEL, threshold=THRESHOLD) for _ in range(2))
    learn(model, uninformative(4, n))
    narrowing = narrowing_of(model)
    assert (narrowing > 1.0) == (n > CHECKED_EVERY)
    linear_models.assert_restored(model, restored, [])
    assert narrowing_of(restored) == narrowing
    # Transitions after which it is looked at again, and the first outcome.
    linear_models.assert_restored(model, restored, [*uninformative(5, CHECKED_EVERY), outcome_at(0.5, *AN_END)])
    assert narrowing_of(model) == narrowing_of(restored) == 1.0


def test_an_outcome_whose_instance_has_been_replaced_is_remembered_after_loading():
    model, restored = (linear_models.make_linear_model(GRID, KERNEL, threshold=THRESHOLD, max_instances=5) for _ in range(2))
    learn(model, [outcome_at(0.5, *AN_END), *uninformative(6, 90)])
    assert not model.instances.terminated[:, :5].any()
    linear_models.finish_episode(model)
    restored.set_state(model.get_state())
    for transition in uninformative(7, 2 * CHECKED_EVERY):
        model.update_rows(model.add(*transition))
        restored.update_rows(restored.add(*transition))
        np.testing.assert_array_equal(restored.known, model.known)
    assert narrowing_of(model) == narrowing_of(restored) == 1.0
