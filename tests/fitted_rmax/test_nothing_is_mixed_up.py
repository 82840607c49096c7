"""Nothing is taken for something else: after a reset, an interrupt, other scales, in several environments."""

import gymnasium as gym
import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.agents import make_agent
from helpers.walk import Walk, small, walk_source
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, SourceInstances, SparseCodingMapping
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.transfer.methods.experts import MappingExperts

CART = "CartPole-v1"  # without bounds: unit coordinates change as the agent sees more


class Note(BaseCallback):
    """Keeps what ``read`` says of the transfer method after every step."""

    def __init__(self, read):
        super().__init__()
        self.read, self.found = read, []

    def _on_step(self):
        self.found.append(self.read(self.model.transfer))
        return True


@pytest.fixture
def rescaled(monkeypatch):
    """How often unit coordinates were changed."""
    times, before = [], FittedRMaxAgent._rescale
    monkeypatch.setattr(FittedRMaxAgent, "_rescale", lambda self, *given: (times.append(1), before(self, *given))[1])
    return times


def test_a_random_mapping_is_drawn_once_for_the_whole_run(rescaled):
    source = SourceInstances.record(None, CART, 300, seed=0)
    method = TIMBREL(source, "random", mappings="signed_injective", use="prior")
    models = [FittedRMax(CART, transfer=method, seed=seed) for seed in (0, 1)]
    first = [model.transfer.describe_prior() for model in models]
    notes = [Note(lambda transfer: transfer.describe_prior()) for _ in models]
    for model, note in zip(models, notes, strict=True):
        model.learn(150, callback=note)
    assert len(rescaled) > 6 and first[0] != first[1]
    assert [set(note.found) for note in notes] == [{first[0]}, {first[1]}]


def test_experts_and_their_returns_stay_when_unit_coordinates_change(rescaled):
    source = SourceInstances.record(None, CART, 300, seed=0)
    returns = Note(lambda transfer: (list(transfer._numbers), [each.total for each in transfer._ended]))
    model = FittedRMax(CART, transfer=MappingExperts(source, max_experts=3), seed=0).learn(400, callback=returns)
    assert len(rescaled) > 6
    assert len({str(numbers) for numbers, _ in returns.found}) == 1
    made = [info["r"] for info in model.ep_info_buffer]
    assert returns.found[-1][1] == made[: len(returns.found[-1][1])] and len(made) - len(returns.found[-1][1]) <= 1


def test_past_data_are_no_return_of_the_expert_that_acts():
    walk = gym.wrappers.TimeLimit(Walk(limit=1000), 30)
    model = FittedRMax(walk, transfer=MappingExperts(walk_source(), max_experts=2), seed=0).learn(75)
    before = [(each.arm, each.total) for each in model.transfer._all_episodes()]
    model.load_instances(walk_source(100))
    assert [(each.arm, each.total) for each in model.transfer._all_episodes()] == before
    model.learn(60, reset_num_timesteps=False)
    assert {each.total for each in model.transfer._ended} <= {info["r"] for info in model.ep_info_buffer}


class Ending(gym.Env):
    """Each step leads on; an episode ends, or is cut, after ``n`` of them."""

    observation_space, action_space = gym.spaces.Box(0.0, 1.0, (1,)), gym.spaces.Discrete(2)

    def __init__(self, n, terminates):
        self.n, self.terminates = n, terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.k = 0
        return np.float32([0.0]), {}

    def step(self, action):
        self.k += 1
        over = self.k == self.n
        return np.float32([self.k / self.n]), -1.0, over and self.terminates, over and not self.terminates, {}


def test_a_time_limit_of_one_environment_is_no_end_of_another():
    from stable_baselines3.common.vec_env import DummyVecEnv

    source = SourceInstances.record(None, Ending(5, True), 60, seed=0)
    envs = DummyVecEnv([lambda: Ending(5, True), lambda: Ending(5, False)])
    model = FittedRMax(envs, transfer=COMBREL(source), seed=0).learn(40)
    seen = model.transfer.source_prior.transitions
    assert seen.ended[: seen.n].sum() == model.source_instances().terminated.sum() == 4


