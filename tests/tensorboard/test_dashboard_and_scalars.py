"""The dashboard's callback: when it is there, beside what else, and that it changes nothing of what is learned."""

import functools
import subprocess
import sys
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.dashboard import METHODS, NamedWalk, Witness, events, run_folder, scalars, slow_q, walker
from helpers.walk import same_parameters
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_combrel import COMBREL, SourceInstances
from sb3_combrel.callbacks import DashboardCallback
from sb3_combrel.runs.episodes import EpisodeRecorder
from sb3_combrel.tensorboard.readings import bellman_residual, mean_compliance, spread
from sb3_combrel.transfer.instances.bandwidths import default_bandwidths

PICTURE = "value_and_policy/place_height"


def image_steps(log, tag=PICTURE):
    return [image.step for image in events(run_folder(log)).Images(tag)]


@pytest.mark.parametrize("method", METHODS)
def test_every_method_has_its_scalars_and_pictures_which_change_nothing_of_what_is_learned(method, transfers, tmp_path):
    plain = walker(transfer=transfers[method]).learn(150)
    logged = walker(tmp_path, transfers[method]).learn(150, DashboardCallback(picture_freq=90), log_interval=1)
    assert same_parameters(plain, logged)
    found = events(run_folder(tmp_path))
    tags = set(found.Tags()["scalars"])
    always = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "model/instances", "model/known", "model/optimistic"}
    always |= {"model/transferred", "planner/sweeps", "planner/residual", "planner/time_share"}
    assert always <= tags
    of_transfer = {"transfer/instances_used", "transfer/pairs_modelled"}
    of_choice = {"transfer/compliance", "transfer/choice_entropy", "transfer/switches", "transfer/distinct_mappings"}
    assert of_transfer <= tags if method != "none" else not any(tag.startswith("transfer/") for tag in tags)
    assert of_choice <= tags if method == "COMBREL" else not of_choice & tags
    of_choice = ["source_action/place_height", "state_mappings/chosen"] if method in ("TIMBREL", "COMBREL") else []
    assert sorted(found.Tags()["images"]) == sorted([PICTURE, *of_choice])
    assert ("transfer/most_chosen_mappings/text_summary" in found.Tags()["tensors"]) == (method != "none")


class WideWalk(NamedWalk):
    """The walk, in a space without bounds for its first variable."""

    def __init__(self):
        super().__init__(limit=10)
        self.observation_space = gym.spaces.Box(np.float32([-np.inf, 0.0]), np.float32([np.inf, 2.0]))


@pytest.mark.parametrize("use", ["instances", "prior"])
def test_pictures_and_choices_follow_the_scales_of_the_agent(use, tmp_path):
    dashboard = DashboardCallback(picture_freq=7, picture_share=1.0, scalar_share=1.0)
    transfer = COMBREL(SourceInstances.record(None, NamedWalk(), n_instances=150, seed=0), use=use)
    model = walker(tmp_path, transfer, WideWalk()).learn(150, dashboard, log_interval=1)
    scaling = model.policy.scales.scaling
    assert scaling.high[0] < 2.0
    left, right, *_ = dashboard._planes[0].extent
    assert scaling.low[0] - 0.2 < left < scaling.low[0] and scaling.high[0] < right < scaling.high[0] + 0.2
    assert max(dashboard._history.table().sum(axis=0)) > 0
    assert image_steps(tmp_path)[-1] == 150


