"""What the local linear model saves and restores: at an episode's end the same to the last bit, as is what it learns on."""

import numpy as np
import pytest
from helpers.kernel_models import GRIDS, learn, random_transitions
from helpers.linear_models import (
    LINEAR_KERNELS,
    LinearDynamics,
    StubPrior,
    assert_restored,
    assert_same_fits,
    assert_same_sums,
    finish_episode,
    linear_model_and_definition,
    make_linear_model,
)
from helpers.naive_local_linear import NaiveLocalLinear
from hypothesis import given, settings
from hypothesis import strategies as st

problems = st.tuples(st.sampled_from(GRIDS), st.sampled_from(LINEAR_KERNELS), st.integers(0, 10**6), st.integers(1, 80))


@settings(deadline=None, derandomize=True, max_examples=25)
@given(problems)
def test_what_is_restored_at_an_episodes_end_is_and_learns_the_same_to_the_last_bit(problem):
    grid, kernel, seed, n = problem
    model, restored = (make_linear_model(grid, kernel) for _ in range(2))
    transitions = random_transitions(seed, len(grid[0]), n + 30)
    learn(model, transitions[: n // 2])
    finish_episode(model)
    learn(model, transitions[n // 2 : n])
    assert_restored(model, restored, transitions[n:])


@pytest.mark.parametrize("grid", [((2, 2), 1), ((2, 2), 1, (True, False))], ids=str)
def test_what_is_restored_with_a_prior_is_and_learns_the_same_to_the_last_bit(grid):
    prior = StubPrior(LinearDynamics(0, 2).effect, claims=lambda state, action: state[0] < 0.5)
    model, restored = (make_linear_model(grid, LINEAR_KERNELS[0], prior=prior) for _ in range(2))
    model.update_rows(model.renew_prior())
    transitions = random_transitions(3, 2, 90)
    learn(model, transitions[:60])
    assert_restored(model, restored, transitions[60:])


@pytest.mark.parametrize("grid", [((2, 2), 0), ((2, 2), 1, (True, False))], ids=str)
def test_what_is_restored_is_right_after_instances_were_replaced(grid):
    kernel = LINEAR_KERNELS[1]
    model = make_linear_model(grid, kernel, max_instances=15)
    learn(model, random_transitions(9, 2, 200))
    finish_episode(model)
    restored, naive = linear_model_and_definition(grid, kernel, max_instances=15)
    restored.set_state(model.get_state())
    for row in restored.instances.rows():
        naive.put(len(naive.instances[int(row[0])]), as_instance(row))
    for name in ("reach", "limit", "known", "total"):
        getattr(naive, name)[:] = getattr(model.fits, name).reshape(naive.known.shape)
    assert_same_sums(restored, naive)
    assert assert_same_fits(restored, naive) > 0
    # Sums from which others were subtracted are the same but for rounding.
    np.testing.assert_array_equal(model.fits.effect_range[:2], restored.fits.effect_range[:2])
    np.testing.assert_allclose(model.fits.row[model.known], restored.fits.row[model.known], rtol=1e-9, atol=1e-9)
    state = np.array([0.3, 0.6])
    for array, same in zip(model.predict_at(state)[0], restored.predict_at(state)[0], strict=True):
        np.testing.assert_array_equal(array, same)


def as_instance(row):
    made = NaiveLocalLinear(((0, 0), 0), LINEAR_KERNELS[1], 2)
    made.add(row[1:3], int(row[0]), row[-2], row[1:3] + row[3:5], bool(row[-1]))
    return made.instances[int(row[0])][0]


def test_a_pair_that_was_accepted_is_known_after_loading():
    model, restored = (make_linear_model(((2, 2), 0), LINEAR_KERNELS[0], threshold=10.0) for _ in range(2))
    learn(model, random_transitions(1, 2, 8))
    accepted = model.accept(np.arange(len(model.known)))
    assert len(accepted) > 0
    model.update_rows(accepted)
    assert_restored(model, restored, random_transitions(2, 2, 20))
    assert restored.known[accepted].all()
