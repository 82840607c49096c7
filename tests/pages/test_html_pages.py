"""Pages of models and comparisons: what they say, that they are the same each time, and that names in them are escaped."""

import base64
import re
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from helpers.command_line import call_for_all_output
from helpers.dashboard import Still, walker
from matplotlib.colors import to_hex
from stable_baselines3.common.env_util import make_vec_env

from sb3_combrel import FittedRMax, explain
from sb3_combrel.common.files import check_folder
from sb3_combrel.comparison.compare_page import compare_page
from sb3_combrel.pages.drawings import contradictions_figure
from sb3_combrel.pages.evidence_drawings import MAX_NAMED, OTHERS_COLOUR, evidence_figure, mean_evidence_figure, shortened
from sb3_combrel.pages.page import Cell, Page, PageTable, Section, data_address
from sb3_combrel.pages.palette import METHOD_COLOURS, NONE_COLOUR, mapping_colours, method_colours
from sb3_combrel.pages.plane import default_pair, numbered
from sb3_combrel.pages.report_sections import ANOTHER, colour_of, colours_of_reports, contradictions_table, mapping_section
from sb3_combrel.tensorboard.pictures import colours_of_mappings
from sb3_combrel.transfer.report import Contradiction, EvidencePoint, MappingReport, TransferReport

SECTIONS = [
    "Learning curve",
    "Mappings",
    "Evidence over time",
    "Values, bound and policy",
    "Where the source was contradicted",
]


def titles(html):
    return re.findall(r"<h2>(.*)</h2>", html)


def pictures_of(html):
    """The SVGs in a page, as text."""
    return [base64.b64decode(data).decode() for data in re.findall(r'(?:src|srcset)="data:image/svg\+xml;base64,(.*?)"', html)]


def test_the_page_of_a_model_has_all_sections_and_needs_nothing_else(models, tmp_path):
    report = explain(models["prior"], tmp_path)
    html = (tmp_path / "report.html").read_text()
    assert titles(html) == SECTIONS and report.sentence in html.replace("&#39;", "'")
    # Each picture in two widths; and no address but those that hold their data.
    shown = pictures_of(html)
    assert len(shown) == 2 * html.count("<picture>") >= 8 and all(svg.startswith("<?xml") for svg in shown)
    addresses = re.findall(r'(?:src|srcset|href)="([^"]*)"', html)
    assert len(addresses) == len(shown) and "<script" not in html and "url(" not in html and "@import" not in html
    assert not any("Date" in svg for svg in shown)


def test_pages_of_other_models_say_what_they_do_not_have(models, tmp_path, undrawn):
    explain(models["instances"], tmp_path / "instances")
    html = (tmp_path / "instances" / "report.html").read_text()
    assert "No history is kept of this method" in html and "Source action by state" in titles(html)
    explain(models["none"], tmp_path / "none")
    html = (tmp_path / "none" / "report.html").read_text()
    assert titles(html) == ["Learning curve", "Values and policy"] and "no transfer method" in html


@pytest.mark.parametrize(("n_envs", "unit", "ends"), [(1, "environment steps", [25, 50]), (3, "episodes", [1, 2, 3])])
def test_learning_curves_are_over_steps_or_over_the_episodes_of_several_environments(
    n_envs, unit, ends, monkeypatch, tmp_path, undrawn
):
    drawn = []
    monkeypatch.setattr("sb3_combrel.pages.drawings.returns_figure", lambda *given: drawn.append(given))
    env = make_vec_env(lambda: gymnasium.wrappers.TimeLimit(Still(np.float32([0]), np.float32([1])), 25), n_envs)
    explain(walker(env=env).learn(60 if n_envs == 1 else 30 * n_envs), tmp_path)
    assert drawn[0][2] == unit and drawn[0][0].tolist() == ends
    assert f"Return of each episode over {unit}" in (tmp_path / "report.html").read_text()


def test_the_same_model_gives_the_same_bytes(models, tmp_path):
    for name in ("one", "two"):
        explain(models["none"], tmp_path / name)
    one, two = ((tmp_path / name / "report.html").read_bytes() for name in ("one", "two"))
    assert one == two


