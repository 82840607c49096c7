"""A car in disguise, and a cart that carries a pendulum."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sb3_combrel.experiments.benchmark.pairs import ACTIONS, ORDER, SIGNS, make_car, make_disguised_car
from sb3_combrel.experiments.tasks.cart_with_pendulum import PARTS, CartWithPendulumEnv
from sb3_combrel.experiments.tasks.disguised import disguise, disguised, mirrored


class TestDisguise:
    def test_is_the_same_task_under_the_mapping(self):
        """Every step of the disguised car is one of the car's, to rounding."""
        plain, other = make_car(), make_disguised_car()
        box, mapping = plain.observation_space, disguise(ORDER, SIGNS, ACTIONS)
        first, _ = plain.reset(seed=3)
        seen, _ = other.reset(seed=3)
        rng = np.random.default_rng(0)
        for _ in range(150):
            unit = (seen - other.observation_space.low) / (other.observation_space.high - other.observation_space.low)
            back = box.low + mapping.target_to_source(unit[None].astype(np.float64), 2)[0] * (box.high - box.low)
            np.testing.assert_allclose(back, first, atol=1e-6)
            action = int(rng.integers(3))
            seen, reward, *ends, _ = other.step(action)
            first, own_reward, *own_ends, _ = plain.step(mapping.action[action])
            assert (reward, ends) == (own_reward, own_ends)
        assert other.observation_space.contains(seen)

    @pytest.mark.parametrize(
        "order, signs, actions, words",
        [
            ((0, 0), (1, 1), (0, 1, 2), "order must hold each of 0 to 1 once"),
            ((0, 1), (1,), (0, 1, 2), "one bool for each of the 2 variables"),
            ((0, 1), (1, 1), (0, 1, 1), "order must hold each of 0 to 2 once"),
        ],
    )
    def test_refuses_what_does_not_fit(self, order, signs, actions, words):
        with pytest.raises(ValueError, match=words):
            disguised(make_car(), order, signs, actions)

    def test_variables_without_bounds_are_not_mirrored(self):
        with pytest.raises(ValueError, match="where bounds are finite"):
            mirrored(gym.make("CartPole-v1"), (False, True, False, False))


class TestCartWithPendulum:
    @pytest.mark.parametrize("parts", PARTS)
    def test_gymnasium_finds_nothing_wrong(self, parts):
        check_env(CartWithPendulumEnv(parts), skip_render_check=True)

    def test_another_part_is_refused(self):
        with pytest.raises(ValueError, match="parts must be one of cart, pendulum, both, got 'wheel'"):
            CartWithPendulumEnv("wheel")

    def test_the_cart_moves_as_it_does_alone_and_so_does_the_pendulum_without_pushes(self):
        for alone, columns, actions in (("cart", slice(0, 2), (0, 1, 2)), ("pendulum", slice(2, 4), (0, 3, 4))):
            both, part = CartWithPendulumEnv("both"), CartWithPendulumEnv(alone)
            both.reset(seed=5)
            part.reset(seed=5)
            for action in np.random.default_rng(0).integers(0, 3, size=200).tolist():
                np.testing.assert_array_equal(both.step(actions[action])[0][columns], part.step(action)[0])

    def test_a_torque_alone_does_not_lift_the_pendulum(self):
        env = CartWithPendulumEnv("pendulum")
        env.reset(seed=0)
        assert not any(env.step(2)[2] for _ in range(300))
        # With the velocity it does.
        env.reset(seed=0)
        state, ended = env.reset(seed=0)[0], False
        for _ in range(300):
            state, _, ended, _, _ = env.step(2 if state[1] > 0 else 1)
            if ended:
                break
        assert ended and np.cos(state[0]) >= 0.9

    def test_pushes_move_the_cart_to_its_goal_and_pull_the_pendulum(self):
        env = CartWithPendulumEnv("cart")
        env.reset(seed=0)
        assert 20 <= next(k for k in range(300) if env.step(2)[2]) <= 60
        both = CartWithPendulumEnv("both")
        turned = []
        for action in (0, 2):
            both.reset(seed=0)
            turned.append(both.step(action)[0][3])
        assert turned[0] != turned[1]
