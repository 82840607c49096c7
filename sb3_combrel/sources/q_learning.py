"""Q-learning with tile coding: solves small source tasks in seconds, and its experience makes good source instances."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_combrel.common.checks import check_count, check_finite, count_text
from sb3_combrel.common.observations import with_own_arrays
from sb3_combrel.common.scaling import Bounds, StateScaling
from sb3_combrel.sources.transitions import (
    LEARNERS,
    TransitionLog,
    Transitions,
    as_transition_count,
    check_observation,
    check_reward,
    count_actions,
    describe_origin,
    make_env,
    task_names,
)

TransitionCallback = Callable[[NDArray[Any], int, float, NDArray[Any], bool], object]
"""Called with each step: state, action (from 0 on), reward, next state (raw units), and whether that is terminal."""

_MAX_TILES = 10_000_000


class TileCoding:
    """Overlapping grids over the unit cube; each state lies in one tile of each grid (Sutton and Barto, Section 9.5.4)."""

    def __init__(self, n_variables: int, n_tilings: int, n_tiles: int) -> None:
        check_count("n_tilings", n_tilings, max=_MAX_TILES)
        check_count("n_tiles", n_tiles, max=_MAX_TILES)
        # One more tile along each variable than asked for, as the grids are shifted.
        self.n_features = n_tilings * (n_tiles + 1) ** n_variables
        if self.n_features > _MAX_TILES:
            raise ValueError(
                f"n_tiles={n_tiles} makes {count_text(self.n_features)} tiles for {n_variables} state variables, more than "
                f"{_MAX_TILES:,}; choose a smaller n_tiles or n_tilings"
            )
        self.n_tilings, self.n_tiles = n_tilings, n_tiles
        # Odd multiples 1, 3, 5, ... of the unit shift keep the tiles of different grids from lining up on diagonals.
        self._offsets = (np.arange(n_tilings)[:, None] * (2 * np.arange(n_variables) + 1) % n_tilings) / n_tilings
        self._strides = (n_tiles + 1) ** np.arange(n_variables)
        self._first = np.arange(n_tilings) * (n_tiles + 1) ** n_variables

    def tiles(self, unit_state: NDArray[np.float64]) -> NDArray[np.int64]:
        """The tiles in which a state lies, unit coordinates (outside: at the border), one of each grid, shape (n_tilings,)."""
        inside = np.minimum(np.maximum(unit_state, 0.0), 1.0) * self.n_tiles
        return self._first + (inside + self._offsets).astype(np.int64) @ self._strides


class QLearning:
    """Watkins's Q(lambda) on tile-coded states: one-step Q-learning with eligibility traces that a random action cuts.

    Values begin at ``initial_value``; where rewards are negative, 0 is optimistic and makes the learner explore.

    :param env: a task with a Box of a few state variables and a Discrete action space, or its id
    :param learning_rate: fraction of the error that one update corrects
    :param gamma: discount factor
    :param trace_decay: lambda, the decay of the traces; 0 for one-step Q-learning
    :param epsilon: probability of a random action while learning
    :param initial_value: value of every state and action at first
    :param n_tilings: number of grids, see :class:`TileCoding`; ``n_tiles``: tiles along each variable
    :param bounds: ``(low, high)`` of the states if the observation space has none
    :param seed: seed of the learner and its environment
    :raises ValueError: if the spaces are of another kind or an argument is out of range
    """

    def __init__(
        self,
        env: str | gym.Env[Any, Any],
        *,
        learning_rate: float = 0.3,
        gamma: float = 1.0,
        trace_decay: float = 0.9,
        epsilon: float = 0.01,
        initial_value: float = 0.0,
        n_tilings: int = 8,
        n_tiles: int = 8,
        bounds: Bounds | None = None,
        seed: int | None = None,
    ) -> None:
        fractions = {"learning_rate": learning_rate, "gamma": gamma, "trace_decay": trace_decay, "epsilon": epsilon}
        for name, value in fractions.items():
            check_finite(name, value)
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be between 0 and 1, got {value}")
        check_finite("initial_value", initial_value)
        self.env = with_own_arrays(make_env(env))
        self.observation_space, self.action_space = self.env.observation_space, self.env.action_space
        self.scaling = StateScaling.from_space(self.observation_space, bounds)
        self.n_actions = count_actions(self.action_space)
        self.learning_rate, self.gamma, self.trace_decay, self.epsilon = learning_rate, gamma, trace_decay, epsilon
        self.seed = seed
        self.coding = TileCoding(self.scaling.n_variables, n_tilings, n_tiles)
        self.weights = np.full((self.coding.n_features, self.n_actions), initial_value / n_tilings)
        self.episode_lengths: list[int] = []
        self._first_action = int(self.action_space.start)  # type: ignore[attr-defined]
        self._rng = np.random.default_rng(seed)

    def learn(self, total_timesteps: int, callback: TransitionCallback | None = None) -> QLearning:
        """Act and learn. Each call begins with a new episode; the last one may stay unfinished.

        :param total_timesteps: number of steps in the environment; a float such as 1e5 may be given
        :param callback: called with every transition
        :raises ValueError: if ``total_timesteps`` is not a whole number of at least 1, or if the environment returns an
            observation or a reward that is not finite
        """
        total_timesteps = as_transition_count("total_timesteps", total_timesteps)
        steps, seed = 0, self.seed if not self.episode_lengths else None
        while steps < total_timesteps:
            steps += self._episode(total_timesteps - steps, callback, seed)
            seed = None
        return self

    def _episode(self, max_steps: int, callback: TransitionCallback | None, seed: int | None) -> int:
        """Run one episode of at most ``max_steps``; returns its number of steps."""
        state, _ = self.env.reset(seed=seed)
        check_observation(state, f"at the reset before episode {len(self.episode_lengths) + 1}")
        tiles = self._tiles(state)
        # Replacing traces of all tiles and actions; all but those of the tiles visited are 0.
        traces, visited = np.zeros(self.weights.shape), np.empty(0, dtype=np.int64)
        for step in range(1, max_steps + 1):
            values = self._values(tiles)
            greedy = self._argmax(values)
            action = int(self._rng.integers(self.n_actions)) if (self._rng.random() < self.epsilon) else greedy
            if values[action] < values[greedy]:
                # What follows an exploratory action is no evidence on the greedy policy from the states before it.
                traces[visited] = 0.0
                visited = visited[:0]
            following, given, terminated, truncated, _ = self.env.step(action + self._first_action)
            when = f"in step {step} of episode {len(self.episode_lengths) + 1}"
            check_observation(following, when)
            reward = check_reward(given, when)
            if callback is not None:
                callback(state, action, reward, following, bool(terminated))
            next_tiles = self._tiles(following)
            best = 0.0 if terminated else float(self._values(next_tiles).max())
            error = reward + self.gamma * best - values[action]
            if not math.isfinite(error):
                raise ValueError(f"the Q-values overflow {when}, at the reward {reward:g}: scale the rewards down")
            traces[visited] *= self.gamma * self.trace_decay
            traces[tiles] = 0.0
            traces[tiles, action] = 1.0
            visited = np.union1d(visited, tiles)
            self.weights[visited] += (self.learning_rate / self.coding.n_tilings * error) * traces[visited]
            state, tiles = following, next_tiles
            if terminated or truncated:
                self.episode_lengths.append(step)
                return step
        return max_steps

    def predict(
        self,
        observation: NDArray[Any],
        state: Any = None,
        episode_start: NDArray[np.bool_] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[np.int64], Any]:
        """Actions in SB3's manner: greedy ones, or with ``deterministic=False`` a random one with probability ``epsilon``.

        :param observation: raw units, shape (n_variables,) or (n_states, n_variables)
        :return: the action or actions, and ``state``, which is ignored like ``episode_start``
        """
        states = np.asarray(observation)
        actions = np.array([self._argmax(self._values(self._tiles(each))) for each in np.atleast_2d(states)])
        if not deterministic:
            explore = self._rng.random(len(actions)) < self.epsilon
            actions = np.where(explore, self._rng.integers(self.n_actions, size=len(actions)), actions)
        actions = actions + self._first_action
        return (actions[0] if states.ndim == 1 else actions), state

    def _tiles(self, state: NDArray[Any]) -> NDArray[np.int64]:
        return self.coding.tiles(self.scaling.to_unit(state))

    def _values(self, tiles: NDArray[np.int64]) -> NDArray[np.float64]:
        return self.weights[tiles].sum(axis=0)

    def _argmax(self, values: NDArray[np.float64]) -> int:
        best = np.flatnonzero(values == values.max())
        return int(best[0] if len(best) == 1 else self._rng.choice(best))


def learn_q_learning(
    env: str | gym.Env[Any, Any], seed: int | None, total_timesteps: int, learner: dict[str, Any]
) -> Transitions:
    """All transitions while Q-learning learns a task; for the parameters see :meth:`SourceInstances.from_q_learning`."""
    made = QLearning(env, seed=seed, **learner)
    try:
        log = TransitionLog()
        made.learn(total_timesteps, log.add)
        origin = describe_origin(made.env, type(made).__name__, seed)
        origin |= {"recorded_while_learning": True, "total_timesteps": total_timesteps}
        return log.transitions((made.scaling.low, made.scaling.high), made.n_actions, task_names(made.env), origin)
    finally:
        if isinstance(env, str):
            made.env.close()


LEARNERS["q_learning"] = learn_q_learning
