"""Taylor & Stone's measures of made-up results."""

import pytest
from helpers.paper_results import made_up

from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import ICUB, MOUNTAIN_CAR
from sb3_combrel.experiments.paper.measures import measures_table


def results(n_episodes=20, n_runs=6):
    """No transfer: 400 steps, then 240; COMBREL: 240 from the start, 235 in the end; the last method as no transfer."""
    found = []
    for seed in range(n_runs):
        half = n_episodes // 2
        learnt = [400 + seed] * half + [240] * (n_episodes - half)
        found.append(made_up("mountain_car", m.NO_TRANSFER, seed, learnt))
        found.append(made_up("mountain_car", m.COMBREL_PLAIN, seed, [240 - seed] * half + [235] * (n_episodes - half)))
        found.append(made_up("mountain_car", m.UNRELATED, n_runs - 1 - seed, learnt[:half] + learnt[half:]))
    return found


def rows_of(table):
    return {row[0]: dict(zip(table.header[1:], row[1:], strict=True)) for row in table.rows}


def effect(cell):
    return float(cell.split(" (")[0].replace(",", "").rstrip("%"))


def p_value(cell):
    return cell.split(" (")[1].rstrip(")")


def test_effects_by_hand():
    table = measures_table(MOUNTAIN_CAR, results())
    assert "threshold: a return of -250" in table.title
    rows = rows_of(table)
    assert list(rows) == [m.COMBREL_PLAIN, m.UNRELATED]
    of = rows[m.COMBREL_PLAIN]
    # Mean of seeds: 402.5 steps without, 237.5 with transfer; 240 and 235 in the end.
    assert effect(of["jumpstart"]) == 165
    assert effect(of["asymptotic performance"]) == 5
    assert effect(of["total reward"]) == 1650 + 50
    # The least return is -405: areas above it of 20 episodes.
    without = 10 * (405 - 402.5) + 10 * (405 - 240)
    assert effect(of["transfer ratio"]) == pytest.approx(100 * 1700 / without, abs=0.5)
    # The median of five is below 250 at the third of the later ones; at once with transfer.
    assert effect(of["time to threshold"]) == pytest.approx(5 * 237.5 - (10 * 402.5 + 3 * 240), abs=1)
    for cell in of.values():
        assert float(p_value(cell)) < 0.05


def test_p_values_are_corrected_over_the_column():
    alone = [result for result in results() if result.method != m.UNRELATED]
    one = rows_of(measures_table(MOUNTAIN_CAR, alone))[m.COMBREL_PLAIN]
    among = rows_of(measures_table(MOUNTAIN_CAR, results()))
    # Exact: 2 of the 924 regroupings are as far apart, and no difference has 1.
    assert p_value(one["jumpstart"]) == "0.002"
    assert p_value(among[m.COMBREL_PLAIN]["jumpstart"]) == "0.004"
    for name, cell in among[m.UNRELATED].items():
        assert (effect(cell), p_value(cell)) == (0.0, "1.00"), name
        assert cell.startswith("+0")


@pytest.mark.parametrize("n_episodes", [1, 2, 4, 9, 10])
def test_trials_of_few_episodes(n_episodes):
    of = rows_of(measures_table(MOUNTAIN_CAR, results(n_episodes)))[m.COMBREL_PLAIN]
    assert effect(of["jumpstart"]) >= 0.0
    if n_episodes < 5:
        assert of["time to threshold"] == "-"
        assert of["jumpstart"].split(" ")[0] == of["asymptotic performance"].split(" ")[0]


def test_a_single_run_has_effects_without_p_values():
    of = rows_of(measures_table(MOUNTAIN_CAR, results(n_runs=1)))[m.COMBREL_PLAIN]
    assert of["jumpstart"] == "+160 (-)"


def test_thresholds_that_are_never_reached_have_no_effect():
    slow = [made_up("mountain_car", name, seed, [300] * 12) for name in (m.NO_TRANSFER, m.COMBREL_PLAIN) for seed in range(3)]
    of = rows_of(measures_table(MOUNTAIN_CAR, slow))[m.COMBREL_PLAIN]
    assert of["time to threshold"] == "-"
    # Nothing is above the least return.
    assert of["transfer ratio"] == "-"


def test_the_robots_threshold_is_a_return_with_its_hit():
    found = [
        made_up("icub", name, seed, [n] * 12, returns=[100.0 - n] * 12)
        for name, n in ((m.NO_TRANSFER, 45), (m.COMBREL_PLAIN, 40))
        for seed in range(3)
    ]
    table = measures_table(ICUB, found)
    assert "threshold: a return of 60" in table.title
    # 40 commands are good enough, and 45 are not.
    assert rows_of(table)[m.COMBREL_PLAIN]["time to threshold"] == "-"
    fast = [made_up("icub", m.NO_TRANSFER, seed, [38] * 12, returns=[62.0] * 12) for seed in range(3)]
    table = measures_table(ICUB, [*fast, *found[3:]])
    assert effect(rows_of(table)[m.COMBREL_PLAIN]["time to threshold"]) == 5 * 40 - 5 * 38


def test_only_no_transfer_has_an_empty_table():
    assert measures_table(MOUNTAIN_CAR, [made_up("mountain_car", m.NO_TRANSFER, 0, [300] * 12)]).rows == []
