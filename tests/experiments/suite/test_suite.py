"""The suite: runs that go on where they stopped, measures of hand-made episodes, tables and tests."""

import dataclasses
import json
import re
from functools import partial

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from scipy import stats

from sb3_combrel import InterTaskMapping, SourceInstances
from sb3_combrel.comparison.statistics import holm
from sb3_combrel.experiments.suite import command as suite
from sb3_combrel.experiments.suite import measures
from sb3_combrel.experiments.suite.measures import failures
from sb3_combrel.experiments.suite.report import cells_of, columns_of, format_number, frozen_table, headline_table, task_table
from sb3_combrel.experiments.suite.runs import Variant
from sb3_combrel.experiments.suite.tasks import TASKS, NoisyActions, Source, Task, tasks_of
from sb3_combrel.experiments.suite.transfers import INSTANCE_ORACLES, ORACLES, RECORDED, TRANSFERS, check_transfer, source_for
from sb3_combrel.experiments.tasks import icub_arm
from sb3_combrel.experiments.tasks.point_robot import make_point_robot
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.runs.episodes import Episodes
from sb3_combrel.runs.job import chosen_on_purpose, make_env

SMALL = Task(
    "small", partial(make_point_robot, 2, 0.003), n_episodes=3, measures=(measures.steps_in(1, 3),), headline="steps_1_to_3"
)
SHORT = Task("short", partial(make_point_robot, 2), n_steps=500)
VARIANTS = [Variant("default"), Variant("narrow", {"model_breadth": 0.05})]


def run(folder, tasks=(SMALL, SHORT), variants=VARIANTS, seeds=(5, 6), **arguments):
    console = Console(record=True, width=200)
    suite.run_suite(folder, tasks, variants, seeds, evaluation_episodes=2, console=console, **arguments)
    return console.export_text()


def test_a_suite_is_written_run_by_run_and_resumed(tmp_path):
    run(tmp_path, seeds=(5,))
    first = pd.read_csv(tmp_path / "runs.csv")
    assert list(zip(first["task"], first["variant"], first["seed"], strict=True)) == [
        (task, variant, 5) for task in ("short", "small") for variant in ("default", "narrow")
    ]
    assert "4 of 8 runs were complete already." in run(tmp_path)
    rows, episodes = pd.read_csv(tmp_path / "runs.csv"), pd.read_csv(tmp_path / "episodes.csv")
    assert len(rows) == 8
    pd.testing.assert_frame_equal(rows[rows["seed"] == 5].reset_index(drop=True), first)
    for row in rows.itertuples():
        own = episodes[episodes["run"] == row.run]
        assert own["episode"].tolist() == list(range(1, row.episodes + 1))
        if row.task == "small":
            assert len(own) == 3 and own["steps"].sum() == row.steps_1_to_3 == row.steps
        else:
            assert own["steps"].sum() <= row.steps == 500 and np.isnan(row.steps_1_to_3)
        assert own["return"].tolist() == (-own["steps"]).tolist()
        assert (own["terminated"] + own["truncated"] == 1).all() and row.ms_per_step > 0.0
        assert json.loads(row.settings)["learner"] == ({"model_breadth": 0.05} if row.variant == "narrow" else {})
    narrow = rows[(rows["task"] == "small") & (rows["variant"] == "narrow")]["steps_1_to_3"]
    mean, error = (format_number(number) for number in (narrow.mean(), narrow.sem()))
    assert f"| steps_1_to_3 | narrow | 2 | {mean} ± {error} |" in (tmp_path / "tasks.md").read_text()
    with pytest.raises(ValueError, match=r"other settings \(small, narrow, seed 5: learner.model_breadth was 0.05 and is 0.1"):
        run(tmp_path, variants=[Variant("narrow", {"model_breadth": 0.1})])


