"""What a user would pick instead: settings, prefilled replay buffers, evaluation, and the same result for the same job."""

import pickle
import sys
from dataclasses import replace
from itertools import permutations
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import DQN

from sb3_combrel import TIMBREL, InterTaskMapping, SourceInstances
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.experiments.paper import baselines
from sb3_combrel.experiments.paper.baselines import evaluation_steps, make_model
from sb3_combrel.experiments.tasks import icub_arm, mountain_car
from sb3_combrel.runs.job import make_env
from sb3_combrel.sources.transitions import Transitions
from sb3_combrel.transfer.base import TargetTask

CAR, ARM = mountain_car.TARGET_ID, icub_arm.TARGET_ID
CONFIGURATIONS = Path(__file__).resolve().parents[2] / "zoo_configs"
# Long enough for some updates of the network, which begin after 1000 steps.
SHORT = baselines.BaselineJob(group="car", method=baselines.PLAIN, env=CAR, seed=3, n_steps=1200, max_episode_steps=50)


@pytest.fixture(scope="module")
def source():
    make_env(mountain_car.SOURCE_ID).close()
    return SourceInstances.from_q_learning(mountain_car.SOURCE_ID, n_instances=300, seed=0, total_timesteps=3000)


@pytest.fixture(scope="module")
def prefilled_job(source):
    return replace(SHORT, method=baselines.PREFILLED, seed=1, n_steps=400, source=source)


def learnt(job, monkeypatch):
    """The result of a job, and the model after it."""
    made = []
    with monkeypatch.context() as patch:
        patch.setattr(baselines, "make_model", lambda *given: made.append(make_model(*given)) or made[-1])
        result = job.carry_out()
    return replace(result, seconds=0.0), made[0]


def same(first, second):
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def weights_of(model):
    return [tensor.numpy() for tensor in model.policy.state_dict().values()]


@pytest.mark.parametrize("name", (baselines.PLAIN, baselines.QUANTILE))
@pytest.mark.parametrize("env_id", tuple(baselines.HYPERPARAMETERS))
def test_hyperparameters_are_those_of_the_zoo(name, env_id):
    yaml = pytest.importorskip("yaml")
    pytest.importorskip("sb3_contrib")
    settings = yaml.safe_load(
        (CONFIGURATIONS / {baselines.PLAIN: "dqn.yml", baselines.QUANTILE: "qrdqn.yml"}[name]).read_text()
    )[env_id]
    assert settings.pop("n_timesteps") > 0 and settings.pop("policy") == "MlpPolicy"
    assert settings.pop("env_wrapper") == [{"gymnasium.wrappers.RescaleObservation": {"min_obs": -1.0, "max_obs": 1.0}}]
    first_rate = float(settings.pop("learning_rate").removeprefix("lin_"))
    network = eval(settings.pop("policy_kwargs"))
    # Nothing of the file is left out, and nothing is added.
    assert baselines.HYPERPARAMETERS[env_id] == {**settings, "learning_rate": first_rate}
    job = replace(SHORT, method=name, env=env_id)
    env = job.make_env()
    assert np.all(env.observation_space.low == -1.0) and np.all(env.observation_space.high == 1.0)
    model, frequency = make_model(job, env), settings.pop("train_freq")
    assert model.train_freq.frequency == frequency and {key: getattr(model, key) for key in settings} == settings
    assert [model.lr_schedule(left) for left in (1.0, 0.5, 0.0)] == pytest.approx([first_rate, first_rate / 2, 0.0])
    assert model.policy.net_arch == network.pop("net_arch")
    assert {key: getattr(model.policy, key) for key in network} == network


LONG = [pytest.param(name, marks=[pytest.mark.long] * (name != "DQN")) for name in baselines.ALGORITHMS]


@pytest.mark.parametrize("algorithm", LONG)
def test_the_same_job_has_the_same_result(algorithm, source, monkeypatch):
    if algorithm == baselines.QUANTILE:
        pytest.importorskip("sb3_contrib")
    job = replace(SHORT, method=algorithm, source=source if algorithm in baselines.OF_SOURCE else None)
    first, model = learnt(job, monkeypatch)
    np.random.seed(7)
    again, other = learnt(pickle.loads(pickle.dumps(job)), monkeypatch)
    assert first == again and sum(first.steps) <= first.n_steps == 1200
    # Most episodes are cut off, so what they have in common says little; the networks say more.
    assert same(weights_of(model), weights_of(other))
    assert np.array_equal(model.replay_buffer.observations, other.replay_buffer.observations)
    with job.make_env() as env:
        assert not same(weights_of(model), weights_of(make_model(job, env)))


