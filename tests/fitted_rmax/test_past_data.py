"""Past data of the same task count as the agent's own experience, whatever has kept them."""

import pickle
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from helpers.agents import assert_same_state, make_agent
from helpers.dashboard import NamedWalk
from helpers.walk import GOAL, STRIDE, Walk, walk_source
from stable_baselines3 import DQN
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import COMBREL, FittedRMax, SourceInstances

BOUNDS = ([-1.0, 0.0], [1.0, 2.0])


def model(env=None, **arguments):
    return FittedRMax(Walk() if env is None else env, seed=0, **arguments)


def rightwards(state):
    return 1


def test_what_is_loaded_is_known_at_once_and_planned_with():
    loaded = model().load_instances(walk_source())
    assert loaded.agent.model.n_instances == 60 and loaded.num_timesteps == 0
    mean, _ = evaluate_policy(loaded, Monitor(Walk()), n_eval_episodes=5)
    fewest = np.ceil((GOAL + 0.6) / STRIDE)
    assert mean >= -fewest, "without a step in the environment"
    assert loaded.agent.act(loaded.policy.to_unit(np.array([0.0, 1.0]))) == 1, "learning goes on from there"


def test_it_is_what_the_agent_would_know_had_it_made_the_transitions_itself():
    """But for planning, which is done once; with fixed scales, as these are followed at once too."""
    source = walk_source()
    one, other = (model(bounds=BOUNDS, planning_tolerance=1e-9) for _ in range(2))
    one.load_instances(source)
    unit = other.policy.to_unit
    for k in range(len(source)):
        state, after = unit(source.states[k]), unit(source.next_states[k])
        other.agent.update(state, int(source.actions[k]), float(source.rewards[k]), after, bool(source.terminated[k]))
    one_state, other_state = one.agent.get_state(), other.agent.get_state()
    np.testing.assert_array_equal(one_state["instances"], other_state["instances"])
    np.testing.assert_array_equal(one_state["rewards"], other_state["rewards"])
    np.testing.assert_array_equal(one.agent.model.known, other.agent.model.known)


def forms(tmp_path, source):
    """The same instances in all ways in which they may be kept."""
    source.save(tmp_path / "log.npz")
    source.to_table().to_csv(tmp_path / "log.csv", index=False)
    other = model().load_instances(source)
    other.save(tmp_path / "walk.zip")
    yield from (source, source.to_table(), tmp_path / "log.npz", str(tmp_path / "log"), tmp_path / "log.csv", other)
    yield tmp_path / "walk.zip"


def test_however_it_was_kept_it_is_the_same(tmp_path):
    wanted = model().load_instances(walk_source()).agent
    for kept in forms(tmp_path, walk_source()):
        found = model().load_instances(kept).agent
        assert found.model.n_instances == 60, kept
        np.testing.assert_allclose(found.planner.values, wanted.planner.values, atol=1e-6, err_msg=str(kept))
        given = model(instances=kept)
        assert given.instances is None
        assert_same_state(given.agent, found)


def test_columns_and_actions_are_found_by_their_names(tmp_path):
    source = model(NamedWalk()).load_instances(walk_source()).source_instances()
    assert source.state_names == NamedWalk.state_names and source.action_names == NamedWalk.action_names
    turned = source.to_table()[::-1][sorted(source.to_table().columns)]
    turned["action"] = [source.action_names[a] for a in turned["action"]]
    loaded = model(NamedWalk()).load_instances(turned)
    np.testing.assert_allclose(loaded.source_instances().states, source.states[::-1], atol=1e-12)
    np.testing.assert_array_equal(loaded.source_instances().actions, source.actions[::-1])
    swapped = replace(
        source,
        **{name: getattr(source, name)[:, ::-1] for name in ("states", "next_states")},
        **{name: getattr(source, name)[::-1] for name in ("low", "high", "state_names", "action_names")},
        actions=1 - source.actions,
    )
    found = model(NamedWalk()).load_instances(swapped).source_instances()
    np.testing.assert_allclose(found.states, source.states, atol=1e-12)
    np.testing.assert_array_equal(found.actions, source.actions)