@pytest.mark.parametrize("degree", [0, 1])
def test_sizes_are_those_of_the_instances_that_are_kept(degree):
    agent = make_agent(1, 1, max_instances=10, degree=degree)
    rng = np.random.default_rng(0)
    for _ in range(200):
        state = rng.random(1)
        agent.update(state, 0, float(rng.normal()), np.clip(state + 0.1 * rng.normal(size=1), 0.0, 1.0), False)
    model = agent.model
    kept = model.instances.effect[0, :10], model.instances.reward[0, :10]
    np.testing.assert_allclose(model._measured[0][0], [np.abs(kept[0]).sum(), np.abs(kept[1]).sum()], atol=1e-9)


def test_an_interrupt_loses_no_pair_that_is_due(monkeypatch):
    model = small(degree=1).learn(60)
    agent, due = model.agent, []

    def interrupted(pairs):
        due.extend(pairs.tolist())
        raise KeyboardInterrupt

    state = np.array([0.5, 0.5])
    with monkeypatch.context() as patched:
        patched.setattr(agent.model, "update_all", interrupted)
        with pytest.raises(KeyboardInterrupt):
            agent.update(state, 0, -1.0, state + 0.01, False)
    asked, fits = [], agent.model.update_all
    monkeypatch.setattr(agent.model, "update_all", lambda pairs: (asked.extend(pairs.tolist()), fits(pairs)))
    agent.update(state + 0.3, 1, -1.0, state + 0.31, False)
    assert due and set(due) <= set(asked)


def test_a_stay_ends_with_the_episode_that_a_new_call_of_learn_breaks_off():
    model = FittedRMax(Ending(10**6, True), seed=0, bounds=(0.0, 1.0))
    for _ in range(3):
        model.learn(10)
        [stay] = model.agent.promises.stays.values()
        assert stay.n_steps == 10
    model.learn(10, reset_num_timesteps=False)
    [stay] = model.agent.promises.stays.values()
    assert stay.n_steps == 20


@pytest.mark.parametrize("seed", [0, None])
def test_drawn_predictions_go_on_after_loading_as_they_would_have(tmp_path, seed):
    model = small(seed=seed)
    state = np.array([0.2, 1.0], dtype=np.float32)
    model.predict(state, deterministic=False)
    model.save(tmp_path / "walk")
    loaded = [FittedRMax.load(tmp_path / "walk") for _ in range(2)]
    drawn = [[int(each.predict(state, deterministic=False)[0]) for _ in range(20)] for each in (model, *loaded)]
    assert drawn[0] == drawn[1] == drawn[2] and len(set(drawn[0])) == 2


def test_rewards_too_small_for_the_plan_are_named():
    class Tiny(Walk):
        def step(self, action):
            state, reward, terminated, truncated, info = super().step(action)
            return state, 1e-5 * reward, terminated, truncated, info

    with pytest.warns(UserWarning, match=r"no reward so far is larger than 1e-05.*pass planning_tolerance=1e-08"):
        small(Tiny(limit=10)).learn(200)


@pytest.mark.parametrize("degree", [0, 1])
def test_what_is_transferred_stays_when_all_is_computed_anew(degree):
    transfer = TIMBREL(walk_source(), InterTaskMapping([0, 1], [0, 1]))
    agent = small(degree=degree, transfer=transfer).learn(40).agent
    before = agent.mdp.arrays.modelled & ~agent.model.known
    agent.rescale(agent.task.scaling, agent.task.bounds)
    after = agent.mdp.arrays.modelled & ~agent.model.known
    assert before.sum() > 100 and (after[before] | agent.model.known[before]).all()


def test_choices_of_grid_points_are_those_of_where_they_are_when_lines_have_moved():
    rng = np.random.default_rng(9)
    agent = small(transfer=COMBREL(naive.random_source(rng, 60, 2, 2), use="instances", min_compliance=0.0)).agent
    for _ in range(40):
        transition = naive.random_transition(rng, 2, 2)
        agent.update(transition.state, transition.action, -1.0, transition.next_state, False)
    method, lines = agent.transfer, np.abs(agent.grid.arrays.lines) ** 1.5
    agent.rescale(agent.task.scaling, agent.task.bounds, lines)
    n_actions, points = agent.task.n_actions, method.task.sample_states
    for action, chosen in enumerate(method.choices().reshape(n_actions, -1)):
        at = method.selected(points, np.full(len(points), action))
        np.testing.assert_array_equal(chosen, at)
    assert len(np.unique(method.choices())) > 4