def test_evaluation_does_not_interfere(monkeypatch):
    result, model = learnt(SHORT, monkeypatch)
    assert len(result.more["evaluations"]) == 10
    monkeypatch.setattr(baselines, "evaluation_steps", lambda total: [])
    without, other = learnt(SHORT, monkeypatch)
    assert same(weights_of(model), weights_of(other)) and result.steps == without.steps
    assert without.more["evaluations"] == []


def test_episodes_are_those_of_the_task():
    result = replace(SHORT, env=ARM, n_steps=130, max_episode_steps=30).carry_out()
    assert (result.steps, result.returns, result.terminated) == ([30] * 4, [-30.0] * 4, [False] * 4)
    assert result.more["evaluations"][-1] == [130, -30.0, 0.0]


def test_settings_tell_hyperparameters_and_sources_apart(prefilled_job, monkeypatch):
    before = prefilled_job.settings()
    assert before == prefilled_job.settings()
    assert replace(prefilled_job, source=prefilled_job.source.subset(200, seed=0)).settings()["source"] != before["source"]
    monkeypatch.setitem(baselines.HYPERPARAMETERS, CAR, {**baselines.HYPERPARAMETERS[CAR], "gamma": 0.5})
    assert prefilled_job.settings() != before


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
    states, ends = np.array([[0.95, 2.0], [0.25, 5.0]]), np.array([[1.2, 1.0], [0.25, 5.5]])
    instances = SourceInstances(
        states, np.array([0, 1]), np.array([-3.0, 7.0]), ends, np.array([False, True]), np.zeros(2), np.array([1.0, 10.0]), 2
    )
    low, high = np.array([0.0, -50.0, 1.0]), np.array([4.0, 50.0, 3.0])
    transfer = TIMBREL(instances, InterTaskMapping(state=(1, None, 0), action=(1, 0, 1)), breadth=0.1, use="instances")
    transfer.bind(target_task(low, high), np.random.default_rng(0))
    # Unit coordinates of the first: 0.2 of the source's second variable, near 0.95 of its first. The second state is that of
    # no instance; the third one is the second instance's.
    visited_states = np.array([[0.8, 20.0, 2.98], [3.9, 20.0, 2.9], [2.0, -10.0, 1.5]])
    ignored = np.zeros(3)
    outcomes = ignored, visited_states, ignored > 0
    found = baselines.translate(
        transfer, Transitions(visited_states, np.zeros(3, dtype=np.int64), *outcomes, low, high, 3, (), (), {})
    )
    # Effects: 0.25 of the first variable's range, -0.1 of the second's; and 0.05 of the second's. Ends are within the bounds.
    expected = {
        (0.8, 1): ([0.8 - 0.4, 20.0, 3.0], -3.0, False),
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
    found = baselines.translate(
        transfer, Transitions(at, np.zeros(4, dtype=np.int64), none, at, none > 0, low, high, 3, (), (), {})
    )
    assert [column.shape for column in found[:5]] == [(0, 3), (0,), (0,), (0, 3), (0,)]


def test_combrels_translations_are_source_instances_seen_through_some_mapping(prefilled_job, source):
    _, found = baselines.prefill(prefilled_job)
    own = baselines.prefill(replace(prefilled_job, method=baselines.OWN))[1]
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
        fits = np.abs(np.clip(starts[:, None] + translated, 0.0, 1.0) - ends[:, None]).max(axis=2) < 1e-9
        fits &= (found.rewards[:, None] == source.rewards) & (found.terminated[:, None] == source.terminated)
        explained |= fits.any(axis=1)
    assert explained.all()


def test_the_control_is_what_really_happened(prefilled_job):
    episodes, own = baselines.prefill(replace(prefilled_job, method=baselines.OWN))
    assert len(own.states) == episodes.steps.sum()
    with make_env(CAR) as env:
        for start, action, end, reward in zip(own.states[:40], own.actions, own.next_states, own.rewards, strict=False):
            env.reset(options={"state": start})
            state, now, *_ = env.step(int(action))
            np.testing.assert_allclose(state, end, atol=1e-6)
            assert now == reward


@pytest.mark.parametrize("algorithm", baselines.OF_SOURCE)
def test_the_buffer_holds_them_before_learning_and_their_steps_count(algorithm, prefilled_job, monkeypatch):
    job, seen = replace(prefilled_job, method=algorithm), {}
    learn = DQN.learn

    def watched(model, *arguments, **others):
        buffer = model.replay_buffer
        seen.update(size=buffer.size(), starts=buffer.observations[: buffer.size(), 0].copy())
        return learn(model, *arguments, **others)

    monkeypatch.setattr(DQN, "learn", watched)
    result = job.carry_out()
    episodes, found = baselines.prefill(job)
    assert seen["size"] == len(found.states) > 0
    with make_env(CAR) as env:
        low, high = env.observation_space.low, env.observation_space.high
    np.testing.assert_allclose(seen["starts"], 2.0 * (found.states - low) / (high - low) - 1.0, atol=1e-6)
    assert result.steps[:2] == episodes.steps.tolist() and result.returns[:2] == episodes.returns.tolist()
    assert sum(result.steps) == result.n_steps == 400
    assert [row[0] for row in result.more["evaluations"]] == [n for n in evaluation_steps(400) if n > episodes.steps.sum()]


def test_each_is_learnt_from_on_its_own():
    """Returns over five steps would otherwise add up rewards of transitions that have nothing to do with one another."""
    rng = np.random.default_rng(0)
    with SHORT.make_env() as env:
        low, high = env.unwrapped.observation_space.low, env.unwrapped.observation_space.high
        states, ends = (rng.uniform(low, high, (50, 4)) for _ in range(2))
        rewards, terminated = np.arange(50.0), rng.random(50) < 0.3
        given = Transitions(states, rng.integers(5, size=50), rewards, ends, terminated, low, high, 5, (), (), {})
        model = make_model(SHORT, env)
        baselines.fill(model.replay_buffer, given, env)
        batch = model.replay_buffer.sample(400)
    assert model.replay_buffer.size() == 50
    # Rewards are their numbers.
    rows = batch.rewards.numpy()[:, 0].astype(int)
    assert len(set(rows)) == 50 and np.array_equal(batch.dones.numpy()[:, 0], terminated[rows])
    assert np.array_equal(batch.actions.numpy()[:, 0], given.actions[rows])
    np.testing.assert_allclose(batch.discounts.numpy(), 0.99, atol=1e-6)
    np.testing.assert_allclose(batch.next_observations.numpy(), (2.0 * (ends - low) / (high - low) - 1.0)[rows], atol=1e-6)


def test_the_greedy_policy_is_what_is_evaluated():
    with gym.make("CartPole-v1") as env:
        evaluator = baselines.GreedyEvaluator([10, 50, 70], env, seed=5, n_before=40)
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
    # The first was before this learning.
    assert evaluator.evaluations == [[50, np.mean(returns), 1.0], [70, np.mean(returns), 1.0]]


@pytest.mark.parametrize("total", (1, 7, 400, 300_000))
def test_evaluations_are_evenly_spaced_on_a_logarithmic_axis(total):
    steps = evaluation_steps(total)
    assert steps[-1] == total and steps == sorted(set(steps)) and steps[0] >= 1
    if total > 10_000:
        assert len(steps) == 10 and np.ptp(np.diff(np.log(steps))) < 1e-3


@pytest.mark.parametrize(
    ("reached", "expected"),
    [((1.0, 0.8, 1.0, 1.0), 40), ((1.0, 1.0, 1.0, 1.0), 10), ((0.0, 1.0, 1.0, 0.8), np.inf), ((), np.inf)],
)
def test_steps_from_which_on_the_goal_is_always_reached(reached, expected):
    assert baselines.always_reached_from(list(zip((10, 20, 40, 80), (-1.0,) * 4, reached, strict=False))) == expected


class TestBadInput:
    @pytest.mark.parametrize("wrong", [{"method": "SAC"}, {"method": baselines.PREFILLED}, {"source": "any"}])
    def test_unknown_algorithms_and_sources_that_are_missing_or_given_in_vain(self, wrong):
        with pytest.raises(ValueError, match=r"method must be one of DQN, QR-DQN, .*, with a source for .* only, got"):
            replace(SHORT, **wrong)

    def test_prefilling_must_leave_steps(self, prefilled_job):
        with pytest.raises(ValueError, match=r"n_steps must be more than the 100 steps .*got 60"):
            replace(prefilled_job, n_steps=60).carry_out()

    def test_without_sb3_contrib_the_extra_is_named(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "sb3_contrib", None)
        with pytest.raises(ImportError, match=r"pip install 'sb3-combrel\[experiments\]'"):
            replace(SHORT, method=baselines.QUANTILE).carry_out()
