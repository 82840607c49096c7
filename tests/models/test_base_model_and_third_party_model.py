"""The defaults of the base class of models, which need ``predict`` alone, against the kernel average and plain loops."""

import numpy as np
import pytest
import torch as th
from helpers import kernel_models, linear_models
from helpers.naive_fitted_rmax import Instance, kept_instances
from helpers.walk import GOAL, STRIDE, Walk, small, walk_source
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_combrel import TIMBREL, FittedRMax, InterTaskMapping
from sb3_combrel.common.transferred import TransferredInstances
from sb3_combrel.models.base import Model, Predictions
from sb3_combrel.models.kernel_average import KernelAverage

slow_and_repeatable = settings(deadline=None, derandomize=True, max_examples=10)
MAX_KEPT = 60


class NaiveKernelAverage(Model):
    """The kernel average in plain loops, from ``predict`` alone."""

    def predict(self, states, actions):
        s, n, periodic = self.settings, len(states), self.grid.arrays.periodic.tolist()
        found = Predictions(np.zeros(n), np.zeros(n), np.zeros((n, MAX_KEPT)), np.zeros((n, MAX_KEPT, self.grid.n_variables)))
        for row, (state, action) in enumerate(zip(states, actions, strict=True)):
            instances = [
                Instance(row[:d], action, row[-2], row[:d] + row[d : 2 * d], bool(row[-1]), periodic)
                for d, row in ((self.grid.n_variables, row[1:]) for row in self.rows_of(action))
            ]
            kept = kept_instances(state, instances, s.model_breadth, s.min_weight, s.min_fraction, periodic)
            total = sum(w for _, w in kept)
            # Known for ever: by instances that suffice for a list before nearer ones came.
            everything = kept_instances(state, instances, s.model_breadth, s.min_weight, 0.0, periodic)
            least = s.min_fraction * s.exploration_threshold / (1.0 + s.min_fraction)
            was_known = sum(w for _, w in everything if w >= least) >= s.exploration_threshold
            found.weight[row] = max(total, s.exploration_threshold) if was_known else total
            for k, (number, w) in enumerate(kept):
                found.reward[row] += w / total * instances[number].reward
                found.probability[row, k] = 0.0 if instances[number].terminated else w / total
                found.effect[row, k] = instances[number].effect
        return found

    def rows_of(self, action):
        rows = self.instances.rows()
        return rows[rows[:, 0] == action]


class SomeInstances:
    """Transferred instances that depend on state and action alone; for some pairs there are none.

    What it returns is larger than what was asked for, and full of values that must not be read.
    """

    use, max_instances = "instances", 4

    def __init__(self, points, threshold):
        self.points, self.threshold = points, threshold

    def transferred(self, states, actions, own_weight):
        n, d = states.shape
        given = TransferredInstances(
            length=np.full(n + 3, -7, dtype=np.int64),
            weight=np.full((n + 3, self.max_instances), np.nan),
            effect=np.full((n + 3, self.max_instances, d), np.nan),
            reward=np.full((n + 3, self.max_instances), np.nan),
            terminated=np.ones((n + 3, self.max_instances), dtype=np.bool_),
        )
        for row, (state, action) in enumerate(zip(states, actions, strict=True)):
            rng = np.random.default_rng([*np.round(state * 1000).astype(int) % 10**6, int(action)])
            length = given.length[row] = rng.integers(self.max_instances + 1)
            given.weight[row, :length] = rng.random(length) + self.threshold
            given.effect[row, :length] = rng.normal(0.0, 0.2, (length, d)) * (rng.random(length) < 0.8)[:, None]
            given.reward[row, :length] = rng.normal(size=length)
            given.terminated[row, :length] = rng.random(length) < 0.3
        return given

    def transferred_to_sample(self, points, actions, own_weight):
        return self.transferred(self.points[points], actions, own_weight)


problems = st.tuples(
    st.sampled_from(
        [grid for grid in kernel_models.GRIDS if grid not in (((3, 2), 0), ((1, 1, 1), 1), kernel_models.PERIODIC_GRIDS[0])]
    ),
    st.sampled_from([kernel for kernel in kernel_models.KERNELS if kernel["min_fraction"] > 0.02]),
    st.integers(0, 10**6),
    st.integers(0, 20),
    st.sampled_from([1.0, 0.9]),
    st.booleans(),
)


def both(problem):
    """The kernel average and its naive version, which have learned the same."""
    grid, kernel, seed, n, gamma, transfers = problem
    made = []
    for model_class in (KernelAverage, NaiveKernelAverage):
        model = kernel_models.make_model(grid, kernel, gamma, model_class=model_class)
        if transfers:
            model.transfer = SomeInstances(model.grid.points(), 1.0)
        kernel_models.learn(model, kernel_models.random_transitions(seed, len(grid[0]), n))
        model.update_all(np.arange(len(model.known)))
        made.append(model)
    return made


