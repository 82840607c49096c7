"""The agent in plain Python on arrays: without Stable-Baselines3, without Gymnasium."""

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest
from helpers.agents import assert_same_state, make_agent
from helpers.square import FEWEST_STEPS, METHODS, START, evaluate, learn, square_agent, square_source

from sb3_combrel import COMBREL

# Names of methods, and the degree of the local model.
CASES = [("none", 0), ("none", 1), ("TIMBREL pool", 1), ("COMBREL", 0), ("COMBREL drawn", 1)]
DEGREES = pytest.mark.parametrize("degree", [0, 1])


@pytest.fixture(params=CASES, ids=str)
def case(request):
    return request.param


@pytest.fixture
def method(case):
    return case[0]


@pytest.fixture
def degree(case):
    return case[1]


@pytest.mark.parametrize("seed", range(3))
def test_the_agent_learns_the_shortest_plan(seed):
    agent = square_agent(rng=seed)
    lengths = [len(actions) for actions in learn(agent, 25)]
    assert lengths[0] > FEWEST_STEPS and np.median(lengths[-9:]) == FEWEST_STEPS
    assert evaluate(agent) == FEWEST_STEPS and agent.q_values(START).max() == pytest.approx(-FEWEST_STEPS, abs=2.0)


@pytest.mark.parametrize("seed", range(3))
def test_a_kernel_average_finds_a_plan_that_is_nearly_as_short(seed):
    lengths = [len(actions) for actions in learn(square_agent(rng=seed, degree=0, resolution=4), 25)]
    assert lengths[0] > 2 * FEWEST_STEPS and min(lengths) <= FEWEST_STEPS + 2


def test_transfer_from_the_task_itself_saves_the_agent_most_of_the_exploration():
    without, transferring = (sum(map(len, learn(square_agent(method), 5))) for method in ("none", "TIMBREL"))
    assert FEWEST_STEPS * 5 <= transferring < 0.7 * without


def test_the_agent_and_all_that_it_needs_are_imported_without_stable_baselines3():
    # The package's first page imports FittedRMax: an empty module with the same path takes its place.
    code = (
        "import importlib.util, sys, types\n"
        "package = types.ModuleType('sb3_combrel')\n"
        "package.__path__ = importlib.util.find_spec('sb3_combrel').submodule_search_locations\n"
        "sys.modules |= {'sb3_combrel': package, 'stable_baselines3': None, 'torch': None}\n"
        "import sb3_combrel.fitted_rmax.agent\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("method", METHODS)
def test_the_same_seed_gives_the_same_run_and_another_seed_another(method):
    runs = [learn(square_agent(method, seed), 3) for seed in (0, 0, 1)]
    assert runs[0] == runs[1]
    if method != "TIMBREL":
        # What it transfers here leaves hardly any ties, and nothing else is drawn.
        assert runs[0] != runs[2]


@DEGREES
def test_an_agent_of_unknown_actions_tries_each_of_them(degree):
    agent = make_agent(2, 4, degree=degree, model_breadth=0.15, resolution=3)
    assert {agent.act(START) for _ in range(100)} == {0, 1, 2, 3}, "ties are broken at random"
    assert agent.act(START, explore=False) == agent.act(START, explore=False)
    for action in (0, 1, 3):
        agent.update(START, action, -1.0, START, False)
    assert {agent.act(START) for _ in range(20)} == {2}, "the optimistic action comes first"
    assert {agent.sample_action(START) for _ in range(20)} == {2}
    assert agent.act(START, explore=False) != 2, "and an evaluation does not try it"


def test_an_agent_learns_on_from_a_restored_state_as_the_original_bit_for_bit(method, degree):
    agent, restored = square_agent(method, degree=degree), square_agent(method, rng=123, degree=degree)
    learn(agent, 2)
    state = agent.get_state()
    before = copy.deepcopy(state)
    learn(agent, 1)
    for name, array in state.items():
        np.testing.assert_array_equal(array, before[name], err_msg=f"{name} is the agent's own array")
    learn(restored, 1)  # which is forgotten
    restored.set_state(copy.deepcopy(agent.get_state()))
    assert_same_state(restored, agent)
    restored.reseed(agent.rng)
    for state in np.random.default_rng(0).random((20, 2)):
        np.testing.assert_array_equal(restored.q_values(state), agent.q_values(state))
        assert restored.act(state, explore=False) == agent.act(state, explore=False)
    assert learn(restored, 2) == learn(agent, 2)
    assert_same_state(restored, agent)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda agent: pickle.loads(pickle.dumps(agent))], ids=["copy", "pickle"])
@pytest.mark.parametrize("method", ["none", "TIMBREL random", "COMBREL by relevance"])
def test_a_copied_agent_learns_as_the_original_and_apart_from_it(method, copied):
    agent = square_agent(method)
    learn(agent, 2)
    first, second = copied(agent), copied(agent)
    before = copied(agent)
    assert learn(first, 3) == learn(second, 3)
    assert_same_state(first, second)
    assert_same_state(agent, before)


def test_predictions_in_between_change_nothing_that_is_learned_bit_for_bit(method, degree):
    agent, interrupted = square_agent(method, degree=degree), square_agent(method, degree=degree)
    others = np.random.default_rng(5)

    def predict(state):
        for at in (state, others.random(2)):
            interrupted.act(at, explore=False)
            interrupted.sample_action(at)
            interrupted.q_values(at)
        interrupted.statistics()
        interrupted.get_state()

    assert learn(interrupted, 4, before_each=predict) == learn(agent, 4)
    assert_same_state(interrupted, agent)
    assert interrupted.rng.bit_generator.state == agent.rng.bit_generator.state
    assert interrupted.n_sweeps == agent.n_sweeps and interrupted.statistics() == agent.statistics()


@pytest.mark.parametrize("use", ["prior", "instances"])
def test_a_prior_is_not_asked_where_its_instances_have_changed(use, monkeypatch):
    asked = []
    monkeypatch.setattr(COMBREL, "changed", lambda self, known: asked.append(known) or False)
    agent = make_agent(2, 4, COMBREL(square_source(), use=use), model_breadth=0.15, resolution=3)
    learn(agent, 1)
    assert bool(asked) == (use == "instances")


def test_statistics_are_those_of_model_and_planner(method, degree):
    agent = square_agent(method, degree=degree)
    n_steps, figures = sum(map(len, learn(agent, 3))), agent.statistics()
    known, modelled = agent.model.known, agent.mdp.arrays.modelled
    assert figures["model/instances"] == n_steps and figures["model/known"] == known.mean() > 0.0
    assert figures["model/transferred"] == pytest.approx((modelled & ~known).mean())
    assert figures["model/optimistic"] == pytest.approx((~modelled).mean())
    assert (figures["planner/max_value"], figures["planner/gamma"]) == (0.0, 1.0 if agent.rewards.n_ended else 0.99)
    assert all(np.isfinite(value) for value in figures.values())
    assert bool({name for name in figures if name.startswith("transfer/")}) == (method != "none")
    if method != "none":
        assert figures["transfer/instances_used"] > 0
