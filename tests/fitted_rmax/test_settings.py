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

BAD_SETTINGS = [
    ("degree", 2),
    ("degree", True),
    ("degree", "linear"),
    ("model_breadth", -0.1),
    ("min_fraction", 1.1),
    ("min_weight", 1.0),
    ("min_weight", 0.0),
    ("n_neighbors", 1),
    ("n_neighbors", 2.5),
    ("outcome_breadth", 0.0),
    ("max_model_steps", 0),
    ("exploration_threshold", 0.0),
    ("max_value", np.nan),
    ("gamma", 1.5),
    ("planning_tolerance", 0.0),
    ("max_backups", -1),
    ("max_instances", 0),
]


@pytest.mark.parametrize(("name", "value"), BAD_SETTINGS)
def test_settings_out_of_range_are_refused_by_name_and_value(name, value):
    with pytest.raises(ValueError, match=f"{name} must be") as error:
        FittedRMaxSettings(**{name: value})
    assert repr(value) in str(error.value)


@pytest.mark.parametrize("value", [[2, 2, 2], 0, 2.5, "fine"])
def test_an_agent_refuses_a_resolution_that_does_not_fit_its_task(value):
    with pytest.raises(ValueError, match="resolution must be"):
        make_agent(2, 4, resolution=value)


def test_an_agent_refuses_a_transfer_method_that_does_not_fit_its_task():
    with pytest.raises(ValueError, match="target"):
        make_agent(3, 4, TIMBREL(square_source(), SAME))


def test_settings_cannot_be_changed_afterwards():
    with pytest.raises(AttributeError):
        FittedRMaxSettings().gamma = 0.5


def test_fitted_rmax_and_its_policy_have_the_defaults_of_the_settings():
    defaults = FittedRMaxSettings()
    of_fitted_rmax = inspect.signature(FittedRMax).parameters
    assert len(FittedRMaxSettings.names()) == 16
    for name in FittedRMaxSettings.names():
        assert of_fitted_rmax[name].default == getattr(defaults, name), name
    # The policy hands on what it is given, and has no defaults of its own.
    assert not set(FittedRMaxSettings.names()) & set(inspect.signature(FittedRMaxPolicy).parameters)
    box = spaces.Box(0.0, 1.0, (1,), dtype=np.float64)
    assert FittedRMaxPolicy(box, spaces.Discrete(2)).agent.settings == defaults
    assert FittedRMax(Walk()).agent.settings == defaults
    task = Task(StateScaling(np.zeros(1), np.ones(1)), 2)
    assert FittedRMaxAgent(defaults, task).model_settings == defaults.model_settings(1)


@pytest.mark.parametrize(
    ("degree", "n_variables", "breadth", "backups"),
    [
        (0, 1, 0.09, 200),
        (0, 2, 0.09, 100),
        (0, 3, 0.15, 50),
        (0, 4, 0.2, 25),
        (0, 6, 0.2, 6),
        (1, 1, 0.15, 800),
        (1, 2, 0.15, 400),
        (1, 3, 0.25, 200),
        (1, 4, 0.4, 100),
        (1, 5, 0.4, 50),
        (1, 6, 0.5, 25),
        (1, 7, 0.5, 12),
    ],
)
def test_breadth_and_backups_depend_on_degree_and_number_of_variables_unless_given(degree, n_variables, breadth, backups):
    defaults = FittedRMaxSettings(degree=degree)
    given = FittedRMaxSettings(degree=degree, model_breadth=0.3, max_backups=0)
    assert (defaults.breadth_for(n_variables), defaults.backups_for(n_variables)) == (breadth, backups)
    assert (given.breadth_for(n_variables), given.backups_for(n_variables)) == (0.3, 0)
    assert defaults.model_settings(n_variables).model_breadth == breadth


@pytest.mark.parametrize(("n_variables", "n_neighbors"), [(1, 16), (2, 16), (3, 24), (4, 30), (5, 40), (6, 60), (9, 60)])
def test_the_number_of_neighbors_depends_on_the_number_of_variables_unless_given(n_variables, n_neighbors):
    assert FittedRMaxSettings().model_settings(n_variables).n_neighbors == n_neighbors
    assert FittedRMaxSettings(n_neighbors=7).model_settings(n_variables).n_neighbors == 7


@pytest.mark.parametrize(("degree", "min_weight"), [(0, 0.01), (1, 0.05)])
def test_the_least_weight_that_counts_depends_on_the_degree_unless_given(degree, min_weight):
    assert FittedRMaxSettings(degree=degree).model_settings(2).min_weight == min_weight
    assert FittedRMaxSettings(degree=degree, min_weight=0.2).model_settings(2).min_weight == 0.2


def test_the_degree_decides_which_model_is_learned():
    assert type(make_agent(2, 4).model) is LocalLinear
    assert type(make_agent(2, 4, degree=1).model) is LocalLinear
    assert type(make_agent(2, 4, degree=0).model) is KernelAverage


def test_a_task_has_names_for_its_variables_and_actions():
    scaling = StateScaling(np.zeros(2), np.ones(2))
    task = Task(scaling, 3)
    assert (task.n_variables, task.state_names, task.action_names) == (2, ("s0", "s1"), ("a0", "a1", "a2"))
    assert Task(scaling, 1, ["x", "v"], ["push"]).state_names == ("x", "v")
