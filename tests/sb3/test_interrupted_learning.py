"""Learning that is interrupted, in mid-episode or at its end, saved or not, is learning that was not."""

import copy
import signal

import numpy as np
import pytest
from helpers.walk import METHODS, OBSERVATIONS, Walk, same_parameters, small
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_checker import check_env

from sb3_combrel import FittedRMax
from sb3_combrel.common.instances import Instances
from sb3_combrel.common.interrupts import Interrupts
from sb3_combrel.models import grid_model


def learned_the_same(one, other):
    return same_parameters(one, other) and one.agent.rng.bit_generator.state == other.agent.rng.bit_generator.state


@pytest.mark.parametrize("n", [35, 47, 60])
def test_learning_in_two_parts_equals_learning_in_one(make, n):
    """Each call of ``learn`` resets the environment only if steps are counted anew."""
    whole, parts = make().learn(100), make().learn(n)
    parts.learn(100 - n, reset_num_timesteps=False)
    assert parts.num_timesteps == 100 and learned_the_same(parts, whole)


@pytest.mark.parametrize("arguments", [{}, {"degree": 0}], ids=str)
def test_two_parts_equal_one_where_scales_and_optimism_are_found(arguments):
    """Cart-pole: scales change at nearly every episode's end at first."""
    whole, parts = (FittedRMax("CartPole-v1", seed=0, resolution=3, **arguments) for _ in range(2))
    whole.learn(160)
    parts.learn(70).learn(90, reset_num_timesteps=False)
    assert (whole.policy.scales.scaling.high < 10.0).all() and learned_the_same(parts, whole)


class Copies(BaseCallback):
    """Every few steps, in mid-episode, what a saved copy of the model predicts, and what the model does."""

    def __init__(self, path):
        super().__init__()
        self.path, self.copies = path, []

    def _on_step(self):
        if self.num_timesteps % 11 == 0 and not self.locals["dones"].any():
            self.model.save(self.path / f"{self.num_timesteps}")
            loaded = FittedRMax.load(self.path / f"{self.num_timesteps}")
            for model in (self.model, loaded):
                q = [model.agent.q_values(model.policy.to_unit(observation)) for observation in OBSERVATIONS]
                self.copies.append((model.predict(OBSERVATIONS, deterministic=True)[0], np.array(q)))
        return True


def test_a_model_saved_in_mid_episode_predicts_what_the_live_one_does(make, tmp_path):
    saving, plain = Copies(tmp_path), make()
    model = make().learn(90, callback=saving)
    assert len(saving.copies) >= 12
    for live, loaded in zip(saving.copies[::2], saving.copies[1::2], strict=True):
        for one, other in zip(live, loaded, strict=True):
            np.testing.assert_array_equal(one, other)
    assert learned_the_same(model, plain.learn(90)), "saving has changed nothing"


@pytest.mark.parametrize("n", [17, 47, 75])
def test_a_model_loaded_in_mid_episode_learns_on_as_the_live_one(n, make, tmp_path):
    model = make(Walk(start=-0.5)).learn(n)
    if model._last_episode_starts[0]:
        model.learn(1, reset_num_timesteps=False)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=copy.deepcopy(model.get_env()), force_reset=False)
    for each in (model, loaded):
        each.learn(60, reset_num_timesteps=False)
    assert model.num_timesteps == loaded.num_timesteps and learned_the_same(loaded, model)


def test_a_checkpoint_of_a_running_episode_loads_and_learns_on(tmp_path):
    small(transfer=METHODS["COMBREL"]()).learn(40, callback=CheckpointCallback(13, str(tmp_path), "walk"))
    loaded = FittedRMax.load(tmp_path / "walk_26_steps", env=Walk())
    assert loaded.agent.model.n_instances == 26
    loaded.learn(14, reset_num_timesteps=False)
    assert loaded.num_timesteps == loaded.agent.model.n_instances == 40


def test_the_task_of_these_tests_passes_the_check_of_stable_baselines3():
    check_env(Walk())


@pytest.fixture
def interruptible():
    """Python's own handler, also where the tests run in the background, whose interrupts are ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_waits_until_what_a_step_has_shown_is_learned(monkeypatch):
    """Within, arrays would be of two sizes, and what comes next be written beyond the smaller ones."""
    model, whole, enlarged = small(), small().learn(300), Instances.enlarged

    def interrupted(instances, capacity):
        signal.raise_signal(signal.SIGINT)
        return enlarged(instances, capacity)

    with monkeypatch.context() as patched:
        patched.setattr(Instances, "enlarged", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model.learn(300)
    done = model.num_timesteps
    assert 64 < done < 300 and model.agent.model.n_instances == done
    np.testing.assert_array_equal(model.source_instances().states, whole.source_instances().states[:done])
    model.learn(300 - done, reset_num_timesteps=False)
    assert model.agent.model.n_instances == 300


def test_an_interrupt_while_room_is_made_leaves_arrays_that_fit_each_other(monkeypatch):
    """Also where nothing lets it wait, in an agent without Stable-Baselines3."""
    model, whole = (small().learn(60).agent.model for _ in range(2))
    steps = [transition for transition in model.transitions() if transition[1] == 0] * 5

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(grid_model, "Ends", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model._make_room(model.instances.capacity + 1)
    assert model.instances.capacity == model.arrivals.capacity == whole.instances.capacity
    for step in steps:
        np.testing.assert_array_equal(model.add(*step), whole.add(*step))
    assert model.instances.capacity > len(steps)


@pytest.mark.usefixtures("interruptible")
def test_a_second_interrupt_does_not_wait():
    interrupts, done = Interrupts(), []
    with pytest.raises(KeyboardInterrupt), interrupts.taken(), interrupts:
        for number in range(3):
            done.append(number)
            signal.raise_signal(signal.SIGINT)
    assert done == [0, 1]
