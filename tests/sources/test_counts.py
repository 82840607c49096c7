"""Numbers of instances, episodes and steps: what runs for ever is refused, whole floats are taken."""

import numpy as np
import pytest

from sb3_combrel import SourceInstances
from sb3_combrel.sources import fitted_rmax_source
from sb3_combrel.sources.q_learning import QLearning
from sb3_combrel.sources.source_recorder import SourceRecorder

TASK = "MountainCar-v0"
NO_COUNTS = [float("inf"), float("nan"), 2.5, 1e308, 10**30, 0, -1, True, "3"]


def some_instances():
    return SourceInstances.record(None, TASK, 8, seed=0)


@pytest.mark.parametrize("number", NO_COUNTS)
@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("n_instances", lambda n: SourceInstances.record(None, TASK, n)),
        ("n_instances", lambda n: SourceInstances.from_q_learning(TASK, n)),
        ("total_timesteps", lambda n: SourceInstances.from_q_learning(TASK, 1, total_timesteps=n)),
        ("total_timesteps", lambda n: QLearning(TASK).learn(n)),
        ("n_instances", lambda n: SourceInstances.from_fitted_rmax(TASK, n, max_value=0.0)),
        ("n_episodes", lambda n: SourceInstances.from_fitted_rmax(TASK, 1, n_episodes=n, max_value=0.0)),
    ],
    ids=["record", "Q-learning", "Q-learning steps", "learn", "Fitted R-Max", "Fitted R-Max episodes"],
)
def test_learning_refuses_what_is_no_count(name, call, number):
    with pytest.raises(ValueError, match=rf"{name} must be a whole number from 1 to 1?[\d,]+.*, got "):
        call(number)


@pytest.mark.parametrize("number", [each for each in NO_COUNTS if each not in (1e308, 10**30)])
def test_subsets_and_recorders_refuse_what_is_no_count(number):
    with pytest.raises(ValueError, match="n_instances must be a whole number of at least 1, got"):
        some_instances().subset(number)
    with pytest.raises(ValueError, match="max_instances must be a whole number of at least 1, got"):
        SourceRecorder(number)


def test_whole_floats_are_counts():
    assert len(SourceInstances.record(None, TASK, 8.0, seed=0)) == 8
    learned = SourceInstances.from_q_learning(TASK, 5.0, seed=0, total_timesteps=1e2)
    assert learned.origin["total_timesteps"] == 100
    np.testing.assert_array_equal(learned.states, SourceInstances.from_q_learning(TASK, 5, 0, total_timesteps=100).states)
    assert len(some_instances().subset(3.0)) == 3
    assert len(some_instances().subset(10**30)) == 8


@pytest.mark.parametrize("n_actions", [*NO_COUNTS, None])
def test_source_instances_refuse_a_number_of_actions_that_is_no_count(n_actions):
    some = some_instances()
    with pytest.raises(ValueError, match="n_actions must be a whole number from 1 to 1,000,000"):
        SourceInstances(
            some.states, some.actions, some.rewards, some.next_states, some.terminated, some.low, some.high, n_actions
        )


def test_a_method_of_choice_that_does_not_exist_is_refused_before_learning():
    for learn in (SourceInstances.from_q_learning, SourceInstances.from_fitted_rmax):
        with pytest.raises(ValueError, match="method must be 'random' or 'covering', got 'best'"):
            learn("no such task", 5, method="best")


def test_fitted_rmax_must_have_been_handed_in(monkeypatch):
    monkeypatch.setattr(fitted_rmax_source, "_registered", [])
    with pytest.raises(RuntimeError, match="import sb3_combrel first"):
        SourceInstances.from_fitted_rmax(TASK, 5, n_episodes=1, max_value=0.0)
