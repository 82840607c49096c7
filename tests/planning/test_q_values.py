"""Q at exact states against its definition."""

import numpy as np
import pytest
from gymnasium import spaces
from helpers.naive_fitted_rmax import Instance, NaiveFittedRMax
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import TIMBREL, InterTaskMapping, SourceInstances
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy

N_ACTIONS = 3


def policy_and_definition(n_variables, resolution, *, gamma=1.0, max_value=0.0, threshold=1.0, **kernel):
    kernel = dict(breadth=0.3, min_weight=0.01, min_fraction=0.13) | kernel
    policy = FittedRMaxPolicy(
        spaces.Box(0.0, 1.0, (n_variables,), dtype=np.float64),
        spaces.Discrete(N_ACTIONS),
        model_breadth=kernel["breadth"],
        min_weight=kernel["min_weight"],
        min_fraction=kernel["min_fraction"],
        exploration_threshold=threshold,
        resolution=resolution,
        gamma=gamma,
        max_value=max_value,
        rng=np.random.default_rng(0),
    )
    naive = NaiveFittedRMax(
        policy.model.grid.resolution,
        policy.model.grid.margin,
        N_ACTIONS,
        threshold=threshold,
        gamma=gamma,
        max_value=max_value,
        **kernel,
    )
    return policy, naive


def take_up(policy, naive, transitions):
    """Into the models only: Q is compared on values at the grid points that the test chooses."""
    for state, action, reward, next_state, terminated in transitions:
        policy.model.add(state, action, reward, next_state, terminated)
        naive.instances[action].append(Instance(state, action, reward, next_state, terminated))


@settings(deadline=None, derandomize=True, max_examples=60)
@given(
    st.integers(0, 10**6),
    st.integers(1, 3),
    st.integers(0, 40),
    st.sampled_from([1.0, 0.9]),
    st.sampled_from([0.3, 1.0, 2.5]),
    st.sampled_from([0.0, 7.0, -3.0]),
)
def test_q_is_the_backup_of_the_instances_near_the_state(seed, n_variables, n, gamma, threshold, max_value):
    rng = np.random.default_rng(seed)
    policy, naive = policy_and_definition(n_variables, 2, gamma=gamma, threshold=threshold, max_value=max_value)
    transitions = []
    for _ in range(n):
        state = rng.random(n_variables)
        effect = rng.normal(0.0, 0.2, n_variables) * (rng.random() < 0.7)
        transitions.append(
            (state, int(rng.integers(N_ACTIONS)), float(rng.normal()), state + effect, bool(rng.random() < 0.1))
        )
    take_up(policy, naive, transitions)
    policy.planner.values[:] = max_value - 5.0 * rng.random(naive.n_points)
    policy.planner.bounds = (max_value - 20.0, max_value)
    states = [rng.random(n_variables) for _ in range(5)] + [t[0] for t in transitions[:5]]
    for state in states:
        expected = naive.q_values(state, policy.planner.values, max_value - 20.0)
        found = policy.q_values(state)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-9)
        # Optimism is exact: exploration finds untried actions by comparing with ==.
        np.testing.assert_array_equal(found == max_value, expected == max_value)


@pytest.fixture
def one_variable():
    policy, naive = policy_and_definition(1, 2, breadth=0.2, min_fraction=0.01)
    policy.planner.values[:] = -np.arange(naive.n_points, dtype=float)  # grid coordinates: 4 u + 1
    policy.planner.bounds = (-100.0, 0.0)
    return policy


def learn(policy, state, effect, reward=-1.0, terminated=False, times=2, action=0):
    state = np.array([state])
    for _ in range(times):
        policy.model.add(state, action, reward, state + effect, terminated)


def q(policy, state):
    return policy.q_values(np.array([state]))[0]


def test_below_the_threshold_an_action_has_max_value_exactly(one_variable):
    assert (one_variable.q_values(np.array([0.4])) == 0.0).all()
    learn(one_variable, 0.5, 0.1, times=1)
    assert q(one_variable, 0.5 + 1e-3) == 0.0, "one instance weighs less than 1 anywhere but at its own state"
    assert q(one_variable, 0.5) < 0.0, "and 1 there, which reaches the threshold of 1"
    learn(one_variable, 0.5, 0.1, times=1)
    assert q(one_variable, 0.5 + 1e-3) < 0.0
    assert (one_variable.q_values(np.array([0.5]))[1:] == 0.0).all(), "what one action knows is nothing to the others"


def test_knowledge_ends_where_the_weights_end(one_variable):
    learn(one_variable, 0.5, 0.1, times=2)
    edge = 0.2 * np.sqrt(np.log(2))  # two instances weigh 1 here
    assert q(one_variable, 0.5 + edge - 1e-6) < 0.0
    assert q(one_variable, 0.5 + edge + 1e-6) == 0.0


def test_successors_are_interpolated_between_grid_points(one_variable):
    learn(one_variable, 0.5, 0.05)
    assert q(one_variable, 0.5) == pytest.approx(-1.0 - (4 * 0.55 + 1))


def test_effects_are_relative_to_the_state_asked_about(one_variable):
    learn(one_variable, 0.5, 0.05)
    assert q(one_variable, 0.53) == pytest.approx(-1.0 - (4 * 0.58 + 1))


def test_instances_that_ended_the_episode_lead_to_value_0(one_variable):
    learn(one_variable, 0.5, 0.1, reward=-2.0, terminated=True)
    assert q(one_variable, 0.5) == pytest.approx(-2.0)
    learn(one_variable, 0.5, 0.1, reward=-1.0)
    assert q(one_variable, 0.5) == pytest.approx(-1.5 - 0.5 * (4 * 0.6 + 1))


