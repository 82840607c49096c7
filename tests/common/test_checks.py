"""Checks of arguments: what they accept, what they return, and what their messages name."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.common.checks import as_count, check_count, count_text

NO_COUNTS = [float("inf"), -float("inf"), float("nan"), 2.5, 1e308, True, np.bool_(True), "3", None, [3], 1j, 0, -4, 10**400]


@pytest.mark.parametrize("value", NO_COUNTS, ids=str)
def test_as_count_refuses_what_is_no_count_and_names_it(value):
    with pytest.raises(ValueError, match=r"n_things must be a whole number from 1 to 1,000 \(so many fit\), got "):
        as_count("n_things", value, max=1000, why_max="so many fit")


@settings(max_examples=30)
@given(st.integers(1, 2**53))
def test_as_count_converts_whole_floats(number):
    for written in (number, float(number), np.int64(number), np.float64(number)):
        count = as_count("n_things", written)
        assert count == number
        assert type(count) is int


@pytest.mark.parametrize("value", [*NO_COUNTS[:-3], 3.0], ids=str)
def test_check_count_accepts_integers_only(value):
    with pytest.raises(ValueError, match="n_things must be a whole number of at least 1, got"):
        check_count("n_things", value)


def test_check_count_knows_its_limits():
    check_count("n_things", 0, min=0)
    check_count("n_things", np.int32(7), max=7)
    check_count("n_things", None, none_allowed=True)
    with pytest.raises(ValueError, match="n_things must be a whole number from 1 to 7 or None, got 8"):
        check_count("n_things", 8, max=7, none_allowed=True)


@pytest.mark.parametrize(
    ("number", "text"),
    [(0, "0"), (1234567, "1,234,567"), (-1234, "-1,234"), (10**20, "about 10^20"), (-(10**500), "-about 10^500")],
)
def test_count_text_is_short_however_large_the_number(number, text):
    assert count_text(number) == text
