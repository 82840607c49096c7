"""Tables 2 and 4 of made-up results, counted by hand; the tests of dependence against SciPy, and on planted dependence."""

import numpy as np
import pandas as pd
import pytest
from helpers.paper_results import made_up
from scipy import stats

from sb3_combrel.comparison.tables import p_text
from sb3_combrel.experiments.paper.selections import (
    ACTION,
    FEWEST,
    MAPPING,
    N_SHOWN,
    THINNED,
    action_mapping_table,
    dependence_table,
    joint_action_table,
    selections_of,
    state_mapping_table,
    thin,
)

ACTIONS = ("Neutral", "West", "East")
NOTHING = [made_up("mountain_car", "COMBREL", seed, [5, 5]) for seed in range(2)]


def with_uses(*uses):
    return [made_up("mountain_car", "COMBREL", seed, [5], uses=[list(use) for use in part]) for seed, part in enumerate(uses)]


class TestTables:
    def test_action_mappings_in_percent_of_each_action(self):
        results = with_uses(
            [
                ("West", "Left", "x<-x", "Neutral, Left, Right", 6),
                ("East", "Right", "x<-x", "Neutral, Left, Right", 1),
                ("West", "Right", "x<-v", "Neutral, Right, Left", 2),
            ],
            # The same mapping of actions, with another state mapping and in another run.
            [("West", "Left", "x<-v", "Neutral, Left, Right", 2), ("East", "Left", "x<-v", "Neutral, Right, Left", 3)],
        )
        table = action_mapping_table(results, ACTIONS)
        assert table.header == ("mapping", *ACTIONS, "all")
        assert table.rows == [
            *[("NLR", "-", "80.0", "25.0", "64.3"), ("NRL", "-", "20.0", "75.0", "35.7")],
            *[("0 others", "-", "0.0", "0.0", "0.0"), ("selections", "0", "10", "4", "14")],
        ]

    def test_rare_action_mappings_are_counted_together(self):
        letters = "ABCDEFGHIJKL"
        uses = [("East", "x", "s", f"{letter}x, {letter}y", 20 - k) for k, letter in enumerate(letters)]
        table = action_mapping_table(with_uses(uses), ACTIONS)
        assert [row[0] for row in table.rows] == [*(2 * letter for letter in letters[:N_SHOWN]), "3 others", "selections"]
        total = sum(range(9, 21))
        assert table.rows[-2][-2:] == (f"{100 * (11 + 10 + 9) / total:.1f}",) * 2
        assert sum(float(row[3]) for row in table.rows[:-1]) == pytest.approx(100.0, abs=0.6)

    def test_source_actions_in_percent_of_each_target_action(self):
        results = with_uses(
            [("West", "Left", "x<-x", "", 3), ("West", "Left", "x<-v", "", 3), ("West", "Neutral", "x<-v", "", 2)],
            [("East", "Left", "x<-x", "", 1000)],
        )
        table = joint_action_table(results, ACTIONS)
        assert table.rows == [
            ("Left", "-", "75.0", "100.0"),
            ("Neutral", "-", "25.0", "0.0"),
            ("selections", "0", "8", "1,000"),
        ]

    def test_state_mappings_in_percent(self):
        results = with_uses([("West", "Left", "x<-x", "", 3), ("East", "Left", "x<-v", "", 5)], [("West", "R", "x<-x", "", 4)])
        table = state_mapping_table(results)
        assert table.rows == [("x<-x", "58.3"), ("x<-v", "41.7")] and "(2 in all)" in table.title

    def test_without_any_selection(self):
        assert action_mapping_table(NOTHING, ACTIONS).rows == [
            ("0 others", "-", "-", "-", "-"),
            ("selections", "0", "0", "0", "0"),
        ]
        assert joint_action_table(NOTHING, ACTIONS).rows == [("selections", "0", "0", "0")]
        assert state_mapping_table(NOTHING).rows == []
        table = dependence_table(selections_of(NOTHING, ("x", "vx")))
        assert [row[0] for row in table.rows] == [
            "x (Kruskal & Wallis)",
            "vx (Kruskal & Wallis)",
            "target action (chi-square)",
        ]
        assert {cell for row in table.rows for cell in row[1:]} == {"-"}
        assert dependence_table(selections_of([], ("x", "vx"))).rows == table.rows


