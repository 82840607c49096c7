"""Whether values keep their promise where the agent stays, and what it does where they do not."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from sb3_combrel.common.constants import KEPT, MAX_MODEL_STEPS
from sb3_combrel.planning.grid import StateGrid


@dataclass
class Stay:
    """A stay of one environment within a cell of the grid, since the value was last compared."""

    state: np.ndarray  # where it began, unit coordinates, shape (n_variables,)
    value: float  # of the state at the last comparison
    paid: float = 0.0  # discounted rewards since
    discount: float = 1.0
    n_steps: int = 0
    held: int = -1  # the action that is held until the cell is left; -1 for none
    away: int = 0  # steps in a row elsewhere: of two places to and fro between which it stays, one is in another cell


class Promises:
    """Leads the agent away from where interpolated values promise what nobody can have.

    A row of the plan leaves its cell of the grid within ``MAX_MODEL_STEPS`` steps. An agent that has not moved by a cell in so
    many steps, or was elsewhere for single ones only, has either been paid for staying, or its value has risen by what the
    steps have cost; if more than a part of that is missing (``KEPT``), values between the grid points are too high here, and
    the agent would stay for ever. It then holds an action, drawn at random, until the cell is left, and another after as many
    steps more.

    :param grid: of the plan
    :param n_actions: number of actions
    """

    def __init__(self, grid: StateGrid, n_actions: int):
        self._grid, self._n_actions = grid, n_actions
        self._axes = list(zip(grid.arrays.periodic.tolist(), grid.arrays.cells.tolist(), strict=True))
        #: By environment.
        self.stays: dict[int, Stay] = {}

    def choose(self, environment: int, state: np.ndarray, value: float, best: int, rng: np.random.Generator) -> int:
        """Return the best action, or the one that is held.

        :param state: unit coordinates, shape (n_variables,); ``value``: the largest of its action values
        """
        stay = self.stays.get(environment)
        if stay is not None:
            stay.away = stay.away + 1 if self._has_left(state, stay.state) else 0
        if stay is None or stay.away > 1 or (stay.away == 1 and stay.held >= 0):
            self.stays[environment] = Stay(state.copy(), value)
            return best
        if stay.n_steps >= MAX_MODEL_STEPS and stay.away == 0:
            missing = stay.value - stay.paid - stay.discount * value
            broken = stay.held >= 0 or missing > KEPT * abs(stay.paid)
            held = int(rng.integers(self._n_actions)) if broken else -1
            stay = self.stays[environment] = Stay(stay.state if broken else state.copy(), value, held=held)
        return best if stay.held < 0 else stay.held

    def pay(self, environment: int, reward: float, gamma: float) -> None:
        """Take in the reward of a step."""
        if environment in self.stays:
            stay = self.stays[environment]
            stay.paid += stay.discount * reward
            stay.discount *= gamma
            stay.n_steps += 1

    def _has_left(self, state: np.ndarray, before: np.ndarray) -> bool:
        grid = self._grid.arrays
        if grid.even:
            # Number by number: of a few variables arrays take several times as long, at every step.
            return any(
                (min(abs(here - there), 1.0 - abs(here - there)) if periodic else abs(here - there)) * cells >= 1.0
                for here, there, (periodic, cells) in zip(state.tolist(), before.tolist(), self._axes, strict=True)
            )
        here, there = self._grid.coordinates(np.stack([state, before]))
        apart = np.abs(here - there)
        return bool((np.where(grid.periodic, np.minimum(apart, grid.shape - apart), apart) >= 1.0).any())

    def rows(self) -> np.ndarray:
        """The stays, float64, shape (n_environments, n_variables + 7), for :meth:`restore`."""
        rows = [[environment, *stay.state, *astuple(stay)[1:]] for environment, stay in self.stays.items()]
        return np.array(rows, dtype=np.float64).reshape(-1, self._grid.n_variables + 7)

    def restore(self, rows: np.ndarray) -> None:
        """Take over what :meth:`rows` returned, whatever a file says."""
        self.stays.clear()
        for row in rows:
            environment, state, (value, paid, discount, n_steps, held, away) = int(row[0]), row[1:-6].copy(), row[-6:].tolist()
            action = int(np.clip(held, -1, self._n_actions - 1))
            self.stays[environment] = Stay(state, value, paid, discount, int(n_steps), action, int(away))
