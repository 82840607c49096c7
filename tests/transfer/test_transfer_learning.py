"""What transfer is for: four-dimensional Mountain Car in a fraction of the steps, from a thousand steps of the plain one.

Random mappings save two thirds of the steps as well: whatever makes unknown pairs known ends the optimism that explores
them. What selection is worth is what it saves beyond that, so random mappings are the control, drawn state by state from the
same set and with the same settings.

All with the kernel average, as in the paper. The local linear model needs so few steps without transfer that such rates say
nothing of it.
"""

from functools import cache

import numpy as np
import pytest
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env

import combrel_envs  # noqa: F401 - registers the Mountain Cars
from sb3_combrel import COMBREL, TIMBREL, FittedRMax
from sb3_combrel.mappings.named_sets import InterTaskMapping
from sb3_combrel.sources.source_instances import SourceInstances

SEEDS = range(6)
N_EPISODES = 12
EASTWARDS, NORTHWARDS = (0, None, 1, None), (None, 0, None, 1)
ACTIONS = (0, 1, 2, 1, 2)
INTUITIVE = [InterTaskMapping(state, ACTIONS) for state in (EASTWARDS, EASTWARDS, EASTWARDS, NORTHWARDS, NORTHWARDS)]


@cache
def source(seed):
    return SourceInstances.from_q_learning("combrel/MountainCar2D-v0", n_instances=1000, seed=seed)


@cache
def steps(method):
    """Environment steps over the first episodes, each seed; methods are compared on the same seeds."""
    transfer = {
        "none": lambda seed: None,
        "random": lambda seed: TIMBREL(source(seed), "random", mappings="injective"),
        "COMBREL": lambda seed: COMBREL(source(seed)),
        "TIMBREL": lambda seed: TIMBREL(source(seed), INTUITIVE),
    }[method]
    taken = []
    for seed in SEEDS:
        env = make_vec_env("combrel/MountainCar4D-v0", seed=seed, env_kwargs=dict(max_episode_steps=2000))
        model = FittedRMax(
            env, transfer=transfer(seed), degree=0, model_breadth=0.1, resolution=3, min_fraction=0.1, seed=seed
        )
        model.learn(10**6, callback=StopTrainingOnMaxEpisodes(N_EPISODES))
        taken.append(model.num_timesteps)
    return np.array(taken)


pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:resolution=3 is coarse:UserWarning")]


@pytest.mark.parametrize("method", ["COMBREL", "TIMBREL"])
def test_transfer_saves_three_quarters_of_the_steps(method):
    assert steps(method).mean() <= steps("none").mean() / 4


@pytest.mark.parametrize("method", ["COMBREL", "TIMBREL", "random"])
def test_transfer_saves_steps_with_every_seed(method):
    assert (steps(method) < steps("none")).all()


@pytest.mark.parametrize("method", ["COMBREL", "TIMBREL"])
def test_a_selection_saves_a_quarter_of_the_steps_that_random_mappings_take(method):
    """With every seed; by chance alone, six of six would be fewer with a probability of 1/64."""
    assert steps(method).mean() <= 0.75 * steps("random").mean()
    assert (steps(method) < steps("random")).all()
