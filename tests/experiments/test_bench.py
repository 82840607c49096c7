import re
import sys

import pytest

from sb3_combrel.experiments import bench

pytestmark = pytest.mark.long


def test_what_transfer_adds_is_printed_pair_by_pair_and_in_the_mean(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["bench", "--pairs", "1", "--fraction", "0.005"])
    bench.main()
    printed = capsys.readouterr().out
    assert re.findall(r"breadth ([\d.]+)", printed) == ["0.4", "0.1"]
    pairs = re.findall(r"seed +(\d+): ([\d.]+) ([\d.]+) ([+-]\d+)%", printed)
    assert [int(seed) for seed, *_ in pairs] == [0] * 3
    for _, without, transferring, added in pairs:
        assert float(without) > 0.0
        assert int(added) == pytest.approx(100 * (float(transferring) / float(without) - 1.0), rel=0.02, abs=2)
    assert re.findall(r"mean ([+-]\d+)%", printed) == [added for *_, added in pairs]


def test_a_fraction_of_a_cases_episodes_is_learnt_with_the_same_steps_each_time():
    steps, milliseconds, memory, of_dqn = bench.measure(0, fraction=0.04)
    assert (steps, milliseconds > 0.0, memory > 0.0) == (bench.learn(bench.CASES[0], 2)[0], True, True)
    assert of_dqn > 0.0
