"""Whether a pair's known mapping is right: the error of its predictions on target transitions, beside the least of the set."""

from __future__ import annotations

import warnings
from contextlib import closing
from typing import NamedTuple

import numpy as np

from sb3_combrel import COMBREL, FactoredMapping, FittedRMax, InterTaskMapping, SourceInstances
from sb3_combrel.experiments.benchmark.methods import Sources
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.runs.job import chosen_on_purpose
from sb3_combrel.transfer.methods.mapping_transfer import MappingTransfer
from sb3_combrel.transfer.prior.prior_choice import best_division
from sb3_combrel.transfer.prior.source_prior import SourcePrior


class Errors(NamedTuple):
    """
    Mean squared errors of predicted effects on target transitions, over those of "no change".

    :param known: of the known mapping
    :param chosen: of the factored mapping that complies best with all the transitions
    :param least: of the factored mapping that predicts them best, which nobody can know beforehand
    :param description: the one that complies best, in words
    """

    known: float
    chosen: float
    least: float
    description: str


def errors_of(pair: Pair, sources: tuple[SourceInstances, ...], transitions: SourceInstances) -> Errors:
    """
    Compare the known mapping of a pair with all factored mappings of its set.

    :param pair: the pair, whose known mapping exists
    :param sources: instances of its sources
    :param transitions: of its target, in their order
    """
    given: Sources = sources[0] if len(sources) == 1 else list(sources)
    # Copies are compared on all transitions, so that no choice is made before the last.
    prior = _observed(pair, COMBREL(given, pair.mappings, use="prior", max_transitions=len(transitions)), transitions)
    return Errors(known_error(prior, pair), prior.error(), least_error(prior), prior.describe())


def known_error(prior: SourcePrior, pair: Pair) -> float:
    """
    Compute the error of a pair's known mapping.

    :param prior: of the pair's set, that has observed the transitions
    :param pair: the pair
    :raises ValueError: if nobody knows a mapping, or it is not in the set
    """
    sums = prior.sums
    errors = sums.effect.copy()
    for a, parts in enumerate(_parts(pair, len(sums.n))):
        for number, copy in parts:
            found, has = _find(prior, number, copy), copy.mapped
            errors[a, has] = sums.error[found, a, copy.action[a], has]
    return float(errors.sum() / sums.effect.sum())


def _parts(pair: Pair, n_actions: int) -> list[list[tuple[int, InterTaskMapping]]]:
    """What the known mapping makes of each target action: numbers of sources, and their copies."""
    if pair.known is None:
        raise ValueError(f"known must be a mapping, got None: nobody knows that of {pair.name}")
    given = [pair.known] if isinstance(pair.known, FactoredMapping) else list(pair.known)
    factored = [each for each in given if isinstance(each, FactoredMapping)]
    if factored:
        return [[(number, copy) for number, each in enumerate(factored) for copy in each.copies]] * n_actions
    return [[(0, each)] for each in given if isinstance(each, InterTaskMapping)]


def _find(prior: SourcePrior, source: int, copy: InterTaskMapping) -> int:
    """The copy of a prior's set with the variables of a mapping."""
    copies = prior.copies
    same = (copies.source == source) & (copies.state == copy.state_index).all(axis=1)
    same &= ((copies.sign < 0) == (copy.state_sign < 0)).all(axis=1)
    if not same.any():
        raise ValueError(f"known must be made of copies of the pair's set of mappings, got {copy!r}")
    return int(np.flatnonzero(same)[0])


def least_error(prior: SourcePrior) -> float:
    """
    Find the least error that a division of the target's variables into a prior's copies and variables that stay can have.

    :param prior: that has observed the transitions
    """
    copies, sums = prior.copies, prior.sums
    has = copies.state >= 0
    exists = np.arange(copies.most_actions) < copies.table.n_actions[:, None]
    # Of each copy, target action and source action, over the variables of the copy.
    errors = (sums.error * has[:, None, None, :]).sum(axis=3)
    errors = np.where(exists[:, None], errors, np.inf).min(axis=2).sum(axis=1)
    division = best_division(has, -errors, -sums.effect.sum(axis=0))
    staying = ~has[division].any(axis=0) if division else np.ones(has.shape[1], dtype=np.bool_)
    total = errors[division].sum() + sums.effect.sum(axis=0)[staying].sum()
    return float(total / sums.effect.sum())


def _observed(pair: Pair, transfer: object, transitions: SourceInstances) -> SourcePrior:
    """The prior of a transfer method that has observed all transitions."""
    assert isinstance(transfer, MappingTransfer)
    with closing(pair.make_target()) as env, chosen_on_purpose(), warnings.catch_warnings():
        agent = FittedRMax(env, transfer=transfer, seed=0, **pair.learner).agent
        bound = agent.transfer
        assert isinstance(bound, MappingTransfer)
        scaling = agent.task.scaling
        rows = zip(
            scaling.to_unit(transitions.states),
            transitions.actions.tolist(),
            transitions.rewards.tolist(),
            scaling.to_unit(transitions.next_states),
            transitions.terminated.tolist(),
            strict=True,
        )
        for row in rows:
            bound.observe(*row)
    return bound.source_prior
