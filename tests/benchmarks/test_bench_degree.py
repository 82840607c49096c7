"""One environment step of learning in Mountain Car 4D, warm, by degree of the local model: acting, updating, planning."""

import gymnasium
import pytest

import combrel_envs  # noqa: F401 - registers the environments
from sb3_combrel import FittedRMax

N_STEPS_BEFORE = 1500


@pytest.fixture(scope="module", params=[0, 1], ids=["degree 0", "degree 1"])
def learner(request):
    """An agent that has learned for some episodes, and where it is."""
    model = FittedRMax("combrel/MountainCar4D-v0", degree=request.param, resolution=3, seed=0).learn(N_STEPS_BEFORE)
    env = gymnasium.make("combrel/MountainCar4D-v0")
    return model.agent, model.policy.scales.scaling, env


def test_one_learning_step(benchmark, learner):
    agent, scaling, env = learner
    at = [scaling.to_unit(env.reset(seed=0)[0])]
    n_before = agent.model.n_instances

    def step():
        state = at[0]
        action = agent.act(state)
        observation, reward, terminated, truncated, _ = env.step(action)
        at[0] = scaling.to_unit(observation)
        agent.update(state, action, float(reward), at[0], terminated)
        if terminated or truncated:
            at[0] = scaling.to_unit(env.reset()[0])

    benchmark.pedantic(step, rounds=500, warmup_rounds=20)
    assert agent.model.n_instances == n_before + 520
