"""Box coordinates to unit coordinates and back: every state variable divided by its range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from sb3_combrel.common.constants import TOO_WIDE

Bounds = tuple[ArrayLike, ArrayLike]
Limits = tuple[NDArray[np.float64], NDArray[np.float64]]

# A limit of the order of the largest float stands for "unbounded" (3.4e38 in older Gymnasium spaces): a range that
# dwarfs every state would put all states at one unit coordinate.
LARGEST_BOUND = 1e30


@dataclass(frozen=True, eq=False)
class StateScaling:
    """The affine map between a box of states and the unit cube, in which all distances are measured.

    A state outside the box is not clipped: it gets a unit coordinate outside [0, 1], so that the map stays invertible.

    :param low: lower bound of each state variable, raw units, shape (n_variables,)
    :param high: upper bound of each state variable, raw units, shape (n_variables,)
    :raises ValueError: if the bounds are not two finite vectors of the same length with ``low < high``
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        # Copies that cannot be written to: a scaling is shared by the grid, the instances and the transfer method.
        lowest, highest = _as_vector("low", low), _as_vector("high", high)
        if lowest.shape != highest.shape:
            raise ValueError(f"low and high must have the same length, got {lowest.size} and {highest.size} values")
        _check_order(lowest, highest, "low, high")
        for name, vector in (("low", lowest), ("high", highest)):
            vector.flags.writeable = False
            object.__setattr__(self, name, vector)

    @classmethod
    def from_space(cls, space: spaces.Space[Any], bounds: Bounds | None = None) -> StateScaling:
        """Take the scaling from an observation space.

        :param space: a one-dimensional ``Box`` of floating-point numbers
        :param bounds: ``(low, high)``, raw units, in place of the space's own, each one number, or one a variable
        :raises ValueError: if the space is not such a box or is unbounded and ``bounds`` not given, or if these do not fit it
        """
        low, high = cls.limits_of(space, bounds)
        unbounded = np.flatnonzero(~(np.maximum(np.abs(low), np.abs(high)) < LARGEST_BOUND))
        if unbounded.size:
            raise ValueError(
                f"the observation space {space} has no finite bounds for the state variable(s) {unbounded.tolist()}; "
                f"pass bounds=(low, high), each a finite number or a sequence of {len(low)} finite numbers"
            )
        return cls(low, high)

    @classmethod
    def from_observed(cls, limits: Limits, states: NDArray[np.float64]) -> StateScaling:
        """Take limits of :meth:`limits_of`, and for variables without any the range of some states, shape (n, n_variables)."""
        low, high = limits
        least, most = states.min(axis=0), states.max(axis=0)
        # A variable that never changes has no scale; of a huge one a half is lost in rounding.
        around = np.where(most > least, 0.0, np.maximum(0.5, np.spacing(np.abs(most))))
        found_low, found_high = around_zero(least - around, most + around)
        unbounded = without_bounds(low, high)
        return cls(np.where(unbounded, found_low, low), np.where(unbounded, found_high, high))

    @staticmethod
    def limits_of(space: spaces.Space[Any], bounds: Bounds | None = None) -> Limits:
        """As :meth:`from_space`, but the limits themselves, some of which may be infinite: (low, high)."""
        n_variables = _count_variables(space)
        if bounds is not None:
            return check_bounds(bounds, n_variables)
        low, high = (np.asarray(limit, dtype=np.float64) for limit in (space.low, space.high))  # type: ignore[attr-defined]
        return low, high

    @property
    def n_variables(self) -> int:
        """Number of state variables."""
        return int(self.low.size)

    def to_unit(self, states: ArrayLike) -> NDArray[np.float64]:
        """Unit coordinates, in [0, 1] for states in the box, of states in raw units, shape (..., n_variables)."""
        return (np.asarray(states, dtype=np.float64) - self.low) / (self.high - self.low)

    def to_raw(self, units: ArrayLike) -> NDArray[np.float64]:
        """States in raw units, of unit coordinates, shape (..., n_variables)."""
        return self.low + np.asarray(units, dtype=np.float64) * (self.high - self.low)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, StateScaling):
            return NotImplemented
        return np.array_equal(self.low, other.low) and np.array_equal(self.high, other.high)

    def __hash__(self) -> int:
        return hash((self.low.tobytes(), self.high.tobytes()))

    def __repr__(self) -> str:
        return f"StateScaling(low={self.low.tolist()}, high={self.high.tolist()})"


