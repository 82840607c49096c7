"""The iCub's ball-striking tasks: known plans, spaces, noise, starts, conventions and bad input."""

import math
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from helpers.icub_plans import ARM, IDS, LENGTHS, NOISY, TASKS, TORSO, observations, plan_of, replay
from stable_baselines3.common.env_checker import check_env as check_sb3_env

import combrel_envs
from combrel_envs import icub_tasks

LIMITS = {
    TORSO: ([-20, -50], [70, 50]),
    ARM: ([-95.5, 0, -37, 15], [10, 160.8, 80, 106]),
}
STARTS = {TORSO: [0, 40], ARM: [-40, 40, -10, 60]}


def random_actions(env_id, n, seed=0):
    return np.random.default_rng(seed).integers(gymnasium.make(env_id).action_space.n, size=n).tolist()


def hits_of_random_actions(env_id, n_episodes):
    """Share of the episodes in which random actions hit the ball."""
    env, hits = gymnasium.make(env_id), 0
    for actions in np.array(random_actions(env_id, 400 * n_episodes)).reshape(n_episodes, 400).tolist():
        env.reset()
        hits += any(env.step(action)[2] for action in actions)
    return hits / n_episodes


class TestHits:
    @pytest.mark.parametrize("env_id", IDS)
    def test_a_known_plan_hits_the_ball_on_its_last_command(self, env_id):
        actions = plan_of(env_id)
        least, most = LENGTHS[env_id]
        assert least <= len(actions) <= most
        steps = replay(env_id, actions)[1:]
        assert [step[2] for step in steps] == [False] * (len(actions) - 1) + [True]
        assert [step[4]["is_success"] for step in steps] == [step[2] for step in steps]
        assert [step[1] for step in steps] == [-1.0] * (len(actions) - 1) + [99.0]
        assert not any(step[3] for step in steps)

    @pytest.mark.slow
    @pytest.mark.parametrize(("env_id", "least", "most"), [(TORSO, 0.04, 0.08), (ARM, 0.01, 0.04)])
    def test_random_commands_seldom_hit_the_ball(self, env_id, least, most):
        # The standard error of 400 episodes is 0.012 (torso) and 0.008 (arm).
        assert least <= hits_of_random_actions(env_id, 400) <= most

    def test_a_hit_is_noticed_though_the_contact_is_over(self):
        environment = combrel_envs.load("icub", "torso_strike")
        environment.reset()
        steps = [environment.step(action) for action in plan_of(TORSO)]
        assert steps[-1].last() and environment.physics.ball_displacement() > icub_tasks.HIT_DISTANCE

    def test_the_ball_lies_still_until_it_is_hit(self):
        environment = combrel_envs.load("icub", "arm_strike")
        environment.reset()
        for action in plan_of(ARM)[:-1]:
            environment.step(action)
            assert environment.physics.ball_displacement() == 0.0

    def test_the_force_of_a_hand_on_the_table_does_not_grow(self):
        env = gymnasium.make(TORSO, start=(0, 0), max_episode_steps=10_000)
        env.reset()
        physics = env.unwrapped.environment.physics
        down, up = (env.unwrapped.action_names.index(name) for name in ("S1+", "S1-"))
        for _ in range(100):
            blocked = env.step(down)[0][0]
        assert blocked < 16 and physics.hand_distance("table") > -0.03
        lifted = env.step(up)[0][0]
        assert lifted < blocked - 0.5


