"""Sources that mislead: each has lost what it claims to have lost, and nothing else."""

import numpy as np
import pytest

from sb3_combrel import SourceInstances
from sb3_combrel.experiments.tasks.misleading_sources import MISLEADING, NOISE
from sb3_combrel.runs.job import make_env


@pytest.fixture(scope="module")
def source():
    return SourceInstances.record(None, make_env("MountainCar-v0", disable_env_checker=True), 3000, seed=0)


def size_of(changed):
    """Standard deviation of the effects in parts of the range, of those that no bound has cut."""
    low, high = changed.scaling.low, changed.scaling.high
    inside = ((changed.next_states > low) & (changed.next_states < high)).all(axis=1)
    return ((changed.next_states - changed.states) / (high - low))[inside].std(axis=0)


@pytest.mark.parametrize("name", MISLEADING)
def test_a_misleading_source_is_still_one_of_its_task(name, source):
    changed = MISLEADING[name](source)
    assert changed.scaling.low.tolist() == source.scaling.low.tolist()
    assert (changed.next_states >= source.scaling.low).all() and (changed.next_states <= source.scaling.high).all()
    again = MISLEADING[name](source)
    np.testing.assert_array_equal(changed.next_states, again.next_states)
    if name != "few":
        np.testing.assert_array_equal(changed.states, source.states)
        np.testing.assert_array_equal(changed.actions, source.actions)
        different = [
            not np.array_equal(getattr(changed, column), getattr(source, column))
            for column in ("next_states", "rewards", "terminated")
        ]
        assert any(different)


def test_noise_has_the_three_sizes_it_is_named_by(source):
    sizes = {name: size_of(MISLEADING[name](source)) for name in NOISE}
    np.testing.assert_allclose(sizes["noise-small"], 0.003, rtol=0.05)
    np.testing.assert_allclose(sizes["noise"], 0.03, rtol=0.05)
    # Bounds cut so much that what is left is smaller.
    true, random = ((s.next_states - s.states)[:, 1] for s in (source, MISLEADING["noise-small"](source)))
    assert abs(np.corrcoef(true, random)[0, 1]) < 0.06, "noise says nothing of the effect"
    assert (sizes["noise-large"] > 4 * sizes["noise"]).all() and (sizes["noise-large"] < 0.3).all()


def test_mirrored_effects_have_the_other_sign(source):
    changed = MISLEADING["mirrored"](source)
    inside = ((changed.next_states > source.scaling.low) & (changed.next_states < source.scaling.high)).all(axis=1)
    effects = (source.next_states - source.states)[inside]
    assert inside.mean() > 0.9
    np.testing.assert_allclose((changed.next_states - changed.states)[inside], -effects, atol=1e-6)


def test_rewards_goals_and_number(source):
    np.testing.assert_array_equal(MISLEADING["wrong-rewards"](source).rewards, -source.rewards)
    wrong = MISLEADING["wrong-goal"](source)
    assert 0.05 < wrong.terminated.mean() < 0.15
    assert wrong.next_states[wrong.terminated, 0].max() <= wrong.next_states[~wrong.terminated, 0].min()
    assert len(MISLEADING["few"](source)) == 20
