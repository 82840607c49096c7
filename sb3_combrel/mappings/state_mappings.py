"""State mappings as rows of an array: which source variable each target variable is mapped to."""

from __future__ import annotations

from itertools import combinations, permutations, product
from math import comb, perm

import numpy as np

from sb3_combrel.common.checks import check_count, count_text
from sb3_combrel.mappings.inter_task_mapping import UNMAPPED, Ints

MAX_STATE_MAPPINGS = 100_000  # they are rows of an array, and the table of compliances has a column for each

# Far beyond what model learning on a grid is possible with; without limits, counting the mappings already takes for ever.
MAX_SOURCE_VARIABLES = 1000
MAX_TARGET_VARIABLES = 100

TWO_VARIABLES_ON_FOUR: Ints = np.array(list(permutations((0, 1, UNMAPPED, UNMAPPED))), dtype=np.int64)
"""The paper's 4! state mappings from two to four variables: the permutations of (0, 1, None, None); 12 of the 24 differ."""


def state_mappings_using_sources(n_source: int, n_target: int, *, once: bool, allow_none: bool) -> Ints:
    """Every state mapping that uses as many source variables as there is room for (``once`` each), -1 for None, in order."""
    check_count("n_source_variables", n_source, max=MAX_SOURCE_VARIABLES)
    check_count("n_target_variables", n_target, max=MAX_TARGET_VARIABLES)
    different = min(n_source, n_target)
    _check_n_state_mappings(_count_state_mappings(n_source, n_target, once, allow_none))
    choices = np.arange(UNMAPPED if allow_none else 0, n_source, dtype=np.int64)
    rows = np.empty((1, 0), dtype=np.int64)
    for position in range(n_target):
        rows = np.column_stack([np.repeat(rows, len(choices), axis=0), np.tile(choices, len(rows))])
        # Prune at once: rows that can no longer become valid would grow to (n_source + 1) ** n_target.
        used = (rows[:, :, None] == np.arange(n_source)).sum(axis=1)
        keep = (used > 0).sum(axis=1) + (n_target - 1 - position) >= different
        rows = rows[keep & (used <= 1).all(axis=1)] if once else rows[keep]
    return rows


def count_copies(n_source: int, n_target: int, signed: bool = False) -> int:
    """How many :func:`copies_of_source` there are; ``signed``: with all choices of signs."""
    sizes = range(1, min(n_source, n_target) + 1)
    return sum(comb(n_source, k) * perm(n_target, k) * (2**k if signed else 1) for k in sizes)


def copies_of_source(n_source: int, n_target: int) -> Ints:
    """State mappings of every copy of the source, or of some of its variables: of different ones, most variables first."""
    check_count("n_source_variables", n_source, max=MAX_SOURCE_VARIABLES)
    check_count("n_target_variables", n_target, max=MAX_TARGET_VARIABLES)
    largest = min(n_source, n_target)
    _check_n_state_mappings(count_copies(n_source, n_target))
    rows = []
    for size in range(largest, 0, -1):
        for used, taken in product(combinations(range(n_source), size), permutations(range(n_target), size)):
            rows.append(np.full(n_target, UNMAPPED, dtype=np.int64))
            rows[-1][list(taken)] = used
    return np.array(rows)


def with_mirrored(state_mappings: Ints) -> tuple[Ints, Ints]:
    """Every state mapping with every choice of signs for its mapped variables, +1 throughout first, and the signs."""
    mapped = state_mappings != UNMAPPED
    _check_n_state_mappings(sum(2**n for n in mapped.sum(axis=1).tolist()))
    rows, signs = [], []
    for row, is_mapped in zip(state_mappings, mapped, strict=True):
        for mirrored in product((1, -1), repeat=int(is_mapped.sum())):
            sign = np.ones_like(row)
            sign[is_mapped] = mirrored[::-1]  # the first variable's changes fastest
            rows.append(row)
            signs.append(sign)
    return np.array(rows), np.array(signs)


def _count_state_mappings(n_source: int, n_target: int, once: bool, allow_none: bool) -> int:
    if once or n_source >= n_target:
        return perm(max(n_source, n_target), min(n_source, n_target))
    # Inclusion and exclusion over the source variables that are left out.
    choices = n_source + allow_none
    return sum((-1) ** k * comb(n_source, k) * (choices - k) ** n_target for k in range(n_source + 1))


def _check_n_state_mappings(count: int) -> None:
    if count > MAX_STATE_MAPPINGS:
        raise ValueError(
            f"these spaces have {count_text(count)} state mappings of that kind, more than the {MAX_STATE_MAPPINGS:,} that "
            "are practical; give mappings=[InterTaskMapping(...), ...], or a MappingSet of the state mappings of interest"
        )
