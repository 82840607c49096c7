"""Environments: how long they take to make, and 1000 steps of each; 8 rounds a second are 8,000 steps a second."""

import gymnasium
import pytest

import combrel_envs

N_STEPS = 1000
IDS = ["MountainCar2D-v0", "MountainCar4D-v0", "ICubTorsoStrike-v0", "ICubArmStrike-v0", "ICubArmStrikeNoisy-v0"]
DM_CONTROL = [("mountain_car", "climb_4d"), ("icub", "arm_strike")]


@pytest.mark.parametrize("name", IDS)
def test_making(benchmark, name):
    benchmark(lambda: gymnasium.make(f"combrel/{name}").reset())


@pytest.mark.parametrize("name", IDS)
def test_1000_steps_through_gymnasium(benchmark, name):
    env = gymnasium.make(f"combrel/{name}", max_episode_steps=N_STEPS)
    n_actions = int(env.action_space.n)

    def act():
        env.reset(seed=0)
        for step in range(N_STEPS):
            env.step(step % n_actions)

    benchmark(act)


@pytest.mark.parametrize("task", DM_CONTROL, ids="-".join)
def test_1000_steps_through_dm_control(benchmark, task):
    environment = combrel_envs.load(*task, {"time_limit": float("inf")})

    def act():
        environment.reset()
        for step in range(N_STEPS):
            environment.step(step % 2)

    benchmark(act)
