"""What a user would pick instead: settings, prefilled replay buffers, evaluation, and the same result for the same job."""

import pickle
import sys
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from sb3_combrel.experiments.runs import make_task
from stable_baselines3 import DQN

from sb3_combrel import TIMBREL, InterTaskMapping, SourceInstances
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.experiments import baselines, icub_arm, mountain_car
from sb3_combrel.experiments.paper.baselines import (
    ALGORITHMS,
    HYPERPARAMETERS,
    OWN,
    PLAIN,
    PREFILLED,
    QUANTILE,
    BaselineJob,
    Evaluations,
    GreedyEvaluator,
    evaluation_steps,
    fill,
    learn,
    make_env,
    make_model,
    prefill,
    translate,
)
from sb3_combrel.sources.transitions import Transitions
from sb3_combrel.transfer.base import TargetTask

CAR, ARM = mountain_car.TARGET_ID, icub_arm.TARGET_ID
CONFIGURATIONS = Path(__file__).resolve().parents[2] / "zoo_configs"
# Long enough for some updates of the network, which begin after 1000 steps.
SHORT = BaselineJob(PLAIN, CAR, seed=3, total_timesteps=1200, max_episode_steps=50)


@pytest.fixture(scope="module")
def source():
    make_task(mountain_car.SOURCE_ID).close()
    return SourceInstances.from_q_learning(mountain_car.SOURCE_ID, n_instances=300, seed=0, total_timesteps=3000)


@pytest.fixture(scope="module")
def prefilled_job(source):
    return BaselineJob(PREFILLED, CAR, seed=1, total_timesteps=400, max_episode_steps=50, source=source)


def learnt_models(job, monkeypatch):
    """The result of a job, and the model after it."""
    made = []
    with monkeypatch.context() as patch:
        patch.setattr(baselines, "make_model", lambda *given: made.append(make_model(*given)) or made[-1])
        result = learn(job)
    return result, made[0]


def same(first, second):
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def weights_of(model):
    return [tensor.numpy() for tensor in model.policy.state_dict().values()]


@pytest.mark.parametrize("name", (PLAIN, QUANTILE))
@pytest.mark.parametrize("env_id", tuple(HYPERPARAMETERS))
def test_hyperparameters_are_those_of_the_zoo(name, env_id):
    yaml = pytest.importorskip("yaml")
    pytest.importorskip("sb3_contrib")
    file = CONFIGURATIONS / {PLAIN: "dqn.yml", QUANTILE: "qrdqn.yml"}[name]
    settings = yaml.safe_load(file.read_text())[env_id]
    assert settings.pop("n_timesteps") > 0
    assert settings.pop("policy") == "MlpPolicy"
    assert settings.pop("env_wrapper") == [{"gymnasium.wrappers.RescaleObservation": {"min_obs": -1.0, "max_obs": 1.0}}]
    first_rate = float(settings.pop("learning_rate").removeprefix("lin_"))
    network = eval(settings.pop("policy_kwargs"))
    # Nothing of the file is left out, and nothing is added.
    ours = dict(HYPERPARAMETERS[env_id])
    assert ours.pop("learning_rate") == first_rate
    assert ours == settings
    job = BaselineJob(name, env_id, 0, 100, 50)
    env = make_env(job)
    assert np.all(env.observation_space.low == -1.0) and np.all(env.observation_space.high == 1.0)
    model = make_model(job, env)
    frequency = settings.pop("train_freq")
    assert model.train_freq.frequency == frequency
    assert {key: getattr(model, key) for key in settings} == settings
    assert [model.lr_schedule(left) for left in (1.0, 0.5, 0.0)] == pytest.approx([first_rate, first_rate / 2, 0.0])
    assert model.policy.net_arch == network.pop("net_arch")
    assert {key: getattr(model.policy, key) for key in network} == network


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_the_same_job_has_the_same_result(algorithm, source, monkeypatch):
    if algorithm == QUANTILE:
        pytest.importorskip("sb3_contrib")
    job = replace(SHORT, algorithm=algorithm, source=source if algorithm in (PREFILLED, OWN) else None)
    first, model = learnt_models(job, monkeypatch)
    np.random.seed(7)
    again, other = learnt_models(pickle.loads(pickle.dumps(job)), monkeypatch)
    assert same(first.episodes, again.episodes) and same(first.evaluations, again.evaluations)
    # Most episodes are cut off, so what they have in common says little; the networks say more.
    assert same(weights_of(model), weights_of(other))
    assert np.array_equal(model.replay_buffer.observations, other.replay_buffer.observations)
    _, of_other_seed = learnt_models(replace(job, seed=4), monkeypatch)
    assert not same(weights_of(model), weights_of(of_other_seed))
    assert not np.array_equal(model.replay_buffer.observations, of_other_seed.replay_buffer.observations)