def test_names_with_html_in_them_are_escaped(models, comparison, tmp_path, undrawn):
    explain(models["prior"], tmp_path)
    pages = [(tmp_path / "report.html").read_text(), comparison.save(tmp_path / "compare.html").read_text()]
    for html in pages:
        assert "<b>" not in html and "&lt;b&gt;back&lt;/b&gt;" in html and "forth &amp; on" in html
    assert "<i>" not in pages[1] and "&lt;i&gt;COMBREL&lt;/i&gt;" in pages[1]


def test_the_page_of_a_comparison_has_all_sections_and_the_same_bytes_each_time(comparison, tmp_path):
    path = comparison.save(tmp_path / "new" / "report.html")
    html = path.read_text()
    of_values = [f"Values after the first run: {name}" for name in ("none", "&lt;i&gt;COMBREL&lt;/i&gt;", "random mapping")]
    first = ["Learning curves", "Measures", "Mappings", "Evidence over time"]
    assert titles(html) == [*first, *of_values, "Where the source was contradicted"]
    assert all(warning in html for warning in comparison.warnings) and "Only 2 seeds" in html
    assert "inf" not in re.sub(r"base64,[^\"]*", "", html).replace("information", "")
    assert comparison.save(tmp_path / "again.html").read_text() == html
    # A picture of each method's values: the bound of one method only is drawn.
    assert len(pictures_of(html)) == 2 * 5


def test_the_pair_of_variables_can_be_chosen(comparison, models, tmp_path, monkeypatch):
    # A picture is told by the labels of its axes.
    def labels(figure):
        return " ".join(f"{axes.get_xlabel()} {axes.get_ylabel()}" for axes in figure.axes)

    monkeypatch.setattr("sb3_combrel.pages.page.data_address", labels)
    pages = [compare_page(comparison, pair) for pair in (None, [("place", "vplace")], [("vplace", "place")])]
    default, same, other = ([picture for each in page.sections for picture in each.pictures] for page in pages)
    assert default == same != other
    with pytest.raises(ValueError, match="did you mean 'vplace'"):
        comparison.save(tmp_path / "x.html", variables=[("place", "vplce")])
    status, written = call_for_all_output("explain", models["none"], "--output", tmp_path, "--variables", "vplace", "place")
    assert status == 0 and (tmp_path / "value_and_policy_vplace_place.png").exists(), written
    status, written = call_for_all_output("explain", models["none"], "--output", tmp_path, "--variables", "vplace", "plac")
    assert status == 1 and "did you mean 'place'" in written and "Traceback" not in written