def test_a_variant_with_transfer_learns_a_source_once_for_each_seed(tmp_path):
    calls = tmp_path / "calls.txt"

    def learn(seed):
        with calls.open("a") as file:
            file.write(f"{seed} ")
        return SourceInstances.record(None, make_point_robot(2), n_instances=100, seed=seed)

    task = Task("robot", partial(make_point_robot, 3), n_steps=150, source=Source("robot_2d", learn))
    run(tmp_path, tasks=[task], variants=[Variant("combrel", {"gamma": 0.99}, "COMBREL")])
    rows = pd.read_csv(tmp_path / "runs.csv")
    assert calls.read_text() == "5 6 "
    assert [json.loads(own)["source"] for own in rows["settings"]] == ["robot_2d, seed 5", "robot_2d, seed 6"]
    one, other = (SourceInstances.load(tmp_path / "sources" / f"robot_2d_seed{seed}.npz") for seed in (5, 6))
    assert one.n_variables == 2 and not np.array_equal(one.states, other.states)
    # Neither the right mapping nor a source of another domain is known for a task of our own.
    unknown = {"oracle": "nobody knows the mapping of robot", "oracle-instances": "nobody knows the mapping of robot"}
    unknown["COMBREL@other-domain"] = "robot no source of another domain"
    unknown["own-dynamics"] = "recorded for ICubArm, got the task robot"
    unknown |= dict.fromkeys(RECORDED, "mountain_car_2d is recorded so, and robot learns from robot_2d")
    for name in TRANSFERS:
        if name not in unknown:
            check_transfer(name, task)
            continue
        with pytest.raises(ValueError, match=unknown[name]):
            check_transfer(name, task)
    with pytest.raises(ValueError, match="no source task"):
        run(tmp_path, tasks=[SHORT], variants=[Variant("combrel", {}, "COMBREL")])
    other = {name: source_for("COMBREL@other-domain", TASKS[name]).name for name in ("MountainCar6D", "ICubArm-noisy")}
    assert other == {"MountainCar6D": "icub_torso", "ICubArm-noisy": "mountain_car_2d"}
    assert source_for("COMBREL@uniform", TASKS["MountainCar6D"]).name == "mountain_car_2d-uniform"
    assert len(source_for("COMBREL@3000", TASKS["MountainCar4D"]).learn(7)) == 3000
    moves = icub_arm.record_dynamics(seed=3, n=100)
    assert moves.n_variables == 4 and not moves.terminated.any() and set(moves.rewards) == {-1.0}
    assert len(np.unique(moves.actions)) == moves.n_actions == 8 and len(np.unique(moves.states[:, 0])) == 100
    prior = TRANSFERS["own-dynamics"](moves, "ICubArm")
    assert prior.mapping == InterTaskMapping(range(4), range(8)) and not prior.transfer_terminals
    with pytest.raises(ValueError, match="transfer must be one of"):
        run(tmp_path, tasks=[task], variants=[Variant("other", {}, "OTHER")])


@pytest.mark.parametrize("name", sorted({*ORACLES, *INSTANCE_ORACLES}))
def test_mappings_that_are_given_fit_their_tasks(name):
    env = TASKS[name].make()
    n_variables, n_actions = (4, 2) if TASKS[name].source.name == "cart_pole" else (2, 3)
    of_instances = INSTANCE_ORACLES.get(name, [])
    given = [ORACLES[name], *(of_instances if isinstance(of_instances, list) else [of_instances])]
    for mapping in given:
        mapping.check(
            n_source_variables=n_variables,
            n_target_variables=env.observation_space.shape[0],
            n_source_actions=n_actions,
            n_target_actions=env.action_space.n,
        )
    env.close()


def test_variants_are_read_from_text():
    assert suite.variant_of("default") == Variant("default", {}, None)
    assert suite.variant_of("b0.3:model_breadth=0.3,resolution=3") == Variant("b0.3", {"model_breadth": 0.3, "resolution": 3})
    assert suite.variant_of("t:transfer=COMBREL,max_instances=null") == Variant("t", {"max_instances": None}, "COMBREL")
    text = '{"name": "fine", "resolution": [3, 4], "bounds": [[0, 0], [1, 1]]}'
    assert suite.variant_of(text) == Variant("fine", {"resolution": [3, 4], "bounds": [[0, 0], [1, 1]]})


@pytest.mark.parametrize("text", ["fast", "a:resolution", "a:no_such=3", "a_b:resolution=3", '{"resolution": 3}', "", "{"])
def test_bad_variants_are_refused(text):
    with pytest.raises(ValueError):
        suite.variant_of(text)


