"""CartPole with a longer pole and its variables in another order, and the source that it is learnt from."""

import gymnasium as gym
import numpy as np
import pytest

from sb3_combrel.experiments.suite.tasks import TASKS
from sb3_combrel.experiments.tasks import cart_pole

# Gymnasium's constants, of a cart of 1 kg and a pole of 0.1 kg.
GRAVITY, CART, POLE, FORCE, DT = 9.8, 1.0, 0.1, 10.0, 0.02


def equations_of_motion(state, action, half_length):
    """One step of Barto, Sutton & Anderson's cart and pole, the equations solved as a linear system for both accelerations."""
    x, v, angle, spin = state
    force = FORCE if action else -FORCE
    matrix = [[CART + POLE, POLE * half_length * np.cos(angle)], [np.cos(angle), 4.0 / 3.0 * half_length]]
    given = [force + POLE * half_length * spin**2 * np.sin(angle), GRAVITY * np.sin(angle)]
    acceleration, turn = np.linalg.solve(matrix, given)
    return np.array([x + DT * v, v + DT * acceleration, angle + DT * spin, spin + DT * turn])


@pytest.mark.parametrize("half_length", [None, 1.0, 2.5])
def test_the_pole_moves_as_one_of_its_length(half_length):
    env = cart_pole.make_cart_pole(half_length)
    observation, _ = env.reset(seed=0)
    for action in (0, 1, 1, 0, 1, 0, 0):
        expected = equations_of_motion(observation, action, half_length or 0.5)
        observation, *_ = env.step(action)
        np.testing.assert_allclose(observation, expected, rtol=1e-4, atol=1e-6)


def test_variables_and_their_bounds_stand_in_the_order_given():
    plain, changed = cart_pole.make_cart_pole(), cart_pole.make_cart_pole(order=(2, 0, 3, 1))
    for side in ("low", "high"):
        (x, v, angle, spin), after = getattr(plain.observation_space, side), getattr(changed.observation_space, side)
        assert after.tolist() == [angle, x, spin, v]
    first, other = plain.reset(seed=3)[0], changed.reset(seed=3)[0]
    for action in (None, 0, 1, 0, 0):
        if action is not None:
            first, other = plain.step(action)[0], changed.step(action)[0]
        x, v, angle, spin = first
        assert other.tolist() == [angle, x, spin, v] and changed.observation_space.contains(other)


def test_the_right_mapping_undoes_the_order():
    task, mapping = TASKS["CartPole-long"], cart_pole.right_mapping()
    plain, target = gym.make("CartPole-v1"), task.make()
    seen, after = plain.reset(seed=1)[0], target.reset(seed=1)[0]
    # The start does not depend on the pole.
    assert [seen[k] for k in mapping.state] == after.tolist() and mapping.action == (0, 1)
    low, high = task.learner["bounds"]
    assert low == [cart_pole.LEARNER["bounds"][0][k] for k in mapping.state]
    assert high == [cart_pole.LEARNER["bounds"][1][k] for k in mapping.state]
    assert not any(k == variable for variable, k in enumerate(mapping.state)), "no variable keeps its place"


@pytest.mark.parametrize(
    "arguments",
    [
        *[dict(half_length=0.0), dict(half_length=np.nan), dict(order=(0, 1, 2)), dict(order=(0, 1, 2, 2))],
        dict(order=(1, 2, 3, 4)),
    ],
)
def test_bad_input_is_refused(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        cart_pole.make_cart_pole(**arguments)


@pytest.mark.long
def test_the_source_balances_and_has_falls():
    source = cart_pole.learn_source()
    assert len(source) == cart_pole.N_INSTANCES and set(source.actions.tolist()) == {0, 1}
    assert source.terminated.sum() >= 5
    fallen = source.next_states[source.terminated]
    assert ((np.abs(fallen[:, 2]) > 0.2095) | (np.abs(fallen[:, 0]) > 2.4)).all()
    assert source.origin["n_seen"] > 5000, "most episodes are long"
