"""Which of copies that effects do not tell apart is taken: the one that foretells best how the target's episodes end.

Mirror images of a copy, of which one bounds values; and copies of several sources, which tasks of one robot may be.
"""

from __future__ import annotations

import itertools

import numpy as np

from sb3_combrel.transfer.equations import ends_evidence, foretold_ends, rewards_evidence
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.prior.prior_choice import TELLS_APART, Choice, best_actions, images_of, scores_of, twins_of
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions


def best_ending(copies: Copies, sums: CopySums, choice: Choice, transitions: RecordedTransitions) -> Choice:
    """Put mirror images in the place of copies where they foretell the target's ends :data:`TELLS_APART` times as well.

    Effects that are their own mirror image do not tell a copy from its images (``images_of``), but ends do. A target of
    several copies ends when all of them have ended.

    :param choice: of copies that have all variables of their source
    """
    scores = scores_of(copies, sums)
    options = [[copy, *images_of(copies, scores, copy)] for copy in choice.same_copies()]
    return _best_of(options, copies, sums, choice, transitions)


def best_source(copies: Copies, sums: CopySums, choice: Choice, transitions: RecordedTransitions) -> Choice:
    """Put copies of other sources in the place of copies where they foretell ends and rewards twice as well (``TELLS_APART``).

    :param choice: of copies; one whose target actions move different copies stays
    """
    scores = scores_of(copies, sums)
    options = [[copy, *twins_of(copies, scores, copy)] for copy in choice.same_copies()]
    return _best_of(options, copies, sums, choice, transitions, by_rewards=True)


def _best_of(
    options: list[list[int]],
    copies: Copies,
    sums: CopySums,
    choice: Choice,
    transitions: RecordedTransitions,
    by_rewards: bool = False,
) -> Choice:
    """Take one option for each copy of a choice, itself the first of them: those with most evidence, if that is enough."""
    if all(len(each) == 1 for each in options):
        return choice
    actions, _ = best_actions(copies, sums)
    foretold = {copy: _foretold(copies, copy, actions[copy], transitions) for copy in itertools.chain(*options)}
    ended, rewards = transitions.ended[: transitions.n], transitions.rewards[: transitions.n]

    def evidence(chosen: tuple[int, ...]) -> float:
        ends, expected, weights = zip(*(foretold[copy] for copy in chosen), strict=True)
        of_rewards = rewards_evidence(rewards, np.mean(expected, axis=0), np.min(weights, axis=0)) if by_rewards else 0.0
        return ends_evidence(ended, np.prod(ends, axis=0)) + of_rewards

    best, used = max(itertools.product(*options), key=evidence), tuple(each[0] for each in options)
    if evidence(best) <= evidence(used) + np.log(TELLS_APART):
        return choice
    return Choice(np.tile(best, (len(sums.n), 1)), actions[list(best)].T.copy())


def _foretold(copies: Copies, copy: int, actions: np.ndarray, transitions: RecordedTransitions) -> tuple[np.ndarray, ...]:
    """How probable a copy makes it that each of the target's transitions ends an episode; rewards, and weights of its data."""
    n, terminated = transitions.n, copies.sources[copies.source[copy]].terminated
    chosen = actions[transitions.actions[:n]]
    states = copies.as_copy(copy, transitions.states[:n])
    found = copies.model.predict(states, copies.table.first[copy] + np.maximum(chosen, 0))
    weight = np.where(chosen >= 0, found.weight, 0.0)
    return foretold_ends(found.end, weight, (terminated.sum() + 1.0) / (len(terminated) + 2.0)), found.reward, weight
