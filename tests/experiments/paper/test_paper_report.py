"""Tables as files, running times, and the CSV of all runs."""

import csv
import io

from helpers.paper_results import made_up, quiet
from rich.console import Console
from sb3_combrel.experiments.report import Table

from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import PAPER
from sb3_combrel.experiments.paper.plan import targets_of
from sb3_combrel.experiments.paper.report import running_times_table, write_report, write_tables
from sb3_combrel.experiments.paper.runs import ResultFiles

CAR = "mountain_car"


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.reader(file))


class TestTables:
    def test_one_table_is_one_csv_and_several_are_numbered(self, tmp_path):
        one = Table("First, with a comma", ("a", "b"), [("1,000", "x"), ('say "b"', "y")])
        two = Table("Second", ("c",), [])
        written = io.StringIO()
        assert write_tables([one], tmp_path / "one", Console(file=written, width=120)) == [
            tmp_path / "one.md",
            tmp_path / "one.csv",
        ]
        assert rows_of(tmp_path / "one.csv") == [["a", "b"], ["1,000", "x"], ['say "b"', "y"]]
        assert 'say "b"' in written.getvalue()
        made = write_tables([one, two], tmp_path / "both", quiet())
        assert [path.name for path in made] == ["both.md", "both_1.csv", "both_2.csv"]
        assert rows_of(tmp_path / "both_2.csv") == [["c"]]
        text = (tmp_path / "both.md").read_text()
        assert "**First, with a comma**\n\n| a | b |\n| --- | ---: |\n| 1,000 | x |\n" in text
        assert "\n\n**Second**\n\n| c |\n| --- |\n" in text

    def test_a_bar_in_a_cell_ends_no_cell_in_markdown(self):
        assert "| a\\|b | c |\n" in Table("One", ("x", "y"), [("a|b", "c")]).as_markdown()


class TestRunningTimes:
    def test_by_hand(self):
        results = [
            made_up(CAR, m.NO_TRANSFER, 0, [100, 200], seconds=(60.0, 2.0)),
            made_up(CAR, m.NO_TRANSFER, 1, [100, 600], seconds=(120.0, 4.0)),
            made_up(CAR, m.UNRELATED, 0, [100, 400], seconds=(1.0, 0.26)),
        ]
        table = running_times_table(results)
        assert table.rows == [
            # 180 s for 1000 steps.
            (m.NO_TRANSFER, "24.0", "1.50", "3.0", "180.00", "500"),
            (m.UNRELATED, "", "0.02", "0.3", "2.00", "500"),
        ]
        assert table.title == "Processor time of 2 episodes, mean of the runs"

    def test_without_results(self):
        assert running_times_table([]).rows == []


class TestRuns:
    def test_the_csv_has_the_runs_of_earlier_calls_too(self, tmp_path):
        files = ResultFiles(tmp_path)
        table5 = targets_of("table5", PAPER)
        earlier = made_up(CAR, m.ORACLE, 7, [30, 40, 40], seconds=(1.0, 1.0))
        now = [made_up(CAR, m.COMBREL_PLAIN, seed, [10 + seed, 20], seconds=(1.0, 1.0)) for seed in (1, 0)]
        for result in (earlier, *now, made_up("icub", m.COMBREL_PLAIN, 0, [1, 1])):
            files.write(result)
        made = write_report(table5, PAPER, {CAR: now}, tmp_path, quiet())
        assert [path.name for path in made] == ["mountain_car.csv", "table5.md", "table5.csv"]
        assert rows_of(tmp_path / "mountain_car.csv") == [
            ["method", "seed", "steps", "episodes_terminated", "steps_of_episodes"],
            ["COMBREL", "0", "30", "1", "10 20"],
            ["COMBREL", "1", "31", "1", "11 20"],
            ["oracle mapping", "7", "110", "1", "30 40 40"],
        ]
        assert [row[0] for row in rows_of(tmp_path / "table5.csv")] == ["method", "COMBREL"]
