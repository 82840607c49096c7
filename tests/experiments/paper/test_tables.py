"""Table 6, measures, running times, the diagnosis and the baselines, of made-up runs with known answers."""

import numpy as np
import pytest
from helpers.paper_results import made_up, made_up_runs, quiet

from sb3_combrel.comparison.statistics import holm, p_value_of_difference
from sb3_combrel.comparison.tables import p_text
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper import tables
from sb3_combrel.experiments.paper.baselines import PLAIN, QUANTILE
from sb3_combrel.experiments.paper.domains import DOMAINS, ICUB, MOUNTAIN_CAR, PAPER
from sb3_combrel.experiments.paper.jobs import BREADTHS, DIAGNOSED_METHODS, method_at
from sb3_combrel.experiments.paper.report import write_report
from sb3_combrel.experiments.paper.targets import targets_of
from sb3_combrel.experiments.paper.verdicts import (
    CLAIMS,
    CONTROL,
    HELD,
    NOT_HELD,
    OPPOSITE,
    PAPERS,
    TOO_FEW,
    WINDOWS,
    judge,
    verdict_table,
)
from sb3_combrel.runs import runner
from sb3_combrel.runs.job import Job

CAR, ROBOT = MOUNTAIN_CAR.name, ICUB.name
BETTER_THAN_NONE = "COMBREL better than no transfer"


def runs(mean, n_runs=10, n_episodes=20, spread=0.05, seed=0):
    """Steps of runs around a mean."""
    rng = np.random.default_rng([seed, int(mean)])
    return np.round(mean * (1.0 + spread * rng.normal(size=(n_runs, 1))) * np.ones((1, n_episodes))).astype(int)


def verdict_of(combrel, no_transfer, **others):
    steps = {m.COMBREL_PLAIN: combrel, m.NO_TRANSFER: no_transfer, **others}
    (found,) = [each for each in judge({CAR: steps}, PAPERS) if each.claim.text == BETTER_THAN_NONE]
    return found


