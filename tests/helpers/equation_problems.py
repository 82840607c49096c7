"""Source instances and target transitions without any meaning, in the form that the equations take."""

import numpy as np

from helpers import naive_transfer as naive
from sb3_combrel.transfer.equations import Transitions


def as_transitions(source):
    """Source instances in unit coordinates, in their order."""
    start, end = source.scaling.to_unit(source.states), source.scaling.to_unit(source.next_states)
    return Transitions(start, source.actions, end - start, source.rewards, source.terminated)


def as_sample(transitions, n_variables):
    """The naive version's target transitions, one a row."""
    return Transitions(
        np.array([t.state for t in transitions]).reshape(-1, n_variables),
        np.array([t.action for t in transitions], dtype=np.int64),
        np.array([t.next_state - t.state for t in transitions]).reshape(-1, n_variables),
        np.array([t.reward for t in transitions]),
        np.zeros(len(transitions), dtype=bool),
    )


def problem(seed, sizes, n_instances=15, n_transitions=12, spread=0.4):
    """A source, a mapping and target transitions without any meaning."""
    rng = np.random.default_rng(seed)
    source = naive.random_source(rng, n_instances, sizes[0], sizes[2], spread)
    mapping = naive.random_mapping(rng, *sizes)
    return source, mapping, [naive.random_transition(rng, sizes[1], sizes[3], spread) for _ in range(n_transitions)]
