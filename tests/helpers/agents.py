"""Agents on arrays, whose raw units are unit coordinates."""

from contextlib import contextmanager

import numpy as np
import pytest

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


@contextmanager
def interrupted_after(monkeypatch, agent, n):
    """Interrupt what is done within once the model has taken in ``n`` transitions; that it was interrupted is asserted."""
    counts, add = iter(range(1000)), type(agent.model).add

    def interrupted(self, *transition):
        if next(counts) == n:
            raise KeyboardInterrupt
        return add(self, *transition)

    with monkeypatch.context() as patched:
        patched.setattr(type(agent.model), "add", interrupted)
        with pytest.raises(KeyboardInterrupt):
            yield
