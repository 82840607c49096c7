"""The point robot: an environment as Gymnasium wants it, walls that hold, and a way around them."""

from contextlib import closing

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as check_env_for_sb3

from sb3_combrel import FittedRMax
from sb3_combrel.experiments.benchmark.pairs import ACTIONS, ORDER, SIGNS, make_car, make_disguised_car
from sb3_combrel.experiments.suite.tasks import TASKS
from sb3_combrel.experiments.tasks import point_robot
from sb3_combrel.experiments.tasks.cart_with_pendulum import PARTS, CartWithPendulumEnv
from sb3_combrel.experiments.tasks.disguised import disguise, disguised, mirrored
from sb3_combrel.runs.episodes import EpisodeRecorder


@pytest.mark.parametrize("start", ["fixed", "random"])
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("n_variables", [2, 3])
def test_environment_checkers_accept_it(n_variables, noise, start):
    check_env(point_robot.PointRobotEnv(n_variables, noise, start), skip_render_check=True)
    check_env_for_sb3(point_robot.PointRobotEnv(n_variables, noise, start))


def move_in_tiny_steps(position, displacement, walls, n=500):
    position = position.copy()
    for axis, distance in enumerate(displacement):
        for _ in range(n):
            moved = position.copy()
            moved[axis] += distance / n
            inside = any((moved > wall.low).all() and (moved < wall.high).all() for wall in walls)
            if inside or not 0.0 <= moved[axis] <= 1.0:
                break
            position = moved
    return position


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_a_move_ends_at_the_first_wall_or_boundary_in_its_way(seed, n_variables):
    rng = np.random.default_rng(seed)
    position, walls = rng.random(n_variables), point_robot.WALLS[n_variables]
    # A start in a wall is moved beside one, where something is to be seen.
    if any(wall.contains(position) for wall in walls):
        position[0] = rng.choice([0.29, 0.37, 0.63, 0.71])
    displacement = rng.uniform(-0.5, 0.5, n_variables)
    expected = move_in_tiny_steps(position, displacement, walls)
    found = point_robot.move(position, displacement, walls)
    np.testing.assert_allclose(found, expected, atol=np.abs(displacement).max() / 500 + 1e-9)
    assert not any(wall.contains(found) for wall in walls)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_a_slab_is_all_of_a_layer_but_its_gap(seed, n_variables):
    rng = np.random.default_rng(seed)
    axis = int(rng.integers(n_variables))
    gap = [(low, high) if rng.random() < 0.7 else (0.0, 1.0) for low, high in np.sort(rng.random((n_variables - 1, 2)))]
    walls = point_robot.slab(axis, 0.4, 0.5, gap)
    others = [other for other in range(n_variables) if other != axis]
    for position in rng.random((60, n_variables)):
        position[axis] = rng.choice([position[axis], 0.45])
        in_gap = all(low <= position[other] <= high for other, (low, high) in zip(others, gap, strict=True))
        expected = 0.4 < position[axis] < 0.5 and not in_gap
        assert any(wall.contains(position) for wall in walls) == expected


def test_starts_rewards_and_ends():
    fixed = point_robot.make_point_robot(3)
    first, _ = fixed.reset(seed=0)
    second, _ = fixed.reset(seed=1)
    np.testing.assert_array_equal(first, second)
    env = point_robot.PointRobotEnv(2, start="random")
    starts = np.array([env.reset(seed=0 if n == 0 else None)[0] for n in range(300)])
    assert len(np.unique(starts, axis=0)) == 300
    assert not any(wall.contains(start) for wall in env.walls for start in starts)
    assert not (starts >= env.goal.low.astype(np.float32)).all(axis=1).any()
    # Down, into the corner, 400 times; then the same without walls, up, to the goal.
    outcomes = [fixed.step(0)[1:4] for _ in range(point_robot.MAX_EPISODE_STEPS)]
    assert outcomes == [(-1.0, False, False)] * (point_robot.MAX_EPISODE_STEPS - 1) + [(-1.0, False, True)]
    env = point_robot.PointRobotEnv(2)
    env.walls = ()
    env.reset(seed=0)
    outcomes = [env.step(action) for action in [1] * 13 + [3] * 13]
    assert [terminated for _, _, terminated, _, _ in outcomes] == [False] * 25 + [True]
    assert outcomes[-1][4] == {"is_success": True}
    np.testing.assert_allclose(outcomes[-1][0], [0.88, 0.88], atol=1e-6)


def test_noise_is_the_seeds_and_of_the_size_that_was_asked_for():
    def walk(seed):
        env = point_robot.PointRobotEnv(3, noise=0.01)
        positions = [env.reset(seed=seed)[0]]
        positions += [env.step(action)[0] for action in [1, 0] * 200]
        return np.diff(positions, axis=0)

    np.testing.assert_array_equal(walk(3), walk(3))
    moves = walk(3)
    assert (moves != walk(4)).any()
    free = moves[:, 0] - point_robot.STEP * np.tile([1, -1], 200)
    assert np.std(free[np.abs(free) < 0.05]) == pytest.approx(0.01, rel=0.15)


