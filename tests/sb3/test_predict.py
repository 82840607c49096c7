"""Predictions: shapes, no effect on learning, seeds, training and evaluation mode, evaluate_policy, threads."""

import sys
import threading

import numpy as np
import pytest
from helpers.walk import GOAL, METHODS, OBSERVATIONS, STRIDE, Walk, same_parameters, small
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_combrel import FittedRMax


@pytest.mark.parametrize("deterministic", [True, False])
def test_predict_takes_one_observation_or_a_batch(make, deterministic):
    model = make(DummyVecEnv([Walk] * 3)).learn(60)
    one, state = model.predict(OBSERVATIONS[3], deterministic=deterministic)
    assert (state is None) == (not deterministic)
    assert np.shape(one) == () and one in (0, 1)
    batch, _ = model.predict(OBSERVATIONS, deterministic=deterministic)
    assert batch.shape == (21,) and set(batch) <= {0, 1}
    actions, _ = model.predict(model.get_env().reset(), deterministic=deterministic)
    assert model.get_env().step(actions)[0].shape == (3, 2)
    with pytest.raises(ValueError, match="shape"):
        model.predict(np.zeros(5, dtype=np.float32))


def test_deterministic_predictions_do_not_change_and_draw_nothing_whatever_the_mode(make):
    model = make().learn(40)
    generator = model.agent.rng.bit_generator
    before = generator.state
    first, _ = model.predict(OBSERVATIONS, deterministic=True)
    for mode in (True, False):
        model.policy.set_training_mode(mode)
        np.testing.assert_array_equal(model.predict(OBSERVATIONS, deterministic=True)[0], first)
        assert model.policy.training is False, "predict switches to evaluation, as in SB3"
    assert generator.state == before


def ask(model, state):
    """Ask for everything that may be asked for; the state for the next call."""
    model.predict(OBSERVATIONS[::7], deterministic=False)
    actions, state = model.predict(OBSERVATIONS[::5], state, deterministic=True)
    assert set(actions.tolist()) <= {0, 1}
    assert np.isfinite(model.agent.q_values(model.policy.to_unit(OBSERVATIONS[4]))).all()
    assert model.agent.statistics().keys() and model.agent.get_state().keys()
    return state


class Asking(BaseCallback):
    """Asks at every step."""

    def _on_training_start(self):
        self.state = None

    def _on_step(self):
        self.state = ask(self.model, self.state)
        return True


class AskingThread(threading.Thread):
    """Asks in a thread of its own until it is stopped."""

    def __init__(self, model):
        super().__init__(daemon=True)
        self.model, self.n_asked, self.error, self.stopped = model, 0, None, threading.Event()

    def run(self):
        state = None
        try:
            while not self.stopped.wait(1e-4):
                state = ask(self.model, state)
                self.n_asked += 1
        except Exception as error:
            self.error = error


def assert_learned_the_same(one, other):
    assert same_parameters(one, other)
    assert one.agent.rng.bit_generator.state == other.agent.rng.bit_generator.state
    assert one.agent.n_backups == other.agent.n_backups
    assert one.agent.statistics() == other.agent.statistics()


def test_predictions_in_a_callback_or_in_between_do_not_change_what_is_learned(make):
    plain, predicting = (make().learn(100, callback=callback) for callback in (None, Asking()))
    evaluate_policy(predicting, Monitor(Walk()), n_eval_episodes=1)
    for model in (plain, predicting):
        model.learn(50, reset_num_timesteps=False)
    assert_learned_the_same(plain, predicting)


@pytest.mark.parametrize("n_steps", [150, pytest.param(5000, marks=pytest.mark.long)])
def test_predictions_in_a_thread_while_learning_change_nothing_that_is_learned(n_steps):
    plain, predicting = (small(transfer=METHODS["COMBREL"]()) for _ in range(2))
    thread, interval = AskingThread(predicting), sys.getswitchinterval()
    # A race is then seen sooner.
    sys.setswitchinterval(1e-5)
    try:
        thread.start()
        predicting.learn(n_steps)
        while thread.n_asked == 0 and thread.is_alive():
            pass
    finally:
        thread.stopped.set()
        thread.join()
        sys.setswitchinterval(interval)
    assert thread.error is None and thread.n_asked > 0
    assert_learned_the_same(plain.learn(n_steps), predicting)


def stochastic(model, n=5):
    return np.array([model.predict(OBSERVATIONS, deterministic=False)[0] for _ in range(n)])


def test_stochastic_predictions_come_again_with_the_seed_and_differ_from_each_other(make, tmp_path):
    model = make()
    first = stochastic(model)
    assert len(np.unique(first, axis=0)) > 1, "all actions are optimistic: they are drawn"
    assert (stochastic(model) != first).any()
    model.set_random_seed(0)
    np.testing.assert_array_equal(stochastic(model), first)
    np.testing.assert_array_equal(stochastic(make()), first)
    model.set_random_seed(1)
    assert (stochastic(model) != first).any()
    model.learn(30).save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model")
    for each in (model, loaded):
        each.set_random_seed(5)
    np.testing.assert_array_equal(stochastic(model), stochastic(loaded))


def fewest_steps(start):
    return int(np.floor((GOAL - start) / STRIDE)) + 1


def test_evaluate_policy_returns_the_fewest_steps(make):
    model, before = make().learn(200), make().learn(200)
    for start in (-0.55, -0.32, -0.05):
        mean, deviation = evaluate_policy(model, Monitor(Walk(start=start)), n_eval_episodes=2)
        assert (mean, deviation) == (-fewest_steps(start), 0.0)
    arguments = dict(n_eval_episodes=6, deterministic=False, return_episode_rewards=True)
    rewards, lengths = evaluate_policy(model, VecMonitor(DummyVecEnv([Walk] * 2)), **arguments)
    assert len(rewards) == len(lengths) == 6
    assert rewards == [-float(n) for n in lengths]
    assert all(fewest_steps(0.0) <= n <= 30 for n in lengths)
    assert same_parameters(model, before)


def test_the_same_seed_gives_the_same_run_to_the_last_bit(make):
    one, other, third, seeded_later = (make(seed=seed) for seed in (3, 3, 4, 4))
    seeded_later.set_random_seed(3)
    for model in (one, other, third, seeded_later):
        model.learn(100)
    assert same_parameters(one, other) and same_parameters(one, seeded_later)
    assert not same_parameters(one, third)


def test_without_a_seed_numpys_own_generator_determines_the_run():
    runs = []
    for seed in (1, 1, 2, 3, 4, 5):
        np.random.seed(seed)
        runs.append(small(seed=None))
        runs[-1].env.seed(0)
        runs[-1].learn(80)
    assert same_parameters(runs[0], runs[1])
    assert not all(same_parameters(runs[0], other) for other in runs[2:])
