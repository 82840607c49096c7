"""Which of a copy and its mirror images bounds values: the one that foretells best where the target's episodes end."""

from __future__ import annotations

import itertools

import numpy as np

from sb3_combrel.transfer.equations import ends_evidence, foretold_ends
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.prior.prior_choice import TELLS_APART, Choice, best_actions, images_of, scores_of
from sb3_combrel.transfer.recorded_transitions import RecordedTransitions


def best_ending(copies: Copies, sums: CopySums, choice: Choice, transitions: RecordedTransitions) -> Choice:
    """Put mirror images in the place of copies where they foretell the target's ends :data:`TELLS_APART` times as well.

    Effects that are their own mirror image do not tell a copy from its images (``images_of``), but ends do. A target of
    several copies ends when all of them have ended.

    :param choice: of copies that have all variables of their source
    """
    used, scores = choice.same_copies(), scores_of(copies, sums)
    options = [[copy, *images_of(copies, scores, copy)] for copy in used]
    if all(len(each) == 1 for each in options):
        return choice
    actions, _ = best_actions(copies, sums)
    foretold = {copy: _foretold(copies, copy, actions[copy], transitions) for copy in itertools.chain(*options)}
    ended = transitions.ended[: transitions.n]

    def evidence(chosen: tuple[int, ...]) -> float:
        return ends_evidence(ended, np.prod([foretold[copy] for copy in chosen], axis=0))

    best = max(itertools.product(*options), key=evidence)
    if evidence(best) <= evidence(tuple(used)) + np.log(TELLS_APART):
        return choice
    return Choice(np.tile(best, (len(sums.n), 1)), actions[list(best)].T.copy())


def _foretold(copies: Copies, copy: int, actions: np.ndarray, transitions: RecordedTransitions) -> np.ndarray:
    """How probable a copy makes it that each of the target's transitions ends an episode, shape (n,)."""
    n, terminated = transitions.n, copies.sources[copies.source[copy]].terminated
    chosen = actions[transitions.actions[:n]]
    states = copies.as_copy(copy, transitions.states[:n])
    found = copies.model.predict(states, copies.table.first[copy] + np.maximum(chosen, 0))
    return foretold_ends(
        found.end, np.where(chosen >= 0, found.weight, 0.0), (terminated.sum() + 1.0) / (len(terminated) + 2.0)
    )
