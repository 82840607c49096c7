"""Learning with a prior and bounded values: less is explored, and a model is saved with what it knows."""

import dataclasses

import numpy as np
import pytest
from helpers import factored as f
from helpers.asking import bound, transferred_at, transferred_to_pairs
from helpers.mountain_cars import expected_step
from helpers.oscillators import Oscillators, episodes
from helpers.ring import PERIODIC, Ring, ring_transitions, shifted

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, InterTaskMapping, SourceInstances
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.transferred import PriorPredictions
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.transfer.base import TargetTask, Transfer

LOW, HIGH = np.array([-1.2, -0.07]), np.array([0.6, 0.07])
ACTIONS_4D = ("Neutral", "West", "East", "South", "North")
# The source's variables are x and v.
X, Y = "(x, vx) as (x, v)", "(y, vy) as (x, v)"
FOUND = (
    f"Neutral: Neutral on {X}, Neutral on {Y}; West: Left on {X}, Neutral on {Y}; East: Right on {X}, Neutral on {Y}; "
    f"South: Neutral on {X}, Left on {Y}; North: Neutral on {X}, Right on {Y}"
)


def car_source(seed, n=1000):
    """Instances of Mountain Car 2D from everywhere."""
    rng = np.random.default_rng(seed)
    states, actions = LOW + (HIGH - LOW) * rng.random((n, 2)), rng.integers(3, size=n)
    after = np.array([expected_step(state, action) for state, action in zip(states, actions, strict=True)])
    names = ("x", "v"), ("Neutral", "Left", "Right")
    return SourceInstances(states, actions, -np.ones(n), after, after[:, 0] >= 0.5, LOW, HIGH, 3, *names)


def car_task():
    low, high = np.repeat(LOW, 2), np.repeat(HIGH, 2)
    return TargetTask(StateScaling(low, high), 5, np.zeros((1, 4)), 1.0, 0.01, 0.1, ("x", "y", "vx", "vy"), ACTIONS_4D)


@pytest.mark.parametrize(("mappings", "seed"), [("factored", 0), ("signed_factored", 2)])
def test_two_cars_are_found_in_mountain_car_4d_within_one_episode(mappings, seed):
    transfer, task = COMBREL(car_source(seed), mappings, use="prior"), car_task()
    rng = np.random.default_rng(seed)
    transfer.bind(task, rng)
    state = np.array([-0.52, -0.52, 0.0, 0.0])
    for step in range(300):
        if step % 5 == 0:
            action = int(rng.integers(5))
        after = expected_step(state, action)
        transfer.observe(task.scaling.to_unit(state), action, -1.0, task.scaling.to_unit(after), False)
        state = after
        if step + 1 in (150, 300):
            assert transfer.describe_prior() == FOUND
    assert transfer.value_bound() is not None


@pytest.mark.long
def test_two_copies_of_an_exact_source_reach_the_end_sooner():
    """Without transfer hardly any of the first episodes reaches the end, which is some 85 steps away, within 400."""
    source, seeds = f.oscillator_source(1500), range(3)
    without = sum(sum(episodes(None, 2, 12, seed)[1]) for seed in seeds)
    for transfer in (TIMBREL(source, f.copies_mapping(2), use="prior"), COMBREL(source, "factored", use="prior")):
        learned = [episodes(transfer, 2, 12, seed) for seed in seeds]
        assert sum(sum(lengths) for _, lengths in learned) < 0.95 * without
        assert all(model.agent.transfer.statistics()["transfer/values_bounded"] == 1.0 for model, _ in learned)


