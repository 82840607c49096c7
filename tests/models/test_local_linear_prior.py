"""The local linear model with a prior: claims are modelled at once, and own instances are fitted to what is left over."""

import numpy as np
import pytest
from helpers.agents import make_agent
from helpers.kernel_models import GRIDS, N_ACTIONS, learn, random_transitions, row_of
from helpers.linear_models import (
    LINEAR_KERNELS,
    LinearDynamics,
    StubPrior,
    assert_same_fits,
    assert_same_sums,
    finish_episode,
    learn_linear,
    linear_model_and_definition,
    make_linear_model,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.models.linear_fits import PRIOR_OUTCOME_WEIGHT, PRIOR_WEIGHT

slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=25)
problems = st.tuples(
    st.sampled_from(GRIDS),
    st.sampled_from(LINEAR_KERNELS),
    st.integers(0, 10**6),
    st.integers(0, 40),
    st.sampled_from([0.3, 1.0, 4.0]),
)
GRID, KERNEL = ((2, 2), 0), dict(breadth=0.3, min_weight=0.05, n_neighbors=8, outcome_breadth=0.1)


def left_half(state, action):
    return state[0] < 0.5


def first_action(state, action):
    return action == 0


def nothing(state, action):
    return False


class CurvedDynamics(LinearDynamics):
    """Effects that are not linear between the points of a grid."""

    def effect(self, state, action):
        return super().effect(state, action) + 0.05 * np.sin(9.0 * state[::-1] + action)


def renew(model, prior):
    prior.version += 1
    changed = model.renew_prior()
    np.testing.assert_array_equal(np.sort(changed), np.arange(len(model.known)))
    model.update_rows(changed)


def model_with_prior(prior, grid=GRID, kernel=KERNEL, **kwargs):
    model = make_linear_model(grid, kernel, prior=prior, **kwargs)
    model.update_rows(model.renew_prior())
    return model


@slow_and_repeatable
@given(problems, st.lists(st.sampled_from([left_half, first_action, nothing]), min_size=1, max_size=3))
def test_sums_fits_and_rows_are_those_of_the_definition_whatever_the_prior_claims_by_and_by(problem, all_claims):
    grid, kernel, seed, n, threshold = problem
    d = len(grid[0])
    prior = StubPrior(CurvedDynamics(seed, d).effect, all_claims[0], reward=0.7, end=0.2)
    model, naive = linear_model_and_definition(grid, kernel, threshold=threshold, prior=prior)
    transitions = random_transitions(seed, d, n * len(all_claims))
    for part, claims in enumerate(all_claims):
        prior.claims, prior.effect = claims, CurvedDynamics(seed + part, d).effect
        renew(model, prior)
        learn_linear(model, naive, transitions[part * n : (part + 1) * n])
        np.testing.assert_array_equal(model.known.reshape(naive.known.shape), naive.known)
        np.testing.assert_allclose(model.own_weight.reshape(naive.known.shape), naive.total, rtol=1e-9)
        assert_same_sums(model, naive)
        finish_episode(model)
        assert_same_fits(model, naive)


@slow_and_repeatable
@given(problems, st.lists(st.floats(0.0, 1.0), min_size=3, max_size=3))
def test_the_prediction_at_any_state_is_that_of_the_definition(problem, at):
    grid, kernel, seed, n, threshold = problem
    d = len(grid[0])
    prior = StubPrior(CurvedDynamics(seed, d).effect, left_half, reward=0.7, end=0.2)
    model, naive = linear_model_and_definition(grid, kernel, threshold=threshold, prior=prior)
    renew(model, prior)
    learn_linear(model, naive, random_transitions(seed, d, n))
    state = np.array(at[:d])
    prediction, given = model.predict_at(state)
    assert given is None, "instances are asked of no prior"
    for action in range(N_ACTIONS):
        expected, claimed = naive.at_state(state, action), left_half(state, action)
        assert prediction.weight[action] == pytest.approx(expected.weight, rel=1e-9)
        assert prediction.modelled[action] == (claimed or expected.weight >= threshold)
        if claimed or expected.weight > 0.0:
            assert prediction.reward[action] == pytest.approx(expected.reward, abs=1e-9)
            assert prediction.length[action] == (1 if expected.end < 1.0 else 0)
            if expected.end < 1.0:
                assert prediction.probability[action, 0] == pytest.approx(1.0 - expected.end, abs=1e-9)
                np.testing.assert_allclose(prediction.effect[action, 0], expected.effect, rtol=1e-7, atol=1e-8)