@pytest.mark.parametrize("argument", [dict(n_variables=4), dict(noise=-0.1), dict(noise=np.nan), dict(start="middle")])
def test_bad_input_is_refused(argument):
    with pytest.raises(ValueError, match=next(iter(argument))):
        point_robot.PointRobotEnv(**argument)


def test_bad_actions_and_steps_before_reset_are_refused():
    env = point_robot.PointRobotEnv(2)
    with pytest.raises(gym.error.ResetNeeded):
        env.step(0)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="action must be in"):
        env.step(4)


@pytest.mark.long
@pytest.mark.parametrize("seed", [22, 33])
def test_exploration_finds_the_small_goal_at_the_other_end(seed):
    with closing(TASKS["PointRobot3D"].make()) as env:
        recorder = EpisodeRecorder()
        FittedRMax(env, seed=seed).learn(5000, recorder, log_interval=None)
    assert recorder.episodes.terminated[-10:].all()


# A car in disguise, and a cart that carries a pendulum.
class TestDisguise:
    def test_is_the_same_task_under_the_mapping(self):
        """Every step of the disguised car is one of the car's, to rounding."""
        plain, other = make_car(), make_disguised_car()
        box, mapping = plain.observation_space, disguise(ORDER, SIGNS, ACTIONS)
        first, _ = plain.reset(seed=3)
        seen, _ = other.reset(seed=3)
        rng = np.random.default_rng(0)
        for _ in range(150):
            unit = (seen - other.observation_space.low) / (other.observation_space.high - other.observation_space.low)
            back = box.low + mapping.target_to_source(unit[None].astype(np.float64), 2)[0] * (box.high - box.low)
            np.testing.assert_allclose(back, first, atol=1e-6)
            action = int(rng.integers(3))
            seen, reward, *ends, _ = other.step(action)
            first, own_reward, *own_ends, _ = plain.step(mapping.action[action])
            assert (reward, ends) == (own_reward, own_ends)
        assert other.observation_space.contains(seen)

    @pytest.mark.parametrize(
        "order, signs, actions, words",
        [
            ((0, 0), (1, 1), (0, 1, 2), "order must hold each of 0 to 1 once"),
            ((0, 1), (1,), (0, 1, 2), "one bool for each of the 2 variables"),
            ((0, 1), (1, 1), (0, 1, 1), "order must hold each of 0 to 2 once"),
        ],
    )
    def test_refuses_what_does_not_fit(self, order, signs, actions, words):
        with pytest.raises(ValueError, match=words):
            disguised(make_car(), order, signs, actions)

    def test_variables_without_bounds_are_not_mirrored(self):
        with pytest.raises(ValueError, match="where bounds are finite"):
            mirrored(gym.make("CartPole-v1"), (False, True, False, False))


class TestCartWithPendulum:
    @pytest.mark.parametrize("parts", PARTS)
    def test_gymnasium_finds_nothing_wrong(self, parts):
        check_env(CartWithPendulumEnv(parts), skip_render_check=True)

    def test_another_part_is_refused(self):
        with pytest.raises(ValueError, match="parts must be one of cart, pendulum, both, got 'wheel'"):
            CartWithPendulumEnv("wheel")

    def test_the_cart_moves_as_it_does_alone_and_so_does_the_pendulum_without_pushes(self):
        for alone, columns, actions in (("cart", slice(0, 2), (0, 1, 2)), ("pendulum", slice(2, 4), (0, 3, 4))):
            both, part = CartWithPendulumEnv("both"), CartWithPendulumEnv(alone)
            both.reset(seed=5)
            part.reset(seed=5)
            for action in np.random.default_rng(0).integers(0, 3, size=200).tolist():
                np.testing.assert_array_equal(both.step(actions[action])[0][columns], part.step(action)[0])

    def test_a_torque_alone_does_not_lift_the_pendulum(self):
        env = CartWithPendulumEnv("pendulum")
        env.reset(seed=0)
        assert not any(env.step(2)[2] for _ in range(300))
        # With the velocity it does.
        env.reset(seed=0)
        state, ended = env.reset(seed=0)[0], False
        for _ in range(300):
            state, _, ended, _, _ = env.step(2 if state[1] > 0 else 1)
            if ended:
                break
        assert ended and np.cos(state[0]) >= 0.9

    def test_pushes_move_the_cart_to_its_goal_and_pull_the_pendulum(self):
        env = CartWithPendulumEnv("cart")
        env.reset(seed=0)
        assert 20 <= next(k for k in range(300) if env.step(2)[2]) <= 60
        both, turned = CartWithPendulumEnv("both"), []
        for action in (0, 2):
            both.reset(seed=0)
            turned.append(both.step(action)[0][3])
        assert turned[0] != turned[1]
