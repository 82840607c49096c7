"""Table 6: what the paper claims, and what held here; and the same question of the controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sb3_combrel.comparison.measures import steps_to_reach
from sb3_combrel.comparison.statistics import ALPHA, bootstrap_relative_difference, cliffs_delta, holm, p_value_of_difference
from sb3_combrel.comparison.tables import Table, p_text, without_minus_zero
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.curves import WINDOW
from sb3_combrel.experiments.paper.domains import DOMAINS, ICUB, MOUNTAIN_CAR

HELD, NOT_HELD, OPPOSITE = "held", "not held", "opposite"
PAPERS, CONTROL = "paper", "control"


@dataclass(frozen=True)
class Claim:
    """
    That one method needs fewer environment steps than another.

    :param text: in words
    :param domain: name of the domain
    :param better: name of the method that is said to be better
    :param worse: name of the other
    :param kind: whose claim it is: "paper": of its Table 6; "control": what must hold besides for the method to be the reason
    """

    text: str
    domain: str
    better: str
    worse: str
    kind: str = PAPERS


_CAR, _ROBOT = MOUNTAIN_CAR.name, ICUB.name
# Where this held, what is saved need not come from the source.
_UNRELATED_HELPS = "COMBREL with an unrelated source better than no transfer"
CLAIMS: Sequence[Claim] = (
    Claim("COMBREL better than no transfer", _CAR, m.COMBREL_PLAIN, m.NO_TRANSFER),
    Claim("COMBREL better than no transfer", _ROBOT, m.COMBREL_PLAIN, m.NO_TRANSFER),
    Claim("COMBREL better than TIMBREL, intuitive mapping", _CAR, m.COMBREL_PLAIN, m.TIMBREL_INTUITIVE),
    Claim("COMBREL better than TIMBREL, most frequent mapping", _ROBOT, m.COMBREL_PLAIN, m.TIMBREL_FREQUENT),
    Claim("COMBREL better than TIMBREL, random mapping", _ROBOT, m.COMBREL_PLAIN, m.TIMBREL_RANDOM),
    Claim("COMBREL better without relevance than with it", _CAR, m.COMBREL_PLAIN, m.COMBREL_RELEVANCE),
    Claim("With relevance COMBREL better than TIMBREL", _CAR, m.COMBREL_RELEVANCE, m.TIMBREL_RELEVANCE),
    Claim("TIMBREL better with a random mapping than with the most frequent", _ROBOT, m.TIMBREL_RANDOM, m.TIMBREL_FREQUENT),
    *(
        Claim(f"COMBREL better than {words}", domain, m.COMBREL_PLAIN, other, CONTROL)
        for domain in (_CAR, _ROBOT)
        for other, words in (
            (m.TIMBREL_RANDOM, "random mappings, state by state"),
            (m.ONE_RANDOM, "one random mapping"),
            (m.ORACLE, "the oracle mapping"),
            (m.UNRELATED, "itself with an unrelated source"),
            (m.NO_TRANSFER_BEST, "no transfer at its best setting"),
        )
        if not (domain == _ROBOT and other == m.TIMBREL_RANDOM) and not (domain == _CAR and other == m.ORACLE)
    ),
    Claim(_UNRELATED_HELPS, _CAR, m.UNRELATED, m.NO_TRANSFER, CONTROL),
    Claim(_UNRELATED_HELPS, _ROBOT, m.UNRELATED, m.NO_TRANSFER, CONTROL),
)


class Verdict(NamedTuple):
    """
    What the runs say of a claim.

    :param claim: the claim
    :param saved: environment steps of all episodes that the better method saves, as a fraction of the other's; means
    :param low: lower bound of its 95% bootstrap interval; ``high``: upper bound
    :param delta: Cliff's delta: the probability that a run of the better method takes fewer steps than one of the other, less
        that of the reverse
    :param p_value: of the permutation test that both take the same steps in the mean
    :param corrected: the same by Holm's method, for the number of rows of the table
    :param p_threshold: of the test by Mann and Whitney that both need the same steps until the domain's last threshold, by
        Holm's method as well
    :param verdict: "held", "not held" or "opposite"
    """

    claim: Claim
    saved: float
    low: float
    high: float
    delta: float
    p_value: float
    corrected: float
    p_threshold: float
    verdict: str


def judge(steps: Mapping[str, Mapping[str, np.ndarray]], kind: str) -> list[Verdict]:
    """
    Judge all claims of a kind whose methods have been run.

    The steps of all of a run's episodes, the area under its learning curve, are compared. A claim held if the better method
    takes fewer, with a corrected p-value below ``ALPHA``; the opposite if it takes more, with such a p-value.

    :param steps: by domain and method the steps of each run's episodes, shape (n_runs, n_episodes)
    :param kind: "paper" or "control"
    """
    claims = [
        claim for claim in CLAIMS if claim.kind == kind and {claim.better, claim.worse} <= set(steps.get(claim.domain, {}))
    ]
    found, p_thresholds = [], []
    for claim in claims:
        better, worse = (steps[claim.domain][name].sum(axis=1).astype(np.float64) for name in (claim.better, claim.worse))
        saved = bootstrap_relative_difference(better, worse)
        p_value = p_value_of_difference(better, worse, "permutation")
        found.append((claim, -saved.value, -saved.high, -saved.low, -cliffs_delta(better, worse), p_value))
        p_thresholds.append(_p_of_times(steps[claim.domain], claim))
    corrected, p_of_times = holm(np.array([row[-1] for row in found])), holm(np.array(p_thresholds))
    rows = zip(found, corrected.tolist(), p_of_times.tolist(), strict=True)
    return [Verdict(*row, p, p_of_time, _verdict(row[1], p)) for row, p, p_of_time in rows]


def _p_of_times(steps: Mapping[str, np.ndarray], claim: Claim) -> float:
    threshold = DOMAINS[claim.domain].thresholds[-1]
    better, worse = (steps_to_reach(steps[name], threshold, WINDOW) for name in (claim.better, claim.worse))
    return p_value_of_difference(better, worse, "mann-whitney")


def _verdict(saved: float, p_value: float) -> str:
    if not p_value < ALPHA:
        return NOT_HELD
    return HELD if saved > 0.0 else OPPOSITE


def verdict_table(verdicts: Sequence[Verdict], title: str) -> Table:
    """Make a table of verdicts."""
    header = ("claim", "domain", "steps saved", "95% interval", "Cliff's delta", "p", "p (Holm)", "p, threshold", "verdict")
    rows = [
        (
            verdict.claim.text,
            DOMAINS[verdict.claim.domain].title,
            share_text(verdict.saved),
            interval_text(verdict.low, verdict.high),
            f"{without_minus_zero(verdict.delta, 2):+.2f}",
            p_text(verdict.p_value),
            p_text(verdict.corrected),
            p_text(verdict.p_threshold),
            verdict.verdict,
        )
        for verdict in verdicts
    ]
    return Table(title, header, rows)


def summary_table(steps: Mapping[str, Mapping[str, np.ndarray]]) -> Table:
    """
    Make a table of what each method takes: all steps, the first episodes, the end, and steps until each threshold.

    :param steps: by domain and method the steps of each run's episodes, shape (n_runs, n_episodes)
    """
    rows = []
    for domain_name, of_methods in steps.items():
        domain = DOMAINS[domain_name]
        hardest = domain.thresholds[-1]
        for method in (name for name in m.METHODS if name in of_methods):
            samples = of_methods[method]
            needed = steps_to_reach(samples, hardest, WINDOW)
            reached = np.isfinite(needed).sum()
            median = f"{np.median(needed):,.0f}" if np.isfinite(np.median(needed)) else "never"
            rows.append(
                (
                    domain.title,
                    method,
                    str(len(samples)),
                    _mean(samples.sum(axis=1)),
                    _mean(samples[:, :12].sum(axis=1)),
                    _mean(samples[:, -20:].mean(axis=1)),
                    f"{median} ({reached} of {len(samples)} runs; {hardest})",
                )
            )
    header = (
        "domain",
        "method",
        "runs",
        "steps, all",
        "first 12 episodes",
        "an episode, last 20",
        "steps to the last threshold",
    )
    return Table("Environment steps, mean and standard error; median until the last threshold", header, rows)


def _mean(values: np.ndarray) -> str:
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else np.nan
    return f"{values.mean():,.0f}" if np.isnan(error) else f"{values.mean():,.0f} ± {error:,.0f}"


def share_text(share: float) -> str:
    """A share in percent for a table."""
    return f"{without_minus_zero(share, 2):.0%}"


def interval_text(low: float, high: float) -> str:
    """An interval of shares for a table: "-" where there is none."""
    return "-" if np.isnan(low) else f"{share_text(low)} to {share_text(high)}"