@pytest.mark.parametrize("degree", [0, 1])
def test_a_model_that_is_saved_before_its_first_step_learns_as_it_would_have(degree, tmp_path):
    models = [small(degree=degree, transfer=TIMBREL(walk_source(), InterTaskMapping([0, 1], [0, 1]))) for _ in range(2)]
    models[1].save(tmp_path / "model")
    models[1] = FittedRMax.load(tmp_path / "model", env=Walk())
    for model in models:
        model.get_env().seed(0)
        model.learn(20)
    modelled = [model.agent.mdp.arrays.modelled for model in models]
    assert modelled[0].mean() > 0.5
    np.testing.assert_array_equal(*modelled)


def test_an_episode_that_an_expert_has_begun_goes_on_when_all_is_computed_anew():
    agent = small(transfer=MappingExperts(walk_source(), max_experts=2)).agent
    states = np.array([[0.3, 0.5], [0.6, 0.5]])
    for environment in (0, 1):
        agent.act(states[environment], environment=environment)
    agent.update(states[0], 0, -1.0, states[0], False, 0)
    agent.rescale(agent.task.scaling, agent.task.bounds)
    agent.update(states[1], 1, -3.0, states[1], True, 1)
    agent.end_episode(False, 1)
    assert [each.total for each in agent.transfer._ended] == [-3.0]


def test_a_visit_that_a_reset_breaks_off_is_no_end_that_did_not_come():
    agent = small(transfer=TIMBREL(walk_source(), InterTaskMapping([0, 1], [0, 1]))).agent
    evidence = agent.transfer._instances.check.evidence
    evidence.note((1.0, -1.0), -1.0, False)
    assert evidence.steps_of_visit == 1
    agent.break_off()
    evidence.note((0.0, -1.0), -1.0, False)
    assert evidence.absent == 0 and evidence.steps_of_visit == 0


def test_a_learned_translation_hears_of_which_environment_a_transition_is():
    agent = small(transfer=SparseCodingMapping(walk_source(), n_random_steps=20)).agent
    rng = np.random.default_rng(0)
    for i in range(30):
        state = rng.random(2)
        agent.update(state, i % 2, -1.0, state, False, i % 3)
        if agent.transfer.translated is not None and i >= 20:
            assert agent.transfer._timbrel.environment == i % 3
    assert agent.transfer.translated is not None


class OneArray(Walk):
    """Returns the same array at each step, as some simulators do."""

    def observe(self):
        if not hasattr(self, "array"):
            self.array = np.zeros(2, dtype=np.float32)
        self.array[:] = super().observe()
        return self.array


def test_q_learning_records_where_it_was_and_not_where_it_is_now():
    found = [SourceInstances.from_q_learning(env, 100, seed=0, total_timesteps=300) for env in (OneArray(), Walk())]
    assert len(np.unique(found[0].states[:, 0])) > 10
    np.testing.assert_array_equal(found[0].states, found[1].states)
    np.testing.assert_array_equal(found[0].next_states, found[1].next_states)


class Named(Walk):
    state_names, action_names = ["place", "height"], ["left", "right"]


class Swapped(Walk):
    state_names, action_names = ["height", "place"], ["left", "right"]


def test_an_environment_with_its_variables_in_another_order_is_another_one(tmp_path):
    model = small(Named())
    with pytest.raises(ValueError, match=r"env must have the state_names of the model, \['place', 'height'\], got \['height'"):
        model.set_env(Swapped())
    assert model.get_env().get_attr("state_names") == [["place", "height"]]
    model.set_env(Walk())
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="is a model of another task than env: env must have the state_names"):
        FittedRMax.load(tmp_path / "model", env=Swapped())


def test_lists_of_pairs_name_their_instances_after_loading_as_well(tmp_path):
    model = small(transfer=COMBREL(walk_source()), max_instances=20).learn(150)
    model.save(tmp_path / "model")
    agent = FittedRMax.load(tmp_path / "model").agent
    instances, pairs, points = agent.model.instances, agent.model.pairs, agent.grid.points()
    fitted = np.flatnonzero(agent.model.known & (pairs.n_new == 0))
    assert instances.size.max() == 20 and len(fitted) > 40
    for pair in fitted:
        action, point = divmod(int(pair), agent.grid.n_points)
        distance = ((instances.state[action, : instances.size[action]] - points[point]) ** 2).sum(axis=1)
        listed = distance[pairs.item[pair, : pairs.length[pair]]]
        np.testing.assert_allclose(listed, np.sort(distance)[: len(listed)], rtol=1e-9)


