"""Scalars of the dashboard: the event files are read back, and compared with what is computed here."""

import functools
import time

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.dashboard import METHODS, Witness, events, scalars, slow_q, walker

from sb3_combrel.tensorboard.callback import DashboardCallback
from sb3_combrel.tensorboard.readings import bellman_residual, mean_compliance, spread
from sb3_combrel.transfer.bandwidths import default_bandwidths


@pytest.mark.parametrize("method", METHODS)
def test_every_group_of_scalars_is_there(method, transfers, tmp_path):
    walker(tmp_path, transfers[method]).learn(200)
    tags = set(events(tmp_path / "FittedRMax_1").Tags()["scalars"])
    always = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "model/instances", "model/known", "model/optimistic"}
    always |= {"model/transferred", "planner/backups", "planner/residual", "planner/time_share"}
    assert always <= tags
    of_transfer = {"transfer/instances_used", "transfer/pairs_modelled"}
    of_choice = {"transfer/compliance", "transfer/choice_entropy", "transfer/switches", "transfer/distinct_mappings"}
    assert of_transfer <= tags if method != "none" else not any(tag.startswith("transfer/") for tag in tags)
    assert of_choice <= tags if method == "COMBREL" else not of_choice & tags


def test_shares_of_the_grid_are_those_of_its_pairs(transfers, tmp_path):
    def shares(model):
        known, modelled = model.agent.model.known, model.agent.mdp.arrays.modelled
        n = len(known)
        transferred = sum(1 for k, m in zip(known, modelled, strict=True) if m and not k)
        return sum(known) / n, transferred / n, sum(~modelled) / n, transferred

    witness = Witness(shares)
    walker(tmp_path, transfers["COMBREL"]).learn(300, [witness, DashboardCallback(scalar_share=1.0)])
    found = events(tmp_path / "FittedRMax_1")
    assert len(witness.seen) > 2
    for number, tag in enumerate(["model/known", "model/transferred", "model/optimistic", "transfer/pairs_modelled"]):
        assert scalars(found, tag) == pytest.approx({step: seen[number] for step, seen in witness.seen.items()})


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
    assert scalars(events(tmp_path / "FittedRMax_1"), "planner/residual") == pytest.approx(witness.seen, abs=1e-6)


def slow_compliance(model):
    """Mean compliance of the chosen mappings with the nearest transitions, from the equations."""
    transfer = model.policy.transfer
    task, source, candidates = transfer.task, transfer.sources[0], transfer.candidates
    bandwidths, d = default_bandwidths(candidates.instances), task.n_variables
    transitions = [
        naive.Transition(row[:d], int(row[-1]), float(row[-2]), row[:d] + row[d : 2 * d])
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


def test_compliance_is_that_of_the_chosen_mapping_with_the_nearest_transitions(transfers, tmp_path):
    witness = Witness(slow_compliance)
    walker(tmp_path, transfers["COMBREL"]).learn(150, [witness, DashboardCallback(scalar_share=1.0)])
    found = scalars(events(tmp_path / "FittedRMax_1"), "transfer/compliance")
    assert len(found) > 1 and found == pytest.approx(witness.seen, rel=1e-5)


def test_entropy_and_number_of_mappings_are_those_of_the_choices(transfers, tmp_path):
    def entropy(model):
        chosen = [c for c in model.policy.transfer.choices() if c >= 0]
        shares = np.array([chosen.count(c) for c in set(chosen)]) / len(chosen)
        return -sum(shares * np.log(shares)), len(shares)

    witness = Witness(entropy)
    walker(tmp_path, transfers["COMBREL"]).learn(200, [witness, DashboardCallback(scalar_share=1.0)])
    found = events(tmp_path / "FittedRMax_1")
    assert scalars(found, "transfer/choice_entropy") == pytest.approx({s: e for s, (e, _) in witness.seen.items()}, abs=1e-6)
    assert scalars(found, "transfer/distinct_mappings") == {s: n for s, (_, n) in witness.seen.items()}


def test_scalars_stay_within_their_share_of_the_time(tmp_path, monkeypatch):
    from sb3_combrel.tensorboard import readings

    def slowly(agent, max_points=0):
        time.sleep(0.02)
        return 0.0

    monkeypatch.setattr(readings, "bellman_residual", slowly)
    began = time.perf_counter()
    walker(tmp_path).learn(3000, DashboardCallback(picture_freq=None, scalar_share=0.1), log_interval=1)
    took = time.perf_counter() - began
    found = events(tmp_path / "FittedRMax_1")
    assert 1 <= len(found.Scalars("planner/residual")) <= 1 + 0.1 * took / 0.02
    assert (
        len(found.Scalars("planner/residual")) == len(found.Scalars("model/known")) < len(found.Scalars("rollout/ep_rew_mean"))
    )


def test_planning_takes_a_share_of_the_time(tmp_path):
    model = walker(tmp_path).learn(200)
    assert all(0.0 < share < 1.0 for share in scalars(events(tmp_path / "FittedRMax_1"), "planner/time_share").values())
    assert not model.agent.timed


def test_samples_are_spread_and_complete_where_there_is_room():
    assert spread(5, 10).tolist() == [0, 1, 2, 3, 4]
    few = spread(1000, 7)
    assert len(set(few)) == 7 and few.max() > 800


def test_nothing_to_measure_gives_nothing(transfers):
    agent = walker(transfer=transfers["COMBREL"]).agent
    assert bellman_residual(agent) == 0.0 and mean_compliance(agent.transfer) is None
    assert mean_compliance(walker(transfer=transfers["TIMBREL"]).agent.transfer) is None
