"""Fitted R-Max learns: one small run here, the classic tasks and the iCub's with ``make test-all``."""

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import combrel_envs  # noqa: F401 - registers the tasks
from sb3_combrel import FittedRMax

SEEDS = range(5)


class Episodes(BaseCallback):
    """The lengths of episodes; ends the learning after ``n`` of them."""

    def __init__(self, n):
        super().__init__()
        self.n = n
        self.lengths = []

    def _on_step(self):
        self.lengths += [info["episode"]["l"] for info in self.locals["infos"] if "episode" in info]
        return len(self.lengths) < self.n


def lengths_of_episodes(env_id, n_episodes, seed, env_kwargs=None, **kwargs):
    episodes = Episodes(n_episodes)
    FittedRMax(make_vec_env(env_id, seed=seed, env_kwargs=env_kwargs), seed=seed, **kwargs).learn(10**6, callback=episodes)
    return np.array(episodes.lengths)


def test_mountain_car_2d_is_learned_within_ten_episodes():
    """The shortest plan has 103 steps; learned is what is within a tenth of it."""
    assert np.median(lengths_of_episodes("combrel/MountainCar2D-v0", 15, 0, dict(start="fixed"))[10:]) <= 113


@pytest.mark.long
def test_mountain_car_2d_is_learned_as_fast_as_by_the_original():
    """Its authors' program: 163 to 166 steps over the first ten episodes, 115 to 120 from then on."""
    settings = dict(degree=0, model_breadth=1 / 16, resolution=4, min_fraction=0.01)
    runs = np.array([lengths_of_episodes("combrel/MountainCar2D-v0", 50, s, dict(start="fixed"), **settings) for s in SEEDS])
    assert runs[:, :10].mean() <= 170 and runs[:, -10:].mean() <= 120


@pytest.mark.long
@pytest.mark.parametrize(("task", "shortest", "n_episodes"), [("Torso", 25, 30), ("Arm", 27, 60)])
def test_the_icub_s_plans_come_near_the_shortest(task, shortest, n_episodes):
    """Exploration ends, and the median seed's plans are at most a quarter longer."""
    runs = [lengths_of_episodes(f"combrel/ICub{task}Strike-v0", n_episodes, seed, max_value=100.0)[-5:] for seed in SEEDS]
    assert np.median(np.median(runs, axis=1)) <= 1.25 * shortest


CART_POLE = dict(bounds=([-4.8, -3.0, -0.23, -3.2], [4.8, 3.0, 0.23, 3.2]), gamma=0.99, max_value=100)


@pytest.mark.long
@pytest.mark.parametrize(
    ("env_id", "steps", "solved", "settings"),
    [
        ("MountainCar-v0", 3000, -110, {}),
        ("CartPole-v1", 4000, 475, dict(degree=0, exploration_threshold=0.5, resolution=4, **CART_POLE)),
    ],
)
def test_classic_tasks_are_solved(env_id, steps, solved, settings):
    """By the median seed; where a frozen policy falls in some episodes depends on the last digits of values."""
    returns = []
    for seed in SEEDS:
        model = FittedRMax(make_vec_env(env_id, seed=seed), seed=seed, **settings).learn(steps)
        returns.append(evaluate_policy(model, make_vec_env(env_id, seed=1000 + seed), 100, deterministic=True)[0])
    assert np.median(returns) >= solved