def test_without_a_log_nothing_is_computed_for_one(transfers, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("this was for a log that nobody writes")

    monkeypatch.setattr("sb3_combrel.fitted_rmax.agent.FittedRMaxAgent.statistics", refuse)
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.DashboardCallback._on_training_start", refuse)
    monkeypatch.setattr("sb3_combrel.transfer.methods.combrel.COMBREL.choices", refuse)
    model = walker(transfer=transfers["COMBREL"]).learn(200)
    assert model._episode_num > 4
    monkeypatch.undo()
    monkeypatch.setattr("sb3_combrel.fitted_rmax.agent.FittedRMaxAgent.statistics", refuse)
    monkeypatch.setattr("sb3_combrel.tensorboard.callback.DashboardCallback._write_settings", refuse)
    walker(transfer=transfers["COMBREL"]).learn(50, DashboardCallback(picture_freq=10))


@pytest.mark.long
def test_matplotlib_is_imported_for_pictures_only(tmp_path):
    command = (
        "import sys; from sb3_combrel import FittedRMax; from sb3_combrel.callbacks import DashboardCallback;"
        "FittedRMax('MountainCar-v0', seed=0).learn(300);"
        "print('sb3_combrel.tensorboard.pictures' in sys.modules, 'matplotlib' in sys.modules);"
        "model = FittedRMax('MountainCar-v0', seed=0, tensorboard_log=sys.argv[1]);"
        "model.learn(300, DashboardCallback(picture_freq=None)); print('matplotlib' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", command, str(tmp_path)], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False"] * 3 and not events(run_folder(tmp_path)).Tags()["images"]


def test_a_logger_of_the_users_own_counts_as_a_log(tmp_path):
    model = walker()
    model.set_logger(configure(str(tmp_path), ["tensorboard"]))
    model.learn(100, DashboardCallback(), log_interval=None)
    tags = events(tmp_path).Tags()
    assert not tags["scalars"] and tags["images"], "without logs of the algorithm there are pictures all the same"


@pytest.mark.parametrize("given", ["function", "nested"])
def test_the_dashboard_stands_beside_other_callbacks(given, tmp_path):
    calls = []
    nested = CallbackList([EveryNTimesteps(10, Witness(len)), Witness(lambda model: calls.append(1))])
    walker(tmp_path).learn(100, nested if given == "nested" else lambda locals_, globals_: calls.append(1) is None)
    assert calls and "planner/residual" in events(run_folder(tmp_path)).Tags()["scalars"]


def test_a_dashboard_that_is_given_is_the_only_one(tmp_path):
    walker(tmp_path).learn(100, CallbackList([DashboardCallback(picture_freq=50, variables=[("height", "place")])]))
    assert events(run_folder(tmp_path)).Tags()["images"] == ["value_and_policy/height_place"]
    assert image_steps(tmp_path, "value_and_policy/height_place") == [50, 100]


def test_learning_goes_on_in_the_same_log_after_an_interrupt(transfers, tmp_path):
    class Interrupt(BaseCallback):
        def _on_step(self):
            if self.num_timesteps == 130:
                raise KeyboardInterrupt
            return True

    model = walker(tmp_path, transfers["COMBREL"])
    with pytest.raises(KeyboardInterrupt):
        model.learn(1000, [Interrupt(), DashboardCallback(picture_freq=100)])
    model.save(tmp_path / "model")
    model.learn(100, DashboardCallback(picture_freq=100), reset_num_timesteps=False)
    assert image_steps(tmp_path) == [100, 130, 200, 230]


def test_the_dashboard_shows_environments_in_other_processes(transfers, tmp_path):
    env = make_vec_env(NamedWalk, 2, vec_env_cls=SubprocVecEnv, vec_env_kwargs=dict(start_method="fork"))
    walker(tmp_path, transfers["COMBREL"], env).learn(200, DashboardCallback(picture_freq=150))
    env.close()
    assert image_steps(tmp_path) == [150, 200]
    assert "transfer/compliance" in events(run_folder(tmp_path)).Tags()["scalars"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (dict(variables=["place"]), "pairs of two different state variables"),
        (dict(variables=[("place", "place")]), "two different"),
        (dict(variables=[("place", "speed")]), "place, height"),
        (dict(variables=[(0, 2)]), "below 2"),
        (dict(at=[0.0]), "at must be 2 finite numbers"),
    ],
)
def test_variables_and_states_that_do_not_fit_the_task_are_refused(wrong, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        walker(tmp_path).learn(10, DashboardCallback(**wrong))


def test_a_share_is_between_0_and_1_and_a_frequency_a_number_of_steps():
    for name, value in (("scalar_share", 0), ("scalar_share", 1.5), ("picture_share", -0.1), ("picture_freq", 1.5)):
        with pytest.raises(ValueError, match=name):
            DashboardCallback(**{name: value})


# Scalars of the dashboard: the event files are read back, and compared with what is computed here.
def slow_residual(model):
    agent, largest = model.agent, 0.0
    for point in range(agent.grid.n_points):
        q = [slow_q(agent, point, action) for action in range(agent.task.n_actions)]
        if None not in q:
            low, high = agent.planner.bounds
            largest = max(largest, abs(min(max(max(q), low), high) - agent.planner.values[point]))
    return largest


def test_residual_is_the_largest_change_by_a_backup(tmp_path):
    witness = Witness(slow_residual)
    # With a large tolerance values lag behind: a residual of 0 would prove nothing.
    walker(tmp_path, planning_tolerance=1.0).learn(200, [witness, DashboardCallback(scalar_share=1.0)])
    assert max(witness.seen.values()) > 0.0
    assert scalars(events(run_folder(tmp_path)), "planner/residual", witness.seen) == pytest.approx(witness.seen, abs=1e-6)


def slow_compliance(model):
    """Mean compliance of the chosen mappings with the nearest transitions, from the equations."""
    transfer = model.policy.transfer
    task, source, candidates = transfer.task, transfer.sources[0], transfer.candidates
    bandwidths, d = default_bandwidths(candidates.instances), task.n_variables
    transitions = [
        naive.Transition(row[:d], int(row[2 * d + 1]), float(row[2 * d]), row[:d] + row[d : 2 * d])
        for row in transfer.get_state()["transitions"]
    ]

    @functools.cache
    def compliance(candidate, i):
        _, _, state_index, source_action = candidates.origins[candidate]
        mapping = candidates.sets[0].of_candidate(state_index, source_action)
        return naive.compliance(transitions[i], source, mapping, bandwidths)

    means = []
    for pair, candidate in enumerate(transfer.choices().tolist()):
        if candidate >= 0:
            action, point = divmod(pair, len(task.sample_states))
            mine = [i for i, transition in enumerate(transitions) if transition.action == action]
            apart = [((transitions[i].state - task.sample_states[point]) ** 2).sum() for i in mine]
            near = [mine[i] for i in np.argsort(apart, kind="stable")[: transfer.n_neighbors]]
            means.append(np.mean([compliance(candidate, i) for i in near]))
    return np.mean(means)


def test_scalars_of_transfer_are_those_of_pairs_and_choices(transfers, tmp_path):
    def plainly(model):
        known, modelled = model.agent.model.known, model.agent.mdp.arrays.modelled
        n, transferred = len(known), sum(1 for k, m in zip(known, modelled, strict=True) if m and not k)
        chosen = [c for c in model.policy.transfer.choices() if c >= 0]
        shares = np.array([chosen.count(c) for c in set(chosen)]) / len(chosen)
        return {
            "model/known": sum(known) / n,
            "model/transferred": transferred / n,
            "model/optimistic": sum(~modelled) / n,
            "transfer/pairs_modelled": transferred,
            "transfer/compliance": slow_compliance(model),
            "transfer/choice_entropy": -sum(shares * np.log(shares)),
            "transfer/distinct_mappings": len(shares),
        }

    witness = Witness(plainly)
    walker(tmp_path, transfers["COMBREL"]).learn(150, [witness, DashboardCallback(scalar_share=1.0)])
    found = events(run_folder(tmp_path))
    assert len(witness.seen) > 2
    for tag in next(iter(witness.seen.values())):
        expected = {step: seen[tag] for step, seen in witness.seen.items()}
        assert scalars(found, tag, witness.seen) == pytest.approx(expected, rel=1e-5, abs=1e-6), tag


def test_scalars_stay_within_their_share_of_the_time(tmp_path, monkeypatch, clock):
    def slowly(agent):
        clock[0] += 0.02
        return 0.0

    monkeypatch.setattr("sb3_combrel.tensorboard.readings.bellman_residual", slowly)
    walker(tmp_path).learn(800, DashboardCallback(picture_freq=None, scalar_share=0.1), log_interval=1)
    found = events(run_folder(tmp_path))
    # Between logs and with them the first is written before anybody knows how long it takes; the last comes at the end.
    assert 4 <= len(found.Scalars("planner/residual")) <= 3 + 0.1 * clock[0] / 0.02
    assert len(found.Scalars("planner/residual")) == len(found.Scalars("model/known"))
    assert len(found.Scalars("rollout/ep_rew_mean")) > 10


@pytest.mark.parametrize("method", ["none", "COMBREL"])
def test_between_logs_there_are_points_of_all_that_a_log_has(method, transfers, tmp_path):
    """With few and long episodes, too."""
    recorder = EpisodeRecorder()
    walker(tmp_path, transfers[method], NamedWalk(limit=10**6, start=-1.0), max_value=0.0).learn(
        300, [recorder, DashboardCallback(scalar_share=1.0)], log_interval=10**6
    )
    found = events(run_folder(tmp_path))
    steps = {tag: [event.step for event in found.Scalars(tag)] for tag in found.Tags()["scalars"]}
    assert steps["rollout/ep_rew_mean"] == steps["rollout/ep_len_mean"] == np.cumsum(recorder.episodes.steps).tolist()
    assert len(steps["model/known"]) >= 100 and steps["model/known"][-1] == 300
    assert steps["planner/residual"] == steps["planner/sweeps"] == steps["model/known"]
    assert ("transfer/pairs_modelled" in steps) == (method != "none")


@pytest.mark.parametrize("log_interval", [1, 3])
def test_no_step_has_two_points_and_each_episode_has_one(log_interval, tmp_path):
    recorder = EpisodeRecorder()
    walker(tmp_path).learn(200, [recorder, DashboardCallback(scalar_share=1.0)], log_interval=log_interval)
    found = events(run_folder(tmp_path))
    steps = [event.step for event in found.Scalars("planner/residual")]
    assert len(steps) > 100 and len(set(steps)) == len(steps) and steps == sorted(steps)
    returns = recorder.episodes.returns
    means = [returns[: k + 1].mean() for k in range(len(returns))]
    assert [event.step for event in found.Scalars("rollout/ep_rew_mean")] == np.cumsum(recorder.episodes.steps).tolist()
    assert [event.value for event in found.Scalars("rollout/ep_rew_mean")] == pytest.approx(means, rel=1e-6)


def test_evidence_and_bound_of_a_source_as_prior_are_scalars(transfers, tmp_path):
    def plainly(model):
        prior = model.policy.transfer.source_prior
        bound = prior.value_bound()
        strengths = [np.exp(np.mean(np.log(each))) for each in prior.evidence.strength]
        names = [f"evidence/{name}" for name in NamedWalk.action_names]
        of_bound = {} if bound is None else {"transfer/value_bound": sum(bound) / len(bound)}
        return dict(zip(names, strengths, strict=True)) | of_bound

    witness = Witness(plainly)
    prior = replace(transfers["COMBREL"], use="prior")
    walker(tmp_path, prior).learn(150, [witness, DashboardCallback(scalar_share=1.0)], log_interval=1)
    found = events(run_folder(tmp_path))
    tags = set().union(*witness.seen.values())
    assert len(tags) == 3 and "transfer/value_bound" in tags
    for tag in tags:
        expected = {step: seen[tag] for step, seen in witness.seen.items() if tag in seen}
        assert scalars(found, tag, witness.seen) == pytest.approx(expected, rel=1e-5), tag


def test_by_default_there_are_several_sets_of_pictures_in_a_run(tmp_path):
    walker(tmp_path).learn(160, DashboardCallback())
    assert image_steps(tmp_path) == list(range(20, 161, 20))


def test_planning_takes_a_share_of_the_time(tmp_path):
    walker(tmp_path).learn(200)
    assert all(0.0 < share < 1.0 for share in scalars(events(run_folder(tmp_path)), "planner/time_share").values())


def test_samples_are_spread_and_complete_where_there_is_room():
    assert spread(5, 10).tolist() == [0, 1, 2, 3, 4]
    few = spread(1000, 7)
    assert len(set(few)) == 7 and few.max() > 800


def test_nothing_to_measure_gives_nothing(transfers):
    agent = walker(transfer=transfers["COMBREL"]).agent
    assert bellman_residual(agent) == 0.0 and mean_compliance(agent.transfer) is None
    assert mean_compliance(walker(transfer=transfers["TIMBREL"]).agent.transfer) is None