def test_the_network_learns_and_evaluation_does_not_interfere(monkeypatch):
    result, model = learnt_models(SHORT, monkeypatch)
    with make_env(SHORT) as env:
        assert not same(weights_of(model), weights_of(make_model(SHORT, env)))
    assert len(result.evaluations.steps) == 10
    monkeypatch.setattr(baselines, "evaluation_steps", lambda total: [])
    without, other = learnt_models(SHORT, monkeypatch)
    assert same(weights_of(model), weights_of(other)) and same(result.episodes, without.episodes)
    assert len(without.evaluations.steps) == 0


def test_episodes_are_those_of_the_task():
    result = learn(BaselineJob(PLAIN, ARM, 0, 130, 30))
    assert result.episodes.steps.tolist() == [30] * 4 and result.prefilled is None
    assert result.episodes.returns.tolist() == [-30.0] * 4 and not result.episodes.terminated.any()
    assert result.evaluations.steps[-1] == 130 and result.evaluations.returns[-1] == -30.0


def test_steps_of_prefilling_count(prefilled_job):
    result = learn(prefilled_job)
    episodes, _ = prefill(prefilled_job)
    n_first = len(episodes.steps)
    assert n_first == baselines.PREFILLINGS[CAR].n_episodes
    assert same((column[:n_first] for column in result.episodes), episodes)
    n_before = episodes.steps.sum()
    assert result.episodes.steps.sum() == 400
    assert result.evaluations.steps.tolist() == [steps for steps in evaluation_steps(400) if steps > n_before]


def target_task(low, high, threshold=0.5):
    scaling = StateScaling(low, high)
    return TargetTask(
        scaling=scaling,
        n_actions=3,
        sample_states=np.full((1, scaling.n_variables), 0.5),
        exploration_threshold=threshold,
        min_weight=0.01,
        min_fraction=0.01,
        state_names=("a", "b", "c"),
        action_names=("0", "1", "2"),
    )


def test_an_instance_is_translated_as_by_hand():
    # The source's variables range over 1 and 10, the target's over 4, 100 and 2.
    states, ends = np.array([[0.5, 2.0], [0.25, 5.0]]), np.array([[0.75, 1.0], [0.25, 5.5]])
    instances = SourceInstances(
        states, np.array([0, 1]), np.array([-3.0, 7.0]), ends, np.array([False, True]), np.zeros(2), np.array([1.0, 10.0]), 2
    )
    low, high = np.array([0.0, -50.0, 1.0]), np.array([4.0, 50.0, 3.0])
    transfer = TIMBREL(instances, InterTaskMapping(state=(1, None, 0), action=(1, 0, 1)), breadth=0.1, use="instances")
    transfer.bind(target_task(low, high), np.random.default_rng(0))
    # Unit coordinates of the first: 0.2 of the source's second variable, 0.5 of its first. The second state is that of no
    # instance; the third one is the second instance's.
    visited_states = np.array([[0.8, 20.0, 2.0], [3.9, 20.0, 2.9], [2.0, -10.0, 1.5]])
    ignored = np.zeros(3)
    outcomes = ignored, visited_states, ignored > 0
    found = translate(transfer, Transitions(visited_states, np.zeros(3, dtype=np.int64), *outcomes, low, high, 3, (), (), {}))
    # Effects: 0.25 of the first variable's range, -0.1 of the second's; and 0.05 of the second's.
    expected = {
        (0.8, 1): ([0.8 - 0.4, 20.0, 2.0 + 0.5], -3.0, False),
        (2.0, 0): ([2.0 + 0.2, -10.0, 1.5], 7.0, True),
        (2.0, 2): ([2.0 + 0.2, -10.0, 1.5], 7.0, True),
    }
    assert len(found.states) == len(expected)
    for state, action, reward, end, terminated in zip(
        found.states, found.actions, found.rewards, found.next_states, found.terminated, strict=True
    ):
        by_hand = expected.pop((state[0], action))
        np.testing.assert_allclose(end, by_hand[0], atol=1e-12)
        assert (reward, terminated) == by_hand[1:]


