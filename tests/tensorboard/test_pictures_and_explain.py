"""Pictures of the dashboard: when they come, and what they show."""

import numpy as np
import pytest
from helpers.command_line import call_for_all_output
from helpers.dashboard import METHODS, NamedWalk, Still, events, run_folder, slow_q, walker
from helpers.own_method import Mine
from helpers.walk import Walk
from matplotlib.image import imread

from sb3_combrel import COMBREL, FittedRMax, SourceInstances, explain
from sb3_combrel.callbacks import DashboardCallback
from sb3_combrel.pages.drawings import value_figure
from sb3_combrel.pages.palette import MAPPING_COLOURS
from sb3_combrel.pages.plane import numbered, plane_through
from sb3_combrel.pages.snapshot import action_values, greedy_actions, snapshot_of
from sb3_combrel.tensorboard import pictures
from sb3_combrel.tensorboard.explain import FILE_DPI
from sb3_combrel.tensorboard.history import MAX_COLUMNS, ChoiceHistory
from sb3_combrel.tensorboard.mapping_table import mapping_table
from sb3_combrel.tensorboard.pictures import WIDTH, chosen_source_actions, source_action_figure, state_mapping_shares


def test_pictures_that_nobody_asked_for_stay_within_their_share_of_the_time(tmp_path, monkeypatch, clock):
    def slowly(self, step):
        shown.append(clock[0])
        clock[0] += 0.05
        return {}

    shown = []
    monkeypatch.setattr(DashboardCallback, "_draw", slowly)
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.FIRST_PICTURES_SECONDS", 0.01)
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.DEFAULT_PICTURE_FREQ", 10)
    walker(tmp_path).learn(900)
    # The first set was expected to take 0.01 seconds, so it came after 0.07 seconds at the earliest. The last always comes.
    assert 2 <= len(shown) <= 1 + 0.15 * clock[0] / 0.05 and shown[0] >= 0.01 / 0.15


@pytest.mark.parametrize("others_are_left_out", [False, True])
def test_a_short_run_has_one_set_of_pictures_at_its_end(others_are_left_out, tmp_path, monkeypatch):
    if others_are_left_out:
        monkeypatch.setattr("sb3_combrel.tensorboard.callback.DEFAULT_PICTURE_FREQ", 60)
        monkeypatch.setattr("sb3_combrel.tensorboard.callback.FIRST_PICTURES_SECONDS", 1e6)
    walker(tmp_path).learn(120)
    found = events(run_folder(tmp_path))
    assert [image.step for image in found.Images("value_and_policy/place_height")] == [120]
    assert "model/known" in found.Tags()["scalars"]


def ink_at_the_edges(picture):
    """Whether anything is drawn in the outermost pixels."""
    return any((edge < 200).any() for edge in (picture[0], picture[-1], picture[:, 0], picture[:, -1]))


@pytest.mark.parametrize(("words", "n_actions"), [(("a", "b"), 9), (("shoulder_pitch_up", "shoulder_pitch_down"), 5)])
def test_pictures_are_as_wide_as_a_card_and_nothing_is_cut_off(words, n_actions, drawn):
    names = [f"{words[k % 2]}{k}" for k in range(n_actions)]
    env = Still(np.zeros(4, dtype=np.float32), np.ones(4, dtype=np.float32), names)
    source = SourceInstances.record(None, env, n_instances=60, seed=0)
    agent = FittedRMax(env, transfer=COMBREL(source, use="instances"), seed=0, model_breadth=0.4, resolution=2).agent
    plane = plane_through(agent.grid, agent.task.scaling, [f"joint_velocity_{k}" for k in range(4)], (0, 1))
    history = ChoiceHistory()
    history.note(50, np.arange(0, len(agent.transfer.choices()), 97) % 40)
    figures = [value_figure(snapshot_of(agent), plane, WIDTH), source_action_figure(agent, agent.transfer, plane, WIDTH)]
    drawn = [*map(pictures._pixels, figures), pictures.state_mappings(history, agent.transfer)]
    for picture in drawn:
        assert picture.shape[1] == 640 and not ink_at_the_edges(picture)
    # Every action has its colour in the legend.
    colours = {tuple(pixel) for pixel in drawn[1].reshape(-1, 3)}
    assert {tuple(int(c[k : k + 2], 16) for k in (1, 3, 5)) for c in MAPPING_COLOURS[:n_actions]} <= colours


