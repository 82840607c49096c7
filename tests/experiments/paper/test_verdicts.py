"""Table 6 on made-up runs with known answers."""

import numpy as np
import pytest
from sb3_combrel.experiments.statistics import holm

from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import DOMAINS, ICUB, MOUNTAIN_CAR
from sb3_combrel.experiments.paper.verdicts import (
    CLAIMS,
    CONTROL,
    HELD,
    NOT_HELD,
    OPPOSITE,
    PAPERS,
    interval_text,
    judge,
    p_text,
    share_text,
    summary_table,
    verdict_table,
)

CAR, ROBOT = MOUNTAIN_CAR.name, ICUB.name
BETTER_THAN_NONE = "COMBREL better than no transfer"


def runs(mean, n_runs=10, n_episodes=20, spread=0.05, seed=0):
    """Steps of runs around a mean."""
    rng = np.random.default_rng([seed, int(mean)])
    return np.round(mean * (1.0 + spread * rng.normal(size=(n_runs, 1))) * np.ones((1, n_episodes))).astype(int)


def verdict_of(steps, text=BETTER_THAN_NONE, domain=CAR, kind=PAPERS):
    (found,) = [each for each in judge({domain: steps}, kind) if each.claim.text == text]
    return found


class TestJudge:
    def test_half_the_steps_saves_half(self):
        found = verdict_of({m.COMBREL_PLAIN: runs(200), m.NO_TRANSFER: runs(400)})
        assert found.verdict == HELD
        assert found.saved == pytest.approx(0.5, abs=0.03)
        assert 0.4 < found.low < found.saved < found.high < 0.6
        assert found.delta == 1.0
        assert found.p_value < 0.001
        assert verdict_table([found], "title").rows[0][2].rstrip("%") in {"48", "49", "50", "51", "52"}

    def test_exactly(self):
        better, worse = np.array([[10, 20], [30, 40]]), np.array([[100, 100], [60, 140]])
        found = verdict_of({m.COMBREL_PLAIN: better, m.NO_TRANSFER: worse})
        assert (found.saved, found.delta) == (1 - 50 / 200, 1.0)
        # Of the six regroupings two have a difference as large.
        assert found.p_value == pytest.approx(2 / 6)
        assert found.verdict == NOT_HELD

    def test_twice_the_steps_is_the_opposite(self):
        found = verdict_of({m.COMBREL_PLAIN: runs(400), m.NO_TRANSFER: runs(200)})
        assert found.verdict == OPPOSITE
        assert found.saved == pytest.approx(-1.0, abs=0.1)
        assert found.low < found.saved < found.high < 0.0
        assert found.delta == -1.0

    def test_no_difference_does_not_hold(self):
        found = verdict_of({m.COMBREL_PLAIN: runs(400, seed=1), m.NO_TRANSFER: runs(400, seed=2)})
        assert found.verdict == NOT_HELD
        assert found.low < 0.0 < found.high

    def test_methods_that_were_not_run_drop_their_rows(self):
        assert judge({}, PAPERS) == judge({CAR: {}}, PAPERS) == judge({CAR: {m.COMBREL_PLAIN: runs(100)}}, PAPERS) == []
        found = judge({CAR: {m.COMBREL_PLAIN: runs(100), m.NO_TRANSFER: runs(200), m.COMBREL_RELEVANCE: runs(150)}}, PAPERS)
        assert [each.claim.text for each in found] == [BETTER_THAN_NONE, "COMBREL better without relevance than with it"]
        assert verdict_table([], "title").rows == []

    def test_all_rows_of_a_kind_with_all_methods(self):
        steps = {name: {method: runs(100 + 10 * k) for k, method in enumerate(m.METHODS)} for name in DOMAINS}
        papers, controls = judge(steps, PAPERS), judge(steps, CONTROL)
        assert [each.claim for each in (*papers, *controls)] == list(CLAIMS)
        assert len(papers) == 8
        # Every control is beside the method of every claim: against each of them in both domains.
        assert {(each.claim.domain, each.claim.worse) for each in controls} >= {
            (name, other) for name in DOMAINS for other in (m.ONE_RANDOM, m.UNRELATED, m.NO_TRANSFER_BEST)
        }

    def test_p_values_are_corrected_over_the_rows_of_the_table(self):
        rng = np.random.default_rng(3)
        means = {m.COMBREL_PLAIN: 200, m.NO_TRANSFER: 215, m.TIMBREL_INTUITIVE: 212, m.COMBREL_RELEVANCE: 330}
        steps = {CAR: {name: rng.normal(mean, 20, size=(12, 6)).astype(int) for name, mean in means.items()}}
        found = judge(steps, PAPERS)
        raw = np.array([each.p_value for each in found])
        assert len(raw) == 3
        np.testing.assert_array_equal([each.corrected for each in found], holm(raw))
        # Each row of the table decides by the corrected one.
        for each in found:
            assert (each.verdict != NOT_HELD) == (each.corrected < 0.05)

    def test_a_difference_that_is_significant_alone_is_not_among_many(self):
        better = np.arange(0, 10)[:, None] * 10 + 100
        worse = better + 33
        alone = {m.COMBREL_PLAIN: better, m.NO_TRANSFER: worse}
        one = verdict_of(alone)
        assert 0.01 < one.p_value < 0.05 and one.verdict == HELD
        others = {m.TIMBREL_INTUITIVE: better, m.COMBREL_RELEVANCE: better, m.TIMBREL_RELEVANCE: better}
        among = verdict_of({**alone, **others})
        assert among.p_value == one.p_value < among.corrected
        assert among.verdict == NOT_HELD

    def test_a_single_run_has_no_interval_and_no_verdict_but_not_held(self):
        found = verdict_of({m.COMBREL_PLAIN: runs(100, n_runs=1), m.NO_TRANSFER: runs(200, n_runs=1)})
        assert np.isnan(found.low) and np.isnan(found.p_value)
        (row,) = verdict_table([found], "title").rows
        assert row[3] == row[5] == row[6] == row[7] == "-"
        assert row[-1] == NOT_HELD

    def test_the_threshold_is_the_domains_last(self):
        # All reach 250 steps at once with COMBREL, none without transfer, in as many steps.
        reach = np.array([[240] * 10] * 6)
        never = np.array([[260] * 10] * 6)
        found = verdict_of({m.COMBREL_PLAIN: reach, m.NO_TRANSFER: never})
        assert found.p_threshold < 0.01
        found = verdict_of({m.COMBREL_PLAIN: never + 10, m.NO_TRANSFER: never})
        assert found.p_threshold == 1.0
        # Fewer episodes than the window of the median.
        found = verdict_of({m.COMBREL_PLAIN: reach[:, :2], m.NO_TRANSFER: never[:, :2]})
        assert found.p_threshold == 1.0