class TestSelections:
    def test_they_have_states_actions_and_mappings_of_all_runs(self):
        uses = [["West", "Left", "x<-x", "Neutral, Left", 2], ["East", "Right", "x<-x", "", 1]]
        results = [
            made_up("mountain_car", "COMBREL", 0, [3], uses=uses, selections=[[0, 1.0, 2.0], [1, 3.0, 4.0], [0, 5.0, 6.0]]),
            made_up("mountain_car", "COMBREL", 1, [3], uses=uses[::-1], selections=[[0, 7.0, 8.0]]),
        ]
        found = selections_of(results, ("x", "vx"))
        np.testing.assert_array_equal(found[["x", "vx"]], [[1, 2], [3, 4], [5, 6], [7, 8]])
        assert found[ACTION].tolist() == ["West", "East", "West", "East"]
        assert found[MAPPING].tolist() == ["Neutral, Left", "Right", "Neutral, Left", "Right"]

    def test_thinned_selections_are_of_all_actions_and_of_different_steps(self):
        n_steps, actions = 500, list("abcde")
        step = np.repeat(np.arange(n_steps), len(actions))
        thinned = thin(pd.DataFrame({"step": step, ACTION: np.tile(actions, n_steps), MAPPING: "any"}), THINNED)
        assert thinned[ACTION].value_counts().to_dict() == dict.fromkeys(actions, n_steps // THINNED)
        assert np.diff(thinned["step"]).min() == 5
        for _, steps in thinned.groupby(ACTION)["step"]:
            assert set(np.diff(steps)) == {THINNED}


def selection_of(rng, n, mapping, action=None):
    """Selections at states of two variables, drawn at random."""
    action = rng.choice(["West", "East"], size=n) if action is None else action
    return pd.DataFrame(rng.normal(size=(n, 2)), columns=["x", "vx"]).assign(**{ACTION: action, MAPPING: mapping})


def cells_of(selections):
    return {row[0].split(" (")[0]: row[1:] for row in dependence_table(selections).rows}


class TestDependence:
    def test_the_numbers_are_those_of_scipy(self):
        rng, n = np.random.default_rng(0), 60
        mapping = rng.choice(["one", "two", "three"], size=n, p=[0.5, 0.3, 0.2])
        selection = selection_of(rng, n, mapping)
        selection["x"] += 1.5 * (mapping == "one")
        cells = cells_of(selection)
        for name in ("x", "vx"):
            groups = [selection[name][mapping == each] for each in ("one", "two", "three")]
            test = stats.kruskal(*groups)
            epsilon_squared = test.statistic / ((n**2 - 1) / (n + 1))
            assert cells[name][:3] == (f"{test.statistic:,.0f}", f"{epsilon_squared:.2f}", p_text(test.pvalue))
        table = [
            [np.sum((selection[ACTION] == a) & (mapping == each)) for each in ("one", "two", "three")]
            for a in ("West", "East")
        ]
        test = stats.chi2_contingency(np.array(table))
        cramers_v = np.sqrt(test.statistic / n)
        assert cells["target action"][:3] == (f"{test.statistic:,.0f}", f"{cramers_v:.2f}", p_text(test.pvalue))

    def test_a_dependence_on_one_variable_is_found_and_none_on_the_other(self):
        rng = np.random.default_rng(1)
        selection = selection_of(rng, 3000, "")
        selection[MAPPING] = np.where(selection["x"] + 0.3 * rng.normal(size=3000) > 0, "one", "two")
        cells = cells_of(selection)
        assert float(cells["x"][1]) > 0.5 and float(cells["x"][2]) < 1e-10
        assert float(cells["x"][4]) > 0.5 and float(cells["x"][5]) < 1e-10
        for name in ("vx", "target action"):
            assert float(cells[name][1]) < 0.05 and float(cells[name][2]) > 0.05

    def test_a_dependence_on_the_action_is_found(self):
        rng = np.random.default_rng(2)
        action = rng.choice(["West", "East"], size=2000)
        mapping = np.where((rng.random(2000) < 0.7) == (action == "West"), "one", "two")
        cells = cells_of(selection_of(rng, 2000, mapping, action))
        assert 0.3 < float(cells["target action"][1]) < 0.5 and float(cells["target action"][2]) < 1e-10
        assert float(cells["x"][2]) > 0.05 and float(cells["vx"][2]) > 0.05

    def test_rates_of_false_findings_are_those_of_the_level(self):
        rng, found = np.random.default_rng(3), []
        for _ in range(60):
            cells = cells_of(selection_of(rng, 1250, rng.choice(["one", "two", "three"], size=1250)))
            found.append([float(cells[name][k]) < 0.05 for name in ("x", "vx", "target action") for k in (2, 5)])
        assert np.all(np.mean(found, axis=0) < 0.15)

    def test_the_thinned_test_sees_several_actions_where_every_step_has_one_selection_of_each(self):
        rng, action = np.random.default_rng(4), np.tile(np.array(list("abcde")), 400)
        selection = selection_of(rng, 2000, np.where(np.isin(action, ["a", "b"]), "one", "two"), action)
        assert float(cells_of(selection)["target action"][5]) < 1e-6

    def test_rare_mappings_and_a_variable_that_never_changes_have_no_say(self):
        rng = np.random.default_rng(5)
        rare = selection_of(rng, 50 + FEWEST - 1, ["one"] * 50 + ["rare"] * (FEWEST - 1))
        assert {cell for row in cells_of(rare).values() for cell in row} == {"-"}
        more = selection_of(rng, 50 + FEWEST, ["one"] * 50 + ["two"] * FEWEST)
        assert cells_of(more)["x"][0] != "-" and cells_of(more.assign(vx=0.5))["vx"] == ("-",) * 6
        assert {cell for row in cells_of(more[:1]).values() for cell in row} == {"-"}
