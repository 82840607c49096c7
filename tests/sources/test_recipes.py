"""Sources by name: files, ids of environments, recipes; and transfer methods that take them."""

import gymnasium
import numpy as np
import pytest
from helpers.sources import assert_same, some_source
from helpers.walk import Walk, small

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, SourceInstances
from sb3_combrel.sources import recipes
from sb3_combrel.sources.recipes import check_source, find_source, task_spec

WALK = "WalkForRecipes-v0"
SHORT = {"n_instances": 40, "total_timesteps": 200, "seed": 0}


@pytest.fixture(autouse=True)
def walk_task(monkeypatch, tmp_path):
    """A task with an id, and a folder of its own for what is kept."""
    gymnasium.register(WALK, Walk)
    monkeypatch.setenv(recipes.CACHE_VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(recipes, "DEFAULT_RECIPE", SHORT)
    yield
    del gymnasium.registry[WALK]


@pytest.mark.parametrize("method", [COMBREL, TIMBREL])
@pytest.mark.parametrize("source", [WALK, {"env": WALK}], ids=["id", "recipe"])
def test_a_task_is_learned_when_the_model_is_made_and_read_the_next_time(method, source, tmp_path, capsys):
    transfer = method(source)
    assert not (tmp_path / "cache").exists() and not capsys.readouterr().out
    first = small(transfer=transfer)
    assert "Learning the source task" in capsys.readouterr().out
    assert_same(first.transfer.source, SourceInstances.from_q_learning(WALK, **SHORT))
    second = small(transfer=method(source))
    assert not capsys.readouterr().out
    assert_same(first.transfer.source, second.transfer.source)


def test_files_tasks_and_instances_may_be_listed_together(tmp_path):
    file = some_source().save(tmp_path / "source.npz")
    found = COMBREL([str(file), WALK, some_source()], use="instances")
    [one, two, three] = small(transfer=found).transfer.sources
    assert_same(one, some_source())
    assert_same(three, some_source())
    assert two.origin["env"] == WALK


def test_a_saved_model_has_the_instances(tmp_path):
    small(transfer=COMBREL(WALK)).learn(40).save(tmp_path / "model")
    for file in (tmp_path / "cache").iterdir():
        file.unlink()
    assert len(FittedRMax.load(tmp_path / "model", env=Walk()).transfer.source) == 40


@pytest.mark.parametrize("method", [COMBREL, TIMBREL])
@pytest.mark.parametrize("name", ["nowhere.npz", "Nowhere-v0", "no_such_package:Task-v0", "combrel/Nowhere-v0", ""])
def test_what_does_not_exist_is_refused_at_construction(method, name):
    for source in (name, [some_source(), name]):
        with pytest.raises(FileNotFoundError, match=r"there is no source file .*and no environment of that name"):
            method(source)


@pytest.mark.parametrize("method", [COMBREL, TIMBREL])
@pytest.mark.parametrize(
    ("source", "message"),
    [
        ({"n_instances": 3}, "the recipe of a source needs 'env'"),
        ({"env": WALK, "learner": "sarsa"}, "learner must be q_learning or fitted_rmax, got 'sarsa'"),
        (7, "source must be SourceInstances, a path to them, or a list of these"),
        ([], "source must be SourceInstances"),
    ],
)
def test_what_is_no_source_is_refused_at_construction(method, source, message):
    with pytest.raises(ValueError, match=message):
        method(source)


def test_a_path_that_goes_before_it_is_read_is_named(tmp_path):
    file = some_source().save(tmp_path / "source.npz")
    transfer = COMBREL(tmp_path / "source")
    file.unlink()
    with pytest.raises(FileNotFoundError, match=r"no source file .*source"):
        small(transfer=transfer)


def test_a_recipe_with_other_arguments_is_another_source():
    one, other = find_source({"env": WALK}), find_source({"env": WALK, "seed": 1})
    assert not np.array_equal(one.states, other.states)
    with pytest.raises(ValueError, match=r"cannot be learnt by the recipe .*no_such_argument"):
        find_source({"env": WALK, "no_such_argument": 1})


def test_specifications_of_tasks():
    assert task_spec(WALK).id == WALK
    assert task_spec("combrel/MountainCar2D-v0").id == "combrel/MountainCar2D-v0"
    assert task_spec("combrel_envs:combrel/MountainCar2D-v0").id == "combrel/MountainCar2D-v0"
    assert task_spec("Nowhere-v0") is None and task_spec("source.npz") is None
    check_source("combrel/MountainCar2D-v0")