def test_seeds_and_tasks_are_read_from_text():
    assert tasks_of(["all"]) == list(TASKS.values())
    assert tasks_of(["CartPole-v1", "CartPole-v1"]) == [TASKS["CartPole-v1"]]
    for names in (["CartPole"], []):
        with pytest.raises(ValueError, match="tasks must be"):
            tasks_of(names)
    assert suite.seeds_of("0-3") == [0, 1, 2, 3] and suite.seeds_of("4, 0-1,1") == [4, 0, 1]
    assert suite.seeds_of("0-2", 1000) == [1000, 1001, 1002]
    for text in ("", "3-1", "a", "1--2", "-1"):
        with pytest.raises(ValueError, match="seeds"):
            suite.seeds_of(text)


@pytest.mark.parametrize(
    "change",
    [
        *[dict(jobs=0), dict(variants=[]), dict(variants=[Variant("a"), Variant("a", {"resolution": 3})])],
        *[dict(reference="other"), dict(test="t")],
    ],
)
def test_bad_input_is_refused(tmp_path, change):
    with pytest.raises(ValueError, match=next(iter(change))):
        run(tmp_path / "results", **change)
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("name", TASKS)
def test_every_task_can_be_learnt_and_has_its_headline(name):
    task = TASKS[name]
    assert task.headline in columns_of(task)
    env = task.make()
    assert isinstance(env.action_space, gym.spaces.Discrete)
    wrapper = env
    # By its name: RL-Zoo, once imported, puts a subclass, PatchedTimeLimit, in Gymnasium's place.
    while "TimeLimit" not in type(wrapper).__name__:
        wrapper = wrapper.env
    with chosen_on_purpose():
        model = FittedRMax(env, **task.learner)
    assert model.gamma == task.learner.get("gamma")
    env.close()


def test_measures_of_hand_made_episodes():
    steps = [100, 40, 30, 60, 20, 25, 27, 26, 20]
    episodes = Episodes.from_rows([(n, -float(n), True) for n in steps])
    assert measures.steps_in(1, 3).of(episodes) == 170 and measures.mean_steps_in(4, 5).of(episodes) == 40
    assert np.isnan(measures.steps_in(1, 10).of(episodes))
    assert measures.mean_return_in(1, 3).of(episodes._replace(returns=np.arange(9.0) ** 2)) == pytest.approx(5 / 3)
    assert np.isnan(measures.mean_return_in(1, 10).of(episodes)) and measures.mean_return_in(1, 1).higher_is_better
    assert measures.steps_until_always(27).of(episodes) == 230 and measures.steps_until_always(59).of(episodes) == 230
    assert measures.steps_until_always(60).of(episodes) == 100 and measures.steps_until_always(100).of(episodes) == 0
    assert measures.steps_until_always(26).of(episodes) == np.inf, "only two episodes follow the one of 27 steps"
    assert measures.steps_until_always(10).of(episodes) == np.inf
    # The medians of five: 40, 30, 27, 26, 25.
    assert measures.steps_until_median(30).of(episodes) == sum(steps[:6])
    assert measures.steps_until_median(24).of(episodes) == np.inf
    hit = Episodes.from_rows([(400, -400.0, False), (30, -30.0, False), (7, 93.0, True), (9, 91.0, True)])
    assert measures.steps_until_first_end().of(hit) == 437
    assert measures.steps_until_first_end().of(hit.last(4)._replace(terminated=np.zeros(4, dtype=bool))) == np.inf
    none = Episodes.from_rows([])
    assert measures.steps_until_always(27).of(none) == np.inf and measures.steps_until_median(27).of(none) == np.inf


def test_failures_and_summaries_of_hand_made_episodes():
    episodes = Episodes.from_rows([(400, -400.0, False), *[(50, -50.0, True)] * 8, (400, 499.0, False), (60, -60.0, True)])
    np.testing.assert_array_equal(failures(episodes, None), [True, *[False] * 8, True, False])
    np.testing.assert_array_equal(failures(episodes, -60.0), [True, *[False] * 9, True])
    # The first of the eleven episodes is not among the last ten.
    assert measures.summary_of_learning(episodes, None) == {"last10_return": (8 * -50 + 499 - 60) / 10, "last10_failed": 0.1}
    assert np.isnan(measures.summary_of_learning(Episodes.from_rows([]), None)["last10_return"])
    played = Episodes.from_rows([(100, -100.0, True), (110, -110.0, True)])
    summary = measures.summary_of_evaluation(played, None, -100.0)
    assert summary == {"mean": -105.0, "worst": -110.0, "failures": 0, "as_good": 1.0}
    assert measures.summary_of_evaluation(played, None, -99.0)["as_good"] == 0.0
    assert measures.summary_of_evaluation(played, -110.0, -100.0)["as_good"] == 0.0, "one has failed"
    assert measures.summary_of_evaluation(played, None, np.nan)["as_good"] == 0.0, "there is nothing to compare with"


