"""Fitted R-Max learns, fast: on the paper's Mountain Cars and on two of Gymnasium's classic tasks."""

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import combrel_envs  # noqa: F401 - registers the Mountain Cars
from sb3_combrel import FittedRMax

SEEDS = range(5)
CART_POLE_BOUNDS = ([-4.8, -3.0, -0.23, -3.2], [4.8, 3.0, 0.23, 3.2])


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
    env = make_vec_env(env_id, seed=seed, env_kwargs=env_kwargs)
    episodes = Episodes(n_episodes)
    FittedRMax(env, seed=seed, **kwargs).learn(10**6, callback=episodes)
    return np.array(episodes.lengths)


def mountain_car_2d(seed, n_episodes):
    return lengths_of_episodes(
        "combrel/MountainCar2D-v0",
        n_episodes,
        seed,
        dict(start="fixed"),
        degree=0,
        model_breadth=1 / 16,
        resolution=4,
        min_fraction=0.01,
    )


def mountain_car_4d(seed, n_episodes):
    return lengths_of_episodes("combrel/MountainCar4D-v0", n_episodes, seed, model_breadth=0.4, resolution=3, min_fraction=0.1)


def test_mountain_car_2d_is_learned_within_ten_episodes():
    lengths = mountain_car_2d(0, 20)
    assert lengths[:10].mean() <= 190
    assert lengths[10:].mean() <= 135


def test_the_goal_of_mountain_car_4d_is_found_in_the_first_episode():
    assert mountain_car_4d(0, 1)[0] < 1100


@pytest.mark.parametrize("seed", range(2))
def test_mountain_car_2d_is_learned_within_ten_episodes_with_default_parameters(seed):
    """The shortest plan has 103 steps."""
    lengths = lengths_of_episodes("combrel/MountainCar2D-v0", 20, seed, dict(start="fixed"))
    assert lengths[:10].mean() <= 135
    # Now and then an episode still tries something out.
    assert np.median(lengths[10:]) <= 105 and lengths[10:].mean() <= 110


@pytest.mark.parametrize("seed", range(2))
def test_mountain_car_4d_is_learned_within_twelve_episodes_with_default_parameters(seed):
    """The shortest plans have some 180 steps."""
    lengths = lengths_of_episodes("combrel/MountainCar4D-v0", 12, seed)
    assert lengths[0] <= 700
    assert lengths.sum() <= 3300


@pytest.mark.slow
def test_mountain_car_2d_is_learned_as_fast_as_by_the_original():
    """Its authors' program: 163 to 166 steps over the first ten episodes, 115 to 120 from then on."""
    runs = np.array([mountain_car_2d(seed, 50) for seed in SEEDS])
    assert runs[:, :10].mean() <= 170
    assert runs[:, -10:].mean() <= 120


@pytest.mark.slow
def test_mountain_car_4d_is_learned_as_fast_as_by_the_prototype():
    runs = np.array([mountain_car_4d(seed, 60) for seed in SEEDS])
    # Now and then the goal is found only when nearly all has been visited once.
    assert np.median(runs[:, 0]) < 600 and (runs[:, 0] < 2000).all()
    assert runs[:, 40:60].mean() <= 220


def returns_in_evaluation(env_id, steps, seed, n_episodes=100, **kwargs):
    model = FittedRMax(make_vec_env(env_id, seed=seed), seed=seed, **kwargs).learn(steps)
    returns, _ = evaluate_policy(
        model, make_vec_env(env_id, seed=1000 + seed), n_episodes, deterministic=True, return_episode_rewards=True
    )
    return np.array(returns)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_mountain_car_v0_is_solved_with_default_parameters(seed):
    """Solved is -110."""
    assert returns_in_evaluation("MountainCar-v0", 3000, seed).mean() >= -110


CART_POLE = dict(bounds=CART_POLE_BOUNDS, gamma=0.99, max_value=100)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_cart_pole_is_solved_by_the_kernel_average(seed):
    """Solved is 475. A pole falls anywhere alike: with wide bounds for the position, its instances count farther along it."""
    settings = dict(degree=0, exploration_threshold=0.5, resolution=4)
    assert returns_in_evaluation("CartPole-v1", 4000, seed, **CART_POLE, **settings).mean() >= 475


@pytest.mark.slow
def test_cart_pole_is_learned_with_default_parameters():
    """Two of five seeds solve it, with 475 or more; why the others fall is said in docs/results/learner.md."""
    means = np.array([returns_in_evaluation("CartPole-v1", 4000, seed, **CART_POLE).mean() for seed in SEEDS])
    assert means.min() >= 300 and np.median(means) >= 400
