"""Predictions: shapes, no effect on learning, seeds, training and evaluation mode, evaluate_policy."""

import numpy as np
import pytest
from helpers.walk import GOAL, OBSERVATIONS, STRIDE, Walk, same_parameters
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_combrel import FittedRMax


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
    generator = model.agent.rng.bit_generator
    before = generator.state
    first, _ = model.predict(OBSERVATIONS, deterministic=True)
    for _ in range(3):
        np.testing.assert_array_equal(model.predict(OBSERVATIONS, deterministic=True)[0], first)
    assert generator.state == before


def test_predictions_leave_no_trace_in_what_was_learned(make):
    model, before = make().learn(40), make().learn(40)
    model.predict(OBSERVATIONS, deterministic=True)
    model.predict(OBSERVATIONS, deterministic=False)
    assert same_parameters(model, before)


def test_training_and_evaluation_mode_give_the_same_predictions(make):
    model, untouched = make().learn(60), make().learn(60)
    predicted = []
    for mode in (True, False):
        model.policy.set_training_mode(mode)
        assert model.policy.training is mode
        predicted.append(model.policy.predict(OBSERVATIONS, deterministic=True)[0])
        assert model.policy.training is False, "predict switches to evaluation, as in SB3"
    np.testing.assert_array_equal(*predicted)
    assert untouched.predict(OBSERVATIONS, deterministic=True)[0].tolist() == predicted[0].tolist()


def test_predictions_in_between_do_not_change_what_is_learned(make):
    runs = []
    for predicts in (False, True):
        model = make(Walk(start=-0.4))
        for _ in range(3):
            model.learn(30, reset_num_timesteps=False)
            if predicts:
                model.predict(OBSERVATIONS, deterministic=True)
                evaluate_policy(model, Monitor(Walk()), n_eval_episodes=1)
        runs.append(model)
    assert same_parameters(*runs)


class Predicting(BaseCallback):
    """Asks for predictions of all kinds at every step."""

    def _on_step(self):
        for deterministic in (False, True):
            self.model.predict(self.locals["new_obs"], deterministic=deterministic)
            self.model.predict(OBSERVATIONS, deterministic=deterministic)
        return True


def test_predictions_in_a_callback_do_not_change_what_is_learned(make):
    plain, predicting = make().learn(150), make().learn(150, callback=Predicting())
    assert same_parameters(plain, predicting)
    assert plain.agent.rng.bit_generator.state == predicting.agent.rng.bit_generator.state
    if plain.policy.transfer is not None:
        assert plain.policy.transfer.mapping_counts() == predicting.policy.transfer.mapping_counts()


def stochastic(model, n=5):
    return np.array([model.predict(OBSERVATIONS, deterministic=False)[0] for _ in range(n)])


def test_stochastic_predictions_come_again_with_the_seed_and_differ_from_each_other(make):
    model = make()
    first = stochastic(model)
    assert len(np.unique(first, axis=0)) > 1, "all actions are optimistic: they are drawn"
    assert (stochastic(model) != first).any()
    model.set_random_seed(0)
    np.testing.assert_array_equal(stochastic(model), first)
    np.testing.assert_array_equal(stochastic(make()), first)
    model.set_random_seed(1)
    assert (stochastic(model) != first).any()


def test_the_seed_makes_stochastic_predictions_reproducible_after_learning_and_loading(make, tmp_path):
    model = make().learn(30)
    model.save(tmp_path / "model")
    model.set_random_seed(5)
    loaded = FittedRMax.load(tmp_path / "model")
    loaded.set_random_seed(5)
    np.testing.assert_array_equal(stochastic(model), stochastic(loaded))


def fewest_steps(start):
    return int(np.floor((GOAL - start) / STRIDE)) + 1


def test_evaluate_policy_returns_the_fewest_steps(make):
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
    assert same_parameters(model, before)
