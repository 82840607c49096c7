"""The agent in plain Python on arrays: without Stable-Baselines3, without Gymnasium."""

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest
from gymnasium import spaces
from helpers.agents import assert_same_state, make_agent
from helpers.square import FEWEST_STEPS, METHODS, START, evaluate, learn, square_agent, square_source
from hypothesis import given
from hypothesis import strategies as st

from sb3_combrel import COMBREL
from sb3_combrel.fitted_rmax.agent import DECAY_AFTER_EPISODES, THRESHOLD_DECAY
from sb3_combrel.fitted_rmax.loop_detection import EXPLOIT, EXPLORE, OPTIMISTIC, ORDER, EpisodeMemory
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.planning.corrections import MAX_VISITS

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


@DEGREES
def test_the_agent_learns_the_shortest_plan(degree):
    agent = square_agent(degree=degree)
    lengths = [len(actions) for actions in learn(agent, 25)]
    assert lengths[0] > FEWEST_STEPS and lengths[-3:] == [FEWEST_STEPS] * 3
    assert evaluate(agent) == FEWEST_STEPS and agent.q_values(START).max() == pytest.approx(-FEWEST_STEPS, abs=2.0)


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
    assert runs[0] == runs[1] != runs[2]


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
    learn(agent, 1, episode=2)
    for name, array in state.items():
        np.testing.assert_array_equal(array, before[name], err_msg=f"{name} is the agent's own array")
    learn(restored, 1)  # which is forgotten
    restored.set_state(copy.deepcopy(agent.get_state()))
    assert_same_state(restored, agent)
    restored.reseed(agent.rng)
    for state in np.random.default_rng(0).random((20, 2)):
        np.testing.assert_array_equal(restored.q_values(state), agent.q_values(state))
        assert restored.act(state, explore=False) == agent.act(state, explore=False)
    assert learn(restored, 2, episode=3) == learn(agent, 2, episode=3)
    assert_same_state(restored, agent)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda agent: pickle.loads(pickle.dumps(agent))], ids=["copy", "pickle"])
@pytest.mark.parametrize("method", ["none", "TIMBREL random", "COMBREL by relevance"])
def test_a_copied_agent_learns_as_the_original_and_apart_from_it(method, copied):
    agent = square_agent(method)
    learn(agent, 2)
    first, second = copied(agent), copied(agent)
    before = copied(agent)
    assert learn(first, 3, episode=2) == learn(second, 3, episode=2)
    assert_same_state(first, second)
    assert_same_state(agent, before)


def test_predictions_in_between_change_nothing_that_is_learned_bit_for_bit(method, degree):
    agent, interrupted = square_agent(method, degree=degree), square_agent(method, degree=degree)
    memory, others = EpisodeMemory(), np.random.default_rng(5)

    def predict(state):
        for at in (state, others.random(2)):
            interrupted.act(at, explore=False)
            interrupted.act(at, explore=False, memory=memory)
            interrupted.sample_action(at)
            interrupted.q_values(at)
        interrupted.statistics()
        interrupted.get_state()

    assert learn(interrupted, 4, before_each=predict) == learn(agent, 4)
    assert_same_state(interrupted, agent)
    assert interrupted.rng.bit_generator.state == agent.rng.bit_generator.state
    assert interrupted.n_backups == agent.n_backups and interrupted.statistics() == agent.statistics()


@DEGREES
def test_time_limits_lower_the_threshold_of_the_model_and_that_is_saved(degree):
    agent = square_agent(degree=degree, exploration_threshold=2.0)
    learn(agent, 12)
    known = agent.model.known.copy()
    for _ in range(DECAY_AFTER_EPISODES - agent.n_truncated):
        agent.end_episode(truncated=True)
    np.testing.assert_array_equal(agent.model.known, known)
    assert agent.statistics()["model/threshold"] == 2.0, "the first ones change nothing"
    for _ in range(40):
        agent.end_episode(truncated=True)
    threshold = agent.statistics()["model/threshold"]
    assert threshold == pytest.approx(2.0 * THRESHOLD_DECAY**40)
    # What part of the weight at exact states a grid point needs (see models.local_linear).
    np.testing.assert_array_equal(agent.model.known, known | (agent.model.own_weight >= (1.0, 0.5)[degree] * threshold))
    assert agent.model.known.sum() > known.sum()
    np.testing.assert_array_equal(agent.mdp.arrays.modelled, agent.model.known)
    restored = square_agent(degree=degree, exploration_threshold=2.0)
    restored.set_state(agent.get_state())
    assert restored.statistics()["model/threshold"] == threshold
    np.testing.assert_array_equal(restored.model.known, agent.model.known)
    agent.n_truncated = 10**6
    agent.end_episode(truncated=True)
    min_weight = agent.model_settings.min_weight
    assert (agent.model.known == (agent.model.own_weight >= min_weight)).all(), "in the end any instance that counts suffices"


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
    assert figures["model/optimistic"] == pytest.approx((~modelled).mean()) and figures["model/threshold"] == 1.0
    assert figures["planner/corrections"] == len(agent.get_state()["corrections"])
    assert figures["planner/queued"] == agent.planner.n_queued and all(np.isfinite(value) for value in figures.values())
    assert bool({name for name in figures if name.startswith("transfer/")}) == (method != "none")
    if method != "none":
        assert figures["transfer/instances_used"] > 0