def test_what_an_exact_prior_claims_is_modelled_exactly_from_the_start_and_nothing_is_left_over():
    dynamics = LinearDynamics(1, 2)
    prior = StubPrior(dynamics.effect)
    model = model_with_prior(prior)
    points = model.grid.points()
    assert model.mdp.arrays.modelled.all() and not model.known.any()
    state = np.array([0.37, 0.81])
    for transitions in ([], dynamics.transitions(np.random.default_rng(0).random((40, 2)))):
        learn(model, transitions)
        finish_episode(model)
        for action in range(N_ACTIONS):
            expected = np.array([dynamics.effect(point, action) for point in points])
            np.testing.assert_allclose(
                model.fits.row[action * len(points) : (action + 1) * len(points), :2], expected, atol=1e-12
            )
            np.testing.assert_allclose(
                model.predict_at(state)[0].effect[action, 0], dynamics.effect(state, action), atol=1e-12
            )
            assert model.predict_at(state)[0].modelled[action]
    for action, size in enumerate(model.instances.size):
        np.testing.assert_allclose(model.fits.target[action, :size], 0.0, atol=1e-15)
    np.testing.assert_allclose(model.fits.row[:, 2:], [[-1.0, 0.0]] * len(model.known), atol=1e-12)


def test_an_exact_prior_that_claims_nothing_leaves_pairs_optimistic_and_makes_the_first_fit_exact():
    dynamics = LinearDynamics(2, 2)
    model = model_with_prior(StubPrior(dynamics.effect, nothing))
    assert not model.mdp.arrays.modelled.any()
    # Rewards that differ, so that a part of the threshold is enough: no grid point is where the instances are.
    learn(model, [(s, a, -1.0 - a, to, end) for s, a, _, to, end in dynamics.transitions(np.array([[0.4, 0.4]]))])
    finish_episode(model)
    assert model.known.reshape(N_ACTIONS, -1).any(axis=1).all() and (model.mdp.arrays.modelled == model.known).all()
    for pair in np.flatnonzero(model.known):
        action, point = divmod(int(pair), model.grid.n_points)
        # As of an instance at the grid point itself, however far it is.
        expected = dynamics.effect(model.grid.points()[point], action)
        np.testing.assert_allclose(model.fits.row[pair, :2], expected, atol=1e-12)


def test_own_instances_take_over_from_a_wrong_prior_in_proportion_to_their_weight():
    own, wrong = np.array([0.1, 0.05]), np.array([-0.1, 0.0])
    prior = StubPrior(lambda state, action: wrong, reward=-5.0, end=0.5)
    model = model_with_prior(prior, n_actions=1, threshold=5.5)
    state, point = np.array([0.5, 0.5]), 12  # which is the same place
    for n in range(1, 15):
        learn(model, [(state, 0, -1.0, state + own, False)])
        finish_episode(model)
        # Its reward and end count until the instances make the pair known.
        share, share_of_outcome = n / (n + PRIOR_WEIGHT), 1.0 if n >= 6 else n / (n + PRIOR_OUTCOME_WEIGHT)
        expected = wrong + share * (own - wrong)
        expected_reward = -5.0 + share_of_outcome * 4.0
        prediction, _ = model.predict_at(state)
        if n <= KERNEL["n_neighbors"]:
            np.testing.assert_allclose(prediction.effect[0, 0], expected, atol=1e-9)
            assert prediction.reward[0] == pytest.approx(expected_reward)
            assert prediction.probability[0, 0] == pytest.approx(1.0 - 0.5 * (1.0 - share_of_outcome))
        assert model.known[point] == (n >= 6)
        np.testing.assert_allclose(model.fits.row[point, :2], expected, atol=1e-9)
        np.testing.assert_allclose(model.fits.row[point, 2:], [expected_reward, 0.5 * (1.0 - share_of_outcome)], atol=1e-9)


def test_a_lower_threshold_ends_what_the_prior_says_of_rewards():
    prior = StubPrior(lambda state, action: np.zeros(2), reward=-5.0, end=0.5)
    model = model_with_prior(prior, n_actions=1, threshold=4.0)
    state, point = np.array([0.5, 0.5]), 12
    learn(model, [(state, 0, -1.0, state, False)] * 3)
    finish_episode(model)
    assert model.fits.row[point, 2] == pytest.approx((-3.0 - 5.0 * PRIOR_OUTCOME_WEIGHT) / (3.0 + PRIOR_OUTCOME_WEIGHT))
    model.update_rows(model.lower_threshold(2.0))
    np.testing.assert_allclose(model.fits.row[point, 2:], [-1.0, 0.0], atol=1e-12)