def test_cells():
    assert [share_text(share) for share in (0.5, -0.254, -0.001, 0.0, -2.0)] == ["50%", "-25%", "0%", "0%", "-200%"]
    assert interval_text(np.nan, np.nan) == "-"
    assert interval_text(-0.001, 0.25) == "0% to 25%"
    assert [p_text(p) for p in (np.nan, 1.0, 0.012, 0.0099, 1e-12)] == ["-", "1.00", "0.01", "0.01", "1e-12"]


class TestSummary:
    def test_of_steps_by_hand(self):
        steps = {
            m.COMBREL_PLAIN: np.array([[100] * 30, [300] * 30]),
            m.NO_TRANSFER: np.array([[1000] + [400] * 29, [1000] + [400] * 29]),
        }
        rows = {row[1]: row for row in summary_table({CAR: steps}).rows}
        assert list(rows) == [m.NO_TRANSFER, m.COMBREL_PLAIN]
        assert rows[m.NO_TRANSFER] == (
            *("Mountain Car 4D", m.NO_TRANSFER, "2", "12,600 ± 0", "5,400 ± 0", "400 ± 0", "never (0 of 2 runs; 250)"),
        )
        assert rows[m.COMBREL_PLAIN][3:] == ("6,000 ± 3,000", "2,400 ± 1,200", "200 ± 100", "never (1 of 2 runs; 250)")

    def test_the_median_run_reaches_the_threshold(self):
        steps = {m.COMBREL_PLAIN: np.array([[30] * 30, [39] * 30, [400] * 30])}
        ((*_, last),) = summary_table({ROBOT: steps}).rows
        assert last == f"{5 * 39} (2 of 3 runs; 40)"

    def test_short_and_single_runs(self):
        ((*cells, last),) = summary_table({ROBOT: {m.COMBREL_PLAIN: np.array([[30, 50]])}}).rows
        assert cells[2:] == ["1", "80", "80", "40"]
        assert last == "never (0 of 1 runs; 40)"

    def test_methods_that_are_no_methods_of_the_domain_are_left_out(self):
        assert summary_table({CAR: {"no transfer at 0.1": np.array([[30, 50]])}}).rows == []