class TestVerdicts:
    def test_exactly(self):
        found = verdict_of(np.array([[10, 20], [30, 40]]), np.array([[100, 100], [60, 140]]))
        assert (found.saved, found.delta) == (1 - 50 / 200, 1.0)
        # Of the six regroupings two have a difference as large.
        assert found.p_value == pytest.approx(2 / 6) and found.verdict == TOO_FEW

    @pytest.mark.parametrize(("combrel", "none", "saved", "verdict"), [(200, 400, 0.5, HELD), (400, 200, -1.0, OPPOSITE)])
    def test_half_and_twice_the_steps(self, combrel, none, saved, verdict):
        found = verdict_of(runs(combrel), runs(none))
        assert found.verdict == verdict and found.low < found.saved < found.high and abs(found.saved - saved) < 0.1
        assert found.delta == np.sign(saved) and found.p_value < 0.001

    def test_no_difference_does_not_hold(self):
        found = verdict_of(runs(400, seed=1), runs(400, seed=2))
        assert found.verdict == NOT_HELD and found.low < 0.0 < found.high

    def test_claims_whose_methods_were_not_run_have_no_row(self):
        assert judge({}, PAPERS) == judge({CAR: {}}, PAPERS) == judge({CAR: {m.COMBREL_PLAIN: runs(100)}}, PAPERS) == []
        found = judge({CAR: {m.COMBREL_PLAIN: runs(100), m.NO_TRANSFER: runs(200), m.COMBREL_RELEVANCE: runs(150)}}, PAPERS)
        assert [each.claim.text for each in found] == [BETTER_THAN_NONE, "COMBREL better without relevance than with it"]

    def test_all_rows_of_a_kind_with_all_methods(self):
        steps = {name: {method: runs(100 + 10 * k, 3) for k, method in enumerate(m.METHODS)} for name in DOMAINS}
        papers, controls = judge(steps, PAPERS), judge(steps, CONTROL)
        without_windows = [claim for claim in CLAIMS if claim.kind != WINDOWS]
        assert [each.claim for each in (*papers, *controls)] == without_windows and len(papers) == 8
        # The windows are later than these episodes.
        assert judge(steps, WINDOWS) == []
        # Every control is beside the method of every claim: against each of them in both domains.
        assert {(each.claim.domain, each.claim.worse) for each in controls} >= {
            (name, other) for name in DOMAINS for other in (m.ONE_RANDOM, m.UNRELATED, m.NO_TRANSFER_BEST)
        }

    def test_a_window_counts_its_episodes_and_no_others(self):
        fast, slow = runs(30, n_episodes=300), runs(60, n_episodes=300)
        # Outside of episodes 50 to 300 it is the other way round, by more.
        fast[:, :49] = 10_000
        found = judge({ROBOT: {m.COMBREL_PLAIN: fast, m.TIMBREL_RANDOM: slow, m.NO_TRANSFER: slow}}, WINDOWS)
        (row,) = verdict_table(found, "title").rows
        assert row[0].endswith("random mapping, episodes 50 to 300") and row[-1] == HELD and abs(found[0].saved - 0.5) < 0.1
        assert judge({ROBOT: {m.COMBREL_PLAIN: fast[:, :299], m.TIMBREL_RANDOM: slow[:, :299]}}, WINDOWS) == []

    def test_p_values_are_corrected_over_the_rows_of_the_table(self):
        better = np.arange(0, 10)[:, None] * 10 + 100
        one = verdict_of(better, better + 33)
        assert 0.01 < one.p_value < 0.05 and one.verdict == HELD
        others = {m.TIMBREL_INTUITIVE: better, m.COMBREL_RELEVANCE: better, m.TIMBREL_RELEVANCE: better}
        found = judge({CAR: {m.COMBREL_PLAIN: better, m.NO_TRANSFER: better + 33, **others}}, PAPERS)
        expected = holm({each.claim: each.p_value for each in found})
        assert [each.corrected for each in found] == list(expected.values()) and len(expected) == 4
        assert found[0].p_value == one.p_value < found[0].corrected and found[0].verdict == NOT_HELD

    def test_a_single_run_has_no_interval(self):
        (row,) = verdict_table([verdict_of(runs(100, n_runs=1), runs(200, n_runs=1))], "title").rows
        assert row[3] == row[5] == row[6] == row[7] == "-" and row[-1] == TOO_FEW

    def test_the_threshold_is_the_domains_last(self):
        # All reach 250 steps at once with COMBREL, none without transfer, in as many steps.
        reach, never = np.full((6, 10), 240), np.full((6, 10), 260)
        assert verdict_of(reach, never).p_threshold < 0.01 and verdict_of(never + 10, never).p_threshold == 1.0
        # Fewer episodes than the window of the median.
        assert verdict_of(reach[:, :2], never[:, :2]).p_threshold == 1.0


class TestSummary:
    def test_of_steps_by_hand(self):
        steps = {m.COMBREL_PLAIN: [[100] * 30, [300] * 30], m.NO_TRANSFER: [[1000] + [400] * 29] * 2}
        # Other methods are left out.
        table = tables.summary_table({CAR: made_up_runs(CAR, {**steps, "no transfer at 0.1": [[30, 50]]})})
        assert table.rows == [
            ("Mountain Car 4D", m.NO_TRANSFER, "2", "12,600 ± 0", "5,400 ± 0", "400 ± 0", "never (0 of 2 runs; 250)"),
            (
                "Mountain Car 4D",
                m.COMBREL_PLAIN,
                "2",
                "6,000 ± 3,000",
                "2,400 ± 1,200",
                "200 ± 100",
                "never (1 of 2 runs; 250)",
            ),
        ]

    def test_the_median_run_reaches_the_threshold(self):
        ((*_, last),) = tables.summary_table({ROBOT: made_up_runs(ROBOT, {m.ORACLE: [[30] * 30, [39] * 30, [400] * 30]})}).rows
        assert last == f"{5 * 39} (2 of 3 runs; 40)"

    def test_short_and_single_runs(self):
        (row,) = tables.summary_table({ROBOT: [made_up(ROBOT, m.COMBREL_PLAIN, 0, [30, 50])]}).rows
        assert row[2:] == ("1", "80", "80", "40", "- (fewer than 5 episodes)")
        header = tables.summary_table({ROBOT: [made_up(ROBOT, m.COMBREL_PLAIN, 0, [30, 50])]}).header
        assert header[4:6] == ("first 2 episodes", "an episode, last 2")


