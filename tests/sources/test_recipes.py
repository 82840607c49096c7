"""Sources by name: files, ids of environments, recipes; and transfer methods that take them."""

import os
import time
from dataclasses import replace
from functools import partial

import gymnasium
import numpy as np
import pytest
from helpers.dashboard import NamedWalk
from helpers.sources import assert_same, some_source
from helpers.walk import Walk, small, walk_source
from stable_baselines3 import DQN

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, SourceInstances
from sb3_combrel.common.version import __version__
from sb3_combrel.sources import recipes
from sb3_combrel.sources.recipes import checked_source, find_source, task_spec
from sb3_combrel.transfer.methods.experts import MappingExperts
from sb3_combrel.transfer.methods.soft_homomorphism import SoftHomomorphism
from sb3_combrel.transfer.methods.three_way_rbm import ThreeWayRBM
from sb3_combrel.transfer.report import describe_sources

WALK = "WalkForRecipes-v0"
SHORT = {"n_instances": 40, "total_timesteps": 200, "seed": 0}


@pytest.fixture(autouse=True)
def walk_task(monkeypatch, tmp_path):
    """A task with an id, and a folder of its own for what is kept."""
    gymnasium.register(WALK, Walk)
    monkeypatch.setenv(recipes.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(recipes, "DEFAULT_RECIPE", SHORT)
    monkeypatch.setattr(recipes, "_SEEN", set())
    monkeypatch.delenv(recipes.RENEW_VARIABLE, raising=False)
    yield
    del gymnasium.registry[WALK]


@pytest.mark.parametrize(("method", "source"), [(COMBREL, WALK), (TIMBREL, {"env": WALK})], ids=["id", "recipe"])
def test_a_task_is_learned_when_the_model_is_made_and_read_the_next_time(method, source, tmp_path, capsys):
    transfer = method(source)
    assert not (tmp_path / "cache").exists() and not capsys.readouterr().out
    first = small(transfer=transfer)
    assert "Learning the source task" in capsys.readouterr().out
    assert_same(first.transfer.source, SourceInstances.from_q_learning(WALK, **SHORT))
    second = small(transfer=method(source))
    assert not capsys.readouterr().out
    assert_same(first.transfer.source, second.transfer.source)


def test_what_is_read_is_named_once_with_its_date(monkeypatch, tmp_path, capsys):
    find_source(WALK)
    (file,) = (tmp_path / "cache").iterdir()
    os.utime(file, (0.0, time.mktime((2021, 3, 4, 5, 6, 0, 0, 0, -1))))
    monkeypatch.setattr(recipes, "_SEEN", set())
    capsys.readouterr()
    find_source(WALK)
    printed = capsys.readouterr().out
    assert f"{WALK}: 40 instances learned by q_learning on 2021-03-04 05:06, from {file}" in printed and "renew" in printed
    find_source(WALK)
    assert not capsys.readouterr().out


@pytest.mark.parametrize("by", ["recipe", "variable"])
def test_a_source_is_renewed_once_in_a_process(by, monkeypatch, tmp_path, capsys):
    find_source(WALK)
    (file,) = (tmp_path / "cache").iterdir()
    some_source().save(file)
    monkeypatch.setattr(recipes, "_SEEN", set())
    assert_same(find_source(WALK), some_source())
    monkeypatch.setattr(recipes, "_SEEN", set())
    capsys.readouterr()
    if by == "variable":
        monkeypatch.setenv(recipes.RENEW_VARIABLE, "1")
    source = {"env": WALK, "renew": True} if by == "recipe" else WALK
    assert_same(find_source(source), SourceInstances.from_q_learning(WALK, **SHORT))
    assert "again, in place of what was learned on" in capsys.readouterr().out
    some_source().save(file)
    assert_same(find_source(source), some_source())
    assert [file] == list((tmp_path / "cache").iterdir())


class Boundless(Walk):
    """Its space says of the second variable nothing but that it is a number."""

    def __init__(self):
        super().__init__()
        self.observation_space = gymnasium.spaces.Box(np.float32([-1.0, -np.inf]), np.float32([1.0, np.inf]))


@pytest.mark.filterwarnings("ignore:.*is coarse")
def test_a_task_without_bounds_is_learned_by_fitted_rmax(capsys):
    task = "BoundlessForRecipes-v0"
    gymnasium.register(task, Boundless)
    try:
        found = find_source(task)
        assert "by fitted_rmax" in capsys.readouterr().out and len(found) == 40
        assert_same(found, SourceInstances.from_fitted_rmax(task, n_instances=40, seed=0))
        # Who asks for Q-learning, or gives arguments of it, is told what it needs.
        for more in ({"learner": "q_learning"}, {"epsilon": 0.1}, {"total_timesteps": 300}):
            says = r"which Q-learning needs: .* {'env': '%s', 'bounds': \[.*\]}.* {'env': '%s', 'learner': 'fitted_rmax'}"
            with pytest.raises(ValueError, match=says % (task, task)):
                find_source({"env": task, **more})
            assert not capsys.readouterr().out
        assert len(find_source({"env": task, "bounds": [[-1.0, 0.0], [1.0, 2.0]]})) == 40
        assert recipes._has_bounds(WALK) and recipes._has_bounds("Nowhere-v0")
    finally:
        del gymnasium.registry[task]


class OtherWalk(Walk):
    """Another class with the same dynamics."""


@pytest.mark.parametrize(
    "change",
    [dict(entry_point=OtherWalk), dict(entry_point=Walk, kwargs={"limit": 7}), dict(entry_point=Walk, max_episode_steps=9)],
    ids=["class", "arguments", "limit"],
)
def test_another_class_or_other_arguments_are_noticed(change, capsys):
    before = recipes.cache_file({"env": WALK})
    find_source(WALK)
    capsys.readouterr()
    del gymnasium.registry[WALK]
    gymnasium.register(WALK, **change)
    assert recipes.cache_file({"env": WALK}) != before
    if "kwargs" not in change:
        find_source(WALK)
        assert "again: its class or its arguments have changed since 20" in capsys.readouterr().out


def test_a_changed_module_of_the_dynamics_is_noticed(tmp_path, monkeypatch):
    package = tmp_path / "own_walks"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "dynamics.py").write_text("STRIDE = 1\n")
    base = "from own_walks import dynamics\nfrom torch.nn import Module\n"  # Torch has modules whose files are not there.
    (package / "walk.py").write_text(base + "class OwnWalk(Module):\n    stride = dynamics.STRIDE\n")
    monkeypatch.syspath_prepend(tmp_path)
    del gymnasium.registry[WALK]
    gymnasium.register(WALK, "own_walks.walk:OwnWalk")
    before = recipes.fingerprint(WALK)
    assert recipes.fingerprint(WALK) == before
    (package / "dynamics.py").write_text("STRIDE = 2\n")
    assert recipes.fingerprint(WALK) != before