class TestEpisodes:
    @pytest.mark.parametrize("env_id", IDS)
    def test_400_steps_truncate_and_dont_terminate(self, env_id):
        env = gymnasium.make(env_id)
        assert env.spec.max_episode_steps == 400
        env.reset(seed=0)
        steps = [env.step(index % 2) for index in range(400)]
        assert [step[2:4] for step in steps] == [(False, False)] * 399 + [(False, True)]
        assert {step[1] for step in steps} == {-1.0} and not any(step[4]["is_success"] for step in steps)

    def test_make_can_set_another_limit(self):
        env = gymnasium.make(ARM, max_episode_steps=7)
        env.reset(seed=0)
        assert [env.step(0)[3] for _ in range(7)] == [False] * 6 + [True]

    @pytest.mark.parametrize("env_id", IDS)
    def test_a_hit_on_the_very_last_step_terminates(self, env_id):
        actions = plan_of(env_id)
        last = replay(env_id, actions, max_episode_steps=len(actions))[-1]
        assert last[2] and last[1] == 99.0

    @pytest.mark.parametrize("env_id", IDS)
    def test_every_episode_begins_at_the_same_place_with_the_same_ball(self, env_id):
        env = gymnasium.make(env_id)
        first, _ = env.reset(seed=1)
        np.testing.assert_allclose(first, STARTS[env_id], atol=1e-5)
        for action in plan_of(env_id):
            env.step(action)
        assert env.reset()[0].tolist() == first.tolist() == env.reset(seed=2)[0].tolist()
        assert env.unwrapped.environment.physics.ball_displacement() == 0.0

    @pytest.mark.parametrize("env_id", IDS)
    def test_stepping_outside_an_episode_is_an_error(self, env_id):
        env = gymnasium.make(env_id).unwrapped
        with pytest.raises(ResetNeeded):
            env.step(0)
        env.reset()
        for action in plan_of(env_id):
            env.step(action)
        with pytest.raises(ResetNeeded):
            env.step(0)

    @pytest.mark.parametrize("env_id", IDS)
    def test_without_noise_a_run_repeats_itself_bit_by_bit(self, env_id):
        actions = random_actions(env_id, 150)
        first = observations(env_id, actions)
        assert first == observations(env_id, actions, seed=1)
        env = gymnasium.make(env_id)
        for _ in range(2):
            again = [env.reset()[0].tolist()] + [env.step(action)[0].tolist() for action in actions]
            assert again == first


class TestSpaces:
    @pytest.mark.parametrize("env_id", IDS)
    def test_the_bounds_are_the_joint_limits(self, env_id):
        env = gymnasium.make(env_id)
        low, high = LIMITS[env_id]
        np.testing.assert_array_equal(env.observation_space.low, np.float32(low))
        np.testing.assert_array_equal(env.observation_space.high, np.float32(high))
        assert env.action_space == gymnasium.spaces.Discrete(2 * len(low))
        assert env.observation_space.dtype == np.float32

    @pytest.mark.parametrize("env_id", [*IDS, *NOISY.values()])
    def test_observations_stay_within_the_bounds_at_the_limits(self, env_id):
        env = gymnasium.make(env_id)
        env.reset(seed=0)
        for joint in range(len(env.unwrapped.state_names)):
            for direction in (0, 1):
                for _ in range(90):
                    observation, _, terminated, truncated, _ = env.step(2 * joint + direction)
                    assert env.observation_space.contains(observation)
                    if terminated or truncated:
                        env.reset()

    @pytest.mark.parametrize("env_id", IDS)
    def test_each_action_moves_its_joint_by_the_extent(self, env_id):
        env = gymnasium.make(env_id)
        for action, name in enumerate(env.unwrapped.action_names):
            before, _ = env.reset()
            for _ in range(3):
                after, *_ = env.step(action)
            expected = np.zeros_like(before)
            expected[int(name[1]) - 1] = 6 if name[2] == "+" else -6
            np.testing.assert_allclose(after - before, expected, atol=0.3)

    def test_names_and_order_are_those_of_the_paper(self):
        torso, arm = (gymnasium.make(env_id).unwrapped for env_id in IDS)
        assert torso.state_names == ("torso_pitch", "torso_yaw")
        assert arm.state_names == ("r_shoulder_pitch", "r_shoulder_roll", "r_shoulder_yaw", "r_elbow")
        assert torso.action_names == ("S1-", "S1+", "S2-", "S2+")
        assert arm.action_names == ("T1-", "T1+", "T2-", "T2+", "T3-", "T3+", "T4-", "T4+")

    def test_mapping_tables_read_by_joint(self):
        from sb3_combrel import COMBREL, FittedRMax, SourceInstances

        source = SourceInstances.record(None, TORSO, n_instances=20, seed=0)
        model = FittedRMax(ARM, transfer=COMBREL(source), max_value=100, resolution=3, model_breadth=0.4, seed=0)
        assert model.agent.task.state_names[0] == "r_shoulder_pitch" and model.agent.task.action_names[0] == "T1-"
        assert source.state_names == ("torso_pitch", "torso_yaw") and source.action_names[3] == "S2+"

    @pytest.mark.parametrize("env_id", [*IDS, *NOISY.values()])
    def test_the_checkers_find_no_fault(self, env_id):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            check_sb3_env(gymnasium.make(env_id))
            check_gymnasium_env(gymnasium.make(env_id, render_mode="rgb_array", width=64, height=48).unwrapped)


