"""Arguments of the constructor and of ``learn`` that are of another kind: a ValueError that names the argument."""

import numpy as np
import pytest
from helpers.walk import small

NUMBERS = ["model_breadth", "min_fraction", "min_weight", "exploration_threshold", "max_value", "gamma", "planning_tolerance"]
COUNTS = ["max_backups", "max_instances", "seed", "stats_window_size", "resolution"]
NO_NUMBERS = [True, False, np.True_, "three", [], {}, 1 + 2j, float("nan"), float("inf"), object()]


@pytest.mark.parametrize("value", NO_NUMBERS, ids=lambda value: str(value)[:8])
@pytest.mark.parametrize("name", [*NUMBERS, *COUNTS])
def test_an_argument_that_is_no_number_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        small(**{name: value})


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.parametrize("value", [-1, 1.5])
def test_a_count_that_is_negative_or_a_fraction_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"{name} must be .*{value}"):
        small(**{name: value})


@pytest.mark.parametrize(("name", "value"), [("seed", 2**32), ("max_backups", 2**62), ("max_backups", 10**30)])
def test_a_count_that_is_too_large_for_what_it_is_used_for_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        small(**{name: value})


@pytest.mark.parametrize("bounds", [(False, True), ([False, False], [True, True]), ([-1.0, False], [1.0, 2.0]), True])
def test_bounds_that_are_booleans_are_refused(bounds):
    with pytest.raises(ValueError, match="bounds must be"):
        small(bounds=bounds)


@pytest.mark.parametrize(
    ("name", "value"),
    [("verbose", "loud"), ("verbose", None), ("verbose", 0.5), ("tensorboard_log", 3), ("tensorboard_log", True)],
)
def test_wrong_arguments_of_every_algorithm_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        small(**{name: value})


@pytest.fixture(scope="module")
def model():
    return small()


@pytest.mark.parametrize(
    "steps", [1e308, 1e16, 10**400, float("inf"), float("-inf"), float("nan"), True, "many", [10], None, 0.5]
)
def test_numbers_of_steps_that_cannot_be_are_refused(model, steps):
    with pytest.raises(ValueError, match="total_timesteps must be"):
        model.learn(steps)
    assert model.num_timesteps == 0


@pytest.mark.parametrize("steps", [1e1, np.float64(10.0), np.int64(10), 10])
def test_a_whole_number_of_steps_may_be_of_any_type(steps):
    assert small().learn(steps).num_timesteps == 10


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("log_interval", 0),
        ("log_interval", -4),
        ("log_interval", True),
        ("log_interval", 2.5),
        ("tb_log_name", 3),
        ("reset_num_timesteps", "False"),
        ("reset_num_timesteps", None),
        ("progress_bar", "no"),
        ("progress_bar", 1),
    ],
)
def test_wrong_arguments_of_learn_are_refused_by_name(model, name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        model.learn(10, **{name: value})
    assert model.num_timesteps == 0
