"""Fitted R-Max learns to strike the ball, with the torso and with the arm, however narrow its kernel is."""

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from test_learning import SEEDS, lengths_of_episodes

import combrel_envs  # noqa: F401 - registers the tasks
from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.models.kernel_average import EPISODES_OF_PATIENCE

TORSO, ARM = "combrel/ICubTorsoStrike-v0", "combrel/ICubArmStrike-v0"


def lengths(env_id, n_episodes, seed, **kwargs):
    return lengths_of_episodes(env_id, n_episodes, seed, max_value=100.0, **kwargs)


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_the_torso_is_learnt_within_thirty_episodes(seed):
    """The shortest plan has 25 commands."""
    assert np.median(lengths(TORSO, 30, seed, model_breadth=0.1)[-5:]) <= 27


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_the_arm_is_learnt_within_sixty_episodes(seed):
    """The shortest plans have 27 to 29 commands."""
    assert np.median(lengths(ARM, 60, seed, model_breadth=0.2)[-5:]) <= 32


@pytest.mark.slow
def test_exploration_ends_though_the_kernel_is_narrow():
    """What is within reach cannot all become known with the full threshold: 300 episodes of 400 steps were not enough."""
    with pytest.warns(UserWarning, match="coarse"):
        steps = lengths(ARM, 150, 1, model_breadth=0.05)
    assert np.median(steps[-10:]) <= 45


def test_time_limits_make_the_model_content_with_less():
    model = FittedRMax(make_vec_env(TORSO), max_value=100.0, model_breadth=0.1, seed=0).learn(400).policy.model
    known = model.arrays.known.copy()
    assert len(model.lower_threshold(EPISODES_OF_PATIENCE)) == 0, "patience must be at an end first"
    weights = model.arrays.total[~known]
    newly_known = model.lower_threshold(EPISODES_OF_PATIENCE + 40)
    assert 0.0 < model.exploration_threshold < 0.5
    assert len(newly_known) == (weights >= model.exploration_threshold).sum() > 0
    assert not known[newly_known].any()
    model.lower_threshold(10**6)
    assert (model.arrays.known == (model.arrays.total >= model.min_weight)).all(), "any instance that counts will do"


def test_the_lowered_threshold_is_saved(tmp_path):
    model = FittedRMax(make_vec_env(TORSO), max_value=100.0, model_breadth=0.1, seed=0).learn(50)
    for _ in range(EPISODES_OF_PATIENCE + 3):
        model.policy.end_episode(truncated=True)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model")
    assert loaded.policy.model.exploration_threshold == model.policy.model.exploration_threshold < 1.0
    np.testing.assert_array_equal(loaded.policy.model.arrays.known, model.policy.model.arrays.known)


def test_combrel_on_the_arm_runs():
    source = SourceInstances.from_fitted_rmax(TORSO, 200, seed=0, n_episodes=6, max_value=100.0)
    assert source.terminated.any()
    assert len(source) == 200
    model = FittedRMax(make_vec_env(ARM), transfer=COMBREL(source, voting_radius=0.4), max_value=100.0, seed=0)
    model.learn(300)
    assert model.policy.transfer.mapping_counts(), "nothing was transferred"