def test_a_controller_acts_in_the_models_environment():
    loaded = model(Walk(first=1)).load_instances(lambda state: 2, n_instances=40)
    assert loaded.agent.model.n_instances == 40 and loaded.num_timesteps == 0
    assert set(loaded.source_instances().actions) == {1}, "numbered from 0 on"
    loaded.learn(100)
    assert loaded.agent.model.n_instances == 140
    by_model = model().load_instances(loaded_dqn(Walk(), 0), n_instances=20)
    assert by_model.agent.model.n_instances == 20


def loaded_dqn(env, steps):
    dqn = DQN("MlpPolicy", env, seed=0, learning_starts=10, buffer_size=500)
    return dqn.learn(steps) if steps else dqn


def test_a_controller_of_continuous_actions_is_refused_with_what_to_return():
    with pytest.raises(ValueError, match=r"got 0\.3 in the state .*number of the nearest"):
        model().load_instances(lambda state: 0.3)


def test_a_replay_buffer_is_read_transition_by_transition():
    dqn = loaded_dqn(Walk(limit=4), 90)
    for given in (dqn, dqn.replay_buffer):
        found = model().load_instances(given).source_instances()
        size = dqn.replay_buffer.size()
        np.testing.assert_allclose(found.states, dqn.replay_buffer.observations[:size, 0], atol=1e-6)
        np.testing.assert_allclose(found.next_states, dqn.replay_buffer.next_observations[:size, 0], atol=1e-6)
        limits = dqn.replay_buffer.timeouts[:size, 0] > 0.5
        assert limits.any() and not found.terminated[limits].any(), "a time limit is no end"


def test_own_experience_is_written_and_read(tmp_path):
    first = model().learn(60)
    first.source_instances().save(tmp_path / "experience.npz")
    second = model().load_instances(tmp_path / "experience.npz")
    np.testing.assert_allclose(second.source_instances().states, first.source_instances().states, atol=1e-12)
    np.testing.assert_array_equal(second.source_instances().terminated, first.source_instances().terminated)


def test_found_scales_discount_and_optimism_follow():
    source = walk_source()
    positive = replace(source, rewards=source.rewards + 3.0)
    loaded = model().load_instances(positive)
    assert (loaded.agent.mdp.gamma, loaded.agent.planner.bounds[1]) == pytest.approx((0.99, 200.0))
    assert loaded.policy.scales.observed[1, 0] == pytest.approx(source.next_states[:, 0].max())
    narrow = replace(source, states=0.1 * source.states, next_states=0.1 * source.next_states)
    assert model().load_instances(narrow).policy.scales.scaling.high[0] < 0.2


def test_a_transfer_method_observes_it_as_well():
    with_transfer = model(transfer=COMBREL(walk_source())).load_instances(walk_source(100))
    assert with_transfer.transfer.source_prior.n_observed == 100
    assert with_transfer.transfer.report()
    with_transfer.learn(50)


def test_returns_are_of_one_episode_where_past_data_are_cut(tmp_path):
    """Two halves of different episodes: no return may be counted over both."""
    agent = make_agent(1, 2, COMBREL(walk_line()))
    steps = [(np.array([x]), 1, 0.0, np.array([x + 0.05]), False) for x in (0.1, 0.15, 0.6, 0.65)]
    agent.take_in(steps)
    [episode] = agent.transfer.source_prior._episodes.values()
    assert [float(state[0]) for state, *_ in episode] == [0.6, 0.65]


def walk_line(n=60):
    at = np.linspace(0.0, 0.9, n)[:, None]
    return SourceInstances(at, np.arange(n) % 2, np.zeros(n), at + 0.05, np.zeros(n, dtype=bool), [0.0], [1.0], 2)


