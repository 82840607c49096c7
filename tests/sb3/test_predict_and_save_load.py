"""Predictions: shapes, no effect on learning, seeds, training and evaluation mode, evaluate_policy, threads."""

import io
import pathlib
import sys
import threading

import numpy as np
import pytest
from helpers.walk import GOAL, METHODS, OBSERVATIONS, STRIDE, Walk, same_parameters, small
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings


@pytest.mark.parametrize("deterministic", [True, False])
def test_predict_takes_one_observation_or_a_batch(make, deterministic):
    model = make(DummyVecEnv([Walk] * 3)).learn(60)
    one, state = model.predict(OBSERVATIONS[3], deterministic=deterministic)
    assert state is None and np.shape(one) == () and one in (0, 1)
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


def ask(model):
    """Ask for everything that may be asked for."""
    model.predict(OBSERVATIONS[::7], deterministic=False)
    actions, _ = model.predict(OBSERVATIONS[::5], deterministic=True)
    assert set(actions.tolist()) <= {0, 1}
    assert np.isfinite(model.agent.q_values(model.policy.to_unit(OBSERVATIONS[4]))).all()
    assert model.agent.statistics().keys() and model.agent.get_state().keys()


class Asking(BaseCallback):
    """Asks at every step."""

    def _on_step(self):
        ask(self.model)
        return True


class AskingThread(threading.Thread):
    """Asks in a thread of its own until it is stopped."""

    def __init__(self, model):
        super().__init__(daemon=True)
        self.model, self.n_asked, self.error, self.stopped = model, 0, None, threading.Event()

    def run(self):
        try:
            while not self.stopped.wait(1e-4):
                ask(self.model)
                self.n_asked += 1
        except Exception as error:
            self.error = error


def assert_learned_the_same(one, other):
    assert same_parameters(one, other) and one.agent.rng.bit_generator.state == other.agent.rng.bit_generator.state
    assert one.agent.n_sweeps == other.agent.n_sweeps and one.agent.statistics() == other.agent.statistics()


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


def test_a_checkpoint_of_another_thread_waits_while_scales_are_found_anew(monkeypatch):
    """It would have instances in unit coordinates of one scale, and another scale."""
    model = FittedRMax(Walk(limit=7), bounds=None, seed=0)
    waited, rescale = [], FittedRMaxAgent.rescale

    def slowly(agent, *scales):
        thread = threading.Thread(target=model.get_parameters, daemon=True)
        thread.start()
        thread.join(timeout=0.1)
        waited.append(thread.is_alive())
        rescale(agent, *scales)

    monkeypatch.setattr(FittedRMaxAgent, "rescale", slowly)
    model.learn(40)
    assert waited and all(waited)


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
    assert len(rewards) == len(lengths) == 6 and rewards == [-float(n) for n in lengths]
    assert all(fewest_steps(0.0) <= n <= 30 for n in lengths) and same_parameters(model, before)


def test_the_same_seed_gives_the_same_run_to_the_last_bit(make):
    one, other, third, seeded_later = (make(seed=seed) for seed in (3, 3, 4, 4))
    seeded_later.set_random_seed(3)
    for model in (one, other, third, seeded_later):
        model.learn(100)
    assert same_parameters(one, other) and same_parameters(one, seeded_later) and not same_parameters(one, third)


def test_without_a_seed_numpys_own_generator_determines_the_run():
    runs = []
    for seed in (1, 1, 2, 3, 4, 5):
        np.random.seed(seed)
        runs.append(small(seed=None))
        runs[-1].env.seed(0)
        runs[-1].learn(80)
    assert same_parameters(runs[0], runs[1]) and not all(same_parameters(runs[0], other) for other in runs[2:])


# Saving and loading, as people who know SB3 type it.
ARGUMENTS = (*FittedRMaxSettings.names(), "num_timesteps", "seed")


