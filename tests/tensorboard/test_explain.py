"""``explain``: the report and the pictures of a model, in Python and on the command line."""

import numpy as np
import pytest
from helpers.command_line import call_for_all_output
from helpers.dashboard import METHODS, NamedWalk, walker
from helpers.own_method import Mine
from matplotlib.image import imread

from sb3_combrel import FittedRMax, explain
from sb3_combrel.tensorboard import pictures
from sb3_combrel.tensorboard.explain import FILE_DPI
from sb3_combrel.tensorboard.mapping_table import mapping_table
from sb3_combrel.tensorboard.plane import plane_through

TEXTS = ("mappings.md", "report.txt")


@pytest.fixture(scope="module")
def saved(learnt, tmp_path_factory):
    """A model with names from its environment, and its file."""
    model, path = learnt, tmp_path_factory.mktemp("model") / "model.zip"
    model.save(path)
    return model, path


@pytest.mark.parametrize("method", [name for name in METHODS if name != "none"])
def test_every_method_is_explained_with_its_pictures(method, transfers, tmp_path):
    model = walker(transfer=transfers[method]).learn(120)
    assert str(explain(model, tmp_path / "new" / "folder")) == str(model.transfer.report())
    of_choice = ["source_action_place_height.png"] if method in ("TIMBREL", "COMBREL") else []
    written = sorted(path.name for path in (tmp_path / "new" / "folder").iterdir())
    assert written == sorted([*of_choice, *TEXTS, "value_and_policy_place_height.png"])
    table = (tmp_path / "new" / "folder" / "mappings.md").read_text()
    assert table == f"{mapping_table(model.transfer, NamedWalk.action_names)}\n"


def test_the_files_are_the_dashboards_pictures(saved, tmp_path, drawn):
    model, _ = saved
    explain(model, tmp_path, variables=[("height", "place")], at=[0.5, 1.5])
    agent = model.agent
    plane = plane_through(agent.grid, agent.task.scaling, agent.task.state_names, (1, 0), [0.5, 1.5])
    drawn = {
        "value_and_policy_height_place.png": pictures.value_and_policy(agent, plane, FILE_DPI),
        "source_action_height_place.png": pictures.source_actions(agent, model.transfer, plane, FILE_DPI),
    }
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*drawn, *TEXTS])
    for name, pixels in drawn.items():
        np.testing.assert_allclose(imread(tmp_path / name)[..., :3], pixels / 255.0, atol=1 / 255)


def test_a_file_says_the_same_as_the_model_with_the_names_of_the_environment(saved):
    model, path = saved
    report = explain(path)
    assert str(report) == str(explain(model)) == str(explain(path.with_suffix("")))
    assert [each.target_action for each in report.mappings] == list(NamedWalk.action_names)
    assert "place<-" in report.mappings[0].mapping


def test_names_given_to_the_policy_come_before_those_of_the_environment(transfers, tmp_path):
    names = dict(action_names=["left", "right"])
    walker(transfer=transfers["COMBREL"], policy_kwargs=names).learn(60).save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model")
    assert loaded.agent.task.action_names == ("left", "right") and loaded.agent.task.state_names == NamedWalk.state_names


def test_a_method_of_ones_own_has_a_report_and_a_picture(tmp_path):
    assert str(explain(walker(transfer=Mine()).learn(60), tmp_path)).startswith("Mine()")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.txt", "value_and_policy_place_height.png"]


def test_what_cannot_be_explained_is_refused(saved, transfers, tmp_path):
    with pytest.raises(ValueError, match="no transfer method, so there is nothing to explain"):
        explain(walker().learn(40))
    for transfer in (transfers["COMBREL"], Mine()):
        with pytest.raises(ValueError, match=r"not learned anything yet: call model.learn\(total_timesteps\) first"):
            explain(walker(transfer=transfer))
    with pytest.raises(FileNotFoundError, match=r"no model file .*nowhere.zip, looked for in"):
        explain(tmp_path / "nowhere.zip")
    (tmp_path / "text.zip").write_text("mine")
    with pytest.raises(ValueError, match=r"text.zip is not the file of a model"):
        explain(tmp_path / "text.zip")
    with pytest.raises(ValueError, match=r"at must be 2 numbers, one a state variable, got \[1\]"):
        explain(saved[0], tmp_path, at=[1])
    with pytest.raises(ValueError, match=r"names out of place, height, .* got \('place', 'width'\)"):
        explain(saved[0], tmp_path, variables=[("place", "width")])
    assert [path.name for path in tmp_path.iterdir()] == ["text.zip"]


def test_the_command_prints_the_report_and_writes_it_with_the_pictures(saved, tmp_path):
    model, path = saved
    text = str(model.transfer.report())
    assert call_for_all_output("explain", path) == (0, f"{text}\n")
    status, written = call_for_all_output("explain", path, "--output", tmp_path)
    assert status == 0 and written.startswith(text)
    assert (tmp_path / "report.txt").read_text() == f"{text}\n"
    assert all(str(file) in written for file in tmp_path.iterdir())
    assert len(list(tmp_path.glob("*.png"))) == 2
    status, written = call_for_all_output("explain", tmp_path / "nowhere.zip")
    assert status == 1 and "there is no model file" in written and "Traceback" not in written
