"""Fine-tuning: what of a network is copied, and the command."""

import pandas as pd
import pytest
import torch

from sb3_combrel.experiments import fine_tuning
from sb3_combrel.experiments.benchmark.pairs import PAIRS
from sb3_combrel.experiments.fine_tuning import SOURCES, fine_tuning_jobs, warm_start


def network(n_inputs, n_outputs):
    return torch.nn.Sequential(torch.nn.Linear(n_inputs, 8), torch.nn.Linear(8, 8), torch.nn.Linear(8, n_outputs))


def test_parameters_of_the_same_shape_are_copied_and_no_others():
    own, learnt = network(4, 5), network(2, 3)
    before = {name: each.clone() for name, each in own.state_dict().items()}
    assert warm_start(own, learnt) == 3  # the first bias and the whole second layer
    for name, each in own.state_dict().items():
        same = learnt.state_dict()[name] if name in ("0.bias", "1.weight", "1.bias") else before[name]
        assert torch.equal(each, same)
    assert warm_start(network(2, 3), learnt) == 6


def test_every_pair_with_one_source_has_its_environment():
    assert set(SOURCES) == {name for name, pair in PAIRS.items() if len(pair.sources) == 1}


@pytest.mark.long
def test_a_network_that_has_learnt_the_source_acts_otherwise_than_one_from_nothing(tmp_path):
    arguments = {"seeds": [1], "budgets": [5, 10], "source_steps": 60, "output": tmp_path / "a", "table": tmp_path / "a.csv"}
    fine_tuning.fine_tuning(["mirrored-car"], **arguments)
    table = pd.read_csv(arguments["table"])
    assert list(table["algorithm"]) == ["DQN", "DQN", "fine-tuned", "fine-tuned"] and (table["mean_return"] == -200.0).all()
    copied = {job.method: job.carry_out().more["copied"] for job in fine_tuning_jobs(["mirrored-car"], [1], [5], 20)}
    assert copied == {"DQN": 0, "fine-tuned": 6}


def test_unknown_pairs_and_budgets_are_refused():
    with pytest.raises(ValueError, match=r"pairs must be some of .*, got 'mountain-cars'; did you mean 'mountain-car'"):
        fine_tuning_jobs(["mountain-cars"], [1], [5], 20)
    with pytest.raises(ValueError, match="budgets must be numbers of steps, at least 1, got"):
        fine_tuning_jobs(["mountain-car"], [1], [0, 5], 20)