def test_uses_a_step_and_mappings():
    some = [["East", "Left", "x<-x", "", 6], ["West", "Left", "x<-x", "", 3]], [["East", "Left", "x<-v", "", 1]], []
    results = [
        made_up(CAR, m.UNRELATED, seed, [5, 15], uses=uses, mappings_of_episodes=counts)
        for seed, (uses, counts) in enumerate(zip(some, ([1, 1], [1, 0], [0, 0]), strict=True))
    ]
    (row,) = tables.uses_table({CAR: [*results, made_up(CAR, m.NO_TRANSFER, 0, [20])]}).rows
    # A run that used nothing counts as well.
    assert row == ("Mountain Car 4D", m.UNRELATED, "3", f"{(9 / 20 + 1 / 20) / 3:.3f}", "1", "0.5")


def test_training_until_each_threshold():
    # Never, at once, and after an episode of 400 and two of five fast ones more.
    steps = {m.NO_TRANSFER: [[400] * 8] * 4, m.COMBREL_PLAIN: [[45] * 8] * 4, m.ORACLE: [[400] + [60] * 7] * 4}
    table = tables.thresholds_table(ICUB, made_up_runs(ROBOT, steps))
    assert table.header == ("method", "200", "150", "100", "75", "50", "40")
    found = {row[0]: row[1:] for row in table.rows}
    assert found[m.COMBREL_PLAIN] == (*[str(5 * 45)] * 5, "never")
    assert found[m.ORACLE][0].startswith(f"{400 + 4 * 60} (0.0") and found[m.ORACLE][-1] == "never (1.00)"
    others = {m.NO_TRANSFER: p_value_of_difference([np.inf] * 4, [225.0] * 4, "mann-whitney")}
    corrected = holm({**others, m.ORACLE: p_value_of_difference([640.0] * 4, [225.0] * 4, "mann-whitney")})
    assert found[m.NO_TRANSFER][2] == f"never ({p_text(corrected[m.NO_TRANSFER])})"


def learnt(n_episodes=20, n_runs=6):
    """No transfer: 400 steps, then 240; COMBREL: 240 from the start, 235 in the end; the last method as no transfer."""
    found, half = [], n_episodes // 2
    for seed in range(n_runs):
        without = [400 + seed] * half + [240] * (n_episodes - half)
        found.append(made_up(CAR, m.NO_TRANSFER, seed, without))
        found.append(made_up(CAR, m.COMBREL_PLAIN, seed, [240 - seed] * half + [235] * (n_episodes - half)))
        found.append(made_up(CAR, m.UNRELATED, n_runs - 1 - seed, without))
    return found


def measures_of(results, method=m.COMBREL_PLAIN, domain=MOUNTAIN_CAR):
    """Effect, without unit, and p-value of each measure of a method, as text."""
    table = tables.measures_table(domain, results)
    (row,) = [row for row in table.rows if row[0] == method]
    cells = dict(zip(table.header[1:], row[1:], strict=True))
    return {name: tuple(cell.replace(",", "").replace("%", "").rstrip(")").split(" (")) for name, cell in cells.items()}


