"""Agents on arrays, whose raw units are unit coordinates."""

import numpy as np

from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.common.task import Task
from sb3_combrel.fitted_rmax.agent import FittedRMaxAgent
from sb3_combrel.fitted_rmax.settings import FittedRMaxSettings


def make_agent(n_variables, n_actions, transfer=None, rng=0, **settings):
    """An agent for states in the unit box; ``rng``: a seed or a generator."""
    task = Task(StateScaling(np.zeros(n_variables), np.ones(n_variables)), n_actions)
    return FittedRMaxAgent(FittedRMaxSettings(**settings), task, transfer, np.random.default_rng(rng))


def assert_same_state(one, other):
    """What two agents have learned is the same bit for bit."""
    one, other = one.get_state(), other.get_state()
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)
