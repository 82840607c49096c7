"""The iCub's ball-striking tasks: hits, noise, starts and bad input."""

import math

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from helpers.environments import ARM, ICUBS, NOISY, TORSO, observations, plan_of

import combrel_envs
from combrel_envs import icub_tasks

STARTS = {TORSO: [0, 40], ARM: [-40, 40, -10, 60]}


def random_actions(env_id, n, seed=0):
    return np.random.default_rng(seed).integers(2 * len(STARTS[env_id]), size=n).tolist()


class TestHits:
    @pytest.mark.long
    @pytest.mark.parametrize(("env_id", "least", "most"), [(TORSO, 0.04, 0.08), (ARM, 0.01, 0.04)])
    def test_random_commands_seldom_hit_the_ball(self, env_id, least, most):
        env, hits = gymnasium.make(env_id), 0
        for actions in np.array(random_actions(env_id, 400 * 400)).reshape(400, 400).tolist():
            env.reset()
            hits += any(env.step(action)[2] for action in actions)
        # The standard error of 400 episodes is 0.012 (torso) and 0.008 (arm).
        assert least <= hits / 400 <= most

    def test_the_ball_lies_still_until_it_is_hit(self):
        environment = combrel_envs.load("icub", "arm_strike")
        environment.reset()
        displacements = []
        for action in plan_of(ARM):
            environment.step(action)
            displacements.append(environment.physics.ball_displacement())
        assert set(displacements[:-1]) == {0.0} and displacements[-1] > icub_tasks.HIT_DISTANCE

    def test_the_force_of_a_hand_on_the_table_does_not_grow(self):
        env = gymnasium.make(TORSO, start=(0, 0), max_episode_steps=10_000)
        env.reset()
        physics = env.unwrapped.environment.physics
        down, up = (env.unwrapped.action_names.index(name) for name in ("S1+", "S1-"))
        for _ in range(100):
            blocked = env.step(down)[0][0]
        assert blocked < 16 and physics.hand_distance("table") > -0.03 and env.step(up)[0][0] < blocked - 0.5

    def test_a_hit_on_the_last_step_of_the_time_limit_is_an_end(self):
        environment = combrel_envs.load("icub", "torso_strike", {"time_limit": 2.6})
        environment.reset()
        last = [environment.step(action) for action in plan_of(TORSO)][-1]
        assert last.last() and last.discount == 0.0 and last.reward == 99.0

    def test_the_joints_are_only_those_of_the_task_and_the_ball(self):
        for task, n in (("torso_strike", 2), ("arm_strike", 4)):
            model = combrel_envs.load("icub", task).physics.model
            assert (model.nu, model.nv) == (n, n + 6)


@pytest.mark.parametrize("env_id", ICUBS)
class TestEpisodes:
    def test_every_episode_begins_at_the_same_place_with_the_same_ball(self, env_id):
        env = gymnasium.make(env_id)
        first, _ = env.reset(seed=1)
        np.testing.assert_allclose(first, STARTS[env_id], atol=1e-5)
        for action in plan_of(env_id):
            env.step(action)
        with pytest.raises(ResetNeeded):
            env.unwrapped.step(0)
        assert env.reset()[0].tolist() == first.tolist() == env.reset(seed=2)[0].tolist()
        assert env.unwrapped.environment.physics.ball_displacement() == 0.0

    def test_without_noise_a_run_repeats_itself_bit_by_bit(self, env_id):
        actions, env = random_actions(env_id, 150), gymnasium.make(env_id)
        runs = [[env.reset()[0].tolist()] + [env.step(action)[0].tolist() for action in actions] for _ in range(2)]
        assert runs[0] == runs[1] == observations(env_id, actions, seed=1)

    def test_observations_stay_within_the_bounds_at_the_limits(self, env_id):
        env = gymnasium.make(NOISY[env_id])
        env.reset(seed=0)
        for action in range(2 * len(STARTS[env_id])):
            for _ in range(90):
                observation, _, terminated, truncated, _ = env.step(action)
                assert env.observation_space.contains(observation)
                if terminated or truncated:
                    env.reset()

    def test_each_action_moves_its_joint_by_the_extent(self, env_id):
        env = gymnasium.make(env_id)
        for action, name in enumerate(env.unwrapped.action_names):
            before, _ = env.reset()
            for _ in range(3):
                after, *_ = env.step(action)
            expected = np.zeros_like(before)
            expected[int(name[1]) - 1] = 6 if name[2] == "+" else -6
            np.testing.assert_allclose(after - before, expected, atol=0.3)

    def test_a_seed_decides_the_noise_which_is_that_of_the_manual(self, env_id):
        actions = random_actions(env_id, 30)
        first = observations(NOISY[env_id], actions, seed=3)
        assert first == observations(env_id, actions, seed=3, motor_noise=0.1, encoder_noise=0.2)
        assert first != observations(NOISY[env_id], actions, seed=4)