@pytest.mark.parametrize("method", ["chosen", "given"])
def test_a_model_with_a_prior_is_saved_and_learns_on(method, tmp_path):
    source = f.oscillator_source(400)
    made = {
        "chosen": lambda: COMBREL(source, "factored", use="prior"),
        "given": lambda: TIMBREL(source, f.copies_mapping(1), use="prior"),
    }
    model, _ = episodes(made[method](), n=3)
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env=Oscillators(1))
    ours, theirs = model.agent.transfer, loaded.agent.transfer
    assert theirs.use == "prior" and theirs.describe_prior() == ours.describe_prior()
    assert theirs.statistics() == ours.statistics()
    states, actions = np.random.default_rng(0).random((300, 2)), np.zeros(300, dtype=np.int64)
    for one, other in zip(ours.prior(states, actions), theirs.prior(states, actions), strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(model.agent.model.linear.prior, loaded.agent.model.linear.prior)
    assert ours.value_bound() is not None
    np.testing.assert_array_equal(loaded.agent.planner.upper, model.agent.planner.upper)
    assert loaded.learn(60, reset_num_timesteps=False).agent.model.n_instances > model.agent.model.n_instances - 1


class Bounded(Transfer):
    """Predicts nothing; after ``n_steps`` transitions states are worth at most ``highest`` at the left."""

    use = "prior"

    def __init__(self, n_steps=50, highest=-20.0, shape=None):
        self.n_steps, self.highest, self.shape, self.n_seen = n_steps, highest, shape, 0

    def observe(self, state, action, reward, next_state, terminated):
        self.n_seen += 1

    def transferred(self, states, actions, own_weight):
        raise AssertionError("a prior is not asked for instances")

    def prior(self, states, actions):
        return PriorPredictions.nothing(len(actions), self.task.n_variables)

    def prior_version(self):
        return int(self.n_seen >= self.n_steps)

    def value_bound(self):
        if not self.prior_version():
            return None
        return self.highest * (1.0 - self.task.sample_states[:, 0]) if self.shape is None else np.zeros(self.shape)

    def get_state(self):
        return {"n_seen": np.array([float(self.n_seen)])}

    def set_state(self, state):
        self.n_seen = int(state["n_seen"][0])


def car_model(transfer, **kwargs):
    return FittedRMax("MountainCar-v0", degree=1, transfer=transfer, **kwargs)


def test_bounds_of_a_method_of_ones_own_are_used_from_when_its_version_grows(tmp_path):
    model = car_model(Bounded(), seed=0).learn(49)
    planner = model.agent.planner
    assert planner.values.max() == 0.0 and (planner.upper == 0.0).all()
    model.learn(2, reset_num_timesteps=False)
    bound = np.minimum(0.0, -20.0 * (1.0 - model.agent.grid.points()[:, 0]))  # not above max_value
    np.testing.assert_allclose(planner.upper, bound)
    assert (planner.values <= bound + 1e-9).all()
    model.save(tmp_path / "model")
    loaded = FittedRMax.load(tmp_path / "model", env="MountainCar-v0")
    np.testing.assert_array_equal(loaded.agent.planner.upper, planner.upper)
    np.testing.assert_allclose(loaded.agent.planner.values, planner.values)


def test_bounds_of_a_wrong_shape_are_refused_with_what_would_be_right():
    with pytest.raises(ValueError, match=r"value_bound\(\) must return None or a finite number for each of the \d+ states"):
        car_model(Bounded(shape=7), seed=0).learn(60)


def same_as_in_learning(model):
    """In which part of the states the frozen policy chooses the action that the agent would choose to learn."""
    space = model.observation_space
    states = np.random.default_rng(0).uniform(space.low, space.high, (300, len(space.low))).astype(np.float32)
    frozen, _ = model.predict(states, deterministic=True)
    scaling = model.policy.scales.scaling
    learning = [int(model.agent.q_values(scaling.to_unit(state.astype(np.float64))).argmax()) for state in states]
    return float((frozen == learning).mean())


def test_a_frozen_policy_acts_on_bounded_values_as_in_learning_and_without_bounds_on_what_is_known():
    bounded = car_model(Bounded(), seed=0).learn(150)
    unbounded = car_model(Bounded(n_steps=1000), seed=0).learn(150)
    assert same_as_in_learning(bounded) == 1.0 and same_as_in_learning(unbounded) < 0.9


# Transfer to a task with an angle: what is transferred does not depend on where the angle's origin is.
N_CELLS = 16
SAME = [InterTaskMapping([0, 1], [0, 1]), InterTaskMapping([0, None], [0, 1]), InterTaskMapping([0, 1], [1, 0])]
METHODS = {
    "TIMBREL": lambda source: TIMBREL(source, SAME[0], breadth=0.15),
    "TIMBREL, pool, relevance": lambda source: TIMBREL(source, "pool", mappings=SAME, breadth=0.15, relevance=True),
    "COMBREL": lambda source: COMBREL(source, SAME, breadth=0.15, neighbor_radius=0.3),
    "COMBREL, relevance": lambda source: COMBREL(source, SAME, breadth=0.15, relevance=True),
}


def ring_source(cells, n=150):
    """Instances of the ring, the origin moved by some cells."""
    states, actions, rewards, after, terminated = map(np.array, zip(*ring_transitions(7, n), strict=True))
    states, after = shifted(states, cells, N_CELLS), shifted(after, cells, N_CELLS)
    return SourceInstances(states, actions, rewards, after, terminated, [0.0, 0.0], [1.0, 1.0], 2, periodic=tuple(PERIODIC))


def target(periodic=PERIODIC):
    grid = StateGrid(2, (4, 2), 0, periodic)
    return TargetTask(StateScaling([0.0, 0.0], [1.0, 1.0]), 2, grid.points(), 1.0, 0.01, 0.1, ("a", "v"), ("l", "r"), periodic)


def bound_and_shown(method, cells, periodic=PERIODIC):
    """A method, bound to the ring with its origin moved, which has observed some transitions."""
    made = bound(METHODS[method](ring_source(cells)), target(periodic))
    for state, action, reward, after, terminated in ring_transitions(3, 60):
        made.observe(shifted(state, cells, N_CELLS), action, reward, shifted(after, cells, N_CELLS), terminated)
    made.end_episode(False)
    made.changed(np.zeros((2, len(made.task.sample_states)), dtype=bool))
    return made


def given_at(method, states):
    """Lengths, weights in all, and mean effects and rewards for every state and action."""
    rows = []
    for state in states:
        found = transferred_at(method, state, np.zeros(2))
        for row, n in enumerate(found.length[:2]):
            weight = found.weight[row, :n]
            rows.append([n, weight.sum(), *(weight @ found.effect[row, :n]), weight @ found.reward[row, :n]])
    return np.array(rows)


@pytest.mark.parametrize("method", METHODS)
def test_with_another_origin_the_same_is_transferred(method, cells=11):
    one, other = bound_and_shown(method, 0), bound_and_shown(method, cells)
    states = np.random.default_rng(0).random((40, 2))
    expected = given_at(one, states)
    assert (expected[:, 0] > 0).mean() > 0.3
    np.testing.assert_allclose(given_at(other, shifted(states, cells, N_CELLS)), expected, atol=1e-6)
    points = np.arange(len(one.task.sample_states)).reshape(N_CELLS, -1)
    lengths = [transferred_to_pairs(m, p.ravel(), np.zeros(p.size)).length for m, p in ((one, points), (other, points))]
    by_point = [length[: points.size].reshape(points.shape) for length in lengths]
    np.testing.assert_array_equal(by_point[1], np.roll(by_point[0], cells, axis=0))
    one, other = (bound_and_shown(method, each, (False, False)) for each in (0, cells))
    assert np.abs(given_at(one, states) - given_at(other, shifted(states, cells, N_CELLS))).max() > 1e-3


def test_the_flags_of_source_instances_are_kept_and_wrong_ones_refused(tmp_path):
    source = ring_source(0)
    assert SourceInstances.load(source.save(tmp_path / "ring")).periodic == tuple(PERIODIC)
    assert source.subset(20, "covering", 0).periodic == tuple(PERIODIC)
    assert dataclasses.replace(source, periodic=()).periodic == (False, False)
    for flags in (True, (True,), (1, 0), "ab"):
        with pytest.raises(ValueError, match="periodic must be None or 2 booleans"):
            dataclasses.replace(source, periodic=flags)


class TellingRing(Ring):
    """A ring that says by itself that its angle is periodic."""

    periodic = tuple(PERIODIC)


def test_recorded_sources_have_the_flags_of_their_task():
    learner = dict(seed=0, resolution=3, model_breadth=0.15)
    of_rmax = SourceInstances.from_fitted_rmax(Ring(), 50, n_episodes=1, periodic=PERIODIC, **learner)
    recorded = SourceInstances.record(None, TellingRing(), 20, seed=0)
    for source in (of_rmax, recorded, SourceInstances.from_q_learning(TellingRing(), 20, seed=0, total_timesteps=30)):
        assert source.periodic == tuple(PERIODIC)
    assert SourceInstances.record(None, Ring(), 20, seed=0).periodic == (False, False)


def test_the_task_of_a_loaded_models_transfer_stays_periodic(tmp_path):
    FittedRMax(TellingRing(), transfer=COMBREL(ring_source(0)), seed=0, resolution=3).learn(20).save(tmp_path / "ring")
    assert FittedRMax.load(tmp_path / "ring").policy.transfer.task.periodic == tuple(PERIODIC)