def test_a_path_that_cannot_be_written_is_refused_before_anything_is_drawn(comparison, models, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match=r"path must end in \.html, got 'report\.pdf'"):
        comparison.save("report.pdf")
    with pytest.raises(OSError, match=r"path must be in a folder that can be written to, got .*file"):
        comparison.save(tmp_path / "file" / "report.html")
    with pytest.raises(OSError, match=r"output must be in a folder that can be written to, got .*file"):
        check_folder("output", tmp_path / "file")
    status, written = call_for_all_output("explain", models["none"], "--output", tmp_path / "file")
    assert status == 1 and "output must be in a folder that can be written to" in written and "Traceback" not in written
    assert (tmp_path / "file").read_text() == "mine" and [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_mapping_has_one_colour_everywhere(prior_model, comparison, undrawn):
    names = prior_model.transfer.source_prior.candidates.names()
    colours = colours_of_mappings(prior_model.transfer)
    assert [colours[name] for name in names if name != "nothing"] == list(mapping_colours(names).values())[3:]
    # What comes up later changes no colour that was given.
    assert mapping_colours([*names, "another"]).items() >= colours.items()
    section = mapping_section({"": [prior_model.transfer.report()]}, colours)
    marks = {row[1].text: row[1].colour for row in section.table.rows}
    assert marks == {each.mapping: colours[each.mapping] for each in prior_model.transfer.report().mappings}
    [first, *_] = comparison.reports["<i>COMBREL</i>"]
    [of_mappings] = [section for section in compare_page(comparison).sections if section.title == "Mappings"]
    of_page = {cell.text: cell.colour for row in of_mappings.table.rows for cell in row if cell.colour}
    own = mapping_colours([name for point in first.history for name in point.mappings])
    assert of_page and all(own[name] == shown for name, shown in of_page.items() if name in own)


@pytest.mark.parametrize("kind", ["prior", "instances"])
def test_the_colours_of_reports_are_those_of_the_dashboard(kind, models):
    transfer = FittedRMax.load(models[kind]).transfer
    report = transfer.report()
    of_reports, of_pictures = colours_of_reports([report]), colours_of_mappings(transfer)
    assert of_reports == of_pictures and all(colour_of(each.mapping, of_reports) for each in report.mappings)


def test_colours_of_mappings_differ_and_nothing_is_grey():
    names = [f"m{k}" for k in range(60)]
    found = mapping_colours(["nothing", *names, "m0"])
    assert found["nothing"] == NONE_COLOUR and len({found[name] for name in names}) == 60
    assert all(re.fullmatch("#[0-9A-F]{6}", each) for each in found.values())
    assert method_colours(["COMBREL", "none", "TIMBREL"], "none") == dict(
        zip(["none", "COMBREL", "TIMBREL"], METHOD_COLOURS[:3], strict=True)
    )


@pytest.mark.parametrize(
    ("names", "pair"),
    [
        (("x", "y", "vx", "vy"), (0, 2)),
        (("vy", "y", "x"), (1, 0)),
        (("theta", "theta_dot"), (0, 1)),
        (("a", "Joint velocity", "Joint"), (2, 1)),
        (("cart position", "pole angle", "cart velocity"), (0, 2)),
        (("s0", "s1", "s2"), (0, 1)),
        (("alone",), (0, 0)),
    ],
)
def test_a_variable_is_drawn_beside_its_own_velocity(names, pair):
    assert default_pair(names) == pair and numbered(None, names) == [pair]


POINTS = (
    EvidencePoint(10, np.nan, 0.0, False, (0.5, 0.5), ("nothing", "nothing")),
    EvidencePoint(20, 0.4, 0.0, True, (2.0, 1.0), ("left", "right")),
    EvidencePoint(50, 0.3, 1.0, True, (3.0, 1.0), ("left", "left")),
)


def test_evidence_is_drawn_as_it_was_noted():
    colours = mapping_colours(["left", "right"])
    strips, strengths, errors = evidence_figure(POINTS, ("a", "b"), colours, 6.0).axes
    bars = [(bar.get_x(), bar.get_width(), bar.get_facecolor()) for bar in strips.patches]
    assert [(x, width) for x, width, _ in bars] == [(10, 10), (20, 30), (10, 10), (20, 30)]
    assert [line.get_ydata().tolist() for line in strengths.get_lines()] == [[0.5, 2.0, 3.0], [0.5, 1.0, 1.0]]
    np.testing.assert_array_equal(errors.get_lines()[0].get_ydata(), [np.nan, 0.4, 0.3])
    assert len(evidence_figure(POINTS[:1], ("a", "b"), colours, 6.0).axes) == 3


def test_of_many_mappings_those_in_use_for_long_have_their_colours_and_the_others_are_grey():
    names = [f"m{k}" for k in range(MAX_NAMED + 3)]
    # The k-th is in use for k + 1 steps, the last at the end.
    steps = np.cumsum([10, *range(1, len(names) + 1)])
    points = [
        EvidencePoint(int(at), 0.5, 0.0, False, (1.0,), (name,)) for at, name in zip(steps, [*names, names[-1]], strict=True)
    ]
    figure = evidence_figure(points, ("a",), mapping_colours(names), 6.0)
    colours = [to_hex(bar.get_facecolor()).upper() for bar in figure.axes[0].patches]
    assert colours == [OTHERS_COLOUR] * 3 + list(mapping_colours(names).values())[6:]
    assert len(figure.legends[0].get_texts()) == MAX_NAMED + 1


def test_long_names_are_shortened_and_leave_room_for_the_curves(recwarn):
    assert shortened("abcdefghij", 10) == "abcdefghij" and shortened("abcdefghijk", 6) == "ab…ijk"
    names = [f"a_very_long_name_of_an_action_with_number_{k}" for k in range(9)]
    point = EvidencePoint(10, 0.5, 0.0, False, (1.0,) * 9, tuple(f"mapping {k} " + "of much " * 20 for k in range(9)))
    figure = evidence_figure([point, replace(point, step=20)], names, mapping_colours(point.mappings), 4.2)
    data_address(figure)
    assert all(axes.get_position().width > 0.4 for axes in figure.axes) and not recwarn.list


def test_evidence_of_runs_is_averaged_where_they_have_some():
    later = [EvidencePoint(20, 0.8, 0.0, False, (4.0, 4.0), ("left", "left"))]
    figure = mean_evidence_figure({"m": [POINTS, later]}, {"m": "#000000"}, 6.0)
    mean = figure.axes[0].get_lines()[-1]
    assert mean.get_xdata().tolist() == [10, 20, 50] and mean.get_ydata().tolist() == [0.5, (1.5 + 4.0) / 2, (2.0 + 4.0) / 2]


def test_contradictions_are_drawn_by_part_with_what_is_unknown_left_grey():
    errors = np.full((2, 1, 4), np.nan)
    errors[0, 0] = [0.0, 1.0, 3.0, np.inf]
    panel = contradictions_figure(errors, ("a", "b"), {"x": np.linspace(0.0, 1.0, 5)}, 6.0).axes[0]
    shown = panel.images[0].get_array()
    assert shown[0].tolist() == [0.0, 1.0, 2.0, 2.0] and shown.mask[1].all()


def test_errors_by_part_are_those_of_the_contradictions(prior_model):
    errors = prior_model.transfer.region_errors
    parts = errors.by_part()
    assert parts.shape == (2, 2, 4)
    for each in errors.contradictions():
        k = list(errors.edges()).index(each.variable)
        part = int(np.argmin(np.abs(errors.edges()[each.variable][:-1] - each.low)))
        assert parts[errors.task.action_names.index(each.target_action), k, part] == pytest.approx(each.error)


def test_of_several_runs_the_commonest_mapping_is_named_with_its_mean_figures():
    def run(mapping, error):
        return TransferReport("m", "prior", mappings=(MappingReport("go", mapping, error=error),))

    rows = mapping_section({"m": [run("a", 0.1), run("b", 0.9), run("a", 0.3)]}, {"a": "#123456"}).table.rows
    assert [[cell.text for cell in row] for row in rows] == [["m", "go", "a", "2 of 3", "0.20"]] and rows[0][
        2
    ].colour == "#123456"
    rows = mapping_section({"m": [run("a", 0.1), run("b", 0.3)]}, {"a": "#123456"}).table.rows
    assert [cell.text for cell in rows[0]] == ["m", "go", ANOTHER, "0.20"]
    assert mapping_section({"m": [TransferReport("m", "actions")]}, {}).table is None


def test_where_a_source_was_contradicted_is_a_table():
    worst = Contradiction("go", "x", 0.0, 0.5, 12, np.inf)
    table = contradictions_table({"": TransferReport("m", "prior", contradictions=(worst,))})
    assert [[cell.text for cell in row] for row in table.rows] == [["go", "x from 0 to 0.5", "nothing moved", "12"]]
    assert contradictions_table({"": TransferReport("m", "prior")}) is None


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (0.1, "explains the target well"),
        (0.7, "in part"),
        (1.5, "no better than that nothing changes"),
        (np.nan, "Nothing can be"),
    ],
)
def test_the_sentence_says_how_well_the_source_explains_the_target(error, says):
    assert says in TransferReport("m", "prior", error=error, n_compared=10).sentence


def test_a_page_shows_a_table_and_marks():
    table = PageTable(("a", "b"), [[Cell("x", "#123456"), Cell("1")]])
    html = Page("t", ["s."], [], [Section("S", table=table)]).html()
    assert 'style="background: #123456"' in html and '<td class="" data-label="b"><span>1</span></td>' in html


def test_figures_become_addresses_without_dates(prior_model):
    # Figures that are kept lie elsewhere in memory than those that follow.
    figures = [evidence_figure(POINTS, ("a", "b"), mapping_colours(["left"]), 6.0) for _ in range(5)]
    assert len(set(map(data_address, figures))) == 1


def test_a_model_that_was_saved_keeps_its_history(prior_model, tmp_path):
    history = prior_model.transfer.report().history
    assert (
        len(history) > 5 and history[-1].step == 400 and [point.step for point in history] == sorted({p.step for p in history})
    )
    prior_model.save(tmp_path / "again")
    again = type(prior_model).load(tmp_path / "again").transfer.report().history
    np.testing.assert_equal(again, history)