class TestMeasures:
    def test_effects_by_hand(self):
        found = {name: float(effect) for name, (effect, p) in measures_of(learnt()).items() if float(p) < 0.05}
        # Mean of seeds: 402.5 steps without, 237.5 with transfer; 240 and 235 in the end.
        # The least return is -405: areas above it of 20 episodes.
        without = 10 * (405 - 402.5) + 10 * (405 - 240)
        # The median of five is below 250 at the third of the later ones; at once with transfer.
        times = 5 * 237.5 - (10 * 402.5 + 3 * 240)
        assert found == {
            "jumpstart": 165,
            "asymptotic performance": 5,
            "total reward": 1650 + 50,
            "transfer ratio": pytest.approx(100 * 1700 / without, abs=0.5),
            "time to threshold": pytest.approx(times, abs=1),
        }
        assert "threshold: a return of -250" in tables.measures_table(MOUNTAIN_CAR, learnt()).title

    def test_p_values_are_corrected_over_the_column(self):
        alone = [result for result in learnt() if result.method != m.UNRELATED]
        # Exact: 2 of the 924 regroupings are as far apart, and no difference has 1.
        assert measures_of(alone)["jumpstart"][1] == "0.002" and measures_of(learnt())["jumpstart"][1] == "0.004"
        assert set(measures_of(learnt(), m.UNRELATED).values()) == {("+0", "1.00")}

    @pytest.mark.parametrize("n_episodes", [1, 4, 9])
    def test_trials_of_few_episodes(self, n_episodes):
        found = measures_of(learnt(n_episodes))
        assert float(found["jumpstart"][0]) >= 0.0 and (found["time to threshold"] == ("-",)) == (n_episodes < 5)

    def test_what_has_no_effect_or_no_p_value(self):
        assert measures_of(learnt(n_runs=1))["jumpstart"] == ("+160", "-")
        slow = made_up_runs(CAR, {name: [[300] * 12] * 3 for name in (m.NO_TRANSFER, m.COMBREL_PLAIN)})
        # The threshold is never reached, and nothing is above the least return.
        assert measures_of(slow)["time to threshold"] == measures_of(slow)["transfer ratio"] == ("-",)
        assert tables.measures_table(MOUNTAIN_CAR, [made_up(CAR, m.NO_TRANSFER, 0, [300] * 12)]).rows == []

    def test_the_robots_threshold_is_a_return_with_its_hit(self):
        def results(without):
            n_commands = {m.NO_TRANSFER: without, m.COMBREL_PLAIN: 40}.items()
            return [made_up(ROBOT, name, k, [n] * 12, [100.0 - n] * 12) for name, n in n_commands for k in range(3)]

        # 40 commands are good enough, and 45 are not.
        assert measures_of(results(45), domain=ICUB)["time to threshold"] == ("-",)
        assert float(measures_of(results(38), domain=ICUB)["time to threshold"][0]) == 5 * 40 - 5 * 38


def test_running_times():
    results = [
        made_up(CAR, m.NO_TRANSFER, 0, [100, 200], seconds=60.0, first_episode_seconds=2.0),
        made_up(CAR, m.NO_TRANSFER, 1, [100, 600], seconds=120.0, first_episode_seconds=4.0),
        made_up(CAR, m.UNRELATED, 0, [100, 400], seconds=1.0, first_episode_seconds=0.26),
    ]
    table = tables.running_times_table(results)
    assert table.rows == [
        # 180 s for 1000 steps.
        (m.NO_TRANSFER, "24.0", "1.50", "3.0", "180.00", "500"),
        (m.UNRELATED, "", "0.02", "0.3", "2.00", "500"),
    ]
    assert table.title == "Processor time of 2 episodes, mean of the runs"
    assert tables.running_times_table([]).rows == []


