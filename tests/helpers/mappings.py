"""Inter-task mappings for tests: small tasks, drawn mappings, and what belongs to a set by brute force."""

import itertools

from hypothesis import strategies as st

from sb3_combrel import InterTaskMapping

MOUNTAIN_CAR = {"n_source_variables": 2, "n_target_variables": 4, "n_source_actions": 3, "n_target_actions": 5}
SMALL_SIZES = [(n_s, n_t) for n_s in range(1, 4) for n_t in range(1, 5)]


def choices(n_source, n_target):
    """All state mappings whatsoever, as a brute-force starting point."""
    return itertools.product([None, *range(n_source)], repeat=n_target)


@st.composite
def mappings(draw, n_source=3, n_target=4):
    state = draw(st.tuples(*[st.sampled_from([None, *range(n_source)])] * n_target).filter(lambda s: s != (None,) * n_target))
    sign = draw(st.tuples(*[st.sampled_from([1, -1])] * n_target))
    return InterTaskMapping(state, draw(st.tuples(*[st.integers(0, 2)] * 5)), sign)
