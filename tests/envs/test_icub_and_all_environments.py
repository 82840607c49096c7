"""The iCub's ball-striking tasks: hits, noise, starts and bad input."""

import math
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from helpers.environments import (
    ARM,
    CAR_2D,
    CAR_4D,
    EXPECTED,
    ICUBS,
    IDS,
    NOISY,
    TORSO,
    observations,
    plan_of,
    replay,
    start_of_plan,
)
from stable_baselines3.common.env_checker import check_env as check_sb3_env

import combrel_envs
from combrel_envs import icub_tasks
from combrel_envs.gym_env import register_envs

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
        assert blocked < 16 and physics.hand_distance("table") > -0.03
        assert env.step(up)[0][0] < blocked - 0.5

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
        actions = random_actions(env_id, 150)
        env = gymnasium.make(env_id)
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

    def test_the_noise_decides_whether_the_plan_hits(self, env_id):
        env, outcomes = gymnasium.make(NOISY[env_id]), []
        for seed in range(20):
            env.reset(seed=seed)
            outcomes.append(any(env.step(action)[2] for action in plan_of(env_id)))
        assert True in outcomes and False in outcomes


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
        assert np.mean(steps) == pytest.approx(2.0, abs=0.04)
        assert np.std(steps) == pytest.approx(0.2, abs=0.03)

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
            ({"start": 3}, "start must be 2 angles"),
            ({"start": (10, -2)}, r"start must leave the ball untouched; at \(10, -2\) degrees .* touches it already"),
            ({"start": (40, 0)}, r"above the table or beside it; at \(40, 0\) degrees of \(torso_pitch, torso_yaw\)"),
            ({"extent": 0}, "extent must be a finite number above 0, got 0"),
            ({"extent": "far"}, "extent must be a finite number above 0, got 'far'"),
            ({"motor_noise": -0.1}, "motor_noise must be a finite number of at least 0, got -0.1"),
            ({"encoder_noise": math.inf}, "encoder_noise must be a finite number of at least 0, got inf"),
            ({"time_limit": 0}, "time_limit must be a number of seconds above 0"),
            ({"time_limit": math.nan}, "time_limit must be a number of seconds above 0"),
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
            ({"start": (0, 51)}, "torso_yaw must lie between"),
        ],
    )
    def test_wrong_reset_options_are_errors_and_do_not_change_the_next_episode(self, options, message):
        env = gymnasium.make(TORSO)
        env.reset()
        with pytest.raises(ValueError, match=message):
            env.reset(options=options)
        np.testing.assert_allclose(env.reset()[0], STARTS[TORSO], atol=1e-5)


# What holds for every environment: conventions of Gymnasium and dm_control, limits, known plans, seeds and bad input.
SOLVED = {id_: 99.0 if id_ in ICUBS else -1.0 for id_ in IDS}


