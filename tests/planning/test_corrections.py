"""Where an interpolated value is too high and visits bring no progress, corrections cap it: the parts, through Q at states."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel.planning.corrections import CELL_OFFSET, CELLS_PER_GRID_CELL, MAX_VISITS, CorrectionArrays
from sb3_combrel.planning.grid import StateGrid
from sb3_combrel.planning.q_values import Prediction, QValues

GRID = StateGrid(2, 3, 0)
LAST = 8  # the last grid coordinate of each axis
Q = QValues(1, 2)
BOUNDS = (-1e6, 1e6)


def function_of(values, corrections):
    return values, tuple(corrections), GRID.plain, 1.0, BOUNDS, np.full(GRID.n_points, BOUNDS[1])


def visit(values, corrections, state, best_q, episode=0, times=1, tolerance=0.05, max_visits=MAX_VISITS):
    """Visit a state whose only action ends the episode with a reward of ``best_q``; the corrections, with more room."""
    prediction = Prediction.empty(1, 0, 2)
    prediction.modelled[0], prediction.reward[0] = True, best_q
    for _ in range(times):
        corrections = corrections.with_room()
        visitor = (episode, tolerance, max_visits)
        Q.compute(prediction, np.asarray(state, dtype=float), function_of(values, corrections), visitor)
        assert Q.q[0] == best_q
    return corrections


def value_at(values, corrections, state):
    """The value of a state: Q of an action that leads there without a reward."""
    elsewhere = np.array([0.5, 0.5]) if np.abs(np.asarray(state) - 0.5).max() > 0.1 else np.zeros(2)
    prediction = Prediction.empty(1, 1, 2)
    prediction.modelled[0], prediction.length[0], prediction.probability[0, 0] = True, 1, 1.0
    prediction.effect[0, 0] = np.asarray(state) - elsewhere
    Q.compute(prediction, elsewhere, function_of(values, corrections))
    return float(Q.q[0])


def key_of(state, corrections):
    """The number of the small cell around a state; the corrections are used for it, and emptied again."""
    corrections = visit(np.zeros(GRID.n_points), corrections, state, -1.0, max_visits=0)
    [row] = corrections.rows()
    corrections.table.fill(-1)
    corrections.n_states[0] = 0
    return int(row[0])


def naive_cell(state):
    """The small cell around a state, one number a variable."""
    return tuple(np.floor(np.clip(np.asarray(state) * LAST, 0, LAST) * CELLS_PER_GRID_CELL + CELL_OFFSET).astype(int).tolist())


@settings(deadline=None, derandomize=True, max_examples=15)
@given(st.integers(0, 10**6), st.integers(1, 400), st.integers(0, 5))
def test_corrections_are_found_by_their_cells_as_the_table_grows(seed, n, capacity):
    """Compared with a dict: the last state visited in a cell, and its best action value."""
    rng = np.random.default_rng(seed)
    values, corrections, expected = np.zeros(GRID.n_points), CorrectionArrays.empty(2, 2**capacity), {}
    for state in rng.random((n, 2)):
        best_q = -float(rng.random()) - 0.1
        corrections = visit(values, corrections, state, best_q, max_visits=0)
        expected[naive_cell(state)] = (best_q, *state)
    rows = corrections.rows()
    assert len(rows) == len(expected) <= len(corrections.key) < len(corrections.table)
    assert {tuple(row[1:]) for row in rows} == set(expected.values())
    for state in rng.random((50, 2)):
        cap, *_ = expected.get(naive_cell(state), (0.0,))
        assert value_at(values, corrections, state) == pytest.approx(cap)


def test_corrections_come_back_from_their_rows():
    rng = np.random.default_rng(0)
    values, corrections = -10.0 * rng.random(GRID.n_points), CorrectionArrays.empty(2)
    for state in rng.random((400, 2)):
        corrections = visit(values, corrections, state, -20.0 - float(rng.random()), max_visits=0)
    again = CorrectionArrays.of_rows(corrections.rows())
    # Of rows with the same key the last one counts.
    last = CorrectionArrays.of_rows(np.vstack([corrections.rows()[:5] - [0.0, 1000.0, 0.0, 0.0], corrections.rows()]))
    np.testing.assert_array_equal(again.rows(), corrections.rows())
    for state in rng.random((200, 2)):
        assert value_at(values, again, state) == value_at(values, last, state) == value_at(values, corrections, state)


def test_small_cells_are_smaller_than_grid_cells_and_do_not_share_numbers():
    axis, corrections = np.linspace(0.0, LAST, LAST * 3 * 4 + 1), CorrectionArrays.empty(2)
    by_cell = {}
    for x in axis:
        for y in axis:
            by_cell.setdefault(key_of((x / LAST, y / LAST), corrections), []).append((x, y))
    assert 24**2 <= len(by_cell) <= 25**2
    for positions in by_cell.values():
        assert np.ptp(np.array(positions), axis=0).max() < 1 / 3 + 1e-9
    assert key_of((-5.0, 9.0), corrections) == key_of((0.0, 1.0), corrections), "what is outside counts as the edge"
    for at in (0.0, 1.0, 2.0, 7.0, 8.0, 1 / 3, 0.4, 0.5, 2.4):
        keys = {key_of(((at + error) / LAST, 1.0), corrections) for error in (-1e-12, 0.0, 1e-12)}
        assert len(keys) == 1, "a rounding error at a round number"


def test_nothing_is_corrected_before_max_visits():
    values, state = np.zeros(GRID.n_points), (0.3, 0.4)
    corrections = visit(values, CorrectionArrays.empty(2), state, -3.0, times=MAX_VISITS)
    assert value_at(values, corrections, state) == 0.0
    corrections = visit(values, corrections, state, -3.0)
    assert value_at(values, corrections, state) == pytest.approx(-3.0)


def test_visits_are_counted_by_episode_and_cell():
    values, corrections = np.zeros(GRID.n_points), CorrectionArrays.empty(2)
    for episode in range(4 * MAX_VISITS):
        corrections = visit(values, corrections, (0.3, 0.4), -3.0, episode)
    assert len(corrections.rows()) == 0
    for k in range(4 * MAX_VISITS):
        corrections = visit(values, corrections, (0.3, k / (4 * MAX_VISITS)), -3.0, episode=1000)
    assert len(corrections.rows()) == 0


def test_a_value_that_is_not_too_high_is_not_corrected():
    values = np.full(GRID.n_points, -2.0)
    corrections = visit(values, CorrectionArrays.empty(2), (0.3, 0.4), -2.04, times=5 * MAX_VISITS)
    assert len(corrections.rows()) == 0
    corrections = visit(values, corrections, (0.3, 0.4), -1.0, times=5 * MAX_VISITS)
    assert len(corrections.rows()) == 0
    # Nor is any when the agent is not there, as for a prediction.
    corrections = visit(values, CorrectionArrays.empty(2), (0.3, 0.4), -30.0, episode=-1, times=3 * MAX_VISITS)
    assert len(corrections.rows()) == 0 and not corrections.visits.any()


def test_each_visit_renews_the_correction_of_its_cell():
    values = np.zeros(GRID.n_points)
    corrections = visit(values, CorrectionArrays.empty(2), (0.3, 0.4), -3.0, times=MAX_VISITS + 1)
    for best_q in (-4.0, -7.5, -5.0):
        corrections = visit(values, corrections, (0.3, 0.4), best_q)
        assert value_at(values, corrections, (0.3, 0.4)) == pytest.approx(best_q)
    assert len(corrections.rows()) == 1


def test_a_correction_counts_in_its_cell_only_and_never_raises_a_value():
    rng = np.random.default_rng(0)
    values, corrected = -10.0 * rng.random(GRID.n_points), np.array([0.3, 0.4])
    corrections = visit(values, CorrectionArrays.empty(2), corrected, -30.0, times=MAX_VISITS + 1)
    lowered = 0
    for state in [*rng.random((500, 2)), *(corrected + rng.uniform(-0.02, 0.02, (50, 2)))]:
        plain = GRID.interpolate(values, state)
        if naive_cell(state) == naive_cell(corrected):
            assert value_at(values, corrections, state) == pytest.approx(plain - 30.0 - GRID.interpolate(values, corrected))
            lowered += 1
        else:
            assert value_at(values, corrections, state) == pytest.approx(plain)
    assert lowered > 10
    # Once the grid's own value is lower than the correction, the correction has no effect.
    values[:] = -50.0
    assert value_at(values, corrections, corrected) == pytest.approx(-50.0)