def test_where_nothing_is_transferred_nothing_is_translated(source):
    low, high = np.zeros(3), np.ones(3)
    transfer = TIMBREL(source, InterTaskMapping(state=(0, None, 1), action=(0, 0, 0)), breadth=0.01, use="instances")
    transfer.bind(target_task(low, high, threshold=1e6), np.random.default_rng(0))
    at, none = np.full((4, 3), 0.5), np.zeros(4)
    found = translate(transfer, Transitions(at, np.zeros(4, dtype=np.int64), none, at, none > 0, low, high, 3, (), (), {}))
    assert [column.shape for column in found[:5]] == [(0, 3), (0,), (0,), (0, 3), (0,)]


def test_what_is_translated_stays_within_the_bounds():
    states, ends = np.array([[0.9]]), np.array([[1.0]])
    one = np.ones(1)
    instances = SourceInstances(states, np.array([0]), -one, ends, one > 2, 0 * one, one, 1)
    transfer = TIMBREL(instances, InterTaskMapping(state=(0, None, None), action=(0, 0, 0)), breadth=0.5, use="instances")
    low, high = np.zeros(3), np.array([5.0, 1.0, 1.0])
    transfer.bind(target_task(low, high), np.random.default_rng(0))
    at = np.array([[4.75, 0.5, 0.5]])
    visited = Transitions(at, np.zeros(1, dtype=np.int64), -one, at, one > 2, low, high, 3, (), (), {})
    np.testing.assert_allclose(translate(transfer, visited).next_states, [[5.0, 0.5, 0.5]] * 3)


def test_combrels_translations_are_source_instances_seen_through_some_mapping(prefilled_job, source):
    _, found = prefill(prefilled_job)
    own = prefill(replace(prefilled_job, algorithm=OWN))[1]
    assert len(found.states) > len(own.states) / 2
    assert {tuple(state) for state in found.states} <= {tuple(state) for state in own.states}
    scaling = StateScaling(found.low, found.high)
    ends, starts = scaling.to_unit(found.next_states), scaling.to_unit(found.states)
    effects = source.scaling.to_unit(source.next_states) - source.scaling.to_unit(source.states)
    explained = np.zeros(len(starts), dtype=bool)
    # "injective": each source variable is that of one target variable, the two others stay.
    for first, second in permutations(range(4), 2):
        translated = np.zeros((len(effects), 4))
        translated[:, first], translated[:, second] = effects.T
        predicted = np.clip(starts[:, None] + translated, 0.0, 1.0)
        fits = np.abs(predicted - ends[:, None]).max(axis=2) < 1e-9
        fits &= (found.rewards[:, None] == source.rewards) & (found.terminated[:, None] == source.terminated)
        explained |= fits.any(axis=1)
    assert explained.all()


def test_the_control_is_what_really_happened(prefilled_job):
    episodes, own = prefill(replace(prefilled_job, algorithm=OWN))
    assert len(own.states) == episodes.steps.sum()
    with make_task(CAR) as env:
        for start, action, end, reward in zip(own.states[:40], own.actions, own.next_states, own.rewards, strict=False):
            env.reset(options={"state": start})
            state, now, *_ = env.step(int(action))
            np.testing.assert_allclose(state, end, atol=1e-6)
            assert now == reward


@pytest.mark.parametrize("algorithm", (PREFILLED, OWN))
def test_the_buffer_holds_them_before_learning(algorithm, prefilled_job, monkeypatch):
    job = replace(prefilled_job, algorithm=algorithm)
    seen = {}

    def watched(model, *arguments, **others):
        buffer = model.replay_buffer
        seen.update(size=buffer.size(), starts=buffer.observations[: buffer.size(), 0].copy())
        return DQN_LEARN(model, *arguments, **others)

    DQN_LEARN = DQN.learn
    monkeypatch.setattr(DQN, "learn", watched)
    result = learn(job)
    found = prefill(job)[1]
    assert same(result.prefilled[:5], found[:5])
    assert seen["size"] == len(found.states) > 0
    scaled = 2.0 * (found.states - found.low) / (found.high - found.low) - 1.0
    np.testing.assert_allclose(seen["starts"], scaled, atol=1e-6)