def test_the_prior_is_no_finer_than_the_grid():
    """A step of its effects between two grid points is a slope from one to the other."""

    def effect(state, action):
        return np.array([0.1 if state[0] < 0.6 else 0.0, 0.0])

    model = model_with_prior(StubPrior(effect), n_actions=1)  # points at 0, 0.25, 0.5, ...
    learn(model, [(np.array([0.55, 0.3]), 0, -1.0, np.array([0.65, 0.3]), False)])
    np.testing.assert_allclose(model.fits.target[0, 0], [0.1 - 0.1 * 0.8, 0.0], atol=1e-12)
    far = np.array([0.7, 0.95])
    expected = 0.1 * 0.2 + (0.1 - 0.1 * 0.8) * 1.0 / (1.0 + PRIOR_WEIGHT)
    assert 0.0 < model.predict_at(far)[0].effect[0, 0, 0] < expected
    np.testing.assert_allclose(model_with_prior(StubPrior(effect), n_actions=1).predict_at(far)[0].effect[0, 0, 0], 0.02)


def test_a_wrong_prior_is_forgotten_where_there_are_many_instances():
    truth, wrong = LinearDynamics(3, 2), LinearDynamics(4, 2)
    model = model_with_prior(StubPrior(wrong.effect), ((2, 2), 0), KERNEL | dict(n_neighbors=20, breadth=0.5))
    learn(model, truth.transitions(np.random.default_rng(0).random((200, 2))))
    for state in np.random.default_rng(1).uniform(0.2, 0.8, (20, 2)):
        for action in range(N_ACTIONS):
            off = np.abs(model.predict_at(state)[0].effect[action, 0] - truth.effect(state, action)).max()
            assert off < 0.15 * np.abs(wrong.effect(state, action) - truth.effect(state, action)).max() + 1e-3


def test_a_prior_is_asked_again_when_its_version_has_grown_and_only_then():
    one, other = LinearDynamics(5, 2), LinearDynamics(6, 2)
    prior = StubPrior(one.effect)
    model = model_with_prior(prior)
    learn(model, one.transitions(np.random.default_rng(0).random((30, 2))))
    finish_episode(model)
    prior.effect = other.effect
    assert len(model.renew_prior()) == 0
    np.testing.assert_allclose(model.fits.target[0, : model.instances.size[0]], 0.0, atol=1e-15)
    renew(model, prior)
    for action, size in enumerate(model.instances.size):
        states = model.instances.state[action, :size]
        left_over = [one.effect(state, action) - other.effect(state, action) for state in states]
        np.testing.assert_allclose(model.fits.target[action, :size], left_over, atol=1e-12)
    assert len(model.renew_prior()) == 0


def test_pairs_whose_claim_is_withdrawn_are_optimistic_again_unless_they_are_known():
    dynamics = LinearDynamics(7, 2)
    prior = StubPrior(dynamics.effect)
    model = model_with_prior(prior)
    learn(model, dynamics.transitions(np.array([[0.25, 0.25], [0.25, 0.3]])))
    finish_episode(model)
    known = model.known.copy()
    assert known.any() and not known.all() and (model.mdp.arrays.n_optimistic == 0).all()
    prior.claims = nothing
    renew(model, prior)
    np.testing.assert_array_equal(model.known, known)
    np.testing.assert_array_equal(model.mdp.arrays.modelled, known)
    np.testing.assert_array_equal(model.mdp.arrays.n_optimistic, (~known.reshape(N_ACTIONS, -1)).sum(axis=0))
    for pair in np.flatnonzero(~known):
        assert row_of(model.mdp, int(pair)) == {} and model.mdp.arrays.reward[pair] == 0.0
    assert not model.predict_at(np.array([0.9, 0.9]))[0].modelled.any()


def test_predicted_effects_stay_within_those_that_were_seen_or_that_the_prior_predicts():
    prior = StubPrior(lambda state, action: np.array([0.1, 0.0]), reward=0.0)
    model = model_with_prior(prior, n_actions=1)
    np.testing.assert_allclose(model.fits.effect_range[:2, 0], [[0.1, 0.0]] * 2)
    for at in np.linspace(0.0, 0.5, 9):
        learn(model, [(np.array([at, 0.5]), 0, 0.0, np.array([at + 0.1 + at, 0.5]), False)])
    np.testing.assert_allclose(model.fits.effect_range[:2, 0], [[0.1, 0.0], [0.6, 0.0]])
    assert model.predict_at(np.array([0.8, 0.5]))[0].effect[0, 0, 0] <= 0.6 + 1e-12


def test_a_model_with_a_prior_asks_for_no_transferred_instances():
    # The stub has no such methods.
    model = model_with_prior(StubPrior(LinearDynamics(0, 2).effect, nothing))
    learn(model, random_transitions(0, 2, 20))
    assert model.predict_at(np.array([0.5, 0.5]))[1] is None and len(model.outdated()) > 0
    model.update_rows(model.outdated())


def test_an_agent_without_a_prior_has_none():
    agent = make_agent(2, 2, degree=1, resolution=3)
    assert len(agent.model.renew_prior()) == 0 and not agent.model.fits.claimed.any()