def test_save_and_load_keep_everything(make, tmp_path):
    model = make(max_value=3.0).learn(10**6, callback=StopTrainingOnMaxEpisodes(8))
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert same_parameters(model, loaded) and type(loaded.policy) is FittedRMaxPolicy
    assert type(loaded.policy.transfer) is type(model.policy.transfer)
    for name in ARGUMENTS:
        assert getattr(loaded, name) == getattr(model, name)
    np.testing.assert_array_equal(
        loaded.predict(OBSERVATIONS, deterministic=True)[0], model.predict(OBSERVATIONS, deterministic=True)[0]
    )
    for observation in OBSERVATIONS:
        unit = model.policy.to_unit(observation)
        np.testing.assert_array_equal(loaded.agent.q_values(unit), model.agent.q_values(unit))
    ours, theirs = (each.agent.statistics() for each in (model, loaded))
    assert all(theirs[name] == figure for name, figure in ours.items() if name.startswith("model/"))
    n = model.num_timesteps
    loaded.learn(50, reset_num_timesteps=False)
    assert loaded.num_timesteps == loaded.agent.model.n_instances == n + 50


@pytest.mark.parametrize(("kind", "name"), [(str, "car"), (pathlib.Path, "car.zip"), (str, "folder/new/car"), (str, "car.v1")])
def test_a_model_is_saved_and_loaded_by_paths_of_any_kind(kind, name, tmp_path):
    model = small().learn(20)
    model.save(kind(tmp_path / name))
    written = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert [path.name for path in written] == [{"car": "car.zip"}.get(pathlib.Path(name).name, pathlib.Path(name).name)]
    assert same_parameters(FittedRMax.load(kind(tmp_path / name)), model)
    assert same_parameters(FittedRMax.load(written[0]), model)


def test_a_model_is_saved_to_and_loaded_from_open_files(tmp_path):
    model, memory = small().learn(20), io.BytesIO()
    model.save(memory)
    memory.seek(0)
    assert same_parameters(FittedRMax.load(memory), model)
    with (tmp_path / "open.zip").open("wb") as file:
        model.save(file)
        assert not file.closed
    with (tmp_path / "open.zip").open("rb") as file:
        assert same_parameters(FittedRMax.load(file), model) and not file.closed
        with pytest.raises(ValueError, match="writable"):
            model.save(file)


def test_the_environment_can_be_named_when_loading(tmp_path):
    FittedRMax("MlpPolicy", "MountainCar-v0", resolution=3, seed=0).learn(30).save(tmp_path / "car")
    loaded = FittedRMax.load(tmp_path / "car", env="MountainCar-v0")
    assert loaded.get_env().get_attr("spec")[0].id == "MountainCar-v0"
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.agent.model.n_instances == 50


def test_system_info_is_printed(tmp_path, capsys):
    small().learn(5).save(tmp_path / "model")
    FittedRMax.load(tmp_path / "model", print_system_info=True)
    shown = capsys.readouterr().out
    assert "CURRENT SYSTEM INFO" in shown and "SAVED MODEL SYSTEM INFO" in shown
    assert shown.count("Stable-Baselines3:") == 2


def test_arguments_can_be_changed_when_loading(tmp_path):
    small().learn(30).save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk(), max_value=7, verbose=1)
    assert (loaded.max_value, loaded.agent.planner.bounds[1], loaded.verbose) == (7, 7.0, 1)
    with pytest.raises(ValueError, match="max_value must be"):
        FittedRMax.load(tmp_path / "model", max_value=np.nan)


def test_a_grid_of_another_size_is_refused_in_a_sentence(tmp_path):
    small().learn(30).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"must have shape \(722\), got \(242,\)") as error:
        FittedRMax.load(tmp_path / "model", resolution=4)
    assert "\n" not in str(error.value)