def test_each_is_learnt_from_on_its_own():
    """Returns over five steps would otherwise add up rewards of transitions that have nothing to do with one another."""
    job = replace(SHORT, total_timesteps=10)
    rng = np.random.default_rng(0)
    with make_env(job) as env:
        low, high = env.unwrapped.observation_space.low, env.unwrapped.observation_space.high
        states, ends = (rng.uniform(low, high, (50, 4)) for _ in range(2))
        rewards, terminated = np.arange(50.0), rng.random(50) < 0.3
        given = Transitions(states, rng.integers(5, size=50), rewards, ends, terminated, low, high, 5, (), (), {})
        model = make_model(job, env)
        fill(model.replay_buffer, given, env)
        batch = model.replay_buffer.sample(400)
    assert model.replay_buffer.size() == 50
    # Rewards are their numbers.
    rows = batch.rewards.numpy()[:, 0].astype(int)
    assert len(set(rows)) == 50
    assert np.array_equal(batch.dones.numpy()[:, 0], terminated[rows])
    assert np.array_equal(batch.actions.numpy()[:, 0], given.actions[rows])
    np.testing.assert_allclose(batch.discounts.numpy(), 0.99, atol=1e-6)
    np.testing.assert_allclose(batch.next_observations.numpy(), (2.0 * (ends - low) / (high - low) - 1.0)[rows], atol=1e-6)


def test_the_greedy_policy_is_what_is_evaluated():
    with gym.make("CartPole-v1") as env:
        evaluator = GreedyEvaluator([10, 50, 70], env, seed=5, n_before=40)
        # It does not learn in so few steps, so it can be asked again afterwards.
        model = DQN("MlpPolicy", "CartPole-v1", seed=0, learning_starts=1000, device="cpu").learn(60, evaluator)
        returns = []
        for episode in range(5):
            observation, _ = env.reset(seed=5 if episode == 0 else None)
            returns.append(0.0)
            ended = False
            while not ended:
                values = model.q_net(model.policy.obs_to_tensor(observation)[0])
                observation, reward, terminated, truncated, _ = env.step(int(values.argmax()))
                returns[-1] += float(reward)
                ended = terminated or truncated
    assert len(set(returns)) > 1
    found = evaluator.evaluations
    # The first was before this learning.
    assert found.steps.tolist() == [50, 70]
    assert found.returns.tolist() == [np.mean(returns)] * 2 and found.reached.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("total", (1, 7, 400, 300_000))
def test_evaluations_are_evenly_spaced_on_a_logarithmic_axis(total):
    steps = evaluation_steps(total)
    assert steps[-1] == total and steps == sorted(set(steps)) and steps[0] >= 1
    if total > 10_000:
        assert len(steps) == 10
        assert np.ptp(np.diff(np.log(steps))) < 1e-3


@pytest.mark.parametrize(
    "reached, expected",
    (
        ([1.0, 0.8, 1.0, 1.0], 40.0),
        ([1.0, 1.0, 1.0, 1.0], 10.0),
        ([0.0, 1.0, 1.0, 0.8], np.inf),
        ([0.0, 0.0, 0.0, 1.0], 80.0),
        ([], np.inf),
    ),
)
def test_steps_from_which_on_the_goal_is_always_reached(reached, expected):
    steps = np.array([10, 20, 40, 80])[: len(reached)]
    assert Evaluations(steps, -np.ones(len(steps)), np.array(reached)).always_reached_from() == expected


@pytest.mark.parametrize(
    "wrong, message",
    (
        ({"algorithm": "SAC"}, "algorithm must be one of DQN, QR-DQN, .*got 'SAC'"),
        ({"env_id": "CartPole-v1"}, f"env_id must be one of {CAR}, {ARM}, got 'CartPole-v1'"),
        ({"seed": -1}, "seed must be .*got -1"),
        ({"total_timesteps": 0}, "total_timesteps must be .*got 0"),
        ({"max_episode_steps": 2.5}, "max_episode_steps must be .*got 2.5"),
        ({"algorithm": PREFILLED}, "source must be SourceInstances with algorithm='DQN prefilled', got None"),
    ),
)
def test_wrong_jobs_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        replace(SHORT, **wrong)


def test_a_source_that_would_not_be_used_is_refused(source):
    with pytest.raises(ValueError, match="source must be None with algorithm='DQN'"):
        replace(SHORT, source=source)


def test_prefilling_must_leave_steps(prefilled_job):
    with pytest.raises(ValueError, match=r"total_timesteps must be more than the 100 steps .*got 60"):
        learn(replace(prefilled_job, total_timesteps=60))


def test_without_a_source_there_is_nothing_to_fill_in():
    with pytest.raises(ValueError, match="algorithm must be one of DQN prefilled, DQN prefilled with own, got 'DQN'"):
        prefill(SHORT)


def test_there_is_no_source_for_other_tasks():
    with pytest.raises(ValueError, match=r"env_id must be one of .*got 'CartPole-v1'"):
        baselines.learn_source("CartPole-v1")


def test_without_sb3_contrib_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    with pytest.raises(ImportError, match=r"pip install 'sb3-combrel\[experiments\]'"):
        learn(replace(SHORT, algorithm=QUANTILE))
