"""The iCub: how long it takes to make, and its steps (a round is 1000: 8 rounds a second are 8,000 steps a second)."""

import gymnasium
import pytest

import combrel_envs

N_STEPS = 1000
IDS = ["combrel/ICubTorsoStrike-v0", "combrel/ICubArmStrike-v0", "combrel/ICubArmStrikeNoisy-v0"]


@pytest.mark.parametrize("env_id", IDS)
def test_making(benchmark, env_id):
    benchmark(lambda: gymnasium.make(env_id).reset())


@pytest.mark.parametrize("env_id", IDS)
def test_1000_steps_through_gymnasium(benchmark, env_id):
    env = gymnasium.make(env_id, max_episode_steps=N_STEPS)

    def strike():
        env.reset(seed=0)
        for step in range(N_STEPS):
            env.step(step % 2)

    benchmark(strike)


def test_1000_steps_through_dm_control(benchmark):
    environment = combrel_envs.load("icub", "arm_strike", {"time_limit": float("inf")})

    def strike():
        environment.reset()
        for step in range(N_STEPS):
            environment.step(step % 2)

    benchmark(strike)
