"""dm_control's tasks: state variables against the suite's own physics, and the suite's observation as it is."""

import numpy as np
import pytest

from sb3_combrel.experiments.tasks.dm_suite import FAST, STEPS_A_DECISION, VARIABLES, DmControl, make_dm_control

TASKS = [("pendulum", "swingup"), ("cartpole", "swingup"), ("acrobot", "swingup"), ("reacher", "easy")]


def physics_of(env):
    return env.unwrapped._environment.physics


def walk(env, n, seed=0):
    """States, rewards and joint positions of a walk of random actions."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        state, reward, *_ = env.step(rng.uniform(-1.0, 1.0, env.action_space.shape))
        yield state, reward, physics_of(env).data.qpos.copy(), physics_of(env).data.qvel.copy()


@pytest.mark.parametrize(("domain", "task"), TASKS)
def test_speeds_are_those_of_the_joints_and_states_lie_within_their_bounds(domain, task):
    with make_dm_control(domain, task) as env:
        env.reset(seed=1)
        for state, reward, _, speeds in walk(env, 50):
            np.testing.assert_allclose(state[-len(speeds) :], speeds)
            assert env.observation_space.contains(state) and 0.0 <= reward <= 1.0
        assert np.all(env.observation_space.high[-len(speeds) :] == FAST)


def turned(angle, other):
    return np.abs(np.exp(1j * np.asarray(angle)) - np.exp(1j * np.asarray(other))).max()


@pytest.mark.parametrize(
    ("domain", "task", "angles"),
    [
        ("pendulum", "swingup", lambda q: [q[0]]),
        ("cartpole", "swingup", lambda q: [q[1]]),
        # The second joint is counted from the first link, the state from the vertical.
        ("acrobot", "swingup", lambda q: [q[0], q[0] + q[1]]),
        ("reacher", "easy", lambda q: [q[0]]),
    ],
)
def test_periodic_variables_are_the_angles_of_the_joints(domain, task, angles):
    with make_dm_control(domain, task) as env:
        env.reset(seed=2)
        periodic = np.array(VARIABLES[domain].periodic)
        for state, _, positions, _ in walk(env, 50):
            assert turned(state[periodic], angles(positions)) < 1e-9


@pytest.mark.parametrize(("domain", "task"), TASKS)
def test_what_the_suite_observes_is_in_one_vector(domain, task):
    with make_dm_control(domain, task, observed=True) as env:
        first, _ = env.reset(seed=3)
        observed = env.unwrapped._environment.task.get_observation(physics_of(env))
        np.testing.assert_array_equal(first, np.concatenate([np.ravel(each) for each in observed.values()]))
        assert env.observation_space.shape == first.shape


def test_both_forms_are_one_task():
    with make_dm_control("acrobot", "swingup") as env, make_dm_control("acrobot", "swingup", observed=True) as other:
        env.reset(seed=4), other.reset(seed=4)
        for (_, reward, positions, _), (_, same, others, _) in zip(walk(env, 30), walk(other, 30), strict=True):
            assert reward == same
            np.testing.assert_array_equal(positions, others)


def test_a_decision_is_worth_the_mean_of_its_control_steps():
    with make_dm_control("cartpole", "balance") as env:
        env.reset(seed=5)
        physics = physics_of(env)
        state = physics.get_state().copy()
        _, reward, *_ = env.step(np.array([0.3]))
        physics.set_state(state)
        physics.forward()
        environment = env.unwrapped._environment
        rewards = [environment.step(np.array([0.3])).reward for _ in range(STEPS_A_DECISION)]
        assert reward == pytest.approx(np.mean(rewards), abs=1e-6)


def test_a_domain_has_no_other_variables_than_its_space():
    for domain, task in TASKS:
        env = DmControl(domain, task)
        assert len(VARIABLES[domain].high) == len(env.periodic) == env.observation_space.shape[0]
