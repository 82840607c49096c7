"""The arguments of Fitted R-Max: their defaults, and what they must be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from numbers import Integral
from typing import Any

from sb3_combrel.common.checks import check_count, check_finite, check_positive
from sb3_combrel.models.base import Model, ModelSettings
from sb3_combrel.models.kernel_average import KernelAverage
from sb3_combrel.models.local_linear import LocalLinear

# By degree of the local model and number of state variables, the last one for more.
DEFAULT_BREADTHS = {0: (0.09, 0.09, 0.15, 0.2), 1: (0.15, 0.15, 0.25, 0.4, 0.4, 0.5)}
DEFAULT_NEIGHBORS = (16, 16, 24, 30, 40, 60)
DEFAULT_MIN_WEIGHTS = {0: 0.01, 1: 0.05}
# Where a discount is needed and none is given, as in Stable-Baselines3.
DEFAULT_GAMMA = 0.99
MODELS: dict[int, type[Model]] = {0: KernelAverage, 1: LocalLinear}
MAX_NEIGHBORS = 10_000


@dataclass(frozen=True)
class FittedRMaxSettings:
    """The arguments of Fitted R-Max, with their defaults; what they mean is said in :class:`~sb3_combrel.FittedRMax`.

    :raises ValueError: if one is out of its range
    """

    degree: int = 1
    model_breadth: float | None = None
    n_neighbors: int | None = None
    outcome_breadth: float = 0.05
    min_fraction: float = 0.1
    min_weight: float | None = None
    exploration_threshold: float = 1.0
    resolution: int | Sequence[int] | None = None
    max_value: float | None = None
    gamma: float | None = None
    planning_tolerance: float = 0.001
    max_instances: int | None = 20_000
    bounds: tuple[Any, Any] | None = None
    periodic: Sequence[bool] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.degree, bool) or not isinstance(self.degree, Integral) or self.degree not in MODELS:
            raise ValueError(f"degree must be 0 (kernel average) or 1 (local linear), got {self.degree!r}")
        check_positive("model_breadth", self.model_breadth, none_allowed=True)
        check_count("n_neighbors", self.n_neighbors, min=2, max=MAX_NEIGHBORS, none_allowed=True)
        check_positive("outcome_breadth", self.outcome_breadth)
        check_positive("min_fraction", self.min_fraction, max=1.0)
        check_positive("min_weight", self.min_weight, max=0.99, none_allowed=True)
        check_positive("exploration_threshold", self.exploration_threshold)
        check_positive("gamma", self.gamma, max=1.0, none_allowed=True)
        check_positive("planning_tolerance", self.planning_tolerance)
        if self.max_value is not None:
            check_finite("max_value", self.max_value)
        check_count("max_instances", self.max_instances, none_allowed=True)

    @classmethod
    def names(cls) -> tuple[str, ...]:
        """The names of all arguments."""
        return tuple(field.name for field in fields(cls))

    def model_settings(self, n_variables: int) -> ModelSettings:
        """What a model of a task with so many state variables needs of them."""
        return ModelSettings(
            model_breadth=float(_default(self.model_breadth, DEFAULT_BREADTHS[self.degree], n_variables)),
            min_weight=float(DEFAULT_MIN_WEIGHTS[self.degree] if self.min_weight is None else self.min_weight),
            min_fraction=float(self.min_fraction),
            exploration_threshold=float(self.exploration_threshold),
            max_instances=self.max_instances,
            n_neighbors=int(_default(self.n_neighbors, DEFAULT_NEIGHBORS, n_variables)),
            outcome_breadth=float(self.outcome_breadth),
        )


def _default(given: float | None, defaults: Sequence[float], n_variables: int) -> float:
    return defaults[min(n_variables, len(defaults)) - 1] if given is None else given
