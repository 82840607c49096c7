"""A model of somebody else's, of a few lines of NumPy, does all that the kernel average does."""

import inspect

import numpy as np
import pytest
import torch as th
from helpers.walk import GOAL, STRIDE, Walk, small, walk_source
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import TIMBREL, FittedRMax, InterTaskMapping
from sb3_combrel.models.base import Model, Predictions


class NearestNeighbour(Model):
    """Predicts what the nearest instance of the action did; its weight is 1 within the kernel breadth, 0 beyond."""

    def predict(self, states, actions):
        n, d = states.shape
        found = Predictions(np.zeros(n), np.zeros(n), np.zeros((n, 1)), np.zeros((n, 1, d)))
        for action in np.unique(actions):
            size = self.instances.size[action]
            if size == 0:
                continue
            rows = np.flatnonzero(actions == action)
            apart = np.linalg.norm(states[rows][:, None] - self.instances.state[action, :size], axis=2)
            nearest = apart.argmin(axis=1)
            found.weight[rows] = apart.min(axis=1) <= self.settings.model_breadth
            found.reward[rows] = self.instances.reward[action, nearest]
            found.probability[rows, 0] = ~self.instances.terminated[action, nearest]
            found.effect[rows, 0] = self.instances.effect[action, nearest]
        return found


TRANSFERS = {"none": lambda: None, "TIMBREL": lambda: TIMBREL(walk_source(), InterTaskMapping([0, 1], [0, 1]))}


@pytest.fixture(params=TRANSFERS)
def transfer(request):
    return TRANSFERS[request.param]


def third_party(transfer, env=None, **kwargs):
    return small(env, transfer=transfer(), policy_kwargs={"model_class": NearestNeighbour}, **kwargs)


def test_a_third_party_model_has_at_most_forty_lines():
    assert len(inspect.getsource(NearestNeighbour).splitlines()) <= 40
    assert NearestNeighbour.__abstractmethods__ == frozenset() and Model.__abstractmethods__ == {"predict"}
    assert [name for name in vars(NearestNeighbour) if not name.startswith("_")] == ["predict"]


def test_a_third_party_model_learns_the_shortest_plan(transfer):
    model = third_party(transfer).learn(300)
    assert isinstance(model.agent.model, NearestNeighbour)
    for start in (-0.55, -0.32, -0.05):
        fewest = int(np.floor((GOAL - start) / STRIDE)) + 1
        mean, deviation = evaluate_policy(model, Monitor(Walk(start=start)), n_eval_episodes=2)
        assert mean == pytest.approx(-fewest, abs=1.0) and deviation == 0.0
    figures = model.agent.statistics()
    assert figures["model/instances"] == 300
    assert 0.0 < figures["model/known"] == model.agent.model.known.mean()


def test_a_third_party_model_is_saved_loaded_and_learns_on_as_the_original(transfer, tmp_path):
    env = Walk(start=-0.4)  # each episode starts in the same state, so that runs can be compared
    model = third_party(transfer, env)
    while not (model._episode_num and model._last_episode_starts[0]):
        model.learn(1, reset_num_timesteps=False)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Walk(start=-0.4))
    assert isinstance(loaded.agent.model, NearestNeighbour)
    assert_same_parameters(loaded, model)
    for one in (loaded, model):
        one.learn(100, reset_num_timesteps=False)
    assert_same_parameters(loaded, model)
    assert loaded.agent.statistics()["model/instances"] > 100
    model.policy.save(tmp_path / "policy")
    policy = type(model.policy).load(tmp_path / "policy")
    assert isinstance(policy.agent.model, NearestNeighbour)
    observations = np.column_stack([np.linspace(-1.0, 1.0, 21), np.ones(21)]).astype(np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    np.testing.assert_array_equal(policy.predict(observations, deterministic=True)[0], expected)


def assert_same_parameters(one, other):
    one, other = one.get_parameters()["policy"], other.get_parameters()["policy"]
    assert one.keys() == other.keys()
    for name, tensor in one.items():
        assert th.equal(tensor, other[name]), name


def test_beyond_max_instances_a_third_party_model_replaces_its_oldest_instances(tmp_path):
    model = third_party(TRANSFERS["none"], max_instances=15).learn(150)
    agent = model.agent
    expected = [np.empty((0, 2))] * 2
    rng = np.random.default_rng(0)
    for _ in range(60):
        state, action = rng.random(2), int(rng.integers(2))
        agent.update(state, action, -1.0, state, False)
        expected[action] = np.vstack([expected[action], state])[-15:]
    for action, states in enumerate(expected):
        assert len(states) == 15
        own = agent.model.instances.state[action, : agent.model.instances.size[action]]
        assert {tuple(state) for state in own} == {tuple(state) for state in states}
    model.save(tmp_path / "model")
    again = FittedRMax.load(tmp_path / "model").agent
    for one in (agent, again):
        one.update(np.array([0.5, 0.5]), 0, -1.0, np.array([0.5, 0.5]), False)
    states = [{tuple(state) for state in one.model.instances.state[0, :15]} for one in (agent, again)]
    assert states[0] == states[1] == {tuple(state) for state in [*expected[0][1:], (0.5, 0.5)]}, "also after loading"
