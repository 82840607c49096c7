"""FittedRMaxSettings is the one place that has the defaults of Fitted R-Max, and that checks them."""

import inspect

import numpy as np
import pytest
from gymnasium import spaces
from helpers.agents import make_agent
from helpers.square import SAME, square_source
from helpers.walk import Walk

from sb3_combrel import TIMBREL, FittedRMax
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.task import Task
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.policies import FittedRMaxPolicy
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings
from sb3_combrel.models.kernel_average import KernelAverage
from sb3_combrel.models.local_linear import LocalLinear

NO_NUMBERS = [True, np.True_, "three", [], 1 + 2j, np.nan, np.inf]
POSITIVE = ["model_breadth", "outcome_breadth", "min_fraction", "min_weight", "exploration_threshold", "gamma"]
REFUSED = {
    **{name: [0.0, -0.1, *NO_NUMBERS] for name in (*POSITIVE, "planning_tolerance")},
    **{name: [-1, 2.5, *NO_NUMBERS] for name in ("n_neighbors", "max_instances")},
    "max_value": NO_NUMBERS,
    "degree": [2, -1, 0.5, None, [1], np.array([1]), *NO_NUMBERS],
}
OTHERS_REFUSED = [
    *[("min_fraction", 1.1), ("min_fraction", None), ("min_weight", 1.0), ("gamma", 1.5), ("outcome_breadth", None)],
    *[("n_neighbors", 1), ("max_instances", 0)],
]
TOO_LARGE = [("n_neighbors", 10_001), ("n_neighbors", 2**62), ("n_neighbors", 10**30)]


@pytest.mark.parametrize(("name", "value"), [*((n, v) for n, values in REFUSED.items() for v in values), *OTHERS_REFUSED])
def test_settings_out_of_range_are_refused_by_name_and_value(name, value):
    with pytest.raises(ValueError, match=f"^{name} must be ") as error:
        FittedRMaxSettings(**{name: value})
    assert str(error.value).endswith(f"got {value!r}")


@pytest.mark.parametrize(("name", "value"), TOO_LARGE)
def test_a_count_that_is_too_large_for_what_it_is_used_for_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be a whole number from"):
        FittedRMaxSettings(**{name: value})


@pytest.mark.parametrize("value", [[2, 2, 2], [2, 0], 0, -2, 2.5, True, "fine", 1 + 2j])
def test_an_agent_refuses_a_resolution_that_does_not_fit_its_task(value):
    with pytest.raises(ValueError, match="resolution must be"):
        make_agent(2, 4, resolution=value)


def test_an_agent_refuses_a_transfer_method_that_does_not_fit_its_task():
    with pytest.raises(ValueError, match="target"):
        make_agent(3, 4, TIMBREL(square_source(), SAME))


def test_fitted_rmax_and_its_policy_have_the_defaults_of_the_settings():
    defaults, of_fitted_rmax = FittedRMaxSettings(), inspect.signature(FittedRMax).parameters
    for name in FittedRMaxSettings.names():
        assert of_fitted_rmax[name].default == getattr(defaults, name), name
    # The policy hands on what it is given, and has no defaults of its own.
    assert not set(FittedRMaxSettings.names()) & set(inspect.signature(FittedRMaxPolicy).parameters)
    assert FittedRMaxPolicy(spaces.Box(0.0, 1.0, (1,), dtype=np.float64), spaces.Discrete(2)).agent.settings == defaults
    assert FittedRMax(Walk()).agent.settings == defaults
    task = Task(StateScaling(np.zeros(1), np.ones(1)), 2)
    assert FittedRMaxAgent(defaults, task).model_settings == defaults.model_settings(1)


@pytest.mark.parametrize(
    ("degree", "n_variables", "breadth"),
    [
        *[(0, 1, 0.09), (0, 2, 0.09), (0, 3, 0.15), (0, 4, 0.2), (0, 6, 0.2)],
        *[(1, 1, 0.15), (1, 2, 0.15), (1, 3, 0.25), (1, 4, 0.4), (1, 5, 0.4), (1, 7, 0.5)],
    ],
)
def test_the_breadth_depends_on_degree_and_number_of_variables_unless_given(degree, n_variables, breadth):
    assert FittedRMaxSettings(degree=degree).model_settings(n_variables).model_breadth == breadth
    assert FittedRMaxSettings(degree=degree, model_breadth=0.3).model_settings(n_variables).model_breadth == 0.3


def test_neighbors_depend_on_the_number_of_variables_and_the_least_weight_on_the_degree_unless_given():
    found = [FittedRMaxSettings().model_settings(d).n_neighbors for d in (1, 2, 3, 4, 5, 6, 9)]
    assert found == [16, 16, 24, 30, 40, 60, 60]
    assert [FittedRMaxSettings(degree=degree).model_settings(2).min_weight for degree in (0, 1)] == [0.01, 0.05]
    given = FittedRMaxSettings(n_neighbors=7, min_weight=0.2).model_settings(3)
    assert (given.n_neighbors, given.min_weight) == (7, 0.2)


def test_the_arguments_reach_the_model():
    model = FittedRMax(Walk(), degree=1, n_neighbors=7, outcome_breadth=0.02, model_breadth=0.3, resolution=3)
    settings = model.agent.model_settings
    assert (settings.n_neighbors, settings.outcome_breadth, settings.model_breadth) == (7, 0.02, 0.3)
    assert (model.degree, model.n_neighbors, model.outcome_breadth) == (1, 7, 0.02)
    assert type(model.agent.model) is LocalLinear
    assert type(FittedRMax(Walk(), degree=0, resolution=3).agent.model) is KernelAverage


@pytest.mark.parametrize("degree", [0, 1])
def test_arguments_may_be_numpy_numbers(degree):
    floats = {name: np.float32(0.2) for name in ("model_breadth", "outcome_breadth", "gamma")}
    counts = {name: np.int64(8) for name in ("max_instances", "n_neighbors")}
    FittedRMax(Walk(), seed=0, degree=np.int64(degree), resolution=np.array([3, 4]), **floats, **counts).learn(20)


def test_a_task_has_names_for_its_variables_and_actions():
    task = Task(StateScaling(np.zeros(2), np.ones(2)), 3)
    assert (task.n_variables, task.state_names, task.action_names) == (2, ("s0", "s1"), ("a0", "a1", "a2"))
    assert Task(task.scaling, 1, ["x", "v"], ["push"]).state_names == ("x", "v")
