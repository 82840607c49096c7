"""Which copies of the source the target is made of, and which source action moves each: chosen by evidence, or drawn."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np

from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums

# Divisions are searched subset by subset of the target's variables.
MAX_FACTORED_VARIABLES = 12
# By so many times as much evidence a copy is told apart from its mirror images, and a division from whole copies. Where a
# task's effects are their own mirror image both explain about as much, and only one of them has the goal on the right side.
TELLS_APART = 2.0


class Choice(NamedTuple):
    """What each target action is made of; int64, shape (n_target_actions, n)."""

    copies: np.ndarray  # copies that it moves, -1 for none
    actions: np.ndarray  # the source action that moves each, -1 where none has been chosen so far

    def same(self, other: Choice | None) -> bool:
        """Whether another choice is the same."""
        return other is not None and all(np.array_equal(one, two) for one, two in zip(self, other, strict=True))

    def same_copies(self) -> list[int]:
        """Return the copies that every target action moves; none if not all move the same."""
        first = self.copies[0]
        return first[first >= 0].tolist() if (self.copies == first).all() else []

    def moves(self, action: int) -> list[tuple[int, int]]:
        """Return the copies that a target action moves, and the source actions by which it does."""
        pairs = zip(self.copies[action].tolist(), self.actions[action].tolist(), strict=True)
        return [(copy, used) for copy, used in pairs if copy >= 0 and used >= 0]


Chooser = Callable[[CopySums], Choice]


def best_actions(copies: Copies, sums: CopySums, allowed: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Find the source action with most evidence for each copy and target action, each on its own.

    Of an action that no instance of the source has taken nothing is known.

    :param allowed: bool, shape (n_copies, n_target_actions, most source actions): what may be chosen; None: everything
    :return: the actions, int64, shape (n_copies, n_target_actions), -1 for none; and the evidence, -inf for none
    """
    gain = sums.gain.sum(axis=3)
    taken = copies.taken[:, None]
    gain = np.where(taken if allowed is None else taken & allowed, gain, -np.inf)
    best = np.where(sums.n == 0.0, -np.inf, gain.max(axis=2))
    return np.where(best == -np.inf, -1, gain.argmax(axis=2)), best


def choose_mapping(copies: Copies, sums: CopySums, allowed: np.ndarray) -> Choice:
    """Choose for each target action the state mapping (a copy) and source action with most evidence."""
    action, gain = best_actions(copies, sums, allowed)
    best = gain.argmax(axis=0)
    chosen = action[best, np.arange(len(best))]
    return Choice(np.where(chosen < 0, -1, best)[:, None], chosen[:, None])


def choose_factored(copies: Copies, sums: CopySums) -> Choice:
    """Choose the division into copies and variables that stay with most evidence, ``equations.division_evidence``."""
    return _division(copies, sums, scores_of(copies, sums))


def choose_whole(copies: Copies, sums: CopySums, in_use: Choice) -> Choice:
    """Choose the division into copies that have all variables of their source, and so can bound values.

    The whole copies of the division in use, if that has :data:`TELLS_APART` times the evidence on any variable. Parts of a
    source explain effects somewhat better than the whole does, as its data weigh more in fewer variables; that does not speak
    against the whole.
    """
    found = _division(copies, sums, np.where(copies.whole, scores_of(copies, sums), -np.inf))
    told_apart = TELLS_APART * _evidence_by_variable(sums, found) < _evidence_by_variable(sums, in_use)
    return whole_part(copies, in_use) if told_apart.any() else found


def _evidence_by_variable(sums: CopySums, choice: Choice) -> np.ndarray:
    """What a choice explains of each target variable, in nats, shape (n_target_variables,)."""
    moves = [(copy, a, used) for a in range(len(sums.n)) for copy, used in choice.moves(a)]
    return np.sum([sums.gain[move] for move in moves], axis=0) if moves else np.zeros(sums.gain.shape[3])


