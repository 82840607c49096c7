"""Table 6: what the paper claims, and what held here; and the same question of the controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from sb3_combrel.comparison.measures import steps_to_reach
from sb3_combrel.comparison.statistics import (
    ALPHA,
    bootstrap_relative_difference,
    cliffs_delta,
    holm,
    p_value_of_difference,
    smallest_p_value,
)
from sb3_combrel.comparison.tables import Table, interval_text, p_text, share_text, without_minus_zero
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import DOMAINS, ICUB, MOUNTAIN_CAR
from sb3_combrel.experiments.paper.figures import WINDOW

HELD, NOT_HELD, OPPOSITE, TOO_FEW = "held", "not held", "opposite", "too few runs"
PAPERS, WINDOWS, CONTROL = "paper", "window", "control"


class Claim(NamedTuple):
    """That one method needs fewer environment steps than another in a domain."""

    text: str
    domain: str
    better: str
    worse: str
    kind: str = PAPERS  # the paper's, of its Table 6; the same of its own window; or a control's: what must hold besides
    episodes: tuple[int, int] | None = None  # the first and the last that count, from 1 on; None: all


_CAR, _ROBOT = MOUNTAIN_CAR.name, ICUB.name
_CONTROLS = {
    m.TIMBREL_RANDOM: "random mappings, state by state",
    m.ONE_RANDOM: "one random mapping",
    m.ORACLE: "the oracle mapping",
    m.UNRELATED: "itself with an unrelated source",
    m.NO_TRANSFER_BEST: "no transfer at its best setting",
}
# Where this held, what is saved need not come from the source.
_UNRELATED_HELPS = "COMBREL with an unrelated source better than no transfer"
_LATER, _RELEVANT = (50, 300), (100, 170)
CLAIMS: Sequence[Claim] = (
    Claim("COMBREL better than no transfer", _CAR, m.COMBREL_PLAIN, m.NO_TRANSFER),
    Claim("COMBREL better than no transfer", _ROBOT, m.COMBREL_PLAIN, m.NO_TRANSFER),
    Claim("COMBREL better than TIMBREL, intuitive mapping", _CAR, m.COMBREL_PLAIN, m.TIMBREL_INTUITIVE),
    Claim("COMBREL better than TIMBREL, most frequent mapping", _ROBOT, m.COMBREL_PLAIN, m.TIMBREL_FREQUENT),
    Claim("COMBREL better than TIMBREL, random mapping", _ROBOT, m.COMBREL_PLAIN, m.TIMBREL_RANDOM),
    Claim("COMBREL better without relevance than with it", _CAR, m.COMBREL_PLAIN, m.COMBREL_RELEVANCE),
    Claim("With relevance COMBREL better than TIMBREL with relevance", _CAR, m.COMBREL_RELEVANCE, m.TIMBREL_RELEVANCE),
    Claim("TIMBREL better with a random mapping than with the most frequent", _ROBOT, m.TIMBREL_RANDOM, m.TIMBREL_FREQUENT),
    Claim("COMBREL better than TIMBREL, most frequent mapping", _ROBOT, m.COMBREL_PLAIN, m.TIMBREL_FREQUENT, WINDOWS, _LATER),
    Claim("COMBREL better than TIMBREL, random mapping", _ROBOT, m.COMBREL_PLAIN, m.TIMBREL_RANDOM, WINDOWS, _LATER),
    Claim(
        "With relevance COMBREL better than TIMBREL with relevance",
        _CAR,
        m.COMBREL_RELEVANCE,
        m.TIMBREL_RELEVANCE,
        WINDOWS,
        _RELEVANT,
    ),
    *(
        Claim(f"COMBREL better than {words}", domain, m.COMBREL_PLAIN, other, CONTROL)
        for domain in (_CAR, _ROBOT)
        for other, words in _CONTROLS.items()
        # The one is among the paper's claims, and the other does not exist.
        if (domain, other) not in ((_ROBOT, m.TIMBREL_RANDOM), (_CAR, m.ORACLE))
    ),
    Claim(_UNRELATED_HELPS, _CAR, m.UNRELATED, m.NO_TRANSFER, CONTROL),
    Claim(_UNRELATED_HELPS, _ROBOT, m.UNRELATED, m.NO_TRANSFER, CONTROL),
)


class Verdict(NamedTuple):
    """What the runs say of a claim."""

    claim: Claim
    saved: float  # environment steps of all episodes that the better method saves, as a fraction of the other's; means
    low: float  # lower bound of its 95% bootstrap interval; ``high``: upper bound
    high: float
    delta: float  # Cliff's delta: how much more often a run of the better method takes fewer steps than more
    p_value: float  # of the permutation test that both take the same steps in the mean
    corrected: float  # the same by Holm's method, for the number of rows of the table
    p_threshold: float  # of Mann and Whitney's test of the steps until the domain's last threshold, by Holm's method as well
    tellable: bool  # whether there are runs enough for any p-value below ``ALPHA``

    @property
    def verdict(self) -> str:
        """Whether the claim held."""
        if not self.corrected < ALPHA:
            return NOT_HELD if self.tellable else TOO_FEW
        return HELD if self.saved > 0.0 else OPPOSITE


def judge(steps: Mapping[str, Mapping[str, np.ndarray]], kind: str) -> list[Verdict]:
    """Judge all claims of a kind whose methods have been run, for all of its episodes.

    The steps of a run's episodes, the area under its learning curve, are compared. A claim held if the better method
    takes fewer, with a corrected p-value below ``ALPHA``; the opposite if it takes more, with such a p-value.
    """
    totals, p_values, p_thresholds = {}, {}, {}
    for claim in CLAIMS:
        of_domain = steps.get(claim.domain, {})
        if claim.kind == kind and {claim.better, claim.worse} <= set(of_domain):
            better, worse = of_domain[claim.better], of_domain[claim.worse]
            start, end = claim.episodes or (1, better.shape[1])
            if end > better.shape[1]:
                continue
            first, second = (each[:, start - 1 : end].sum(axis=1).astype(float) for each in (better, worse))
            totals[claim] = first, second
            p_values[claim] = p_value_of_difference(first, second, "permutation")
            hardest = DOMAINS[claim.domain].thresholds[-1]
            first, second = steps_to_reach(better, hardest, WINDOW), steps_to_reach(worse, hardest, WINDOW)
            p_thresholds[claim] = p_value_of_difference(first, second, "mann-whitney")
    corrected, p_thresholds = holm(p_values), holm(p_thresholds)
    found = []
    for claim, samples in totals.items():
        more, low, high = bootstrap_relative_difference(*samples)
        p = p_values[claim], corrected[claim], p_thresholds[claim]
        tellable = smallest_p_value(len(samples[0]), len(samples[1]), 1) < ALPHA
        found.append(Verdict(claim, -more, -high, -low, -cliffs_delta(*samples), *p, tellable))
    return found


def verdict_table(verdicts: Sequence[Verdict], title: str) -> Table:
    """Make a table of verdicts."""
    header = ("claim", "domain", "steps saved", "95% interval", "Cliff's delta", "p", "p (Holm)", "p, threshold", "verdict")
    rows = []
    for each in verdicts:
        window = ", episodes {} to {}".format(*each.claim.episodes) if each.claim.episodes else ""
        claim = each.claim.text + window, DOMAINS[each.claim.domain].title
        saved = share_text(each.saved), interval_text(each.low, each.high), f"{without_minus_zero(each.delta, 2):+.2f}"
        p_values = map(p_text, (each.p_value, each.corrected, each.p_threshold))
        rows.append((*claim, *saved, *p_values, each.verdict))
    return Table(title, header, rows)