class TestOptions:
    def test_encoder_noise_is_in_the_readings_only(self):
        actions = random_actions(ARM, 60)
        plain, noisy = (np.array(observations(ARM, actions, encoder_noise=noise)) for noise in (0.0, 0.2))
        # Small enough for the limits to cut little of it off.
        assert 0.15 < np.std(noisy - plain) < 0.25 and abs(np.mean(noisy - plain)) < 0.04

    def test_motor_noise_changes_how_far_a_command_goes(self):
        environment = combrel_envs.load("icub", "torso_strike", {"motor_noise": 0.1, "random": 0})
        steps = []
        for _ in range(300):
            environment.reset()
            before = environment.physics.targets()
            environment.step(2)
            steps.append(before[1] - environment.physics.targets()[1])
        assert np.mean(steps) == pytest.approx(2.0, abs=0.04) and np.std(steps) == pytest.approx(0.2, abs=0.03)

    def test_the_extent_is_how_far_a_command_goes(self):
        before, after = observations(TORSO, [2], extent=5.0)
        assert after[1] == pytest.approx(before[1] - 5, abs=0.4)

    def test_another_start_can_be_the_rule_or_an_exception(self):
        env = gymnasium.make(ARM, start=(-36, 44, -14, 60))
        np.testing.assert_allclose(env.reset()[0], (-36, 44, -14, 60), atol=1e-5)
        np.testing.assert_allclose(env.reset(options={"start": (-36, 46, -20, 66)})[0], (-36, 46, -20, 66), atol=1e-5)
        np.testing.assert_allclose(env.reset()[0], (-36, 44, -14, 60), atol=1e-5)

    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"look": "wood"}, "look must be one of 'primitives', 'meshes', got 'wood'"),
            ({"start": (0, 60)}, "start: torso_yaw must lie between -50 and 50 degrees, got 60"),
            ({"start": (0, math.nan)}, "start: torso_yaw must lie between"),
            ({"start": (0, 1, 2)}, r"start must be 2 angles in degrees \(torso_pitch, torso_yaw\), got \(0, 1, 2\)"),
            ({"start": "left"}, "start must be 2 angles"),
            ({"start": (10, -2)}, r"start must leave the ball untouched; at \(10, -2\) degrees .* touches it already"),
            ({"start": (40, 0)}, r"above the table or beside it; at \(40, 0\) degrees of \(torso_pitch, torso_yaw\)"),
            ({"extent": 0}, "extent must be a finite number above 0, got 0"),
            ({"motor_noise": -0.1}, "motor_noise must be a finite number of at least 0, got -0.1"),
            ({"encoder_noise": math.inf}, "encoder_noise must be a finite number of at least 0, got inf"),
            ({"time_limit": 0}, "time_limit must be a number of seconds above 0"),
        ],
    )
    def test_wrong_arguments_are_errors(self, kwargs, message):
        with pytest.raises(ValueError, match=message):
            combrel_envs.load("icub", "torso_strike", kwargs)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"begin": (0, 0)}, "options of reset must be empty or have a 'start', got {'begin'"),
            ({"start": (10, -2)}, "start must leave the ball untouched"),
        ],
    )
    def test_wrong_reset_options_are_errors_and_do_not_change_the_next_episode(self, options, message):
        env = gymnasium.make(TORSO)
        env.reset()
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)
        np.testing.assert_allclose(env.reset()[0], STARTS[TORSO], atol=1e-5)

    @pytest.mark.parametrize("call", ["reset", "render"])
    def test_a_call_after_close_says_so(self, call):
        env = gymnasium.make(TORSO, render_mode="rgb_array").unwrapped
        env.close()
        with pytest.raises(ClosedEnvironmentError, match=rf"{call}\(\) must come before close\(\)"):
            getattr(env, call)()