def test_without_matplotlib_there_are_no_pictures_but_all_else(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_combrel.pages.plane.find_spec", lambda name: None)
    walker(tmp_path).learn(150)
    found = events(run_folder(tmp_path))
    assert not found.Tags()["images"] and "model/known" in found.Tags()["scalars"]
    with pytest.raises(ModuleNotFoundError, match="matplotlib"):
        walker(tmp_path).learn(10, DashboardCallback())


def test_the_greedy_action_is_the_best_of_the_model():
    agent = walker().learn(400).agent
    points = np.arange(agent.grid.n_points)
    q, greedy = action_values(agent, points), greedy_actions(agent, points)
    for point in points:
        slow = [slow_q(agent, point, action) for action in range(2)]
        assert q[:, point] == pytest.approx([np.nan if value is None else value for value in slow], nan_ok=True)
        assert greedy[point] == (-1 if None in slow else int(np.argmax(slow)))
    assert {-1, 0, 1} >= set(greedy) and (greedy >= 0).any()


def test_other_variables_are_held_at_the_nearest_grid_points():
    low, high = np.float32([0, 0, -1]), np.float32([1, 10, 1])
    agent = FittedRMax(Still(low, high), model_breadth=0.3, resolution=2).agent
    plane = plane_through(agent.grid, agent.task.scaling, ("a", "b", "c"), (2, 0), at=[0.5, 7.0, 0.3])
    states = agent.task.scaling.to_raw(agent.grid.points())[plane.points]
    assert plane.names == ("c", "a") and states[0, 0, [2, 0]] == pytest.approx([-1.0, 0.0])
    assert np.all(states[..., 1] == 7.5) and plane.held == "b = 7.5"
    assert np.all(np.diff(states[..., 2], axis=1) > 0) and np.all(np.diff(states[..., 0], axis=0) > 0)


def test_the_first_two_variables_are_drawn_by_default_or_the_only_one(tmp_path):
    FittedRMax(Still(np.float32([0]), np.float32([1])), seed=0, tensorboard_log=str(tmp_path)).learn(50, DashboardCallback())
    assert events(run_folder(tmp_path)).Tags()["images"] == ["value_and_policy/s0"]
    assert numbered(None, ("a",)) == [(0, 0)]
    agent = FittedRMax(Still(np.float32([0]), np.float32([1])), seed=0).agent
    panels = value_figure(snapshot_of(agent), plane_through(agent.grid, agent.task.scaling, ("a",), (0, 0)), WIDTH).axes
    assert len(panels[0].get_xticks()) > 1 and len(panels[0].get_yticks()) == 0


def test_source_actions_are_those_of_the_chosen_mappings(learnt):
    agent = learnt.agent
    points = np.arange(agent.grid.n_points)
    names, numbers = chosen_source_actions(agent.transfer, points, 2)
    assert names == ["back", "forth"]
    for action in range(2):
        for point in points:
            candidate = agent.transfer.choices()[action * len(points) + point]
            description = agent.transfer.describe(candidate) if candidate >= 0 else ""
            expected = -1 if candidate < 0 else names.index(description.split("<-")[1].split(" ")[0])
            assert numbers[action, point] == expected


def test_shares_of_state_mappings_add_up(learnt):
    transfer, history = learnt.transfer, ChoiceHistory()
    history.note(0, np.full(9, -1))
    history.note(100, transfer.choices())
    names, shares = state_mapping_shares(history, transfer)
    assert shares[:, 0].sum() == 0.0 and shares[:, 1].sum() == pytest.approx(1.0)
    assert len(set(names)) == len(names) == len(shares)
    chosen = [transfer.candidate(c).state_mapping for c in transfer.choices() if c >= 0]
    assert shares[:, 1] == pytest.approx([chosen.count(name) / len(chosen) for name in names])


def test_history_stays_small_and_spread_over_the_run():
    history = ChoiceHistory()
    for step in range(5 * MAX_COLUMNS):
        history.note(step, np.array([0]))
    assert len(history.steps) < MAX_COLUMNS and history.steps[0] == 0 and history.steps[-1] > 4.9 * MAX_COLUMNS
    assert len(set(np.diff(history.steps))) == 1


# ``explain``: the report and the pictures of a model, in Python and on the command line.
TEXTS = ("mappings.md", "report.html", "report.txt")


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
        "value_and_policy_height_place.png": value_figure(snapshot_of(agent), plane, WIDTH),
        "source_action_height_place.png": source_action_figure(agent, model.transfer, plane, WIDTH),
    }
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*drawn, *TEXTS])
    for name, figure in drawn.items():
        pixels = pictures._pixels(figure, FILE_DPI)
        np.testing.assert_allclose(imread(tmp_path / name)[..., :3], pixels / 255.0, atol=1 / 255)


