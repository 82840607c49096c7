"""Curves over environment steps and episodes, against naive computations."""

import numpy as np
import pytest

from sb3_combrel.experiments.benchmark.figures import WINDOW, _by_episodes, _by_steps, style_of
from sb3_combrel.experiments.transfer_measures import LearningCurves


@pytest.fixture
def curves():
    """Three runs of different numbers of episodes."""
    rng = np.random.default_rng(0)
    steps = [rng.integers(5, 40, size=n).tolist() for n in (4, 9, 15)]
    returns = [rng.normal(size=len(row)).tolist() for row in steps]
    return LearningCurves.from_rows(returns, steps)


def test_over_steps_a_value_is_the_mean_of_the_last_episodes_that_have_ended(curves):
    where, values = _by_steps(curves)
    for run in range(3):
        ends = np.cumsum(curves.steps[run, : int(curves.n_episodes[run])])
        for at, value in zip(where, values[run], strict=True):
            ended = [curves.returns[run, k] for k, end in enumerate(ends) if end <= at]
            assert value == pytest.approx(np.mean(ended[-WINDOW:]))
    # From where every run has an episode to the end of the longest.
    assert where[0] == max(curves.steps[:, 0]) and where[-1] == curves.n_steps.max()


def test_over_episodes_it_is_the_moving_average_as_far_as_all_runs_go(curves):
    where, values = _by_episodes(curves)
    assert where.tolist() == [4] and values.shape == (3, 1)
    np.testing.assert_allclose(values[:, 0], [np.mean(row[:4]) for row in curves.returns])


def test_styles_differ():
    assert len({style_of(number) for number in range(30)}) == 30
