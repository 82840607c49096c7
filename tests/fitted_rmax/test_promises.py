"""Stays within a cell of the grid whose values are not kept: an action is held until the cell is left."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import FittedRMax
from sb3_combrel.common.constants import MAX_MODEL_STEPS
from sb3_combrel.experiments.tasks.point_robot import make_point_robot
from sb3_combrel.fitted_rmax.promises import Promises
from sb3_combrel.planning.grid import StateGrid

HERE = np.array([0.4, 0.4])
BEST, N_ACTIONS = 2, 5
CELL = 1.0 / 8.0


def stay(values, reward, gamma=1.0, n=4 * MAX_MODEL_STEPS, states=None, periodic=None, seed=0):
    """The actions of an agent whose value is ``values`` or a function of the step, and where it stays."""
    promises, rng = Promises(StateGrid(2, 3, periodic=periodic), N_ACTIONS), np.random.default_rng(seed)
    actions = []
    for k in range(n):
        state = HERE if states is None else states(k)
        value = values(k) if callable(values) else values
        actions.append(promises.choose(0, state, value, BEST, rng))
        promises.pay(0, reward, gamma)
    return np.array(actions)


def test_where_steps_cost_and_nothing_is_gained_an_action_is_held_and_then_another():
    actions = stay(values=-30.0, reward=-1.0)
    assert (actions[:MAX_MODEL_STEPS] == BEST).all()
    for first in range(MAX_MODEL_STEPS, len(actions), MAX_MODEL_STEPS):
        assert len(set(actions[first : first + MAX_MODEL_STEPS])) == 1
    assert len({tuple(stay(-30.0, -1.0, seed=seed)) for seed in range(8)}) > 1, "drawn at random"


@pytest.mark.parametrize(
    ("values", "reward", "gamma"),
    [
        (lambda k: -100.0 + k, -1.0, 1.0),
        (lambda k: -100.0 + 0.6 * k, -1.0, 1.0),
        (100.0, 1.0, 0.99),
        (-100.0, -1.0, 0.99),
        (0.0, 0.0, 0.99),
    ],
    ids=["what was paid is gained", "most of it", "paid for staying", "a cost for ever", "nothing promised"],
)
def test_a_promise_that_is_kept_leaves_the_agent_alone(values, reward, gamma):
    assert (stay(values, reward, gamma) == BEST).all()


def test_a_promise_of_rewards_that_never_come_is_broken():
    assert (stay(50.0, 0.0, 0.99)[MAX_MODEL_STEPS:] != BEST).any()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.floats(1.0, 3.0), st.integers(0, 1))
def test_it_ends_as_soon_as_the_cell_is_left(seed, cells, variable):
    away = HERE.copy()
    away[variable] += cells * CELL
    left = MAX_MODEL_STEPS + 20
    actions = stay(-30.0, -1.0, n=left + MAX_MODEL_STEPS, states=lambda k: HERE if k < left else away, seed=seed)
    assert (actions[left:] == BEST).all(), "and a stay elsewhere has only begun"


def test_around_a_periodic_variable_the_way_is_short():
    ends = [np.array([at, 0.4]) for at in (0.01, 0.02, 0.99, 0.98)]
    near = stay(-30.0, -1.0, states=lambda k: ends[k % 4], periodic=[True, False])
    assert (near[MAX_MODEL_STEPS:] != BEST).any(), "it has stayed"
    assert (stay(-30.0, -1.0, states=lambda k: ends[k % 4]) == BEST).all(), "it goes from end to end"


def test_to_and_fro_is_a_stay_and_a_longer_way_is_none():
    places = [HERE, HERE + 2.0 * CELL, HERE + 4.0 * CELL]
    actions = stay(-30.0, -1.0, states=lambda k: places[k % 2])
    held = np.flatnonzero(actions != BEST)
    assert held.size > 0 and held[0] >= MAX_MODEL_STEPS and (np.diff(held) > 1).all(), "until the cell is left"
    assert (stay(-30.0, -1.0, states=lambda k: places[k % 3]) == BEST).all()


def test_each_environment_has_its_own_stay_and_an_episode_ends_it():
    promises, rng = Promises(StateGrid(2, 3), N_ACTIONS), np.random.default_rng(0)
    for _ in range(MAX_MODEL_STEPS):
        promises.choose(0, HERE, -30.0, BEST, rng)
        promises.pay(0, -1.0, 1.0)
        promises.pay(1, -1.0, 1.0)
    again = Promises(StateGrid(2, 3), N_ACTIONS)
    again.restore(promises.rows())
    np.testing.assert_array_equal(again.rows(), promises.rows())
    assert promises.choose(1, HERE, -30.0, BEST, rng) == BEST
    state = rng.bit_generator.state
    held = promises.choose(0, HERE, -30.0, BEST, rng)
    rng.bit_generator.state = state
    assert again.choose(0, HERE, -30.0, BEST, rng) == held and promises.stays[0].held == held
    del promises.stays[0]
    assert promises.choose(0, HERE, -30.0, BEST, rng) == BEST


@pytest.mark.long
def test_a_robot_without_noise_does_not_go_back_and_forth_for_ever():
    model = FittedRMax(make_point_robot(3, 0.0, "fixed"), seed=1).learn(5_000)
    returns = [info["r"] for info in model.ep_info_buffer]
    assert np.mean(returns[-10:]) > -200.0