def test_a_loaded_model_keeps_what_it_was_given(tmp_path):
    given = model(instances=walk_source()).learn(40)
    given.save(tmp_path / "walk.zip")
    again = FittedRMax.load(tmp_path / "walk.zip", env=Walk())
    assert_same_state(again.agent, given.agent)
    assert again.instances is None and again.agent.model.n_instances == 100


def other_task():
    source = walk_source()
    return SourceInstances(
        np.hstack([source.states] * 2),
        source.actions,
        source.rewards,
        np.hstack([source.next_states] * 2),
        source.terminated,
        np.full(4, -1.0),
        np.full(4, 2.0),
        2,
    )


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (other_task(), ValueError, "2 state variables.*got 4.*COMBREL"),
        (walk_source().to_table().drop(columns="reward"), ValueError, "no column 'reward'"),
        ("nothere.npz", FileNotFoundError, "nothere.npz"),
        ("nothere", FileNotFoundError, "nothere"),
        (7, ValueError, "instances must be .* got 7"),
        (COMBREL, ValueError, "instances must be"),
        ([7] * 1_000, ValueError, "instances must be .{,300}$"),
    ],
)
def test_what_cannot_be_loaded_is_named_and_nothing_changes(given, error, message):
    learner = model()
    with pytest.raises(error, match=message):
        learner.load_instances(given)
    assert learner.agent.model.n_instances == 0


def test_a_table_with_other_columns_is_read_with_the_names_of_the_states():
    table = walk_source().to_table().assign(second=0.5, next_second=0.5)
    with pytest.raises(ValueError, match=r"got 3 .*'second'.*from_table\(table, state_names="):
        model().load_instances(table)
    chosen = SourceInstances.from_table(table, state_names=["s0", "s1"])
    assert model().load_instances(chosen).agent.model.n_instances == 60


def test_other_names_are_another_task():
    source = model(NamedWalk()).load_instances(walk_source()).source_instances()
    renamed = replace(source, state_names=("height", "mass"))
    with pytest.raises(ValueError, match=r"got \('height', 'mass'\), without \['place'\].*COMBREL"):
        model(NamedWalk()).load_instances(renamed)


def test_names_that_a_task_was_given_are_names_too():
    source = model().load_instances(walk_source()).source_instances()
    assert source.state_names == ("s0", "s1")
    turned = source.to_table()[["s1", "s0", "action", "reward", "next_s1", "next_s0", "terminated"]]
    np.testing.assert_allclose(model().load_instances(turned).source_instances().states, source.states, atol=1e-12)


def test_without_names_of_its_own_a_task_takes_variables_in_their_order_and_says_so():
    named = replace(walk_source(), state_names=("height", "mass"))
    with pytest.warns(UserWarning, match="in their order: height as s0, mass as s1"):
        found = model().load_instances(named).source_instances()
    np.testing.assert_allclose(found.states, named.states, atol=1e-12)


def test_states_in_other_units_are_refused_and_nothing_is_taken_in():
    fits, table = model(bounds=None), walk_source().to_table()
    with pytest.raises(
        ValueError, match=r"units of the task, got s0 from -\d\S* to \d\S*; the observation space has it from -1 to 1"
    ):
        fits.load_instances(table.assign(s0=100 * table["s0"]))
    with pytest.raises(ValueError, match="units of the task, got s0 from -999 to"):
        fits.load_instances(table.assign(next_s0=table["next_s0"].mask(table["terminated"], -999.0)))
    assert fits.agent.model.n_instances == 0 and not np.isfinite(fits.policy.scales.observed).any()


def test_data_without_an_end_are_of_a_task_without_one_as_after_a_time_limit():
    goes_on, ends = walk_source(), model().load_instances(walk_source())
    found = model().load_instances(goes_on.to_table().assign(terminated=False))
    assert (found.agent.rewards.gamma, ends.agent.rewards.gamma) == (0.99, 1.0)
    found.load_instances(walk_source())
    assert found.agent.rewards.gamma == found.agent.mdp.gamma == 1.0


