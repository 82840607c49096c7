"""Taylor and Stone's measures as rows of text, with raw and corrected p-values."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from sb3_combrel.comparison.measures import Comparison, TransferMeasures
from sb3_combrel.comparison.statistics import holm

NONE = "—"
NOT_REACHED = "not reached"


class _Row(NamedTuple):
    """How a measure is shown."""

    name: str
    of: Callable[[TransferMeasures], Comparison | None]
    average: Callable[[np.ndarray], np.floating[Any]] = np.mean
    scale: float = 1.0
    has_sides: bool = True  #: whether both methods have the measure by themselves


def measure_table(
    measures: Mapping[str, TransferMeasures], baseline: str, n_steps: int, threshold: float
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Make the header and the rows, by method. Rows of a method that say the same are one, named after both.

    :param measures: by method; p-values are corrected by Holm's method over these, measure by measure
    :param baseline: that they are against
    :param n_steps: environment steps that returns are averaged over
    :param threshold: the return of the time to threshold
    """
    kinds = [
        _Row("jumpstart", lambda of: of.jumpstart),
        _Row("asymptotic performance", lambda of: of.asymptotic_performance),
        _Row("mean return over steps", lambda of: of.total_reward_by_steps, scale=1.0 / n_steps),
        _Row("transfer ratio, over steps", lambda of: of.transfer_ratio_by_steps, has_sides=False),
        _Row(f"steps to a return of {threshold:.4g}", lambda of: of.time_to_threshold, np.median),
    ]
    corrected = {row.name: holm({method: _p_value(row.of(each)) for method, each in measures.items()}) for row in kinds}
    rows: list[tuple[str, ...]] = []
    for method, each in measures.items():
        names: dict[tuple[str, ...], list[str]] = {}
        for row in kinds:
            measure = row.of(each)
            if measure is not None:
                names.setdefault(_cells(row, measure, corrected[row.name][method]), []).append(row.name)
        rows += [(", ".join(same), method, *cells) for cells, same in names.items()]
    return ("measure", "method", baseline, "with", "difference", "95% interval", "p", "p (Holm)"), rows


def p_value_text(p_value: float) -> str:
    """Return a p-value with two digits."""
    return f"{p_value:.2g}" if np.isfinite(p_value) else NONE


def _p_value(measure: Comparison | None) -> float:
    return np.nan if measure is None else measure.p_value


def _cells(row: _Row, measure: Comparison, corrected: float) -> tuple[str, ...]:
    sides = (measure.without, measure.with_transfer) if row.has_sides else ()
    texts = [_value(float(row.average(runs)) * row.scale, NOT_REACHED) for runs in sides] or [NONE, NONE]
    low, high = measure.low * row.scale, measure.high * row.scale
    interval = f"{low:.3g} to {high:.3g}" if np.isfinite([low, high]).all() else NONE
    effect = measure.effect * row.scale
    difference = f"{effect:+.3g}" if np.isfinite(effect) else NONE
    return (*texts, difference, interval, p_value_text(measure.p_value), p_value_text(corrected))


def _value(number: float, if_infinite: str) -> str:
    return f"{number:.4g}" if np.isfinite(number) else if_infinite