def test_files_tasks_and_instances_may_be_listed_together_and_are_saved_with_the_model(tmp_path):
    file = some_source().save(tmp_path / "source.npz")
    small(transfer=COMBREL([str(file), WALK, some_source()], use="instances")).save(tmp_path / "model")
    file.unlink()
    [one, two, three] = FittedRMax.load(tmp_path / "model", env=Walk()).transfer.sources
    assert_same(one, some_source())
    assert_same(three, some_source())
    assert two.origin["env"] == WALK


@pytest.mark.parametrize(
    ("source", "error", "message"),
    [
        *(
            (name, FileNotFoundError, "there is no file .*and no environment or Minari dataset of that name")
            for name in ("nowhere.npz", "Nowhere-v0", "no_such_package:Task-v0", "combrel/Nowhere-v0", "")
        ),
        ({"n_instances": 3}, ValueError, "the recipe of a source needs 'env'"),
        ({"env": WALK, "learner": "sarsa"}, ValueError, "learner must be q_learning or fitted_rmax, got 'sarsa'"),
        (7, ValueError, "source must be SourceInstances, a file .*or a list of these"),
        ([], ValueError, "source must be SourceInstances"),
    ],
)
def test_what_is_no_source_is_refused_at_construction(source, error, message):
    for given in (source, [some_source(), source]):
        for method in (COMBREL, TIMBREL):
            with pytest.raises(error, match=message):
                method(given)


def test_a_path_that_goes_before_it_is_read_is_named(tmp_path):
    file, transfer = some_source().save(tmp_path / "source.npz"), COMBREL(tmp_path / "source")
    file.unlink()
    with pytest.raises(FileNotFoundError, match=r"no file .*source"):
        small(transfer=transfer)