class TestOptions:
    @pytest.mark.parametrize("env_id", IDS)
    def test_a_seed_decides_the_noise(self, env_id):
        actions = random_actions(env_id, 30)
        first = observations(NOISY[env_id], actions, seed=3)
        assert first == observations(NOISY[env_id], actions, seed=3)
        assert first != observations(NOISY[env_id], actions, seed=4)

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
        assert np.mean(steps) == pytest.approx(2.0, abs=0.04)
        assert np.std(steps) == pytest.approx(0.2, abs=0.03)

    @pytest.mark.parametrize("env_id", IDS)
    def test_the_noisy_variants_have_the_noise_of_the_manual(self, env_id):
        assert gymnasium.spec(NOISY[env_id]).kwargs == {"motor_noise": 0.1, "encoder_noise": 0.2}
        actions = random_actions(env_id, 20)
        noise = {"motor_noise": 0.1, "encoder_noise": 0.2}
        assert observations(NOISY[env_id], actions) == observations(env_id, actions, **noise)

    @pytest.mark.parametrize("env_id", IDS)
    def test_the_noise_decides_whether_the_plan_hits(self, env_id):
        def hits(seed):
            env = gymnasium.make(NOISY[env_id])
            env.reset(seed=seed)
            return any(env.step(action)[2] for action in plan_of(env_id))

        outcomes = [hits(seed) for seed in range(20)]
        assert True in outcomes and False in outcomes

    def test_the_extent_is_how_far_a_command_goes(self):
        env = gymnasium.make(TORSO, extent=5.0)
        before, _ = env.reset()
        assert env.step(2)[0][1] == pytest.approx(before[1] - 5, abs=0.4)

    def test_another_start_can_be_the_rule_or_an_exception(self):
        env = gymnasium.make(ARM, start=(-36, 44, -14, 60))
        np.testing.assert_allclose(env.reset()[0], (-36, 44, -14, 60), atol=1e-5)
        np.testing.assert_allclose(env.reset(options={"start": (-36, 46, -20, 66)})[0], (-36, 46, -20, 66), atol=1e-5)
        np.testing.assert_allclose(env.reset()[0], (-36, 44, -14, 60), atol=1e-5)


class TestDmControl:
    @pytest.mark.parametrize("env_id", IDS)
    def test_both_interfaces_give_the_same_episodes(self, env_id):
        environment = combrel_envs.load("icub", TASKS[env_id])
        ours = [environment.reset()] + [environment.step(action) for action in plan_of(env_id)]
        theirs = replay(env_id, plan_of(env_id))
        assert [step.observation["encoders"].astype(np.float32).tolist() for step in ours] == [s[0].tolist() for s in theirs]
        assert ours[-1].last() and ours[-1].discount == 0.0 and ours[-1].reward == 99.0

    @pytest.mark.parametrize("task", ["torso_strike", "arm_strike", "torso_strike_noisy", "arm_strike_noisy"])
    def test_observations_and_actions_fit_the_specs(self, task):
        environment = combrel_envs.load("icub", task, {"random": 0})
        time_step = environment.reset()
        for action in range(environment.action_spec().num_values):
            environment.action_spec().validate(action)
            environment.observation_spec()["encoders"].validate(time_step.observation["encoders"])
            time_step = environment.step(action)

    def test_the_default_time_limit_is_400_steps(self):
        environment = combrel_envs.load("icub", "arm_strike")
        environment.reset()
        steps = [environment.step(0) for _ in range(400)]
        assert [step.last() for step in steps] == [False] * 399 + [True]
        assert steps[-1].discount == 1.0

    @pytest.mark.parametrize("n_steps", [1, 3, 6, 29])
    def test_the_time_limit_can_be_set(self, n_steps):
        environment = combrel_envs.load("icub", "arm_strike", {"time_limit": n_steps * 0.1})
        environment.reset()
        assert [environment.step(0).last() for _ in range(n_steps)] == [False] * (n_steps - 1) + [True]

    def test_a_hit_on_the_last_step_of_the_time_limit_is_an_end(self):
        environment = combrel_envs.load("icub", "torso_strike", {"time_limit": 2.6})
        environment.reset()
        last = [environment.step(action) for action in plan_of(TORSO)][-1]
        assert last.last() and last.discount == 0.0 and last.reward == 99.0

    def test_the_joints_are_only_those_of_the_task_and_the_ball(self):
        for task, n in (("torso_strike", 2), ("arm_strike", 4)):
            model = combrel_envs.load("icub", task).physics.model
            assert (model.nu, model.nv) == (n, n + 6)