def whole_part(copies: Copies, choice: Choice) -> Choice:
    """Leave out of a choice the copies that do not have all variables of their source."""
    kept = (choice.copies >= 0) & copies.whole[choice.copies]
    used = kept.any(axis=0)
    return Choice(np.where(kept, choice.copies, -1)[:, used], choice.actions[:, used])


def _division(copies: Copies, sums: CopySums, scores: np.ndarray) -> Choice:
    """The best division by the ``scores`` of all copies, each with its best actions.

    Of mirrored copies those alone may be chosen that have :data:`TELLS_APART` times the evidence of one that is not, or in
    whose place there would be parts of them, one of which is mirrored.
    """
    action, _ = best_actions(copies, sums)
    members: np.ndarray = copies.state >= 0
    mirrored = np.asarray((copies.sign < 0.0).any(axis=1))
    barred = mirrored & ~explains_more(members, mirrored, scores)
    chosen = best_division(members, np.where(barred, -np.inf, scores))
    barred &= ~made_of_parts(members, mirrored, chosen)
    chosen = best_division(members, np.where(barred, -np.inf, scores))
    n_actions = len(sums.n)
    return Choice(np.tile(np.array(chosen, dtype=np.int64), (n_actions, 1)), action[chosen].T.copy())


def scores_of(copies: Copies, sums: CopySums) -> np.ndarray:
    """What each copy adds to the evidence for a division, with its best actions, ``equations.division_evidence``."""
    _, gain = best_actions(copies, sums)
    taken = sums.n > 0.0
    cost = taken.sum() * np.log(copies.table.n_actions) + np.log(len(copies))
    return np.asarray(np.where(taken, gain, 0.0).sum(axis=1) - cost)


def images_of(copies: Copies, scores: np.ndarray, copy: int) -> list[int]:
    """Find the mirror images of a copy, the original among them, that the effects' evidence does not tell apart from it.

    :param scores: :func:`scores_of`
    """
    images = (copies.state == copies.state[copy]).all(axis=1) & (copies.source == copies.source[copy])
    images[copy] = False
    return np.flatnonzero(images & (TELLS_APART * scores > scores[copy])).tolist()


def twins_of(copies: Copies, scores: np.ndarray, copy: int) -> list[int]:
    """Find the best copy of each other source that the effects' evidence does not tell apart from a copy.

    One that has all variables of its source is told apart from parts of others.

    :param scores: :func:`scores_of`
    """
    same = ((copies.state >= 0) == (copies.state[copy] >= 0)).all(axis=1) & (TELLS_APART * scores > scores[copy])
    same &= copies.whole | ~copies.whole[copy]
    found = []
    for source in np.setdiff1d(copies.source[same], copies.source[copy]).tolist():
        of_source = np.flatnonzero(same & (copies.source == source))
        found.append(int(of_source[scores[of_source].argmax()]))
    return found


def variables_of(members: np.ndarray) -> np.ndarray:
    """A number for the set of variables of each copy, int64; ``members``: bool, shape (n_copies, n_variables)."""
    return np.asarray(members @ (1 << np.arange(members.shape[1])))