def test_a_recipe_with_other_arguments_is_another_source():
    one, other = find_source({"env": WALK}), find_source({"env": WALK, "seed": 1})
    assert not np.array_equal(one.states, other.states)
    with pytest.raises(ValueError, match=r"cannot be learnt by the recipe .*no_such_argument"):
        find_source({"env": WALK, "no_such_argument": 1})
    with pytest.raises(ValueError, match="renew must be true or false, got 'often'"):
        find_source({"env": WALK, "renew": "often"})


def test_specifications_of_tasks():
    assert task_spec(WALK).id == WALK and task_spec("combrel/MountainCar2D-v0").id == "combrel/MountainCar2D-v0"
    assert task_spec("combrel_envs:combrel/MountainCar2D-v0").id == "combrel/MountainCar2D-v0"
    assert task_spec("Nowhere-v0") is None and task_spec("source.npz") is None
    checked_source("combrel/MountainCar2D-v0")


def test_what_a_learner_takes_as_past_data_is_a_source_too(tmp_path):
    """Read at construction where it is in memory, of a file when learning starts; and saved with the model."""
    model = small(Walk()).learn(20)
    experience = model.source_instances()
    model.save(tmp_path / "walk")
    experience.to_table().to_csv(tmp_path / "log.csv", index=False)
    for given in (model, experience.to_table(), tmp_path / "walk", str(tmp_path / "walk.zip"), tmp_path / "log.csv"):
        np.testing.assert_allclose(find_source(given).states, experience.states, atol=1e-12)
        assert len(COMBREL([given, walk_source()]).source) == 2
    learner = FittedRMax(Walk(), transfer=COMBREL(model, use="instances"), seed=0)
    assert len(learner.transfer.sources[0]) == 20
    model.learn(20)
    assert len(learner.transfer.sources[0]) == 20, "as it was"


def test_a_replay_buffer_is_a_source_with_the_names_of_its_models_task():
    dqn = DQN("MlpPolicy", NamedWalk(), learning_starts=10, buffer_size=60, seed=0).learn(90)
    identity = InterTaskMapping([0, 1], [0, 1])
    for kind in (COMBREL, partial(TIMBREL, mappings=identity), MappingExperts, SoftHomomorphism, ThreeWayRBM):
        of_model, of_buffer = (kind(given).source for given in (dqn, dqn.replay_buffer))
        np.testing.assert_array_equal(of_model.states, of_buffer.states)
        assert len(of_model) == 60 and of_model.origin["recorder"] == "DQN" and of_buffer.state_names == ("s0", "s1")
        assert (of_model.state_names, of_model.action_names) == (NamedWalk.state_names, NamedWalk.action_names)
        np.testing.assert_array_equal(of_buffer.low, Walk().observation_space.low)
    assert len(SourceInstances.from_replay_buffer(dqn.replay_buffer, 7, seed=0)) == 7
    narrow = SourceInstances.from_replay_buffer(dqn.replay_buffer, bounds=([-3.0, -3.0], [3.0, 3.0]))
    np.testing.assert_array_equal(narrow.low, [-3.0, -3.0])


def test_what_has_no_experience_is_told_how_it_becomes_a_source():
    for model in (lambda state: 0, DQN("MlpPolicy", Walk(), buffer_size=10)):
        with pytest.raises(ValueError, match=r"pass what it does, SourceInstances\.record\(model, env\)$"):
            checked_source(model)
    with pytest.raises(ValueError, match="no experience yet"):
        checked_source(small(Walk()))


def test_a_compressed_table_is_a_source(tmp_path):
    walk_source().to_table().to_csv(tmp_path / "log.csv.gz", index=False)
    np.testing.assert_allclose(find_source(tmp_path / "log.csv.gz").states, walk_source().states)


def test_actions_that_nobody_has_taken_are_named():
    source = walk_source()
    assert "none with" not in repr(source)
    more = replace(source, n_actions=4, action_names=("back", "forth", "up", "down"))
    assert ", none with up or down, " in repr(more)
    assert describe_sources([more]) == ("an unnamed task (60 instances, none with up or down)",)


def test_instances_say_by_which_version_they_were_recorded():
    assert SourceInstances.record(None, Walk(), 5, seed=0).origin["package"] == f"sb3-combrel {__version__}"
