"""Learning with a prior: Mountain Car's division is found, and a source that is exact shortens learning."""

import numpy as np
import pytest
from helpers import factored as f
from helpers.mountain_cars import expected_step
from helpers.oscillators import Oscillators, episodes

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, SourceInstances
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.transfer.base import TargetTask

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


@pytest.mark.parametrize(("mappings", "seed"), [("factored", 0), ("factored", 1), ("signed_factored", 2)])
def test_two_cars_are_found_in_mountain_car_4d_within_one_episode(mappings, seed):
    transfer = COMBREL(car_source(seed), mappings, use="prior")
    task = car_task()
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
    assert transfer.source_prior.claims.trust.min() >= 0.8


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2))
def test_two_copies_of_an_exact_source_reach_the_end_from_the_first_episode_on(seed):
    """Without transfer hardly any of these episodes reaches the end, which is some 85 steps away."""
    source = f.oscillator_source(1500)
    _, without = episodes(None, 2, 2, seed)
    assert sum(without) > 600
    for transfer in (TIMBREL(source, f.copies_mapping(2), use="prior"), COMBREL(source, "factored", use="prior")):
        model, lengths = episodes(transfer, 2, 4, seed)
        assert lengths[0] < 250 and max(lengths[1:]) < 130
        assert model.agent.transfer.statistics()["transfer/ends_confirmed"] == 4


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
    np.testing.assert_array_equal(model.agent.model.fits.prior, loaded.agent.model.fits.prior)
    assert loaded.learn(60, reset_num_timesteps=False).agent.model.n_instances > model.agent.model.n_instances - 1
