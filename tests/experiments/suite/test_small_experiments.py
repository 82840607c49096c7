"""Two small experiments: the iCub at several breadths, and models with one or several successors."""

import numpy as np
import pandas as pd
import pytest
from helpers.kernel_models import random_transitions

from sb3_combrel.experiments.suite import breadths as breadths_module
from sb3_combrel.experiments.suite import residual_successors as residual_module
from sb3_combrel.experiments.suite.breadths import breadths, jobs_of, summary_of
from sb3_combrel.experiments.suite.residual_successors import (
    LAST_EXPONENT,
    RIDGE,
    MeanSuccessor,
    ResidualSuccessors,
    residual_successors,
)
from sb3_combrel.models.base import ModelSettings
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.mdp import FiniteMDP

SETTINGS = ModelSettings(
    model_breadth=0.4, min_weight=0.05, min_fraction=0.1, exploration_threshold=1.0, n_neighbors=8, outcome_breadth=0.1
)


def learned(model_class, n):
    model = model_class(FiniteMDP(StateGrid(2, 2), 2, 1.0), SETTINGS)
    for transition in random_transitions(0, 2, n):
        model.add(*transition)
    return model


@pytest.mark.parametrize("n", [4, 8, 60])
def test_the_mean_is_that_of_least_squares_on_the_nearest_instances(n):
    model = learned(MeanSuccessor, n)
    state, action = np.array([0.4, 0.6]), 0
    found, size = model.predict(state[None], np.array([action])), int(model.instances.size[action])
    states, effects = model.instances.state[action, :size], model.instances.effect[action, :size]
    squared = ((states - state) ** 2).sum(axis=1)
    near = np.argsort(squared)[:8]
    breadth = min(0.4**2, squared[near[-1]] / LAST_EXPONENT) if len(near) == 8 else 0.4**2
    weight = np.exp(-squared[near] / breadth)
    mean_state, mean_effect = (np.average(array[near], axis=0, weights=weight) for array in (states, effects))
    root = np.sqrt(weight)[:, None]
    rows = np.vstack([root * (states[near] - mean_state), np.sqrt(RIDGE * breadth) * np.eye(2)])
    slopes = np.linalg.lstsq(rows, np.vstack([root * (effects[near] - mean_effect), np.zeros((2, 2))]), rcond=None)[0]
    expected = np.clip(mean_effect + (state - mean_state) @ slopes, effects.min(axis=0), effects.max(axis=0))
    np.testing.assert_allclose(found.effect[0, 0], expected, atol=1e-9)
    assert found.weight[0] == pytest.approx(np.exp(-squared[near] / 0.4**2).sum())


def test_several_successors_have_the_mean_of_the_one_unless_they_are_clipped():
    one, several = learned(MeanSuccessor, 60), learned(ResidualSuccessors, 60)
    states, actions = np.random.default_rng(1).uniform(0.2, 0.8, (50, 2)), np.zeros(50, dtype=np.int64)
    mean, found = one.predict(states, actions), several.predict(states, actions)
    np.testing.assert_allclose(found.probability.sum(axis=1), mean.probability[:, 0])
    np.testing.assert_array_equal(found.weight, mean.weight)
    np.testing.assert_array_equal(found.reward, mean.reward)
    effects = several.instances.effect[0, : several.instances.size[0]]
    inside = ((found.effect > effects.min(axis=0)) & (found.effect < effects.max(axis=0))).all(axis=(1, 2))
    inside &= found.probability.sum(axis=1) > 0.0
    assert inside.sum() > 10
    share = found.probability[inside] / found.probability[inside].sum(axis=1, keepdims=True)
    np.testing.assert_allclose((share[..., None] * found.effect[inside]).sum(axis=1), mean.effect[inside, 0], atol=1e-9)
    assert found.effect[inside].std(axis=1).min() > 0.0


@pytest.mark.long
def test_the_comparison_of_models_prints_a_row_a_run(monkeypatch, capsys):
    monkeypatch.setattr(residual_module, "STEPS", {"ICubTorso-noisy": 420})
    monkeypatch.setattr(residual_module, "EVALUATION_EPISODES", 1)
    residual_successors(seeds=1)
    rows = capsys.readouterr().out.strip().split("\n")
    assert len(rows) == 2 + 2 and "ResidualSuccessors" in rows[-1]


def test_of_the_breadths_there_is_a_line_for_each_run_and_a_table(tmp_path, monkeypatch):
    made = []

    def run_missing(jobs, *_):
        made.extend(jobs)
        steps = {"torso": [400, 30, 26, 25, 27, 27, 25], "arm": [400] * 7}
        return [job.result(steps[job.group], [0.0] * 7, [True] * 7, 930, seconds=1.0) for job in jobs]

    monkeypatch.setattr(breadths_module, "run_missing", run_missing)
    breadths(tmp_path, seeds=1, episodes=7, breadths=(0.2,))
    summary = pd.read_csv(tmp_path / "summary.csv")
    assert summary["setting"].tolist() == ["torso 0.2", "torso 0.2 noisy", "arm 0.2", "arm 0.2 noisy"]
    assert summary["episodes_until_learnt"].tolist() == [5.0, 5.0, np.inf, np.inf] and summary["steps"][0] == 560
    table = (tmp_path / "tables.md").read_text()
    assert "| torso 0.2 | 1 of 1 | 5 (5 to 5) | 27 (27 to 27) | 560 |" in table and "| arm 0.2 | 0 of 1 |" in table
    assert [job.env for job in made][1:3] == ["combrel/ICubTorsoStrikeNoisy-v0", "combrel/ICubArmStrike-v0"]
    assert made[0].learner == {"degree": 0, "max_value": 100.0, "model_breadth": 0.2}
    for change in (dict(seeds=0), dict(episodes=-1), dict(breadths=(0.1, 0.0))):
        with pytest.raises(ValueError, match=next(iter(change))):
            breadths(tmp_path, **change)


@pytest.mark.long
def test_the_torso_is_learnt_within_a_few_episodes():
    [job, *_] = jobs_of(1, 6, (0.2,))
    assert summary_of([job.carry_out()])["episodes_until_learnt"][0] == 6.0
