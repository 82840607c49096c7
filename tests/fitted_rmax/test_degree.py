"""The arguments of the local linear model: what is refused, defaults by number of variables, and that they reach the model."""

import numpy as np
import pytest
from helpers.agents import make_agent
from helpers.walk import Walk

from sb3_combrel import FittedRMax
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings
from sb3_combrel.models.kernel_average import KernelAverage
from sb3_combrel.models.local_linear import LocalLinear

REFUSED = [
    ("degree", 2, "0 (kernel average) or 1 (local linear)"),
    ("degree", -1, "0 (kernel average) or 1 (local linear)"),
    ("degree", True, "0 (kernel average) or 1 (local linear)"),
    ("degree", 0.5, "0 (kernel average) or 1 (local linear)"),
    ("degree", "1", "0 (kernel average) or 1 (local linear)"),
    ("degree", None, "0 (kernel average) or 1 (local linear)"),
    ("n_neighbors", 1, "a whole number from 2 to 10,000 or None"),
    ("n_neighbors", 0, "a whole number from 2 to 10,000 or None"),
    ("n_neighbors", 10_001, "a whole number from 2 to 10,000 or None"),
    ("n_neighbors", 2.5, "a whole number from 2 to 10,000 or None"),
    ("n_neighbors", True, "a whole number from 2 to 10,000 or None"),
    ("n_neighbors", "many", "a whole number from 2 to 10,000 or None"),
    ("max_model_steps", 0, "a whole number from 1 to 10,000 or None"),
    ("max_model_steps", 10_001, "a whole number from 1 to 10,000 or None"),
    ("max_model_steps", 2.5, "a whole number from 1 to 10,000 or None"),
    ("max_model_steps", "all", "a whole number from 1 to 10,000 or None"),
    ("outcome_breadth", 0.0, "a number above 0"),
    ("outcome_breadth", -0.1, "a number above 0"),
    ("outcome_breadth", np.inf, "a number above 0"),
    ("outcome_breadth", np.nan, "a number above 0"),
    ("outcome_breadth", None, "a number above 0"),
    ("outcome_breadth", "narrow", "a number above 0"),
]


def shown(value):
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else repr(value)


@pytest.mark.parametrize(("name", "value", "right"), REFUSED)
def test_what_cannot_be_is_refused_with_its_name_its_value_and_what_would_be_right(name, value, right):
    for make in (lambda: FittedRMaxSettings(**{name: value}), lambda: FittedRMax(Walk(), **{name: value})):
        with pytest.raises(ValueError, match=f"^{name} must be ") as error:
            make()
        assert right in str(error.value) and str(error.value).endswith(f"got {shown(value)}")


@pytest.mark.parametrize("n_variables", range(1, 8))
def test_defaults_depend_on_the_number_of_state_variables(n_variables):
    defaults = FittedRMaxSettings(degree=1).model_settings(n_variables)
    broader = FittedRMaxSettings(degree=1).model_settings(n_variables + 1)
    assert 2 <= defaults.n_neighbors <= broader.n_neighbors and defaults.model_breadth <= broader.model_breadth
    assert defaults.n_neighbors > n_variables + 1, "a fit has so many unknowns for each effect"
    average = FittedRMaxSettings(degree=0).model_settings(n_variables)
    assert average.model_breadth < defaults.model_breadth and average.min_weight < defaults.min_weight


def test_the_original_looks_one_step_ahead():
    assert FittedRMaxSettings(degree=0).model_settings(2).max_model_steps == 1
    assert FittedRMaxSettings(degree=0, max_model_steps=1).model_settings(2).max_model_steps == 1
    with pytest.raises(ValueError, match="max_model_steps must be 1 or None with degree=0, the original algorithm, got 3"):
        FittedRMaxSettings(degree=0, max_model_steps=3)
    assert FittedRMaxSettings(max_model_steps=7).model_settings(4).max_model_steps == 7


def test_the_arguments_reach_the_model():
    model = FittedRMax(Walk(), degree=1, n_neighbors=7, outcome_breadth=0.02, model_breadth=0.3, resolution=3)
    settings = model.agent.model_settings
    assert (settings.n_neighbors, settings.outcome_breadth, settings.model_breadth) == (7, 0.02, 0.3)
    assert type(model.agent.model) is LocalLinear
    assert (model.degree, model.n_neighbors, model.outcome_breadth) == (1, 7, 0.02)
    assert type(FittedRMax(Walk(), degree=0, resolution=3).agent.model) is KernelAverage
    assert make_agent(2, 2, degree=1, n_neighbors=np.int64(9), resolution=3).model_settings.n_neighbors == 9
