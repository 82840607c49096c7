"""TIMBREL: what a given mapping transfers to which pairs, and that the target's own instances take over."""

import copy

import numpy as np
import pytest
from helpers import naive_transfer as naive
from helpers.asking import bound, changed_pairs, pairs_of, transferred_at, transferred_to_pairs
from helpers.walk import same_parameters
from stable_baselines3.common.env_util import make_vec_env

import combrel_envs  # noqa: F401 - registers the Mountain Cars
from sb3_combrel import COMBREL, TIMBREL, FittedRMax
from sb3_combrel.mappings.named_sets import InterTaskMapping

POINTS = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
ONE = InterTaskMapping([0, None, 1], [1, 0])
OTHER = InterTaskMapping([None, 1, 0], [0, 0], [1, -1, 1])


@pytest.fixture
def source():
    return naive.random_source(np.random.default_rng(0), 200, 2, 2)


@pytest.fixture
def task():
    return naive.target_task(POINTS, 2)


def given_to_all(method, task, own=0.0):
    return copy.deepcopy(transferred_to_pairs(method, pairs_of(task), np.full(len(pairs_of(task)), own)))


def assert_transfers(method, task, drawn_from, breadth):
    """Every pair gets what the naive version takes from ``drawn_from(action)``; at an exact state, too."""
    on_grid, n_points, n_transferred = given_to_all(method, task), len(task.sample_states), 0
    for point, state in enumerate(task.sample_states):
        at = transferred_at(method, state, np.zeros(task.n_actions))
        for action in range(task.n_actions):
            expected = naive.transferred(state, 0.0, drawn_from(action), task, breadth)
            n_transferred += len(expected)
            for found, row in ((on_grid, action * n_points + point), (at, action)):
                n = found.length[row]
                assert n == len(expected)
                np.testing.assert_allclose(found.weight[row, :n], [e[0] for e in expected], rtol=1e-9)
                np.testing.assert_allclose(found.effect[row, :n], np.array([e[1] for e in expected]).reshape(n, 3), atol=1e-12)
    assert n_transferred > len(task.sample_states)


@pytest.mark.parametrize(
    ("given", "of_action"),
    [
        ({"mapping": ONE}, [[ONE]] * 2),
        ({"mapping": [ONE, OTHER]}, [[ONE], [OTHER]]),
        ({"mapping": "pool", "mappings": [ONE, OTHER]}, [[ONE, OTHER]] * 2),
    ],
    ids=["one for all actions", "one for each action", "pool"],
)
def test_what_a_mapping_transfers(given, of_action, source, task):
    method = bound(TIMBREL(source, **given, breadth=0.15), task)
    assert_transfers(method, task, lambda action: [(source, mapping, action) for mapping in of_action[action]], 0.15)


def test_random_draws_a_mapping_of_the_set_with_each_transition(source, task):
    method = bound(TIMBREL(source, "random", mappings=[ONE, OTHER], breadth=0.2), task)
    state = np.full(3, 0.4)
    possible = [
        np.array([e[1] for e in naive.transferred(state, 0.0, [(source, mapping, 0)], task, 0.2)]) for mapping in (ONE, OTHER)
    ]
    drawn = []
    for _ in range(60):
        method.observe(state, 0, -1.0, state, False)
        generator = method.rng.bit_generator.state
        before = transferred_at(method, state, np.array([0.0, 1.0])).effect[0].copy()
        found = transferred_at(method, state, np.array([0.0, 1.0]))
        effects = found.effect[0, : found.length[0]]
        # To ask leaves no trace: asked twice, it returns the same.
        np.testing.assert_array_equal(effects, before[: len(effects)])
        assert method.rng.bit_generator.state == generator
        [which] = [k for k, p in enumerate(possible) if p.shape == effects.shape and np.allclose(p, effects)]
        drawn.append(which)
    assert 15 < sum(drawn) < 45


def test_at_first_everything_has_changed_and_then_nothing(source, task):
    method = bound(TIMBREL(source, ONE), task)
    known = np.arange(2 * len(POINTS)) % 3 == 0
    assert changed_pairs(method, known).tolist() == np.flatnonzero(~known).tolist()
    method.observe(POINTS[5], 0, -1.0, POINTS[6], False)
    assert changed_pairs(method, known).tolist() == []


def mountain_car(transfer, seed=0, **kwargs):
    env = make_vec_env("combrel/MountainCar2D-v0", seed=seed, env_kwargs=dict(max_episode_steps=200))
    return FittedRMax(env, transfer=transfer, model_breadth=1 / 16, resolution=4, seed=seed, **kwargs)


IDENTITY = InterTaskMapping([0, 1], [0, 1, 2])


@pytest.mark.parametrize("degree", [0, 1])
def test_a_known_pairs_row_is_built_of_its_own_instances_only(degree):
    """The same experience gives the same rows with transfer and without, wherever the pair is known."""
    three_actions = naive.random_source(np.random.default_rng(0), 500, 2, 3)
    model, plain = mountain_car(TIMBREL(three_actions, IDENTITY), degree=degree), mountain_car(None, degree=degree)
    rng = np.random.default_rng(1)
    model.agent.prepare()
    before = {pair: row_of(model, pair) for pair in range(3 * 17 * 17)}
    state = rng.uniform(0.3, 0.7, 2)
    for _ in range(400):
        action, after = int(rng.integers(3)), np.clip(state + 0.03 * rng.normal(size=2), 0.0, 1.0)
        for each in (model, plain):
            each.agent.update(state, action, -1.0, after, False)
        state = after
    # Within an episode a row that is right within a tolerance is kept.
    for each in (model, plain):
        each.agent.model.update_rows(np.flatnonzero(each.agent.model.known))
    known = np.flatnonzero(model.agent.model.known)
    assert known.tolist() == np.flatnonzero(plain.agent.model.known).tolist() and len(known) > 30
    n_changed = 0
    for pair in known:
        assert row_of(model, pair) == row_of(plain, pair)
        n_changed += pair in before and row_of(model, pair) != before[pair]
    assert n_changed > 0.9 * len(known), "what was transferred there before was something else"
    transferred = model.agent.mdp.arrays.modelled & ~model.agent.model.known
    assert transferred.sum() > 100 and not plain.agent.mdp.arrays.modelled[transferred].any()


def row_of(model, pair):
    arrays, (action, point) = model.agent.mdp.arrays, divmod(pair, model.agent.grid.n_points)
    if not arrays.modelled[pair]:
        return None
    used = slice(arrays.length[point, action])
    row = (array[point, action, used].tolist() for array in (arrays.to, arrays.weight))
    return float(arrays.reward[point, action]), *row


@pytest.mark.parametrize("method", [TIMBREL, COMBREL])
def test_the_object_that_was_given_is_left_alone_and_serves_two_models(method):
    source = naive.random_source(np.random.default_rng(0), 200, 2, 3)
    given = method(source, IDENTITY)
    before = {**vars(given)}
    models = [mountain_car(each) for each in (given, given, method(source, IDENTITY))]
    for _ in range(2):
        for model in models:
            model.learn(60, reset_num_timesteps=False)
    assert vars(given) == before and given.source is source
    assert len({id(transfer) for transfer in (given, *(model.transfer for model in models))}) == 4
    assert same_parameters(models[0], models[1]) and same_parameters(models[0], models[2])