def test_save_excludes_and_includes_attributes(tmp_path):
    model = small(verbose=1).learn(10)
    model.save(tmp_path / "less", exclude=["verbose"])
    assert "verbose" not in load_from_zip_file(tmp_path / "less")[0] and FittedRMax.load(tmp_path / "less").verbose == 0
    model.save(tmp_path / "more", include=["_episode_rewards"])
    assert "_episode_rewards" in load_from_zip_file(tmp_path / "more")[0]


def test_saving_changes_nothing(make, tmp_path):
    model, other = make().learn(60), make().learn(60)
    before = dict(vars(model))
    model.save(tmp_path / "model")
    assert vars(model).keys() == before.keys() and all(vars(model)[name] is value for name, value in before.items())
    assert same_parameters(model.learn(60), other.learn(60))


def generator_state(model):
    return model.agent.rng.bit_generator.state


def test_random_numbers_go_on_where_they_were_unless_a_seed_is_given(make, tmp_path):
    model = make().learn(40)
    model.save(tmp_path / "model")
    assert generator_state(FittedRMax.load(tmp_path / "model")) == generator_state(model)
    one, other = (FittedRMax.load(tmp_path / "model", seed=9) for _ in range(2))
    assert generator_state(one) == generator_state(other) == np.random.default_rng(9).bit_generator.state


def kept_weight(state, instances, breadth, min_fraction):
    """Weight of the instances that a kernel average keeps at a state: nearest first, while they add enough."""
    total = 0.0
    for weight in sorted(np.exp(-((instances - state) ** 2).sum(axis=1) / breadth**2), reverse=True):
        if weight < min_fraction * total:
            break
        total += weight
    return total


def test_pairs_that_are_known_by_history_alone_are_saved(tmp_path):
    """A nearer instance shortens the list of a kernel average."""
    model = small(degree=0, min_fraction=0.6, model_breadth=0.5, resolution=1, bounds=(0.0, 1.0))
    for state in (0.1, 0.1, 0.45):
        model.agent.update(np.array([state, 0.5]), 0, -1.0, np.array([state + 0.1, 0.5]), False)
    learned = model.agent.model
    known = np.flatnonzero(learned.known)
    points = model.agent.grid.states_of(known)
    instances = learned.instances.state[0, :3]
    assert min(kept_weight(point, instances, 0.5, 0.6) for point in points) < 1.0, "the case that this test is about"
    model.save(tmp_path / "model")
    np.testing.assert_array_equal(FittedRMax.load(tmp_path / "model").agent.model.known, learned.known)


def test_a_saved_model_can_be_loaded_for_more_environments(tmp_path):
    small().learn(50).save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=DummyVecEnv([Walk, Walk])).learn(20)
    assert loaded.n_envs == 2 and loaded.agent.model.n_instances == 70


def test_a_model_without_transfer_cannot_take_one_up_when_loaded(tmp_path):
    small().learn(20).save(tmp_path / "model")
    with pytest.raises(ValueError, match="transfer") as error:
        FittedRMax.load(tmp_path / "model", transfer=METHODS["COMBREL"]())
    assert "\n" not in str(error.value)


def layouts(value, seen):
    """How all arrays that an object holds are laid out: compiled code is compiled once more for each layout."""
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.ndim, value.flags.c_contiguous, value.flags.writeable
    if id(value) in seen or isinstance(value, str | int | float):
        return None
    seen.add(id(value))
    if isinstance(value, list | tuple):
        return [layouts(each, seen) for each in value]
    return {name: layouts(each, seen) for name, each in vars(value).items()} if hasattr(value, "__dict__") else None


@pytest.mark.parametrize("degree", [0, 1])
def test_nothing_is_compiled_once_more_for_a_loaded_model(degree, tmp_path):
    model = small(degree=degree).learn(40)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model")
    for name in ("grid", "mdp", "planner", "model"):
        one, other = (getattr(each.agent, name) for each in (model, loaded))
        assert layouts(other, set()) == layouts(one, set()), name