def test_an_end_that_pays_more_than_max_value_is_told():
    paid = replace(walk_source(), rewards=np.where(walk_source().terminated, 100.0, -1.0))
    with pytest.warns(UserWarning, match="a return of 100 was observed"):
        model(max_value=0.0, gamma=0.99).load_instances(paid)


def test_what_was_recorded_where_actions_count_from_1_is_not_suspected(recwarn):
    model(Walk(first=1)).load_instances(lambda state: 2, 40)
    assert not [each for each in recwarn if "count from" in str(each.message)]
    with pytest.warns(UserWarning, match="those of the environment count from 1"):
        model(Walk(first=1)).load_instances(replace(walk_source(), actions=np.ones(60, dtype=int)))
    with pytest.warns(UserWarning, match="actions from 0 to 0, .*; those of the environment count from -1"):
        model(Walk(first=-1)).load_instances(replace(walk_source(), actions=np.zeros(60, dtype=int)))


class Doors(gym.Env):
    """A walk on a line to one end; at the other nobody has been, as the log has never gone there."""

    observation_space, action_space = gym.spaces.Box(0.0, 1.0, (1,)), gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = 0.4
        return np.float32([self.at]), {}

    def step(self, action):
        self.at = float(np.clip(self.at + (0.05 if action else -0.05), 0.0, 1.0))
        return np.float32([self.at]), -1.0, self.at > 0.9, False, {}


def test_before_it_has_acted_itself_its_policy_keeps_to_what_the_data_show(tmp_path):
    rng = np.random.default_rng(0)
    log = SourceInstances.record(lambda state: int(rng.random() < 0.8), Doors(), 200, seed=0)
    given = FittedRMax(gym.wrappers.TimeLimit(Doors(), 50), seed=0).load_instances(log)
    assert not given.agent.has_acted
    given.save(tmp_path / "given")
    for each in (given, FittedRMax.load(tmp_path / "given")):
        mean, _ = evaluate_policy(each, Monitor(gym.wrappers.TimeLimit(Doors(), 50)), n_eval_episodes=1)
        assert mean >= -11.0, "the shortest way"
    values = given.agent.planner.values.copy()
    given.agent.act(np.array([0.5]), explore=False)
    np.testing.assert_array_equal(given.agent.planner.values, values)
    given.learn(1)
    given.save(tmp_path / "given")
    assert given.agent.has_acted and FittedRMax.load(tmp_path / "given").agent.has_acted


class Interrupted(Walk):
    """Its tenth step is made and interrupted."""

    def __init__(self):
        super().__init__()
        self.n = 0

    def step(self, action):
        made = super().step(action)
        self.n += 1
        if self.n == 10:
            raise KeyboardInterrupt
        return made


def test_a_step_that_was_interrupted_is_no_transition():
    stopped = model(Interrupted())
    with pytest.raises(KeyboardInterrupt):
        stopped.learn(50)
    stopped.learn(20, reset_num_timesteps=False)
    found = stopped.source_instances()
    assert len(found) == 9 + 20
    moved = np.abs(found.next_states - found.states)[:, 0]
    assert (moved <= STRIDE + 1e-6).all(), "a step at most"


def test_a_pickle_is_never_read(tmp_path):
    """Nor run: reading one may do anything."""
    (tmp_path / "buffer.pkl").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(ValueError, match=r"pickle.*load_from_pkl"):
        model().load_instances(tmp_path / "buffer.pkl")


