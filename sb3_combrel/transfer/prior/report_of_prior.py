"""The report of a source as the prior: which mappings, how sure, which would be next, what the target contradicted."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from sb3_combrel.transfer.prior.copy_sums import SMALLEST_SCALE
from sb3_combrel.transfer.prior.prior_choice import Choice, best_actions
from sb3_combrel.transfer.prior.source_prior import SourcePrior
from sb3_combrel.transfer.report import MappingReport, TransferReport, describe_sources

# Alternatives are compared on so many of the recorded transitions, at most, evenly spread.
MAX_TRANSITIONS = 1000


class _Sample(NamedTuple):
    """
    Recorded transitions of the target, unit coordinates, and what squared errors are compared with.

    :param scale: shape (n_variables,): of each variable the squared mean size of its effects
    """

    states: np.ndarray
    actions: np.ndarray
    effects: np.ndarray
    scale: np.ndarray


class _Fit(NamedTuple):
    """How well a choice predicts a sample: compliance, squared error and squared effect of each transition, shape (n,)."""

    compliance: np.ndarray
    error: np.ndarray
    effect: np.ndarray

    def of(self, rows: np.ndarray) -> tuple[float, float]:
        """Mean compliance, and error over that of "no change", of some transitions; NaN for none."""
        if not rows.any():
            return np.nan, np.nan
        moved = float(self.effect[rows].sum())
        return float(self.compliance[rows].mean()), float(self.error[rows].sum()) / moved if moved > 0.0 else np.nan


def report_of_prior(method: str, prior: SourcePrior, statistics: Mapping[str, float]) -> TransferReport:
    """
    Report what a source was taken for, as the prior of the target's model.

    :param method: the method with its arguments, as text
    :param prior: after one step at least
    :param statistics: the method's figures of the log, by name
    """
    names = prior.task.action_names
    pairs = np.argwhere(~prior.claims.explains)
    choice = prior.choice
    next_division, next_error = _next_division(prior) if choice is not None else ("", np.nan)
    return TransferReport(
        method=method,
        use="prior",
        sources=describe_sources(prior.sources),
        n_steps=prior.n_observed,
        n_rested=prior.n_claimed,
        mappings=() if choice is None else _mappings_of_prior(prior, choice),
        error=prior.error(),
        next_best=next_division,
        next_best_error=next_error,
        n_compared=int(prior.errors.of_actions[:, 0].sum()),
        n_worse=int(prior.errors.of_actions[:, 3].sum()),
        contradictions=prior.errors.contradictions(),
        not_used=tuple((names[a], prior.task.state_names[v]) for a, v in pairs.tolist()),
        ends=(prior.claims.outcomes.confirmed, prior.claims.outcomes.contradicted),
        bounds_values=prior.value_bound() is not None,
        rewards=(prior.claims.outcomes.rewards_right, prior.claims.outcomes.rewards_wrong),
        statistics=statistics,
    )


def _mappings_of_prior(prior: SourcePrior, choice: Choice) -> tuple[MappingReport, ...]:
    sample = _sample(prior)
    fit, still = _fit(prior, choice, sample), _no_change(sample)
    others = [(other, _fit(prior, other, sample)) for other in _alternatives(prior, choice)]
    candidates, uses, in_use = prior.candidates, prior.uses(), prior.choices_by_action()
    placed, compared = prior.errors.errors(), prior.errors.of_actions[:, 0]
    found = []
    for a, name in enumerate(prior.task.action_names):
        rows = sample.actions == a
        compliance, error = fit.of(rows)
        of_action = {each: n for each, n in uses.items() if candidates.parts(each).target_action == a}
        in_words = candidates.describe_action(choice, a)
        next_best, next_compliance, next_error = "", np.nan, np.nan
        for other, its_fit in others:
            its_compliance, its_error = its_fit.of(rows)
            words = candidates.describe_action(other, a)
            if words != in_words and rows.any() and not its_compliance <= next_compliance:
                next_best = words
                next_compliance, next_error = its_compliance, its_error
        found.append(
            MappingReport(
                target_action=name,
                mapping=in_words,
                share=of_action.get(int(in_use[a]), 0) / max(sum(of_action.values()), 1),
                n_mappings=len(of_action),
                compliance=compliance,
                next_best=next_best,
                next_best_compliance=next_compliance,
                no_change_compliance=still.of(rows)[0],
                # Of a mapping that is given no transitions are recorded.
                error=error if rows.any() else float(placed[a]),
                next_best_error=next_error,
                n_compared=int(rows.sum()) if rows.any() else int(compared[a]),
                trust=float(prior.claims.trust[a]),
            )
        )
    return tuple(found)


def _sample(prior: SourcePrior) -> _Sample:
    seen = prior.transitions
    n = seen.n
    rows = np.arange(n) if n <= MAX_TRANSITIONS else (np.arange(MAX_TRANSITIONS) * (n / MAX_TRANSITIONS)).astype(np.int64)
    effects = seen.effects[rows]
    size = np.abs(effects).mean(axis=0) if n else np.zeros(effects.shape[1])
    return _Sample(seen.states[rows], seen.actions[rows], effects, np.maximum(size**2, SMALLEST_SCALE))


def _fit(prior: SourcePrior, choice: Choice, sample: _Sample) -> _Fit:
    if not len(sample.actions):
        return _no_change(sample)
    uses = prior.copies.uses(*choice)
    predicted, *_ = prior.copies.predict(uses, prior.copies.work_space(uses), sample.states, sample.actions)
    return _fit_of_effects(predicted, sample)


def _no_change(sample: _Sample) -> _Fit:
    return _fit_of_effects(np.zeros_like(sample.effects), sample)


def _fit_of_effects(predicted: np.ndarray, sample: _Sample) -> _Fit:
    squared = (sample.effects - predicted) ** 2
    return _Fit(np.exp(-(squared / sample.scale).sum(axis=1)), squared.sum(axis=1), (sample.effects**2).sum(axis=1))


def _alternatives(prior: SourcePrior, choice: Choice) -> list[Choice]:
    """
    Return choices that have another mapping for every target action: the best by compliance, copy by copy.

    None for a mapping that is given: nothing was compared then.
    """
    if not prior.chooses:
        return []
    # What is in use cannot be chosen again.
    measured = prior.measured_sums()
    compliance = measured.compliance.copy()
    for a in range(len(choice.copies)):
        for copy, used in zip(choice.copies[a].tolist(), choice.actions[a].tolist(), strict=True):
            if copy >= 0 and used >= 0:
                compliance[copy, a, used] = -1.0 - measured.n[a]
    sums = measured._replace(compliance=compliance)
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


def _next_division(prior: SourcePrior) -> tuple[str, float]:
    """Find the best division of the target's variables that lacks one of the copies in use; by name, and its error."""
    assert prior.choice is not None
    if prior.whole or not prior.chooses or not prior.transitions.n:
        return "", np.nan
    sample, measured = _sample(prior), prior.measured_sums()
    everything = np.ones(len(sample.actions), dtype=np.bool_)
    best, name, error = -1.0, "", np.nan
    for copy in np.unique(prior.choice.copies[prior.choice.copies >= 0]).tolist():
        compliance = measured.compliance.copy()
        # Below what no change has, so that it cannot be chosen.
        compliance[copy] = -1.0 - measured.n[:, None]
        other = prior.choose(measured._replace(compliance=compliance))
        its_compliance, its_error = _fit(prior, other, sample).of(everything)
        if its_compliance > best:
            best, name, error = its_compliance, prior.candidates.describe_copies(other), its_error
    return name, error