def test_the_csv_has_the_runs_of_earlier_calls_too(tmp_path):
    earlier = made_up(CAR, m.ORACLE, 7, [30, 40, 40])
    now = [made_up(CAR, m.COMBREL_PLAIN, seed, [10 + seed, 20]) for seed in (1, 0)]
    runner.run_missing([], tmp_path)
    for result in (earlier, *now, made_up(ROBOT, m.COMBREL_PLAIN, 0, [1, 1])):
        job = Job(group=result.group, method=result.method, seed=result.seed, env="Some-v0")
        runner._write(job, job.settings(), result, tmp_path)
    made = write_report(targets_of("table5", PAPER), PAPER, now, tmp_path, quiet())
    assert [path.name for path in made] == ["mountain_car.csv", "table5.md", "table5.csv"]
    assert made[0].read_text().splitlines() == [
        "method,seed,steps,episodes_terminated,steps_of_episodes",
        "COMBREL,0,30,1,10 20",
        "COMBREL,1,31,1,11 20",
        "oracle mapping,7,110,1,30 40 40",
    ]


class TestDiagnosis:
    def results(self, n_runs=8, spread=0):
        rng, means = np.random.default_rng(0), dict(zip(DIAGNOSED_METHODS, (400, 200, 300), strict=True))
        steps = {
            method_at(method, breadth): np.abs(rng.normal(mean, spread, size=(n_runs, 6))).astype(int)
            for method, mean in means.items()
            for breadth in BREADTHS
        }
        return made_up_runs(CAR, steps), steps

    def test_what_is_saved_at_each_breadth(self):
        table = tables.diagnosis_table(self.results()[0])
        assert [row[0] for row in table.rows] == [f"{breadth:g}" for breadth in BREADTHS]
        assert "6 episodes, 8 runs" in table.title
        for row in table.rows:
            assert row[1:4] == ("2,400", "50% (50% to 50%)", "25% (25% to 25%)") and float(row[4]) < 0.01
        assert {row[2:] for row in tables.diagnosis_table(self.results(n_runs=1)[0]).rows} == {("50% (-)", "25% (-)", "-")}

    def test_p_values_are_corrected_over_the_breadths(self):
        results, steps = self.results(spread=200)
        raw = {}
        for breadth in BREADTHS:
            combrel, random = (steps[method_at(method, breadth)].sum(axis=1) for method in DIAGNOSED_METHODS[1:])
            raw[breadth] = p_value_of_difference(combrel, random, "permutation")
        assert len(set(raw.values())) == len(BREADTHS)
        assert [row[4] for row in tables.diagnosis_table(results).rows] == [p_text(p) for p in holm(raw).values()]


def test_baselines():
    evaluations = [[1000, -400.0, 0.0], [20_000, -30.0, 1.0]]
    of_robot = [
        made_up(ROBOT, QUANTILE, 1, [5, 4], evaluations=[[1000, -400.0, 0.2], [20_000, -400.0, 0.8]]),
        made_up(ROBOT, PLAIN, 7, [5, 4], evaluations=evaluations),
        made_up(ROBOT, PLAIN, 2, [5, 4], evaluations=evaluations[1:]),
    ]
    results = {CAR: [made_up(CAR, m.COMBREL_PLAIN, 1, [5, 4])], ROBOT: of_robot}
    frame = tables.evaluations_frame(results)
    assert list(frame) == ["domain", "algorithm", "seed", "steps", "greedy_return", "fraction_reached"]
    assert [tuple(row) for row in frame.itertuples(index=False)] == [
        (ROBOT, PLAIN, 2, 20_000, -30.0, 1.0),
        (ROBOT, PLAIN, 7, 1000, -400.0, 0.0),
        (ROBOT, PLAIN, 7, 20_000, -30.0, 1.0),
        (ROBOT, QUANTILE, 1, 1000, -400.0, 0.2),
        (ROBOT, QUANTILE, 1, 20_000, -400.0, 0.8),
    ]
    assert [row[1:] for row in tables.baselines_table(results).rows] == [
        (PLAIN, "20,000", "2 of 2", "20,000", "-30"),
        (QUANTILE, "20,000", "0 of 1", "never", "-400"),
    ]
