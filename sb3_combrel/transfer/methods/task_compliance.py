"""Compliance of virtual source tasks with the target (Eq. 6), and how often each candidate is in tasks that comply."""

from __future__ import annotations

import numpy as np

from sb3_combrel.common.instances import Instances
from sb3_combrel.mappings.action_mappings import AllActionMappings
from sb3_combrel.mappings.mapping_set import MappingSet
from sb3_combrel.transfer.candidates import Candidates
from sb3_combrel.transfer.methods.least_error import action_table


def mean_compliances(mappings: MappingSet, sums: np.ndarray, n_transitions: int) -> np.ndarray:
    """
    Return for each state mapping, target action and source action the compliance of the tasks that have these, added up.

    The compliance of a task, Lambda_X of Eq. 6, is the sum over target actions of the compliances of their transitions,
    divided by the number of all transitions. Every mapping of the set is as likely as any other.

    :param mappings: the mappings to one source
    :param sums: compliances of the target's transitions added up, by state mapping, target action and source action, shape
        (n_state_mappings, n_target_actions, n_source_actions)
    :param n_transitions: of all target actions together
    :return: sum over X of Lambda_X / n_mappings, shape of ``sums``
    """
    n_rows, n_actions, n_source_actions = sums.shape
    if mappings.pairs is None and isinstance(mappings.actions, AllActionMappings):
        # In the mean over all source actions that the other target actions may have.
        of_action = sums.mean(axis=2)
        others = of_action.sum(axis=1, keepdims=True) - of_action
        everything: np.ndarray = sums + others[:, :, None]
        return everything / (n_transitions * n_rows * n_source_actions)
    found, each_action = np.zeros_like(sums), np.arange(n_actions)
    if mappings.pairs is not None:
        rows, actions = mappings.pairs[:, :1], action_table(mappings.actions, mappings.pairs[:, 1].tolist())
        of_task = sums[rows, each_action, actions].sum(axis=1) / (n_transitions * len(rows))
        np.add.at(found, (rows, each_action, actions), of_task[:, None])
        return found
    actions = action_table(mappings.actions, range(mappings.n_action_mappings))
    for row in range(n_rows):
        of_task = sums[row][each_action, actions].sum(axis=1) / (n_transitions * n_rows * len(actions))
        np.add.at(found[row], (each_action, actions), of_task[:, None])
    return found


def candidate_compliances(candidates: Candidates, sums: np.ndarray, n_transitions: int) -> np.ndarray:
    """
    Return for each candidate the compliance of all virtual source tasks that have it, added up.

    Among the candidates of a target action it is in proportion to the probability that an instance comes from a task with
    that candidate, if tasks are drawn in proportion to their compliance. Sources are equally likely beforehand, and so are
    the mappings to each.

    :param candidates: the candidates of every target action, of all sources
    :param sums: see :func:`mean_compliances`; the state mappings of all sources one below the other, their actions numbered on
    :param n_transitions: of all target actions together
    :return: shape (n_candidates,); of each target action they add up to the mean compliance of all tasks
    """
    origins = np.array(candidates.origins, dtype=np.int64)
    found, row, action = np.zeros(len(origins)), 0, 0
    for number, (source, mappings) in enumerate(zip(candidates.sources, candidates.sets, strict=True)):
        rows, actions = slice(row, row + mappings.n_state_mappings), slice(action, action + source.n_actions)
        each = mean_compliances(mappings, sums[rows, :, actions], n_transitions) / len(candidates.sources)
        # Of equal state mappings one is a candidate, which stands for all.
        same = np.unique(np.hstack([mappings.state_mappings, mappings.state_signs]), axis=0, return_inverse=True)[1].ravel()
        of_equal = np.zeros_like(each)
        np.add.at(of_equal, same, each)
        own = origins[:, 0] == number
        _, target_action, state_index, source_action = origins[own].T
        found[own] = of_equal[same[state_index], target_action, source_action]
        row, action = rows.stop, actions.stop
    return found


def draw_instances(
    candidates: Candidates, compliances: np.ndarray, relevances: np.ndarray, n: int, rng: np.random.Generator
) -> np.ndarray:
    """
    Draw translated instances for each target action, without replacement.

    Each time one is drawn, a candidate is drawn in proportion to its compliance, and of it an instance in proportion to its
    relevance, of those that are left. Drawn as the n largest of log-probabilities with Gumbel noise, which is the same.

    :param compliances: of each candidate, shape (n_candidates,)
    :param relevances: of each candidate's instances, shape (n_candidates, most instances of an action)
    :param n: instances of each target action, at most; fewer if no more have a probability above 0
    :param rng: the same one draws much the same from probabilities that are much the same
    :return: candidate and number of its instance, one a row, in order, int64, shape (n_drawn, 2)
    """
    size = candidates.instances.size[candidates.arrays.action]
    exists = np.arange(relevances.shape[1]) < size[:, None]
    relevant = np.where(exists, relevances, 0.0)
    total = relevant.sum(axis=1, keepdims=True)
    probability = compliances[:, None] * np.divide(relevant, total, out=np.zeros_like(relevant), where=total > 0.0)
    noise = rng.gumbel(size=probability.shape)
    rank = np.log(probability, out=np.full_like(probability, -np.inf), where=probability > 0.0) + noise
    found = []
    for first, last in zip(candidates.arrays.first[:-1], candidates.arrays.first[1:], strict=True):
        of_action = rank[first:last].ravel()
        best = np.argsort(-of_action, kind="stable")[:n]
        best = np.sort(best[of_action[best] > -np.inf])
        found.append(np.column_stack([first + best // rank.shape[1], best % rank.shape[1]]))
    return np.vstack(found).astype(np.int64)


def instances_of_each(candidates: Candidates, drawn: np.ndarray) -> Instances:
    """
    Return drawn instances by candidate, in the coordinates of their sources.

    :param drawn: candidate and number of its instance, one a row, in order, int64, shape (n, 2)
    """
    source, (candidate, number) = candidates.instances, drawn.T
    action = candidates.arrays.action[candidate]
    at = action, number
    columns = source.state[at], source.effect[at], source.reward[at], source.terminated[at]
    return Instances.of_rows(len(candidates), candidate, *columns, periodic=source.periodic)
