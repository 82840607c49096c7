"""bsuite's tasks with a Gymnasium face: what is read from its observations, and ends by Gymnasium's limit alone."""

import numpy as np
import pytest

from sb3_combrel.experiments.tasks.bsuite_tasks import FACES, SEA, make_bsuite

pytest.importorskip("bsuite")


def steps(env, n, seed=0):
    rng = np.random.default_rng(seed)
    for _ in range(n):
        yield env.step(rng.integers(env.action_space.n))


@pytest.mark.parametrize("name", FACES)
@pytest.mark.parametrize("observed", [False, True])
def test_episodes_follow_from_their_seed_and_stay_in_their_spaces(name, observed):
    with make_bsuite(name, observed) as env, make_bsuite(name, observed) as other:
        for seed in (3, None):
            (state, _), (same, _) = env.reset(seed=seed), other.reset(seed=seed)
            np.testing.assert_array_equal(state, same)
            for (state, reward, *ends), (same, other_reward, *other_ends) in zip(
                steps(env, 10), steps(other, 10), strict=True
            ):
                np.testing.assert_array_equal(state, same)
                assert reward == other_reward and ends[:2] == other_ends[:2] and env.observation_space.contains(state)


def test_state_variables_are_those_of_bsuite():
    for name in ("mountain_car", "cartpole_swingup"):
        with make_bsuite(name) as env:
            env.reset(seed=1)
            inner = env.unwrapped._environment
            for state, *_ in steps(env, 30):
                if name == "mountain_car":
                    known = [inner._position, inner._velocity]
                else:
                    x, speed, angle, turning, _ = inner._state
                    known = [x / 3.0, np.remainder(angle + np.pi, 2 * np.pi) - np.pi, speed / 3.0, turning]
                np.testing.assert_allclose(state, known, atol=1e-5)


def test_the_sea_is_seen_by_row_and_column_and_ends_below_its_last_row():
    with make_bsuite("deep_sea") as env:
        state, _ = env.reset(seed=1)
        np.testing.assert_array_equal(state, [0.0, 0.0])
        seen = list(steps(env, SEA))
        assert [state[0] for state, *_ in seen] == list(range(1, SEA + 1))
        assert [terminated for _, _, terminated, *_ in seen] == [False] * (SEA - 1) + [True]


def test_only_the_time_limit_ends_an_episode_that_has_not_failed():
    with make_bsuite("mountain_car") as env:
        env.reset(seed=1)
        ends = [env.step(1)[2:4] for _ in range(1000)]
    assert ends == [(False, False)] * 999 + [(False, True)]