def test_a_file_says_the_same_as_the_model_with_the_names_of_the_environment(saved):
    model, path = saved
    with pytest.raises(ValueError, match="model must be a FittedRMax model or the path of its file, got 5"):
        explain(5)
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
    written = ["report.html", "report.txt", "value_and_policy_place_height.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == written


def test_a_model_without_transfer_has_values_and_policy(tmp_path):
    report = explain(walker().learn(60), tmp_path)
    assert str(report) == "The model has no transfer method: what it knows is its own." and report.use == "none"
    written = ["report.html", "report.txt", "value_and_policy_place_height.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == written


def test_what_cannot_be_explained_is_refused(saved, transfers, tmp_path):
    for transfer in (None, transfers["COMBREL"], Mine()):
        with pytest.raises(ValueError, match=r"not learned anything yet: call model.learn\(total_timesteps\) first"):
            explain(walker(transfer=transfer))
    with pytest.raises(FileNotFoundError, match=r"no model file .*nowhere.zip, looked for in"):
        explain(tmp_path / "nowhere.zip")
    (tmp_path / "text.zip").write_text("mine")
    with pytest.raises(ValueError, match=r"text.zip is not the file of a model"):
        explain(tmp_path / "text.zip")
    for at in ([1], [np.nan, 1.0], ["place", "height"]):
        with pytest.raises(ValueError, match="at must be 2 finite numbers, one a state variable, got"):
            explain(saved[0], tmp_path, at=at)
    for variables in ([], (0, 1), 0, [(["place"], "height")]):
        with pytest.raises(ValueError, match=r"variables must be pairs of two different state variables, .* got"):
            explain(saved[0], tmp_path, variables=variables)
    with pytest.raises(ValueError, match=r"names out of place, height, .* got \('place', 'width'\)"):
        explain(saved[0], tmp_path, variables=[("place", "width")])
    with pytest.raises(ValueError, match=r"got \('place', 'heigth'\); did you mean 'height'\?"):
        explain(saved[0], tmp_path, variables=[("place", "heigth")])
    with pytest.raises(OSError, match=r"output must be in a folder that can be written to, got .*text.zip"):
        explain(saved[0], tmp_path / "text.zip")
    assert [path.name for path in tmp_path.iterdir()] == ["text.zip"]


def test_the_command_prints_the_report_and_writes_it_with_the_pictures(saved, tmp_path):
    model, path = saved
    text = str(model.transfer.report())
    assert call_for_all_output("explain", path) == (0, f"{text}\n")
    (tmp_path / "mine.png").touch()
    status, written = call_for_all_output("explain", path, "--output", tmp_path)
    assert status == 0 and written.startswith(text) and (tmp_path / "report.txt").read_text() == f"{text}\n"
    assert str(tmp_path / "report.html") in written and "mine.png" not in written and len(list(tmp_path.glob("*.png"))) == 3
    status, written = call_for_all_output("explain", tmp_path / "nowhere.zip")
    assert status == 1 and "there is no model file" in written and "Traceback" not in written


@pytest.mark.parametrize("drawn", [{"variables": [("x", "nonsense")]}, {"at": [1.0, 2.0, 3.0]}])
def test_what_is_to_be_drawn_needs_a_folder(drawn):
    [name] = drawn
    with pytest.raises(ValueError, match=rf"output must be a folder where {name}=.* says what is drawn, got None"):
        explain(walker().learn(20), **drawn)


def test_a_file_of_a_talkative_model_is_explained_without_its_talk(tmp_path, capsys):
    FittedRMax(Walk(), resolution=3, model_breadth=0.15, verbose=1).learn(20).save(tmp_path / "model")
    capsys.readouterr()
    explain(tmp_path / "model")
    assert capsys.readouterr().out == ""


def test_a_dashboard_without_a_log_says_that_it_does_nothing():
    with pytest.warns(UserWarning, match="does nothing without a TensorBoard log: pass the model tensorboard_log='logs'"):
        walker().learn(20, callback=DashboardCallback())
