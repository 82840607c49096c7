"""Tasks that others made: what each learner is given, and the command, without SBX and bsuite."""

import importlib.util

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

from sb3_combrel.experiments import other_tasks
from sb3_combrel.experiments.other_tasks import TASKS, AtBudgets, budget_jobs

HERE = ["pendulum-swingup", "cartpole-balance"]


def test_fitted_r_max_has_few_variables_and_actions_and_crossq_the_task_as_it_is():
    spaces = {}
    for algorithm in other_tasks.ALGORITHMS:
        with TASKS["acrobot-swingup"].made_for(algorithm) as env:
            spaces[algorithm] = env.observation_space.shape, env.action_space
    assert spaces["FittedRMax"] == ((4,), gym.spaces.Discrete(3))
    assert spaces["DQN"] == spaces["QRDQN"] == ((6,), gym.spaces.Discrete(3))
    assert spaces["CrossQ"][0] == (6,) and isinstance(spaces["CrossQ"][1], gym.spaces.Box)


def test_few_actions_have_the_limits_and_what_lies_between():
    with TASKS["reacher-easy"].made_for("DQN") as env:
        assert env.action_space.n == 9
        pushed = {tuple(np.round(env.action(a), 6)) for a in range(9)}
    assert pushed == {(x, y) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)}


@pytest.mark.long
def test_returns_are_in_the_makers_unit_and_played_by_the_frozen_policy():
    class Always:
        """Acts as SB3's models do, without learning anything."""

        num_timesteps = 0

        def predict(self, observation, deterministic):
            assert deterministic
            return np.int64(1), None

    with TASKS["cartpole-balance"].made_for("FittedRMax") as env:
        callback = AtBudgets(env, (2, 4), seed=5)
        callback.model = Always()
        goes_on = []
        for callback.num_timesteps in range(1, 5):
            goes_on.append(callback._on_step())
    assert goes_on == [True, True, True, False] and list(callback.returns) == [2, 4]
    assert callback.returns[2] == callback.returns[4] and 0.0 < callback.returns[2] < 500.0
    assert TASKS["cartpole-balance"].unit == 2.0


def test_the_command_writes_a_row_for_each_budget_and_does_not_repeat_what_is_there(monkeypatch, tmp_path):
    monkeypatch.setattr(other_tasks, "N_EPISODES", 1)
    arguments = {"seeds": [1], "budgets": [20, 40], "output": tmp_path / "runs", "table": tmp_path / "table.csv"}
    other_tasks.other_tasks(HERE[:1], ["FittedRMax", "DQN"], **arguments)
    table = pd.read_csv(arguments["table"])
    assert list(table["algorithm"]) == ["FittedRMax"] * 2 + ["DQN"] * 2 and list(table["steps"]) == [20, 40] * 2
    assert table["mean_return"].between(0.0, 1000.0).all() and (table["seconds"] > 0.0).all()
    other_tasks.other_tasks(HERE[:1], ["FittedRMax", "DQN"], **arguments)
    assert pd.read_csv(arguments["table"]).equals(table)


def test_crossq_has_no_runs_where_actions_are_discrete(monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: find_spec("rl_zoo3" if name in ("sbx", "bsuite") else name))
    jobs = budget_jobs(list(TASKS), ["CrossQ"], [1], [100])
    assert [job.group for job in jobs] == [name for name in TASKS if not name.startswith("bsuite-")]


@pytest.mark.parametrize(("package", "tasks"), [("sbx", HERE), ("bsuite", ["bsuite-deep_sea"])])
def test_what_is_not_installed_is_named_with_the_extra(monkeypatch, package, tasks):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == package else find_spec(name))
    with pytest.raises(ModuleNotFoundError, match=rf"needs {package}, .*pip install 'sb3-combrel\[benchmarks\]'"):
        budget_jobs(tasks, ["CrossQ" if package == "sbx" else "DQN"], [1], [100])


def test_unknown_names_and_budgets_are_refused():
    with pytest.raises(ValueError, match=r"tasks must be some of .*, got 'acrobot-swing'; did you mean 'acrobot-swingup'"):
        budget_jobs(["acrobot-swing"], ["DQN"], [1], [100])
    with pytest.raises(ValueError, match=r"algorithms must be some of .*, got 'SAC'"):
        budget_jobs(HERE, ["SAC"], [1], [100])
    with pytest.raises(ValueError, match="budgets must be numbers of steps, at least 1, got"):
        budget_jobs(HERE, ["DQN"], [1], [0, 10])
