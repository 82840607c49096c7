"""An evaluation that goes round in circles notices it, where its caller lets it remember."""

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from sb3_combrel.fitted_rmax.loop_detection import HOPEFUL, TRUSTING, TRYING, EpisodeMemory
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.planning.corrections import PATIENCE


def modes(steps, gamma):
    """The way to act at each of some (cell, value, reward), and after the last."""
    memory, seen = EpisodeMemory(), []
    for cell, value, reward in steps:
        seen.append(memory.mode)
        memory.note(cell, value, reward, gamma)
    return [*seen, memory.mode]


@given(st.floats(0.8, 1.0), st.floats(0.01, 100.0), st.integers(1, 7), st.booleans())
def test_who_goes_round_in_circles_tries_one_way_after_another(gamma, size, n_cells, sparse):
    """Costs on the way to somewhere, or a reward that is far away: the value should rise, and doesn't."""
    if sparse and gamma > 0.99:
        gamma = 0.99
    value, reward = (size, 0.0) if sparse else (-size, -size)
    seen = modes([(n % n_cells, value, reward) for n in range(n_cells * (3 * PATIENCE + 10))], gamma)
    assert seen[: n_cells * PATIENCE] == [TRUSTING] * n_cells * PATIENCE
    changes = [mode for mode, before in zip(seen[1:], seen[:-1], strict=True) if mode != before]
    assert changes[:3] == [HOPEFUL, TRYING, TRUSTING]


@given(st.floats(0.9, 1.0), st.floats(0.6, 1.5))
def test_who_makes_progress_has_no_doubts(gamma, part):
    """However small the steps are: values rise by what is hoped for, or by a little less."""
    value, steps = -60.0, []
    for _ in range(40):
        steps.append(("here", value, -1.0))
        value += part * (1.0 + (1.0 - gamma) * value)
    assert set(modes(steps, gamma)) == {TRUSTING}


def test_a_pole_in_balance_stays_there():
    """Each step brings 1, and what is to come is worth 100, with a discount of 0.99; the model errs by some percent."""
    values = np.random.default_rng(0).normal(97.0, 3.0, size=1000)
    assert set(modes([("upright", value, 1.0) for value in values], 0.99)) == {TRUSTING}


def test_another_place_is_another_matter():
    assert set(modes([(n, -50.0, -1.0) for n in range(1000)], 1.0)) == {TRUSTING}


# ------------------------------------------------------------------ through predict


@pytest.fixture
def policy():
    """Knows, wrongly, that action 0 leads on at 0.3; of action 1 it knows nothing."""
    line = spaces.Box(0.0, 1.0, (1,), dtype=np.float64)
    policy = FittedRMaxPolicy(line, spaces.Discrete(2), model_breadth=0.1, resolution=3, rng=np.random.default_rng(0))
    for _ in range(3):
        policy.learn_from(np.array([0.3]), 0, -1.0, np.array([0.32]), False)
    return policy


HERE = np.array([0.3])


def test_what_does_not_come_true_is_not_tried_for_ever(policy):
    state, actions = None, []
    for _ in range(4 * PATIENCE):
        action, state = policy.predict(HERE, state, deterministic=True)
        actions.append(int(action))
    assert actions[: PATIENCE + 1] == [0] * (PATIENCE + 1) and 1 in actions


def test_who_remembers_nothing_always_does_the_same(policy):
    actions = {int(policy.predict(HERE, deterministic=True)[0]) for _ in range(4 * PATIENCE)}
    assert actions == {0}


def test_a_new_episode_begins_without_doubts(policy):
    state = None
    for step in range(4 * PATIENCE):
        action, state = policy.predict(HERE, state, np.array([step % PATIENCE == 0]), deterministic=True)
        assert action == 0


def test_each_environment_has_a_memory_of_its_own(policy):
    state, acted = None, []
    for step in range(4 * PATIENCE):
        elsewhere = [step / (4 * PATIENCE)]
        actions, state = policy.predict(np.array([HERE, elsewhere]), state, np.zeros(2, dtype=bool), deterministic=True)
        alone = policy.predict(np.array([elsewhere]), deterministic=True)[0]
        assert actions[1] == alone[0]
        acted.append(int(actions[0]))
    assert 1 in acted


def test_a_state_of_something_else_is_refused(policy):
    _, of_one = policy.predict(HERE, deterministic=True)
    for wrong in (of_one, (np.zeros(2),), ()):
        with pytest.raises(ValueError, match="state must be None or what predict returned for 2 observation"):
            policy.predict(np.array([HERE, HERE]), wrong, deterministic=True)
    assert policy.predict(np.array([HERE, HERE]), deterministic=True)[0].tolist() == [0, 0]


def test_sampling_remembers_nothing(policy):
    assert policy.predict(HERE, deterministic=False)[1] is None