def without_bounds(low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which variables have no bounds to scale them by: infinite ones, or, where one never changes, without a width."""
    return ~((np.maximum(np.abs(low), np.abs(high)) < LARGEST_BOUND) & (np.asarray(low) < high))


def has_bounds(space: spaces.Space[Any]) -> bool:
    """Whether a space has bounds for all variables; a ValueError if it is no Box of a few of them."""
    return not without_bounds(*StateScaling.limits_of(space)).any()


def around_zero(low: NDArray[np.float64], high: NDArray[np.float64]) -> Limits:
    """Make bounds that reach about as far on either side of 0 reach equally far: 0 is a grid point then.

    There, where things are at rest, interpolated values would be too high, and keep the agent.
    """
    far, near = np.maximum(-low, high), np.minimum(-low, high)
    alike = near * TOO_WIDE >= far
    return np.where(alike, -far, low), np.where(alike, far, high)


def _as_vector(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """A float64 copy of ``values``, shape (n,) with n > 0, all finite."""
    try:
        vector = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be a sequence of numbers, one a state variable, got {values!r}") from error
    if vector.ndim != 1 or vector.size == 0:
        raise ValueError(f"{name} must be a one-dimensional sequence of at least one number, got {values!r}")
    if not np.all(np.isfinite(vector)):
        raise ValueError(f"{name} must hold finite numbers only, got {vector.tolist()}")
    return vector


def _check_order(low: NDArray[np.float64], high: NDArray[np.float64], name: str) -> None:
    wrong = np.flatnonzero(~(low < high))
    if wrong.size:
        i = int(wrong[0])
        raise ValueError(
            f"{name}: the lower bound of every state variable must be below its upper bound, "
            f"got low={low[i]} and high={high[i]} for variable {i}"
        )
    if not np.all(np.isfinite(high - low)):
        raise ValueError(f"{name}: the range high - low overflows, got low={low.tolist()} and high={high.tolist()}")


def _count_variables(space: spaces.Space[Any]) -> int:
    """Number of variables of a one-dimensional continuous box; anything else is refused."""
    wanted = "the observation space must be a one-dimensional Box of floating-point numbers"
    flatten = "flatten it first, for example with gymnasium.wrappers.FlattenObservation"
    if isinstance(space, spaces.Dict | spaces.Tuple):
        raise ValueError(f"{wanted}, got {space}; {flatten}")
    if not isinstance(space, spaces.Box):
        remedy = "numbers of states say nothing of which are alike: give the variables that they stand for"
        raise ValueError(f"{wanted}, got {space}; {remedy}, with gymnasium.wrappers.TransformObservation or a wrapper")
    if len(space.shape) != 1 or space.shape[0] == 0:
        remedy = "images are not supported: pass a vector of state variables" if len(space.shape) == 3 else flatten
        raise ValueError(f"{wanted}, got shape {space.shape}; {remedy}")
    if not np.issubdtype(space.dtype, np.floating):
        raise ValueError(f"{wanted}, got dtype {space.dtype}; convert it, as by gymnasium.wrappers.DtypeObservation")
    return int(space.shape[0])


def check_bounds(bounds: Bounds, n_variables: int) -> Limits:
    """``(low, high)`` of the ``bounds`` argument, each broadcast to one number a variable; a ValueError if they are wrong."""
    wrong = f"bounds must be (low, high), each a finite number or a sequence of {n_variables} finite numbers, got {{}}"
    try:
        low, high = (np.array(bound, dtype=np.float64) for bound in bounds)
        if any(isinstance(each, bool | np.bool_) for given in bounds for each in np.array(given, dtype=object).flat):
            raise TypeError("booleans are no numbers")
    except (TypeError, ValueError) as error:
        raise ValueError(wrong.format(f"bounds={bounds!r}")) from error
    for name, bound in (("low", low), ("high", high)):
        if bound.shape not in ((), (n_variables,)):
            raise ValueError(wrong.format(f"a {name} of shape {bound.shape} in bounds={bounds!r}"))
        if not np.all(np.isfinite(bound)):
            raise ValueError(wrong.format(f"a {name} of {bound.tolist()} in bounds={bounds!r}"))
    low, high = np.broadcast_to(low, n_variables), np.broadcast_to(high, n_variables)
    if n_variables == 2 and not (low < high).all() and low[0] < low[1] and high[0] < high[1]:
        by_variable = list(zip(low.tolist(), high.tolist(), strict=True))
        raise ValueError(wrong.format(f"a pair for each variable, bounds={bounds!r}: pass bounds={by_variable}"))
    _check_order(low, high, "bounds")
    return low, high