# An evaluation that is caught in a loop notices it, where its caller hands on the state that ``predict`` returns.
def modes(steps, gamma):
    """How actions are chosen at each of some (cell, value, reward), and after the last."""
    memory, seen = EpisodeMemory(), []
    for cell, value, reward in steps:
        seen.append(ORDER[memory.attempt])
        memory.note(cell, value, reward, gamma)
    return [*seen, ORDER[memory.attempt]]


@given(st.floats(0.8, 1.0), st.floats(0.01, 100.0), st.integers(1, 7), st.booleans())
def test_an_episode_caught_in_a_loop_changes_how_actions_are_chosen_again_and_again(gamma, size, n_cells, sparse):
    """Costs along the way, or a reward that is far away: the value should rise, and doesn't."""
    if sparse and gamma > 0.99:
        gamma = 0.99
    value, reward = (size, 0.0) if sparse else (-size, -size)
    seen = modes([(n % n_cells, value, reward) for n in range(n_cells * (3 * MAX_VISITS + 10))], gamma)
    assert seen[: n_cells * MAX_VISITS] == [EXPLOIT] * n_cells * MAX_VISITS
    changes = [mode for mode, before in zip(seen[1:], seen[:-1], strict=True) if mode != before]
    assert changes[:3] == [OPTIMISTIC, EXPLORE, EXPLOIT]


@given(st.floats(0.9, 1.0), st.floats(0.6, 1.5))
def test_an_episode_that_makes_progress_is_not_caught_in_a_loop(gamma, fraction):
    """However small the steps are: values rise by what is expected, or by a little less."""
    value, steps = -60.0, []
    for _ in range(40):
        steps.append(("here", value, -1.0))
        value += fraction * (1.0 + (1.0 - gamma) * value)
    assert set(modes(steps, gamma)) == {EXPLOIT}


def test_a_pole_in_balance_is_not_caught_in_a_loop():
    """Each step brings 1, and what is to come is worth 100, with a discount of 0.99; the model errs by some percent."""
    values = np.random.default_rng(0).normal(97.0, 3.0, size=1000)
    assert set(modes([("upright", value, 1.0) for value in values], 0.99)) == {EXPLOIT}


HERE = np.array([0.3])


@pytest.fixture
def policy():
    """Its model predicts, wrongly, that action 0 leads on at 0.3; action 1 is unknown."""
    line = spaces.Box(0.0, 1.0, (1,), dtype=np.float64)
    policy = FittedRMaxPolicy(line, spaces.Discrete(2), model_breadth=0.1, resolution=3, rng=np.random.default_rng(0))
    for _ in range(3):
        policy.agent.update(HERE, 0, -1.0, np.array([0.32]), False)
    return policy


def test_predict_with_a_state_tries_another_action_where_it_is_caught_in_a_loop(policy):
    state, actions = None, []
    for _ in range(4 * MAX_VISITS):
        action, state = policy.predict(HERE, state, deterministic=True)
        actions.append(int(action))
    assert actions[: MAX_VISITS + 1] == [0] * (MAX_VISITS + 1) and 1 in actions


def test_predict_without_a_state_always_chooses_the_same_action(policy):
    actions = {int(policy.predict(HERE, deterministic=True)[0]) for _ in range(4 * MAX_VISITS)}
    assert actions == {0}


def test_predict_forgets_visits_when_an_episode_begins(policy):
    state = None
    for step in range(4 * MAX_VISITS):
        action, state = policy.predict(HERE, state, np.array([step % MAX_VISITS == 0]), deterministic=True)
        assert action == 0


def test_predict_counts_visits_of_each_environment_by_itself(policy):
    state, acted = None, []
    for step in range(4 * MAX_VISITS):
        elsewhere = [step / (4 * MAX_VISITS)]
        actions, state = policy.predict(np.array([HERE, elsewhere]), state, np.zeros(2, dtype=bool), deterministic=True)
        alone = policy.predict(np.array([elsewhere]), deterministic=True)[0]
        assert actions[1] == alone[0]
        acted.append(int(actions[0]))
    assert 1 in acted


def test_predict_refuses_a_state_that_it_did_not_return_for_as_many_observations(policy):
    _, of_one = policy.predict(HERE, deterministic=True)
    for wrong in (of_one, (np.zeros(2),), ()):
        with pytest.raises(ValueError, match="state must be None or what predict returned for 2 observation"):
            policy.predict(np.array([HERE, HERE]), wrong, deterministic=True)
    assert policy.predict(np.array([HERE, HERE]), deterministic=True)[0].tolist() == [0, 0]