def test_staying_is_worth_the_state_s_own_value_and_not_the_interpolated_one(one_variable):
    learn(one_variable, 0.5, 0.0)
    learn(one_variable, 0.5, 0.1)
    # q = -1 + q / 2 + V(0.6) / 2
    assert q(one_variable, 0.5) == pytest.approx(2 * (-1.0 - 0.5 * (4 * 0.6 + 1)))


def test_staying_for_ever_is_worth_the_bound_that_the_reward_points_to(one_variable):
    learn(one_variable, 0.5, 0.0)
    assert q(one_variable, 0.5) == -100.0
    learn(one_variable, 0.5, 0.0, reward=0.0, action=1)
    assert one_variable.q_values(np.array([0.5]))[1] == 0.0


def test_successors_beyond_the_grid_count_as_its_edge(one_variable):
    learn(one_variable, 1.0, 0.5)
    assert q(one_variable, 1.0) == pytest.approx(-1.0 - 6.0), "the margin ends at 1.25"


def test_pushing_against_the_edge_of_the_grid_is_staying():
    policy, _ = policy_and_definition(3, 1, breadth=0.5, min_fraction=0.01)
    policy.planner.bounds = (-100.0, 0.0)
    corner = np.ones(3)
    for _ in range(2):
        policy.model.add(corner, 0, -1.0, corner + 0.3, False)
    assert policy.q_values(corner)[0] == -100.0


def test_values_stay_within_their_bounds(one_variable):
    learn(one_variable, 0.5, 0.1, reward=1e6)
    learn(one_variable, 0.5, 0.1, reward=-1e6, action=1)
    found = one_variable.q_values(np.array([0.5]))
    assert list(found[:2]) == [0.0, -100.0]


def test_asking_for_q_changes_nothing(one_variable):
    learn(one_variable, 0.5, 0.05)
    before = {name: array.copy() for name, array in one_variable._saved_arrays().items()}
    first = one_variable.q_values(np.array([0.52]))
    np.testing.assert_array_equal(one_variable.q_values(np.array([0.52])), first)
    for name, array in one_variable._saved_arrays().items():
        np.testing.assert_array_equal(array, before[name])


def test_what_was_near_before_has_no_part_in_the_result():
    """A search starts from what the last one found; wherever that was, it must come to the same."""
    rng = np.random.default_rng(3)
    policy, naive = policy_and_definition(2, 3, breadth=0.15, min_fraction=0.05)
    states = np.round(rng.random((300, 2)) * 12) / 12
    take_up(policy, naive, [(s, int(rng.integers(N_ACTIONS)), -1.0, np.clip(s + 0.05, 0, 1), False) for s in states])
    policy.planner.values[:] = rng.normal(size=len(policy.planner.values)) - 5.0
    queries = np.round(rng.random((40, 2)) * 24) / 24
    first = [policy.q_values(state) for state in queries]
    for number in rng.permutation(len(queries)):
        np.testing.assert_array_equal(policy.q_values(queries[number]), first[number])
        policy._query.length[:] = 0
        np.testing.assert_array_equal(policy.q_values(queries[number]), first[number])


def line_policy(transfer=None):
    """On a line, with actions 0 and 1."""
    line, actions = spaces.Box(0.0, 1.0, (1,), dtype=np.float64), spaces.Discrete(2)
    narrow = dict(model_breadth=0.05, resolution=4, rng=np.random.default_rng(0))
    return FittedRMaxPolicy(line, actions, transfer=transfer, **narrow)


def ends_anywhere(reward):
    """Transfer from a source in which action 1 ends the episode anywhere, with a reward; action 0 moves a little, for -1."""
    at = np.linspace(0.0, 1.0, 201)
    states, ends = np.tile(at, 2)[:, None], np.append(np.clip(at + 0.1, 0.0, 1.0), at)[:, None]
    actions = np.repeat([0, 1], 201)
    rewards = np.where(actions == 1, reward, -1.0)
    source = SourceInstances(states, actions, rewards, ends, actions == 1, [0.0], [1.0], 2)
    return TIMBREL(source, InterTaskMapping([0], [0, 1]))


def test_an_evaluation_trusts_known_actions_first():
    """Whatever the source promises; what the target itself has shown comes first, where it has."""
    policy = line_policy(ends_anywhere(-1.0))
    policy.prepare()
    state, elsewhere = np.array([0.3]), np.array([0.7])
    for _ in range(3):
        policy.learn_from(state, 0, -1.0, np.array([0.32]), False)
    best, second = policy.q_values(state)[::-1]
    assert best > second and policy.explore(state, 0) == 1
    assert policy.exploit(state) == 0
    assert policy.exploit(elsewhere) == 1, "where nothing is known, the best of what was transferred"


def test_an_evaluation_takes_a_transferred_end_that_is_worth_as_much_as_optimism():
    policy = line_policy(ends_anywhere(0.0))
    policy.prepare()
    state = np.array([0.3])
    assert policy.q_values(state)[1] == policy.planner.bounds[1] > policy.q_values(state)[0]
    assert policy.exploit(state) == 1


def test_an_evaluation_takes_an_end_that_is_worth_as_much_as_optimism():
    policy, state = line_policy(), np.array([0.3])
    for _ in range(3):
        policy.learn_from(state, 0, -1.0, np.array([0.32]), False)
    assert policy.exploit(state) == 0, "action 1 is optimistic: nobody knows where it leads"
    for _ in range(3):
        policy.learn_from(state, 1, 0.0, np.array([0.32]), True)
    assert policy.q_values(state)[1] == 0.0 == policy.planner.bounds[1]
    assert policy.exploit(state) == 1
