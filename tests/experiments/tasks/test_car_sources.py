"""Recordings of the car by different means: each is of the task, and of its own kind."""

import numpy as np
import pytest
from helpers.mountain_cars import expected_step

import combrel_envs  # noqa: F401 - registers the tasks
from sb3_combrel.experiments.tasks import car_sources
from sb3_combrel.experiments.tasks.car_sources import RECORDINGS

QUICK = [name for name in RECORDINGS if name not in ("q-learning", "last-policy", "noisy")]


@pytest.mark.parametrize("name", QUICK)
def test_a_recording_is_of_the_task_and_depends_on_its_seed_alone(name):
    one, again, other = (RECORDINGS[name](seed, 60) for seed in (3, 3, 4))
    assert len(one) == 60
    np.testing.assert_array_equal(one.states, again.states)
    np.testing.assert_array_equal(one.actions, again.actions)
    assert not np.array_equal(one.states, other.states)
    after = np.array([expected_step(state, action) for state, action in zip(one.states, one.actions, strict=True)])
    np.testing.assert_allclose(one.next_states, after, atol=1e-6)


def test_each_is_of_its_own_kind():
    made = {name: RECORDINGS[name](0, 300) for name in QUICK}
    assert not (made["never-neutral"].actions == car_sources.NEUTRAL).any()
    assert (made["scripted"].actions == car_sources.NEUTRAL).any()
    low, high = made["uniform"].scaling.low, made["uniform"].scaling.high
    units = {name: (each.states - low) / (high - low) for name, each in made.items()}
    for v in range(2):
        counts = np.histogram(units["uniform"][:, v], bins=5, range=(0.0, 1.0))[0]
        assert counts.min() > 30, "everywhere"
        assert np.ptp(units["random"][:, v]) < 0.6, "near the start"
    pushed = made["scripted"]
    with_the_car = np.where(pushed.states[:, 1] >= 0.0, car_sources.RIGHT, car_sources.LEFT)
    assert 0.7 < (pushed.actions == with_the_car).mean() < 0.9


@pytest.mark.long
def test_those_that_are_learned():
    noisy, exact, last = (RECORDINGS[name](0, 500) for name in ("noisy", "q-learning", "last-policy"))
    size = (noisy.states - exact.states).std(axis=0) / (exact.scaling.high - exact.scaling.low)
    np.testing.assert_allclose(size, car_sources.SENSOR_NOISE, rtol=0.2)
    assert last.terminated.sum() >= 3, "it knows the way"