@slow_and_repeatable
@given(problems, st.integers(0, 10**6))
def test_rows_and_predictions_by_the_base_class_agree_with_those_of_the_kernel_average(problem, seed):
    model, naive = both(problem)
    np.testing.assert_allclose(naive.own_weight, model.own_weight, rtol=1e-9)
    np.testing.assert_array_equal(naive.known, model.known)
    np.testing.assert_array_equal(naive.mdp.arrays.modelled, model.mdp.arrays.modelled)
    np.testing.assert_array_equal(naive.mdp.arrays.n_optimistic, model.mdp.arrays.n_optimistic)
    np.testing.assert_allclose(naive.mdp.arrays.reward, model.mdp.arrays.reward, rtol=1e-9, atol=1e-9)
    for action in range(kernel_models.N_ACTIONS):
        for point in range(model.grid.n_points):
            kernel_models.assert_same_row(
                kernel_models.row_of(naive.mdp, point, action), kernel_models.row_of(model.mdp, point, action)
            )
    if problem[-1] and not model.known.all():
        assert (model.mdp.arrays.modelled & ~model.known).any(), "some pairs are modelled with transferred instances"
    for state in np.random.default_rng(seed).random((4, len(problem[0][0]))):
        (found, given), (expected, expected_given) = naive.predict_at(state), model.predict_at(state)
        assert (given is None) == (expected_given is None)
        np.testing.assert_array_equal(found.modelled, expected.modelled)
        np.testing.assert_allclose(found.weight, expected.weight, rtol=1e-9)
        for action in np.flatnonzero(found.modelled):
            assert found.reward[action] == pytest.approx(expected.reward[action], abs=1e-9)
            successors = [as_set(prediction, action) for prediction in (found, expected)]
            np.testing.assert_allclose(*successors, rtol=1e-9, atol=1e-12)


@slow_and_repeatable
@given(st.sampled_from(linear_models.SMALL_GRIDS), st.integers(0, 10**6), st.integers(0, 12), st.booleans())
def test_transferred_instances_join_those_of_a_local_linear_model_as_the_base_class_says(grid, seed, n, gamma_is_one):
    model, plain = (
        linear_models.make_linear_model(
            grid, linear_models.LINEAR_KERNELS[0], gamma=1.0 if gamma_is_one else 0.9, threshold=2.0
        )
        for _ in range(2)
    )
    for one in (model, plain):
        one.transfer = SomeInstances(model.grid.points(), 2.0)
        kernel_models.learn(one, linear_models.small_steps(seed, len(grid[0]), n))
    model.update_all(np.arange(len(model.known)))
    unknown = np.flatnonzero(~model.known & (model.own_weight < model.exploration_threshold))
    Model.update_rows(plain, unknown)
    np.testing.assert_array_equal(plain.mdp.arrays.modelled[unknown], model.mdp.arrays.modelled[unknown])
    for pair in unknown.tolist():
        action, point = divmod(pair, model.grid.n_points)
        rewards = [one.mdp.arrays.reward[point, action] for one in (model, plain)]
        np.testing.assert_allclose(*rewards, rtol=1e-9, atol=1e-9)
        rows = [kernel_models.row_of(one.mdp, point, action) for one in (model, plain)]
        kernel_models.assert_same_row(*rows)


def as_set(prediction, action):
    """Probability and effect of each successor with a probability above 0, in an order of their own."""
    n = prediction.length[action]
    rows = np.column_stack([prediction.probability[action, :n], prediction.effect[action, :n]])
    rows = rows[rows[:, 0] > 0.0]
    return rows[np.lexsort(np.round(rows.T, 9))]


# A model of somebody else's, of a few lines of NumPy, does all that the kernel average does.
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


def test_a_third_party_model_learns_the_shortest_plan(transfer):
    model = third_party(transfer).learn(300)
    assert isinstance(model.agent.model, NearestNeighbour)
    for start in (-0.55, -0.32, -0.05):
        fewest = int(np.floor((GOAL - start) / STRIDE)) + 1
        mean, deviation = evaluate_policy(model, Monitor(Walk(start=start)), n_eval_episodes=2)
        assert mean == pytest.approx(-fewest, abs=1.0) and deviation == 0.0
    figures = model.agent.statistics()
    assert figures["model/instances"] == 300 and 0.0 < figures["model/known"] == model.agent.model.known.mean()


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
    agent, expected = model.agent, [np.empty((0, 2))] * 2
    rng, came = np.random.default_rng(0), []
    for _ in range(60):
        state, action = rng.random(2), int(rng.integers(2))
        came.append((action, state))
        agent.update(state, action, -1.0, state, False)
        expected[action] = np.vstack([expected[action], state])[-15:]
    for action, states in enumerate(expected):
        assert len(states) == 15
        own = agent.model.instances.state[action, : agent.model.instances.size[action]]
        assert {tuple(state) for state in own} == {tuple(state) for state in states}
    model.save(tmp_path / "model")
    again = FittedRMax.load(tmp_path / "model").agent
    for one in (agent, again):
        order = [(action, tuple(state)) for state, action, *_ in one.model.transitions()]
        kept = [(action, tuple(state)) for action, state in came if tuple(state) in {tuple(s) for s in expected[action]}]
        assert order == kept, "in the order in which they came"
        one.update(np.array([0.5, 0.5]), 0, -1.0, np.array([0.5, 0.5]), False)
    states = [{tuple(state) for state in one.model.instances.state[0, :15]} for one in (agent, again)]
    assert states[0] == states[1] == {tuple(state) for state in [*expected[0][1:], (0.5, 0.5)]}, "also after loading"