@pytest.mark.parametrize("use", ["prior", "instances"])
def test_a_mapping_that_is_drawn_once_more_takes_no_random_number_from_learning(tmp_path, use):
    model = small(transfer=TIMBREL(walk_source(), "random", use=use)).learn(60)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model")
    assert loaded.agent.rng.bit_generator.state == model.agent.rng.bit_generator.state


def test_how_low_values_may_get_does_not_depend_on_how_often_all_is_computed_anew():
    agent = small(max_value=-50.0, gamma=0.9).learn(40).agent
    bounds = agent.planner.bounds
    for _ in range(3):
        agent.rescale(agent.task.scaling, agent.task.bounds)
    assert agent.planner.bounds == bounds and bounds[0] < -50.0


@pytest.mark.parametrize("longer", [0.0, 0.2])
def test_pairs_of_all_actions_hear_of_an_end_that_counts_no_more(longer):
    """Action 1 moves farther by ``longer`` than action 0, which ends the episode at 0.9; known first."""
    agent = make_agent(1, 2, max_instances=20)
    for action in (0, 1):
        for x in np.linspace(0.6, 0.85, 20) - longer * action:
            ends = action == 0 and x > 0.84
            to = np.array([x + 0.05 + longer * action])
            agent.update(np.array([x]), action, -100.0 if ends else -1.0, to, bool(ends))
    rewards = agent.mdp.arrays.reward.T.ravel()
    near = np.flatnonzero(agent.model.known & np.isfinite(rewards) & (rewards < -10.0))
    assert len(near[near >= agent.grid.n_points]) > 0
    agent.update(np.array([0.85]), 0, -1.0, np.array([0.9]), False)
    assert len(agent.model.ends.state) == 0
    # At the grid's last point one stays for ever now.
    rewards = agent.mdp.arrays.reward.T.ravel()[near[agent.model.known[near]]]
    assert len(rewards) > 10 and np.isin(np.round(rewards, 6), [-1.0, -np.inf]).all()


@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_vectorised_environment_may_return_one_array_as_well(n_envs):
    models = [small(make_vec_env(which, n_envs, seed=0)).learn(300) for which in (OneArray, Walk)]
    found, right = (model.source_instances() for model in models)
    assert right.terminated.any()
    for name in ("states", "next_states", "terminated"):
        np.testing.assert_array_equal(getattr(found, name), getattr(right, name))
    recorded = [SourceInstances.record(None, make_vec_env(which, n_envs), 200, 0) for which in (OneArray, Walk)]
    np.testing.assert_array_equal(*(source.next_states for source in recorded))


def test_attributes_are_set_and_methods_called_in_a_vectorised_environment_as_without_a_learner():
    vec = DummyVecEnv([lambda: Walk(limit=9)] * 2)
    inner = list(vec.envs)
    model = small(vec).learn(20)
    small(vec)
    vec.set_attr("limit", 5, indices=[1])
    model.get_env().set_attr("hardness", 2.0)
    assert [each.limit for each in inner] == vec.get_attr("limit") == [9, 5]
    assert [each.hardness for each in inner] == [2.0, 2.0] and vec.env_is_wrapped(Walk) == [False, False]
    assert [each.unwrapped for each in vec.envs] == inner == [each.env for each in vec.envs], "and wrapped once"
    vec.reset()
    assert [vec.step([1, 1])[2].tolist() for _ in range(5)][-1] == [False, True]


def test_one_array_in_another_process_is_warned_of():
    env = SubprocVecEnv([OneArray], start_method="spawn")
    try:
        with pytest.warns(UserWarning, match="the last observation of an episode equals the first of the next: .*copy"):
            small(env).learn(60)
        with pytest.warns(UserWarning, match="the last observation of an episode equals the first of the next"):
            SourceInstances.record(None, env, 100, 0)
    finally:
        env.close()


def test_what_told_states_apart_stays_told_when_max_instances_has_removed_it():
    agent, rng = make_agent(2, 2, max_instances=40), np.random.default_rng(0)
    for k in range(400):
        state = rng.random(2)
        agent.update(state, k % 2, -1.0, np.clip(state + np.array([0.05, 0.0]), 0.0, 1.0), k == 20)
    known = agent.model.known.copy()
    assert len(agent.model.ends.state) == 0 and agent.rewards.n_ended == 1
    agent.rescale(agent.task.scaling, agent.task.bounds)
    np.testing.assert_array_equal(agent.model.known, agent.model.own_weight >= agent.model._threshold)
    assert agent.model.known.mean() > 0.99 * known.mean()