class TestBadInput:
    @pytest.mark.parametrize(
        ("kwargs", "message"),
        [
            ({"look": "wood"}, "look must be one of 'primitives', 'meshes', got 'wood'"),
            ({"start": (0, 60)}, "start: torso_yaw must lie between -50 and 50 degrees, got 60"),
            ({"start": (0, math.nan)}, "start: torso_yaw must lie between"),
            ({"start": (0, 1, 2)}, r"start must be 2 angles in degrees \(torso_pitch, torso_yaw\), got \(0, 1, 2\)"),
            ({"start": "left"}, "start must be 2 angles"),
            ({"start": 3}, "start must be 2 angles"),
            ({"start": (10, -2)}, r"start must leave the ball untouched; at \(10, -2\) degrees .* touches it already"),
            ({"start": (40, 0)}, r"above the table or beside it; at \(40, 0\) degrees of \(torso_pitch, torso_yaw\)"),
            ({"extent": 0}, "extent must be a finite number above 0, got 0"),
            ({"extent": "far"}, "extent must be a finite number above 0, got 'far'"),
            ({"motor_noise": -0.1}, "motor_noise must be a finite number of at least 0, got -0.1"),
            ({"encoder_noise": math.inf}, "encoder_noise must be a finite number of at least 0, got inf"),
            ({"camera": "side"}, "camera must be one of 'front', 'top', got 'side'"),
        ],
    )
    def test_wrong_arguments_are_errors(self, kwargs, message):
        with pytest.raises(ValueError, match=message):
            gymnasium.make(TORSO, **kwargs)

    def test_an_unknown_task_is_an_error_that_names_the_tasks(self):
        with pytest.raises(ValueError, match=r"task of 'icub' must be one of 'torso_strike', 'arm_strike', .*, got 'kick'"):
            combrel_envs.load("icub", "kick")

    @pytest.mark.parametrize("time_limit", [0, -1, "long", math.nan])
    def test_an_impossible_time_limit_is_an_error(self, time_limit):
        with pytest.raises(ValueError, match="time_limit must be a number of seconds above 0"):
            combrel_envs.load("icub", "arm_strike", {"time_limit": time_limit})

    @pytest.mark.parametrize("action", [-1, 4, 1.0, "S1+", None])
    def test_impossible_actions_are_errors(self, action):
        env = gymnasium.make(TORSO)
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"action must be an integer from 0 to 3 \(S1-, S1\+, S2-, S2\+\)"):
            env.step(action)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"begin": (0, 0)}, "options of reset must be empty or have a 'start', got {'begin'"),
            ({"start": (10, -2)}, "start must leave the ball untouched"),
            ({"start": (0, 51)}, "torso_yaw must lie between"),
        ],
    )
    def test_wrong_reset_options_are_errors_and_do_not_change_the_next_episode(self, options, message):
        env = gymnasium.make(TORSO)
        env.reset()
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)
        np.testing.assert_allclose(env.reset()[0], STARTS[TORSO], atol=1e-5)

    def test_missing_meshes_are_an_error_that_says_what_to_install(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "icub_models", None)
        with pytest.raises(ModuleNotFoundError, match=r"look='meshes' needs icub_models.*'sb3-combrel\[icub\]'"):
            gymnasium.make(TORSO, look="meshes")

    @pytest.mark.integration
    def test_without_opengl_all_but_pictures_works_and_the_error_says_what_to_do(self):
        code = f"""
import combrel_envs, gymnasium
environment = combrel_envs.load("icub", "arm_strike")
environment.reset()
env = gymnasium.make("{TORSO}", render_mode="rgb_array")
env.reset()
env.step(0)
for draw in (environment.physics.render, env.render):
    try:
        draw()
    except combrel_envs.RenderingError as error:
        print(error)
"""
        environ = {"MUJOCO_GL": "no-such-backend", "PATH": "", "PYTHONPATH": ":".join(filter(None, sys.path))}
        output = subprocess.run([sys.executable, "-c", code], env=environ, check=True, capture_output=True, text=True).stdout
        assert output.count("apt-get install libegl1 libgl1-mesa-dri") == 2
        assert output.count("set MUJOCO_GL=egl") == 2
