"""The report of a source as the prior: which mappings, how sure, which would be next, what the target contradicted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sb3_combrel.transfer.equations import prediction_compliances
from sb3_combrel.transfer.prior.evidence import SMALLEST_ERROR
from sb3_combrel.transfer.prior.prior_choice import Choice, best_actions
from sb3_combrel.transfer.prior.prior_history import evidence_points
from sb3_combrel.transfer.prior.source_prior import SourcePrior
from sb3_combrel.transfer.report import MappingReport, TransferReport, describe_sources

# Alternatives are compared on so many of the recorded transitions, at most, evenly spread.
MAX_TRANSITIONS = 1000


class _Sample:
    """Recorded transitions of the target by which choices are compared."""

    def __init__(self, prior: SourcePrior):
        self.copies, seen = prior.copies, prior.transitions
        rows = np.linspace(0.0, seen.n, min(seen.n, MAX_TRANSITIONS), endpoint=False).astype(np.int64)
        self.states, self.actions, self.effects = seen.states[rows], seen.actions[rows], seen.effects[rows]
        size = np.abs(self.effects).sum(axis=0) / max(len(rows), 1)
        self.scale = np.maximum(size**2, SMALLEST_ERROR**2)

    def judge(self, choice: Choice | None, action: int | None = None) -> tuple[float, float]:
        """Mean compliance of a choice, or of "no change", and its error over that of "no change"; NaN for none."""
        rows = np.ones(len(self.actions), dtype=np.bool_) if action is None else self.actions == action
        if not rows.any():
            return np.nan, np.nan
        effects = self.effects[rows]
        predicted = np.zeros_like(effects)
        if choice is not None:
            predicted = self.copies.predict(self.copies.uses(*choice), self.states[rows], self.actions[rows])[0]
        error, moved = float(((effects - predicted) ** 2).sum()), float((effects**2).sum())
        compliance = prediction_compliances(effects, predicted, self.scale)
        return float(compliance.mean()), error / moved if moved > 0.0 else np.nan


def compliance_of_prior(prior: SourcePrior) -> np.ndarray:
    """Mean compliance of what each target action is taken for, shape (n_target_actions,); NaN where nothing is chosen."""
    choice, sample = prior.choice, _Sample(prior)
    actions = range(prior.task.n_actions)
    return np.array([sample.judge(choice, a)[0] if choice is not None and choice.moves(a) else np.nan for a in actions])


def report_of_prior(method: str, prior: SourcePrior, statistics: Mapping[str, float]) -> TransferReport:
    """Report what a source was taken for; ``method``: with its arguments, as text; ``statistics``: its figures of the log."""
    choice, sample, bound = prior.choice, _Sample(prior), prior.value_bound()
    mappings: tuple[MappingReport, ...] = ()
    next_best = "", np.nan
    in_use, bounding = (prior.candidates.describe_choice(each) for each in (choice, prior.bounding))
    if choice is not None:
        others = _alternatives(prior, choice)
        mappings = tuple(_mapping(prior, choice, a, sample, others) for a in range(prior.task.n_actions))
        next_best = _next_division(prior, choice, sample)
    return TransferReport(
        method=method,
        use="prior",
        sources=describe_sources(prior.sources),
        n_steps=prior.n_observed,
        mappings=mappings,
        error=prior.error(),
        next_best=next_best[0],
        next_best_error=next_best[1],
        bounds_values=bound is not None,
        bound=() if bound is None else tuple(np.quantile(bound, (0.0, 0.5, 1.0)).tolist()),
        why_unbounded=prior.why_unbounded(),
        bounded_through=bounding if bound is not None and bounding != in_use else "",
        statistics=statistics,
        history=evidence_points(prior),
        **prior.errors.report_fields(),
    )


def _mapping(prior: SourcePrior, choice: Choice, action: int, sample: _Sample, others: Sequence[Choice]) -> MappingReport:
    """Report what one target action is taken for."""
    candidates, in_use = prior.candidates, int(prior.choices_by_action()[action])
    of_action = {each: n for each, n in prior.uses().items() if candidates.parts(each).target_action == action}
    mapping = candidates.describe_moves(choice.moves(action))
    compliance, error = sample.judge(choice, action)
    n_compared = int((sample.actions == action).sum())
    if not n_compared:
        # Of a mapping that is given no transitions are recorded.
        error, n_compared = float(prior.errors.errors()[action]), int(prior.errors.of_actions[action, 0])
    next_best = "", np.nan, np.nan
    for other in others:
        words, judged = candidates.describe_moves(other.moves(action)), sample.judge(other, action)
        if words != mapping and not np.isnan(judged[0]) and not judged[0] <= next_best[1]:
            next_best = words, *judged
    return MappingReport(
        target_action=prior.task.action_names[action],
        mapping=mapping,
        share=of_action.get(in_use, 0) / max(sum(of_action.values()), 1),
        n_mappings=len(of_action),
        compliance=compliance,
        next_best=next_best[0],
        next_best_compliance=next_best[1],
        no_change_compliance=sample.judge(None, action)[0],
        error=error,
        next_best_error=next_best[2],
        n_compared=n_compared,
        strength=float(prior.strengths()[action]),
        no_source=float(prior.no_source()[action]),
    )


def _alternatives(prior: SourcePrior, choice: Choice) -> list[Choice]:
    """The best choices with another mapping for every target action: all at once, or copy by copy; none if given."""
    if prior.choose is None:
        return []
    used = np.nonzero((choice.copies >= 0) & (choice.actions >= 0))
    sums = prior.sums.excluding(choice.copies[used], used[0], choice.actions[used])
    if prior.whole:
        return [prior.choose(sums)]
    other_actions, _ = best_actions(prior.copies, sums)
    found = []
    for slot in range(choice.copies.shape[1]):
        actions = choice.actions.copy()
        for a, copy in enumerate(choice.copies[:, slot].tolist()):
            if copy >= 0 and other_actions[copy, a] >= 0:
                actions[a, slot] = other_actions[copy, a]
        found.append(Choice(choice.copies, actions))
    return found


def _next_division(prior: SourcePrior, choice: Choice, sample: _Sample) -> tuple[str, float]:
    """Find the best division of the target's variables that lacks one of the copies in use; by name, and its error."""
    if prior.whole or prior.choose is None or not prior.transitions.n:
        return "", np.nan
    best, name, error = -1.0, "", np.nan
    for copy in np.unique(choice.copies[choice.copies >= 0]).tolist():
        other = prior.choose(prior.sums.excluding(copy, slice(None), slice(None)))
        its_compliance, its_error = sample.judge(other)
        if its_compliance > best:
            best, name, error = its_compliance, prior.candidates.describe_copies(other), its_error
    return name, error
