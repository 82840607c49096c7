"""Whether a pair's known mapping is right: the error of its predictions on target transitions, beside COMBREL's."""

from __future__ import annotations

from contextlib import closing
from typing import Any, NamedTuple, cast

import numpy as np

from sb3_combrel import COMBREL, FittedRMax, SourceInstances
from sb3_combrel.common.periodic import differences, flag_array
from sb3_combrel.experiments.benchmark.methods import METHODS, DoesNotFit, Sources
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.runs.job import chosen_on_purpose


class Errors(NamedTuple):
    """Mean squared errors of predicted effects on target transitions, over those of "no change"."""

    known: float  # of the known mapping
    chosen: float  # of the factored mapping of the pair's set that complies best with all the transitions
    description: str  # that mapping in words


def errors_of(pair: Pair, sources: tuple[SourceInstances, ...], transitions: SourceInstances) -> Errors:
    """Compare the known mapping of a pair with the one that COMBREL chooses.

    :param sources: instances of its sources
    :param transitions: of its target, in their order
    :raises ValueError: if nobody knows a mapping
    """
    given: Sources = sources[0] if len(sources) == 1 else list(sources)
    try:
        oracle = METHODS["oracle"].make(given, pair)
    except DoesNotFit as error:
        raise ValueError(f"known must be a mapping: {error}") from error
    # Copies are compared on all transitions, so that no choice is made before the last.
    combrel = COMBREL(given, pair.mappings, use="prior", max_transitions=len(transitions))
    with closing(pair.make_target()) as env, chosen_on_purpose():
        agents = [FittedRMax(env, transfer=each, seed=0, **pair.learner).agent for each in (oracle, combrel)]
    known, chosen = (cast(Any, agent.transfer) for agent in agents)
    scaling = agents[0].task.scaling
    states, after = scaling.to_unit(transitions.states), scaling.to_unit(transitions.next_states)
    rest: list[Any] = [each.tolist() for each in (transitions.actions, transitions.rewards, transitions.terminated)]
    for state, action, reward, next_state, terminated in zip(states, *rest[:2], after, rest[2], strict=True):
        chosen.observe(state, action, reward, next_state, terminated)
    effects = differences(after, states, flag_array(known.task.periodic, transitions.n_variables))
    predicted = known.source_prior.predict(states, transitions.actions).effect
    of_known = float(np.sum((effects - predicted) ** 2) / np.sum(effects**2))
    return Errors(of_known, chosen.source_prior.error(), chosen.describe_prior())