def test_files_that_others_read_are_named_with_who_reads_them(tmp_path):
    for name in ("log.parquet", "log.json", "log.TSV"):
        (tmp_path / name).write_text("x")
        with pytest.raises(ValueError, match=f"{name} must be .*read it with pandas, and pass the DataFrame"):
            model().load_instances(tmp_path / name)
    (tmp_path / "log.csv").write_text("s0,action,reward\n")
    with pytest.raises(ValueError, match=r"or read a table with SourceInstances.from_table\(path\)"):
        SourceInstances.load(tmp_path / "log.csv")
    for folder in (tmp_path, "."):
        with pytest.raises(ValueError, match="instances must be a file, got the folder"):
            model().load_instances(folder)
    empty = ReplayBuffer(10, Walk().observation_space, Walk().action_space)
    with pytest.raises(ValueError, match="must hold transitions, got a ReplayBuffer that is empty"):
        model().load_instances(empty)


def test_what_is_no_file_of_past_data_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match="no file"):
        model().load_instances(tmp_path / "nothing.pkl")
    DQN("MlpPolicy", Walk(), buffer_size=10).save(tmp_path / "dqn")
    with pytest.raises(ValueError, match=r"a model of another algorithm, of stable_baselines3\.dqn\.policies"):
        model().load_instances(tmp_path / "dqn.zip")


def test_without_experience_there_is_nothing_to_write():
    with pytest.raises(ValueError, match="no experience yet"):
        model().source_instances()


def test_a_buffer_that_forgets_where_episodes_ended_is_refused():
    walk = Walk()
    buffer = ReplayBuffer(
        10, walk.observation_space, walk.action_space, optimize_memory_usage=True, handle_timeout_termination=False
    )
    at = np.array([[0.0, 1.0]])
    buffer.add(at, at, np.array([[1]]), np.array([-1.0]), np.array([False]), [{}])
    with pytest.raises(ValueError, match="optimize_memory_usage"):
        model().load_instances(buffer)


def test_a_discount_that_past_data_change_is_that_of_every_row():
    learned = model().learn(20)
    assert learned.agent.mdp.gamma == 1.0
    learned.load_instances(walk_source().to_table().assign(terminated=False).head(1))
    rows, gamma = learned.agent.mdp.arrays, learned.agent.mdp.gamma
    used = np.arange(rows.weight.shape[2]) < rows.length[..., None]
    assert gamma == 0.99 and rows.modelled.sum() > 50
    assert np.where(used, rows.weight, 0.0).sum(axis=2).max() <= gamma + 1e-12


class Back(gym.Env):
    """To and fro along a line without bounds, for ever."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,))
    action_space = gym.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = self.np_random.uniform(-1.0, 1.0, 2)
        return np.float32(self.x), {}

    def step(self, action):
        self.x = np.clip(self.x + np.array([0.2 * (2 * action - 1), 0.0]), -1.0, 1.0)
        return np.float32(self.x), -1.0, False, False, {}


def test_the_first_end_that_is_loaded_makes_known_what_suffices_then():
    agent = (
        model(gym.wrappers.TimeLimit(Back(), 20))
        .learn(120)
        .load_instances(SourceInstances([[0.0, 0.0]], [0], [-1.0], [[0.05, 0.0]], [True], [-1, -1], [1, 1], 2))
        .agent
    )
    enough = agent.model.own_weight >= agent.model._threshold
    assert enough.sum() > 1000
    np.testing.assert_array_equal(agent.model.known, enough)


def test_pairs_of_all_actions_hear_of_ends_that_are_loaded_later():
    rng, agent = np.random.default_rng(1), make_agent(2, 2, gamma=0.99, max_value=0.0)
    states = rng.random((400, 2))
    agent.take_in([(state, 0, -1.0, np.clip(state - [0.04, 0.0], 0.0, 1.0), False) for state in states])
    agent.take_in([(np.array([0.46, 0.5]), 1, -50.0, np.array([0.5, 0.5]), True)])
    near = (np.abs(agent.grid.points() - 0.5) < 0.02).all(axis=1)
    fitted_at = agent.model.pairs.fitted_at[: agent.grid.n_points]
    assert near.sum() > 3 and agent.model.known[: agent.grid.n_points][near].all()
    np.testing.assert_array_equal(fitted_at[near], 401)