def explains_more(members: np.ndarray, mirrored: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Whether copies score :data:`TELLS_APART` times as much as the best of the same variables that is not mirrored.

    :param members: the variables of each copy, bool, shape (n_copies, n_variables); ``mirrored``: bool, shape (n_copies,)
    :param scores: of each copy, shape (n_copies,)
    """
    variables = variables_of(members)
    best = np.zeros(1 << members.shape[1])
    np.maximum.at(best, variables[~mirrored], scores[~mirrored])
    more: np.ndarray = scores > TELLS_APART * best[variables]
    return more


def made_of_parts(members: np.ndarray, mirrored: np.ndarray, chosen: list[int]) -> np.ndarray:
    """Whether copies that are chosen, one of them mirrored, have some of each copy's variables and no others.

    :param members: the variables of each copy, bool, shape (n_copies, n_variables); ``mirrored``: bool, shape (n_copies,)
    :return: bool, shape (n_copies,)
    """
    parts = members[chosen]
    overlap = (members[:, None] & parts).any(axis=2)
    inside = overlap & ~(parts & ~members[:, None]).any(axis=2)
    made: np.ndarray = (overlap == inside).all(axis=1) & (inside & mirrored[chosen]).any(axis=1)
    return made


def best_division(members: np.ndarray, scores: np.ndarray) -> list[int]:
    """Find the disjoint copies whose scores add up to most; by their first variable.

    By dynamic programming over the subsets of the variables that are divided already. ``members``: the variables of each copy,
    bool, shape (n_copies, n_variables); ``scores``: of each copy; of variables in no copy it is 0.
    """
    n_variables = members.shape[1]
    masks = variables_of(members)
    # Of the copies of the same variables only the best can be chosen; the first of equal ones.
    best: dict[int, int] = {}
    for copy in np.argsort(-scores, kind="stable").tolist():
        best.setdefault(int(masks[copy]), copy)
    starting: list[list[tuple[int, int]]] = [[] for _ in range(n_variables)]
    for mask, copy in best.items():
        starting[(mask & -mask).bit_length() - 1].append((mask, copy))
    found: dict[int, tuple[float, tuple[int, ...]]] = {0: (0.0, ())}
    full = (1 << n_variables) - 1
    for taken in range(full):
        if taken not in found:
            continue
        score, chosen = found[taken]
        v = (~taken & (taken + 1)).bit_length() - 1
        options = [(mask, float(scores[copy]), (*chosen, copy)) for mask, copy in starting[v] if not mask & taken]
        for mask, more, with_it in [*options, (1 << v, 0.0, chosen)]:
            if taken | mask not in found or score + more > found[taken | mask][0]:
                found[taken | mask] = score + more, with_it
    return list(found[full][1])


def draw_mapping(allowed: np.ndarray, rng: np.random.Generator) -> Choice:
    """Draw for each target action one of the pairs of state mapping and source action that are ``allowed``."""
    drawn = [rng.choice(np.argwhere(allowed[:, a])) for a in range(allowed.shape[1])]
    chosen = np.array(drawn, dtype=np.int64)
    return Choice(chosen[:, :1].copy(), chosen[:, 1:].copy())


def draw_factored(copies: Copies, n_actions: int, rng: np.random.Generator) -> Choice:
    """Draw a factored mapping for the whole run, as a control.

    All divisions of as many target variables as possible into as few copies as possible are equally likely, and so are all
    source actions, each copy's and each target action's on its own.
    """
    masks = variables_of(copies.state >= 0).tolist()
    full = (1 << copies.state.shape[1]) - 1

    @cache
    def best_ways(taken: int) -> tuple[tuple[int, int], int, list[tuple[int, int, int]]]:
        """What the best divisions of the rest leave out, how many copies they have, how many there are, and how they go on.

        By a copy that has the first variable that is not taken, and no other that is, or it stays (copy -1); in how many ways.
        """
        if taken == full:
            return (0, 0), 1, []
        first = ~taken & (taken + 1)
        fit = [(mask, copy) for copy, mask in enumerate(masks) if mask & first and not mask & (taken | (first - 1))]
        found: dict[tuple[int, int], list[tuple[int, int, int]]] = {}
        for mask, copy in [*fit, (first, -1)]:
            (left, n_copies), n, _ = best_ways(taken | mask)
            found.setdefault((left + (copy < 0), n_copies + (copy >= 0)), []).append((mask, copy, n))
        best, options = min(found.items())
        return best, sum(n for *_, n in options), options

    taken, chosen = 0, []
    while taken < full:
        *_, options = best_ways(taken)
        counts = np.array([n for *_, n in options], dtype=np.float64)
        mask, copy, _ = options[int(rng.choice(len(options), p=counts / counts.sum()))]
        taken |= mask
        if copy >= 0:
            chosen.append(copy)
    of_source = copies.table.n_actions[chosen]
    actions = rng.integers(0, of_source, size=(n_actions, len(chosen)))
    return Choice(np.tile(np.array(chosen, dtype=np.int64), (n_actions, 1)), actions.astype(np.int64))
