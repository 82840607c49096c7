"""What holds for every environment: conventions of Gymnasium and dm_control, limits, known plans, seeds and bad input."""

import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env as check_gymnasium_env
from helpers.environments import ARM, CAR_2D, CAR_4D, EXPECTED, ICUBS, IDS, NOISY, TORSO, plan_of, replay, start_of_plan
from stable_baselines3.common.env_checker import check_env as check_sb3_env

import combrel_envs
from combrel_envs.gym_env import register_envs

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


@pytest.mark.parametrize("env_id", [*IDS, *NOISY.values()])
def test_a_copy_in_mid_episode_goes_on_as_the_original(env_id):
    env = gymnasium.make(env_id)
    env.reset(seed=0)
    for action in (1, 2, 0, 1):
        env.step(action)
    envs = [env, copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    ours, *theirs = [[each.step(action)[0].tolist() for action in (0, 1, 2, 2, 1, 1)] for each in envs]
    assert [ours] * 2 == theirs


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
    assert [step.last() for step in steps] == [False] * (n - 1) + [True] and steps[-1].discount == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("mountain_bike", "climb_2d"), "domain must be one of 'mountain_car', 'icub', got 'mountain_bike'"),
        (("mountain_car", "climb"), "must be one of 'climb_2d', 'climb_4d', 'climb_6d', got 'climb'"),
        (("mountain_car", "climb_2d", {"start": "top"}), "start must be one of"),
        (("mountain_car", "climb_2d", {"time_limit": 0}), "time_limit must be a number of steps above 0, got 0"),
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
