"""The arguments of Fitted R-Max: their defaults, and what they must be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from sb3_combrel.common.checks import check_count, check_finite, check_positive, check_resolution
from sb3_combrel.common.periodic import periodic_flags
from sb3_combrel.models.base import ModelSettings

# By default so many corners of grid cells are looked at in a step: a backup costs as much as a cell has corners.
CORNERS_A_STEP = 400
DEFAULT_BREADTHS = {1: 0.09, 2: 0.09, 3: 0.15}
DEFAULT_BREADTH_OF_MORE = 0.2
# More than any step has time for; at an episode's end there are 400 times as many, which must fit into an int64.
MAX_BACKUPS = 10**12


@dataclass(frozen=True)
class FittedRMaxSettings:
    """
    The arguments of Fitted R-Max, with their defaults; what they mean is said in :class:`~sb3_combrel.FittedRMax`.

    :raises ValueError: if one is out of its range
    """

    model_breadth: float | None = None
    min_fraction: float = 0.1
    min_weight: float = 0.01
    exploration_threshold: float = 1.0
    resolution: int | Sequence[int] | None = None
    max_value: float = 0.0
    gamma: float = 1.0
    planning_tolerance: float = 0.001
    max_backups: int | None = None
    max_instances: int | None = 20_000
    bounds: tuple[Any, Any] | None = None
    periodic: Sequence[bool] | None = None

    def __post_init__(self) -> None:
        if self.model_breadth is not None:
            check_positive("model_breadth", self.model_breadth)
        check_positive("min_fraction", self.min_fraction, max=1.0)
        check_positive("min_weight", self.min_weight, max=0.99)
        check_positive("exploration_threshold", self.exploration_threshold)
        check_positive("gamma", self.gamma, max=1.0)
        check_positive("planning_tolerance", self.planning_tolerance)
        check_finite("max_value", self.max_value)
        check_count("max_backups", self.max_backups, min=0, max=MAX_BACKUPS, none_allowed=True)
        check_count("max_instances", self.max_instances, none_allowed=True)

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The names of all arguments."""
        return tuple(field.name for field in fields(cls))

    def breadth_for(self, n_variables: int) -> float:
        """The kernel breadth for so many state variables."""
        if self.model_breadth is not None:
            return float(self.model_breadth)
        return DEFAULT_BREADTHS.get(n_variables, DEFAULT_BREADTH_OF_MORE)

    def backups_for(self, n_variables: int) -> int:
        """The backups of a step with so many state variables."""
        return max(1, CORNERS_A_STEP // 2**n_variables) if self.max_backups is None else int(self.max_backups)

    def resolution_for(self, n_variables: int) -> int | Sequence[int] | None:
        """
        The grid's resolution, checked against the number of state variables.

        :raises ValueError: if it is not None, a whole number, or one for each state variable
        """
        check_resolution(self.resolution, n_variables)
        return self.resolution

    def periodic_for(self, n_variables: int) -> tuple[bool, ...]:
        """
        Which state variables are periodic, checked against their number.

        :raises ValueError: if it is not None or one bool for each state variable
        """
        return periodic_flags(self.periodic, n_variables)

    def model_settings(self, n_variables: int) -> ModelSettings:
        """What a model of a task with so many state variables needs of them."""
        return ModelSettings(
            model_breadth=self.breadth_for(n_variables),
            min_weight=float(self.min_weight),
            min_fraction=float(self.min_fraction),
            exploration_threshold=float(self.exploration_threshold),
            max_instances=self.max_instances,
        )
