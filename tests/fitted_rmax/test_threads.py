"""Predicting from another thread or from a callback while ``learn`` runs is safe, and changes nothing that is learned."""

import sys
import threading
import time

import numpy as np
import pytest
import torch as th
from helpers.walk import METHODS, OBSERVATIONS, Walk, small
from stable_baselines3.common.callbacks import BaseCallback


@pytest.fixture(autouse=True)
def frequent_switches_between_threads():
    """A race is then seen sooner."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    yield
    sys.setswitchinterval(interval)


class Predictor(threading.Thread):
    """Predicts in a thread of its own until it is stopped, deterministically and not, with a state and without."""

    def __init__(self, model):
        super().__init__(daemon=True)
        self.model = model
        self.n_predictions = 0
        self.error = None
        self._stopped = threading.Event()

    def run(self):
        state = None
        try:
            while not self._stopped.is_set():
                state = predict(self.model, state)
                self.n_predictions += 1
                # Learning needs the interpreter, too.
                time.sleep(1e-4)
        except Exception as error:
            self.error = error

    def stop(self):
        self._stopped.set()
        self.join()


def predict(model, state):
    """Ask for everything that may be asked for; the state for the next call."""
    model.predict(OBSERVATIONS[::7], deterministic=False)
    actions, state = model.predict(OBSERVATIONS[::5], state, deterministic=True)
    assert set(actions.tolist()) <= {0, 1}
    assert np.isfinite(model.agent.q_values(model.policy.to_unit(OBSERVATIONS[4]))).all()
    assert model.agent.statistics().keys() and model.agent.get_state().keys()
    return state


class PredictingCallback(BaseCallback):
    """Predicts at every step."""

    def _on_training_start(self):
        self.state = None

    def _on_step(self):
        self.state = predict(self.model, self.state)
        return True


def learned(method, seed, n_steps, in_thread=False, in_callback=False):
    """What is learned in ``n_steps``: parameters, generator, backups, and actions for many observations."""
    model = small(Walk(), transfer=METHODS[method](), seed=seed)
    predictor = Predictor(model)
    if in_thread:
        predictor.start()
    model.learn(n_steps, callback=PredictingCallback() if in_callback else None)
    if in_thread:
        predictor.stop()
        assert predictor.error is None, predictor.error
        assert predictor.n_predictions > 10
    actions = model.predict(OBSERVATIONS, deterministic=True)[0]
    generator = model.agent.rng.bit_generator.state
    return model.get_parameters()["policy"], generator, model.agent.n_backups, actions.tolist(), model.agent.statistics()


def assert_same(found, expected):
    parameters, *others = found
    expected_parameters, *expected_others = expected
    assert parameters.keys() == expected_parameters.keys()
    for name, tensor in parameters.items():
        assert th.equal(tensor, expected_parameters[name]), name
    assert others == expected_others


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("where", ["thread", "callback"])
def test_predictions_while_learning_change_nothing_that_is_learned_bit_for_bit(method, where):
    predicting = learned(method, 0, 600, in_thread=where == "thread", in_callback=where == "callback")
    assert_same(predicting, learned(method, 0, 600))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(20))
def test_predictions_in_a_thread_change_nothing_in_twenty_runs_of_5000_steps(seed):
    method = list(METHODS)[seed % len(METHODS)]
    predicting = learned(method, seed, 5000, in_thread=True, in_callback=seed % 4 == 0)
    assert_same(predicting, learned(method, seed, 5000))
