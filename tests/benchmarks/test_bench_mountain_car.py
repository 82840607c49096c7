"""Steps of Mountain Car: a round is 1000 steps, so 25 rounds a second are 25,000 steps a second."""

import gymnasium
import pytest

import combrel_envs

N_STEPS = 1000


@pytest.mark.parametrize("env_id", ["combrel/MountainCar2D-v0", "combrel/MountainCar4D-v0"])
def test_1000_steps_through_gymnasium(benchmark, env_id):
    env = gymnasium.make(env_id)
    n_actions = int(env.action_space.n)

    def drive():
        env.reset(seed=0)
        for step in range(N_STEPS):
            env.step(step % n_actions)

    benchmark(drive)


def test_1000_steps_through_dm_control(benchmark):
    environment = combrel_envs.load("mountain_car", "climb_4d")

    def drive():
        environment.reset()
        for step in range(N_STEPS):
            environment.step(step % 5)

    benchmark(drive)