def test_noisy_actions_are_drawn_by_the_environments_seed():
    env = NoisyActions(make_env("MountainCar-v0"), 0.3)

    def taken(seed):
        env.reset(seed=seed)
        return [env.action(2) for _ in range(3000)]

    assert taken(0) == taken(0) != taken(1)
    # A third of the replacements draws the action itself.
    assert np.mean(np.array(taken(0)) != 2) == pytest.approx(0.2, abs=0.03) and set(taken(0)) == {0, 1, 2}
    with pytest.raises(ValueError, match="probability"):
        NoisyActions(env, 1.5)


def test_tables_of_hand_made_runs():
    def row(variant, seed, steps, mean):
        return {"task": "small", "variant": variant, "seed": seed, "steps_1_to_3": steps, "greedy_mean": mean}

    steps = {"a": [100.0, 104.0, 102.0], "b": [50.0, 54.0, 52.0], "c": [103.0, 98.0, np.inf]}
    rows = [row(name, seed, n, -n) for name, own in steps.items() for seed, n in enumerate(own)]
    cells = cells_of(rows, [SMALL], list(steps), "a", "welch")
    raw = [stats.ttest_ind(steps["a"], steps["b"], equal_var=False).pvalue, stats.mannwhitneyu(steps["a"], steps["c"]).pvalue]
    found = [cells["small", "steps_1_to_3", name].p_value for name in ("b", "c")]
    np.testing.assert_allclose(found, list(holm(dict(enumerate(raw))).values()))
    table = {(line[0], line[1]): line[2:] for line in task_table(cells, SMALL, list(steps), "p against a").rows}
    assert table["steps_1_to_3", "a"] == ("3", "102.0 ± 1.15", "102.0", "104.0", "")
    assert table["steps_1_to_3", "c"][:4] == ("3", "2 of 3 reached it", "103.0", "never")
    assert table["greedy_mean", "b"][:4] == ("3", "-52.0 ± 1.15", "-52.0", "-54.0")
    table = headline_table(cells, [SMALL], list(steps), "a")
    assert table.header[-2:] == ("better than a by", "p")
    (first, *found), (*second, gain, p_value), (*third, nothing, _) = (line[2:] for line in table.rows)
    assert (first, *found) == ("a", "3", "102.0 ± 1.15", "102.0", "104.0", "", "")
    assert second == ["b", "3", "52.0 ± 1.15", "52.0", "54.0"] and float(p_value) < 0.01
    assert re.fullmatch(r"49% \(4[678]% to 5[01]%\)", gain)
    assert third == ["c", "3", "2 of 3 reached it", "103.0", "never"] and nothing == "-"
    alone = headline_table(cells, [SMALL], ["b"], "b")
    assert alone.rows == [("small", "steps_1_to_3", "3", "52.0 ± 1.15", "52.0", "54.0")]
    returns = headline_table(cells, [dataclasses.replace(SMALL, headline="greedy_mean")], ["a", "b"], "a").rows[1][-2]
    assert re.fullmatch(r"50.0 \(4[678].\d to 5[123].\d\)", returns)


def test_the_table_of_frozen_policies_counts_seeds():
    columns = ("last10_return", "last10_failed", "greedy_mean", "greedy_worst", "greedy_as_good", "ms_per_step")
    numbers = [(-50.0, 0.0, -51.0, -60.0, 1.0, 0.1), (-60.0, 1.0, -99.0, -400.0, 0.0, 0.3)]
    rows = [
        {"task": "small", "variant": "a", "seed": seed, **dict(zip(columns, own, strict=True))}
        for seed, own in enumerate(numbers)
    ]
    (line,) = frozen_table(cells_of(rows, [SMALL], ["a", "b"], "a", "welch"), [SMALL], ["a", "b"]).rows
    assert line[:3] == ("small", "a", "-55.0 ± 5.00") and line[3:6] == ("-75.0 ± 24.0", "-400.0", "1 of 2")
    assert line[6:] == ("1", "0.20 ± 0.10")
