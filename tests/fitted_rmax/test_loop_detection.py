"""An evaluation that is caught in a loop notices it, where its caller hands on the state that ``predict`` returns."""

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from sb3_combrel.fitted_rmax.loop_detection import EXPLOIT, EXPLORE, OPTIMISTIC, ORDER, EpisodeMemory
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.planning.corrections import MAX_VISITS


def modes(steps, gamma):
    """How actions are chosen at each of some (cell, value, reward), and after the last."""
    memory, seen = EpisodeMemory(), []
    for cell, value, reward in steps:
        seen.append(ORDER[memory.attempt])
        memory.note(cell, value, reward, gamma)
    return [*seen, ORDER[memory.attempt]]


@given(st.floats(0.8, 1.0), st.floats(0.01, 100.0), st.integers(1, 7), st.booleans())
def test_an_episode_caught_in_a_loop_changes_how_actions_are_chosen_again_and_again(gamma, size, n_cells, sparse):
    """Costs along the way, or a reward that is far away: the value should rise, and doesn't."""
    if sparse and gamma > 0.99:
        gamma = 0.99
    value, reward = (size, 0.0) if sparse else (-size, -size)
    seen = modes([(n % n_cells, value, reward) for n in range(n_cells * (3 * MAX_VISITS + 10))], gamma)
    assert seen[: n_cells * MAX_VISITS] == [EXPLOIT] * n_cells * MAX_VISITS
    changes = [mode for mode, before in zip(seen[1:], seen[:-1], strict=True) if mode != before]
    assert changes[:3] == [OPTIMISTIC, EXPLORE, EXPLOIT]


@given(st.floats(0.9, 1.0), st.floats(0.6, 1.5))
def test_an_episode_that_makes_progress_is_not_caught_in_a_loop(gamma, fraction):
    """However small the steps are: values rise by what is expected, or by a little less."""
    value, steps = -60.0, []
    for _ in range(40):
        steps.append(("here", value, -1.0))
        value += fraction * (1.0 + (1.0 - gamma) * value)
    assert set(modes(steps, gamma)) == {EXPLOIT}


def test_a_pole_in_balance_is_not_caught_in_a_loop():
    """Each step brings 1, and what is to come is worth 100, with a discount of 0.99; the model errs by some percent."""
    values = np.random.default_rng(0).normal(97.0, 3.0, size=1000)
    assert set(modes([("upright", value, 1.0) for value in values], 0.99)) == {EXPLOIT}


def test_steps_in_different_cells_are_no_loop():
    assert set(modes([(n, -50.0, -1.0) for n in range(1000)], 1.0)) == {EXPLOIT}


HERE = np.array([0.3])


@pytest.fixture
def policy():
    """Its model predicts, wrongly, that action 0 leads on at 0.3; action 1 is unknown."""
    line = spaces.Box(0.0, 1.0, (1,), dtype=np.float64)
    policy = FittedRMaxPolicy(line, spaces.Discrete(2), model_breadth=0.1, resolution=3, rng=np.random.default_rng(0))
    for _ in range(3):
        policy.agent.update(HERE, 0, -1.0, np.array([0.32]), False)
    return policy


def test_predict_with_a_state_tries_another_action_where_it_is_caught_in_a_loop(policy):
    state, actions = None, []
    for _ in range(4 * MAX_VISITS):
        action, state = policy.predict(HERE, state, deterministic=True)
        actions.append(int(action))
    assert actions[: MAX_VISITS + 1] == [0] * (MAX_VISITS + 1) and 1 in actions


def test_predict_without_a_state_always_chooses_the_same_action(policy):
    actions = {int(policy.predict(HERE, deterministic=True)[0]) for _ in range(4 * MAX_VISITS)}
    assert actions == {0}


def test_predict_forgets_visits_when_an_episode_begins(policy):
    state = None
    for step in range(4 * MAX_VISITS):
        action, state = policy.predict(HERE, state, np.array([step % MAX_VISITS == 0]), deterministic=True)
        assert action == 0


def test_predict_counts_visits_of_each_environment_by_itself(policy):
    state, acted = None, []
    for step in range(4 * MAX_VISITS):
        elsewhere = [step / (4 * MAX_VISITS)]
        actions, state = policy.predict(np.array([HERE, elsewhere]), state, np.zeros(2, dtype=bool), deterministic=True)
        alone = policy.predict(np.array([elsewhere]), deterministic=True)[0]
        assert actions[1] == alone[0]
        acted.append(int(actions[0]))
    assert 1 in acted


def test_predict_refuses_a_state_that_it_did_not_return_for_as_many_observations(policy):
    _, of_one = policy.predict(HERE, deterministic=True)
    for wrong in (of_one, (np.zeros(2),), ()):
        with pytest.raises(ValueError, match="state must be None or what predict returned for 2 observation"):
            policy.predict(np.array([HERE, HERE]), wrong, deterministic=True)
    assert policy.predict(np.array([HERE, HERE]), deterministic=True)[0].tolist() == [0, 0]
