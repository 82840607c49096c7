"""Predictions: shapes, no trace, training and evaluation mode, evaluate_policy."""

import numpy as np
import pytest
from helpers.walk import GOAL, OBSERVATIONS, STRIDE, Walk, same_parameters
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor


@pytest.mark.parametrize("deterministic", [True, False])
def test_predict_takes_one_observation_or_a_batch(make, deterministic):
    model = make().learn(100)
    one, state = model.predict(OBSERVATIONS[3], deterministic=deterministic)
    assert (state is None) == (not deterministic)
    assert np.shape(one) == () and one in (0, 1)
    batch, _ = model.predict(OBSERVATIONS, deterministic=deterministic)
    assert batch.shape == (21,) and set(batch) <= {0, 1}


def test_observations_of_a_vectorised_environment_are_a_batch(make):
    model = make(DummyVecEnv([Walk] * 3)).learn(30)
    actions, _ = model.predict(model.get_env().reset(), deterministic=True)
    assert actions.shape == (3,)
    assert model.get_env().step(actions)[0].shape == (3, 2)


def test_observations_of_another_shape_are_refused(make):
    with pytest.raises(ValueError, match="shape"):
        make().learn(20).predict(np.zeros(5, dtype=np.float32))


def test_deterministic_predictions_do_not_change_and_draw_nothing(make):
    model = make().learn(40)
    chance = model._rng.bit_generator.state
    first, _ = model.predict(OBSERVATIONS, deterministic=True)
    for _ in range(3):
        np.testing.assert_array_equal(model.predict(OBSERVATIONS, deterministic=True)[0], first)
    assert model._rng.bit_generator.state == chance


def test_predictions_leave_no_trace_in_what_was_learned(make):
    model, before = make().learn(40), make().learn(40)
    model.predict(OBSERVATIONS, deterministic=True)
    model.predict(OBSERVATIONS, deterministic=False)
    seen = {k: v for k, v in model.get_parameters()["policy"].items() if k not in USES}
    for name, array in seen.items():
        np.testing.assert_array_equal(array, before.get_parameters()["policy"][name])


# How often transferred instances were used counts predictions, too.
USES = ("transfer_uses", "transfer_instances_used")


def test_training_and_evaluation_mode_say_the_same(make):
    model, untouched = make().learn(60), make().learn(60)
    said = []
    for mode in (True, False):
        model.policy.set_training_mode(mode)
        assert model.policy.training is mode
        said.append(model.policy.predict(OBSERVATIONS, deterministic=True)[0])
        assert model.policy.training is False, "predict switches to evaluation, as in SB3"
    np.testing.assert_array_equal(*said)
    assert untouched.predict(OBSERVATIONS, deterministic=True)[0].tolist() == said[0].tolist()


def test_predictions_in_between_do_not_change_what_is_learned(make):
    runs = []
    for predicts in (False, True):
        model = make(Walk(start=-0.4))
        for _ in range(3):
            model.learn(30, reset_num_timesteps=False)
            if predicts:
                model.predict(OBSERVATIONS, deterministic=True)
                evaluate_policy(model, Monitor(Walk()), n_eval_episodes=1)
        runs.append(model.get_parameters()["policy"])
    for name in runs[0].keys() - set(USES):
        np.testing.assert_array_equal(runs[0][name], runs[1][name])


def fewest_steps(start):
    return int(np.floor((GOAL - start) / STRIDE)) + 1


def test_evaluate_policy_finds_the_shortest_way(make):
    model = make().learn(300)
    for start in (-0.55, -0.32, -0.05):
        mean, deviation = evaluate_policy(model, Monitor(Walk(start=start)), n_eval_episodes=3)
        assert (mean, deviation) == (-fewest_steps(start), 0.0)


@pytest.mark.parametrize("deterministic", [True, False])
def test_evaluate_policy_on_several_environments(make, deterministic):
    model = make().learn(200)
    before = make().learn(200)
    rewards, lengths = evaluate_policy(
        model,
        VecMonitor(DummyVecEnv([Walk] * 2)),
        n_eval_episodes=6,
        deterministic=deterministic,
        return_episode_rewards=True,
    )
    assert len(rewards) == len(lengths) == 6
    assert rewards == [-float(n) for n in lengths]
    assert all(fewest_steps(0.0) <= n <= 30 for n in lengths)
    if not before.policy.transfer:
        assert same_parameters(model, before)
