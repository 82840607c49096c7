"""Scalars of the dashboard: the event files are read back, and compared with what is computed here."""

import functools

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.dashboard import NamedWalk, Witness, events, run_folder, scalars, slow_q, walker

from sb3_combrel.callbacks import DashboardCallback
from sb3_combrel.tensorboard.readings import bellman_residual, mean_compliance, spread
from sb3_combrel.transfer.instances.bandwidths import default_bandwidths


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
    # Without backups to spare, values lag behind: a residual of 0 would prove nothing.
    walker(tmp_path, max_backups=0).learn(200, [witness, DashboardCallback(scalar_share=1.0)])
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
        _, action, state_index, source_action = candidates.origins[candidate]
        mappings = candidates.sets[0]
        mapping = mappings[mappings.find(state_index, action, source_action)]
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
    walker(tmp_path, transfers[method], NamedWalk(limit=10**6, start=-1.0), max_value=0.0).learn(
        300, DashboardCallback(scalar_share=1.0), log_interval=10**6
    )
    found = events(run_folder(tmp_path))
    steps = {tag: [event.step for event in found.Scalars(tag)] for tag in found.Tags()["scalars"]}
    assert not any(tag.startswith("rollout/") for tag in steps)
    assert len(steps["model/known"]) >= 100 and steps["model/known"][-1] == 300
    assert steps["planner/residual"] == steps["planner/backups"] == steps["model/known"]
    assert ("transfer/pairs_modelled" in steps) == (method != "none")


def test_no_step_has_two_points(tmp_path):
    walker(tmp_path).learn(200, DashboardCallback(scalar_share=1.0), log_interval=1)
    steps = [event.step for event in events(run_folder(tmp_path)).Scalars("planner/residual")]
    assert len(steps) > 100 and len(set(steps)) == len(steps) and steps == sorted(steps)


def test_planning_takes_a_share_of_the_time(tmp_path):
    model = walker(tmp_path).learn(200)
    assert all(0.0 < share < 1.0 for share in scalars(events(run_folder(tmp_path)), "planner/time_share").values())
    assert not model.agent.timed


def test_samples_are_spread_and_complete_where_there_is_room():
    assert spread(5, 10).tolist() == [0, 1, 2, 3, 4]
    few = spread(1000, 7)
    assert len(set(few)) == 7 and few.max() > 800


def test_nothing_to_measure_gives_nothing(transfers):
    agent = walker(transfer=transfers["COMBREL"]).agent
    assert bellman_residual(agent) == 0.0 and mean_compliance(agent.transfer) is None
    assert mean_compliance(walker(transfer=transfers["TIMBREL"]).agent.transfer) is None