@pytest.mark.parametrize("env_id", [*IDS, *NOISY.values()])
def test_the_checkers_find_no_fault(env_id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_sb3_env(gymnasium.make(env_id))
        check_gymnasium_env(gymnasium.make(env_id).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", IDS)
class TestGymnasium:
    def test_spaces_names_and_limit_are_those_of_the_manual(self, env_id):
        env, expected = gymnasium.make(env_id), EXPECTED[env_id]
        np.testing.assert_array_equal(env.observation_space.low, np.float32(expected.low))
        np.testing.assert_array_equal(env.observation_space.high, np.float32(expected.high))
        assert env.observation_space.dtype == np.float32
        assert env.unwrapped.state_names == tuple(expected.state_names.split())
        assert env.unwrapped.action_names == tuple(expected.action_names.split())
        assert env.action_space == gymnasium.spaces.Discrete(len(env.unwrapped.action_names))
        assert env.spec.max_episode_steps == expected.max_steps

    @pytest.mark.parametrize("limit", [None, 7])
    def test_the_last_step_of_the_limit_truncates_and_doesnt_terminate(self, env_id, limit):
        n = limit or EXPECTED[env_id].max_steps
        steps = replay(env_id, [index % 2 for index in range(n)], max_episode_steps=limit)[1:]
        assert [step[2:4] for step in steps] == [(False, False)] * (n - 1) + [(False, True)]
        assert {step[1] for step in steps} == {-1.0} and not any(step[4]["is_success"] for step in steps)

    def test_a_known_plan_solves_the_task_on_its_last_step(self, env_id):
        actions = plan_of(env_id)
        steps = replay(env_id, actions, **start_of_plan(env_id))[1:]
        assert [step[2] for step in steps] == [False] * (len(actions) - 1) + [True]
        assert [step[4]["is_success"] for step in steps] == [step[2] for step in steps]
        assert [step[1] for step in steps] == [-1.0] * (len(actions) - 1) + [SOLVED[env_id]]
        assert not any(step[3] for step in steps)
        last = replay(env_id, actions, max_episode_steps=len(actions), **start_of_plan(env_id))[-1]
        assert last[2] and last[1] == SOLVED[env_id]

    def test_stepping_before_the_first_reset_is_an_error(self, env_id):
        with pytest.raises(ResetNeeded):
            gymnasium.make(env_id).unwrapped.step(0)

    @pytest.mark.parametrize("action", [-1, 9, 1.0, "East", None, np.array([1])])
    def test_impossible_actions_are_errors(self, env_id, action):
        env, n = gymnasium.make(env_id), len(EXPECTED[env_id].action_names.split())
        env.reset(seed=0)
        with pytest.raises(ValueError, match=rf"action must be an integer from 0 to {n - 1} \(.*, got"):
            env.step(action)


def test_all_kinds_of_integers_are_actions():
    for action in (2, np.int64(2), np.array(2), np.uint8(2)):
        assert replay(CAR_4D, [action])[-1][0].tolist() == replay(CAR_4D, [2])[-1][0].tolist()


def test_a_plan_has_as_many_steps_as_the_manual_says():
    assert [len(plan_of(env_id)) for env_id in IDS] == [103, 146, 200, 26, 29]


@pytest.mark.parametrize("env_id", IDS)
class TestDmControl:
    def test_both_interfaces_give_the_same_episodes(self, env_id):
        domain, task = EXPECTED[env_id].task
        environment = combrel_envs.load(domain, task, start_of_plan(env_id), {"flat_observation": True})
        ours = [environment.reset()] + [environment.step(action) for action in plan_of(env_id)]
        theirs = [step[0].tolist() for step in replay(env_id, plan_of(env_id), **start_of_plan(env_id))]
        assert [step.observation["observations"].astype(np.float32).tolist() for step in ours] == theirs
        assert [step.last() for step in ours] == [False] * (len(ours) - 1) + [True]
        assert (ours[-1].discount, ours[-1].reward) == (0.0, SOLVED[env_id])

    def test_observations_and_actions_fit_the_specs(self, env_id):
        domain, task = EXPECTED[env_id].task
        environment = combrel_envs.load(domain, task, {"random": 0})
        time_step = environment.reset()
        for action in range(environment.action_spec().num_values):
            environment.action_spec().validate(action)
            for name, spec in environment.observation_spec().items():
                spec.validate(time_step.observation[name])
            time_step = environment.step(action)
        assert list(time_step.observation) == (["encoders"] if env_id in ICUBS else ["position", "velocity"])


@pytest.mark.parametrize(("env_id", "unit"), [(CAR_2D, 1), (ARM, 0.1)])
@pytest.mark.parametrize("n_steps", [None, 1, 3, 29])
def test_dm_controls_time_limit_is_the_same_and_can_be_set(env_id, unit, n_steps):
    domain, task = EXPECTED[env_id].task
    environment = combrel_envs.load(domain, task, {"time_limit": n_steps * unit} if n_steps else {})
    environment.reset()
    n = n_steps or EXPECTED[env_id].max_steps
    steps = [environment.step(0) for _ in range(n)]
    assert [step.last() for step in steps] == [False] * (n - 1) + [True]
    assert steps[-1].discount == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("mountain_bike", "climb_2d"), "domain must be one of 'mountain_car', 'icub', got 'mountain_bike'"),
        (("mountain_car", "climb"), "must be one of 'climb_2d', 'climb_4d', 'climb_6d', got 'climb'"),
        (("mountain_car", "climb_2d", {"start": "top"}), "start must be one of"),
        (("icub", "kick"), r"task of 'icub' must be one of 'torso_strike', 'arm_strike', .*, got 'kick'"),
    ],
)
def test_wrong_domains_tasks_and_starts_are_errors(arguments, message):
    with pytest.raises(ValueError, match=message):
        combrel_envs.load(*arguments)


@pytest.mark.parametrize("kwargs", [{"width": 0}, {"height": 2.5}, {"camera": "behind"}, {"render_mode": "ansi"}])
@pytest.mark.parametrize("env_id", [CAR_4D, TORSO])
def test_wrong_pictures_are_errors(env_id, kwargs):
    with pytest.raises(ValueError, match=f"{next(iter(kwargs))} must be"):
        gymnasium.make(env_id, **kwargs)


def test_registering_the_environments_again_changes_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_envs()
