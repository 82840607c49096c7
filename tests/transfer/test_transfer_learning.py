"""What transfer is for: four-dimensional Mountain Car in a fraction of the steps, from a thousand steps of the plain one.

Random mappings save many steps as well: whatever makes unknown pairs known ends the optimism that explores them. So they are
the control, drawn state by state from the same set and with the same settings. All with the kernel average, as in the paper.
"""

from functools import cache

import numpy as np
import pytest
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env

import combrel_envs  # noqa: F401 - registers the Mountain Cars
from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, SourceInstances

EASTWARDS, NORTHWARDS = (0, None, 1, None), (None, 0, None, 1)
ACTIONS = (0, 1, 2, 1, 2)
INTUITIVE = [InterTaskMapping(state, ACTIONS) for state in (EASTWARDS, EASTWARDS, EASTWARDS, NORTHWARDS, NORTHWARDS)]
METHODS = {
    "none": lambda source: None,
    "random": lambda source: TIMBREL(source, "random", mappings="injective"),
    "COMBREL": COMBREL,
    "TIMBREL": lambda source: TIMBREL(source, INTUITIVE),
}


@cache
def steps(method):
    """Environment steps over the first 12 episodes, each seed; methods are compared on the same seeds."""
    taken = []
    for seed in range(6):
        source = SourceInstances.from_q_learning("combrel/MountainCar2D-v0", n_instances=1000, seed=seed)
        env = make_vec_env("combrel/MountainCar4D-v0", seed=seed, env_kwargs=dict(max_episode_steps=2000))
        settings = dict(degree=0, model_breadth=0.1, resolution=3, min_fraction=0.1, seed=seed)
        model = FittedRMax(env, transfer=METHODS[method](source), **settings)
        model.learn(10**6, callback=StopTrainingOnMaxEpisodes(12))
        taken.append(model.num_timesteps)
    return np.array(taken)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:resolution=3 is coarse:UserWarning")
@pytest.mark.parametrize("method", ["COMBREL", "TIMBREL"])
def test_transfer_saves_three_quarters_of_the_steps_and_a_quarter_of_those_of_random_mappings(method):
    """With every seed; by chance alone, six of six would be fewer with a probability of 1/64."""
    assert steps(method).mean() <= steps("none").mean() / 4 and steps(method).mean() <= 0.75 * steps("random").mean()
    assert (steps(method) < steps("random")).all() and (steps("random") < steps("none")).all()
