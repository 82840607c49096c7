"""Binding transfer methods, showing them transitions, and asking them for instances."""

import numpy as np


def bound(method, task, seed=0):
    """The method, bound to a task."""
    method.bind(task, np.random.default_rng(seed))
    return method


def show(method, transition):
    """Have the method observe a transition that ends no episode."""
    method.observe(transition.state, transition.action, transition.reward, transition.next_state, False)


def pairs_of(task):
    """The numbers of all state-action pairs of the sample."""
    return np.arange(task.n_actions * len(task.sample_states))


def transferred_to_all(method, task):
    """What the method returns for every pair, as if none had instances of its own."""
    pairs = pairs_of(task)
    found = transferred_to_pairs(method, pairs, np.zeros(len(pairs)))
    return [
        (found.weight[p, :n].tolist(), found.effect[p, :n].tolist(), found.reward[p, :n].tolist())
        for p, n in enumerate(found.length[: len(pairs)])
    ]


def choices_of(method):
    """What the method chooses for every pair if none is known."""
    changed_pairs(method)
    return method.choices()


def transferred_at(method, state, own_weight):
    """What a bound method returns at one state with every action."""
    n = len(own_weight)
    return method.transferred(np.tile(state, (n, 1)), np.arange(n), own_weight)


def transferred_to_pairs(method, pairs, own_weight):
    """What a bound method returns for pairs of the sample, ``action * n_points + point``."""
    n_points = len(method.task.sample_states)
    return method.transferred_to_sample(pairs % n_points, pairs // n_points, own_weight)


def changed_pairs(method, known=None):
    """The pairs of the sample, not known, whose instances may have changed."""
    shape = (method.task.n_actions, len(method.task.sample_states))
    known = np.zeros(shape, dtype=bool) if known is None else known.reshape(shape)
    return np.flatnonzero(np.broadcast_to(method.changed(known), shape) & ~known)


def named_candidates(method):
    """Each candidate of a bound method as the naive selection names it."""
    named = []
    for number, _, state_index, source_action in method.candidates.origins:
        of_source = method.candidates.sets[number]
        index = tuple(None if k < 0 else int(k) for k in of_source.state_mappings[state_index])
        named.append((number, index, tuple(int(s) for s in of_source.state_signs[state_index]), source_action))
    return named
