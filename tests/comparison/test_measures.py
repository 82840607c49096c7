"""Taylor & Stone's measures of transfer, against hand-computed examples, slow computations, and logs that SB3 has written."""

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.monitor import Monitor, load_results
from stable_baselines3.common.results_plotter import X_TIMESTEPS, ts2xy

from sb3_combrel.comparison.curves import LearningCurves, read_monitor_logs
from sb3_combrel.comparison.measures import (
    asymptotic_return,
    compare_learning,
    initial_return,
    steps_to_reach,
    time_to_threshold,
    total_reward,
    total_reward_by_steps,
)
from sb3_combrel.comparison.statistics import bootstrap_difference, p_value_of_difference

INF, NAN = np.inf, np.nan
quick = settings(deadline=None, derandomize=True, max_examples=15)
#: Runs of three, five and four episodes.
RETURNS = [[-9.0, -5.0, -1.0], [-8.0, -8.0, -2.0, -2.0, -2.0], [-6.0, -3.0, -3.0, 0.0]]
STEPS = [[9, 5, 1], [8, 8, 2, 2, 2], [6, 3, 3, 4]]
CURVES = LearningCurves.from_rows(RETURNS, STEPS)


@st.composite
def learning_curves(draw):
    """Returns and steps of 2 to 5 runs of 3 to 8 episodes."""
    lengths = draw(st.lists(st.integers(3, 8), min_size=2, max_size=5))
    returns = [draw(st.lists(st.integers(-50, 50), min_size=n, max_size=n)) for n in lengths]
    return returns, [draw(st.lists(st.integers(1, 20), min_size=n, max_size=n)) for n in lengths]


def measures_of(first, second, **arguments):
    return compare_learning(first, second, **(dict(n_first=2, n_last=2, window=2, n_resamples=100) | arguments))


def test_rows_of_different_lengths_are_filled_with_nan():
    np.testing.assert_array_equal(CURVES.returns[0], [-9.0, -5.0, -1.0, NAN, NAN])
    np.testing.assert_array_equal(CURVES.steps[2], [6.0, 3.0, 3.0, 4.0, NAN])
    assert CURVES.n_episodes.tolist() == [3, 5, 4] and CURVES.n_steps.tolist() == [15.0, 22.0, 16.0]
    np.testing.assert_array_equal(LearningCurves(CURVES.returns, CURVES.steps).returns, CURVES.returns)
    cut = CURVES.first_episodes()
    np.testing.assert_array_equal(cut.returns, [row[:3] for row in RETURNS])
    np.testing.assert_array_equal(cut.steps, [row[:3] for row in STEPS])
    assert CURVES.first_episodes(2).returns.shape == (3, 2)


@quick
@given(learning_curves(), st.integers(-60, 60), st.integers(1, 4))
def test_measures_are_those_of_a_slow_computation(rows, threshold, window):
    returns, steps = rows
    curves = LearningCurves.from_rows(returns, steps)
    first, last = initial_return(curves, 3), asymptotic_return(curves, 2)
    areas, by_steps, times = total_reward(curves), total_reward_by_steps(curves), time_to_threshold(curves, threshold, window)
    shortest, fewest = min(map(len, returns)), min(map(sum, steps))
    for run, (own_returns, own_steps) in enumerate(zip(returns, steps, strict=True)):
        assert first[run] == pytest.approx(sum(own_returns[:3]) / 3)
        assert last[run] == pytest.approx((own_returns[-1] + own_returns[-2]) / 2)
        assert areas[run] == sum(own_returns[:shortest]) and total_reward(curves, 2)[run] == sum(own_returns[:2])
        # One environment step after the other.
        at_step = [value for value, n in zip(own_returns, own_steps, strict=True) for _ in range(n)]
        assert by_steps[run] == sum(at_step[:fewest]) and total_reward_by_steps(curves, 2)[run] == sum(at_step[:2])
        expected = INF
        for end in range(len(own_returns), window - 1, -1):
            if np.median(own_returns[end - window : end]) >= threshold:
                expected = sum(own_steps[:end])
        assert times[run] == expected


def simulated(rng, rate, n_runs=10, n_episodes=30):
    """Episodes of 100 steps at first that get shorter, at -1 a step."""
    mean = 20.0 + 80.0 * np.exp(-rate * np.arange(n_episodes))
    steps = np.maximum(1, rng.normal(mean, 5.0, size=(n_runs, n_episodes)).round())
    return LearningCurves(-steps, steps)


def test_effects_are_tested_and_measured_by_the_statistics_of_the_package():
    rng = np.random.default_rng(1)
    first, second = simulated(rng, 0.3, n_runs=7), simulated(rng, 0.2, n_runs=6)
    measures = compare_learning(first, second, threshold=-40.0, n_first=3, n_resamples=500, seed=9)
    one, other = initial_return(first, 3), initial_return(second, 3)
    jumpstart = measures.jumpstart
    assert jumpstart[2:5] == tuple(bootstrap_difference(one, other, "mean", 500, 9))
    assert jumpstart.p_value == p_value_of_difference(one, other, "permutation", 9)
    last = bootstrap_difference(asymptotic_return(first), asymptotic_return(second), "mean", 500, 9)
    assert measures.asymptotic_performance[2:5] == tuple(last)
    assert jumpstart.higher_is_better and not measures.time_to_threshold.higher_is_better
    one, other = time_to_threshold(first, -40.0), time_to_threshold(second, -40.0)
    assert measures.time_to_threshold[2:5] == tuple(bootstrap_difference(one, other, "median", 500, 9))
    assert measures.time_to_threshold.p_value == p_value_of_difference(one, other, "mann-whitney", 9)
    again = compare_learning(first, second, threshold=-40.0, n_first=3, n_resamples=500, seed=9)
    np.testing.assert_equal(again, measures)


def test_areas_end_where_the_shortest_run_of_both_does():
    long = LearningCurves.from_rows([[1.0] * 6, [2.0] * 5], [[10] * 6, [10] * 5])
    short = LearningCurves.from_rows([[0.0, 0.0, 3.0], [1.0, 1.0, 1.0, 1.0]], [[5, 5, 5], [5, 5, 5, 5]])
    measures = measures_of(long, short)
    assert measures.total_reward.with_transfer.tolist() == [3.0, 6.0]
    assert measures.total_reward.without.tolist() == [3.0, 3.0]
    assert measures.total_reward_by_steps.with_transfer.tolist() == [15.0, 30.0]
    assert measures.total_reward_by_steps.without.tolist() == [15.0, 15.0]
    assert measures.total_reward.effect == 1.5 and measures.total_reward_by_steps.effect == 7.5
    assert measures.floor == 0.0, "no return is negative: areas above zero, as Taylor & Stone define the ratio"
    assert measures.transfer_ratio.effect == 0.5 and measures.transfer_ratio_by_steps.effect == 0.5
    assert measures.time_to_threshold is None


def test_ratios_of_negative_returns_are_of_areas_above_a_floor():
    better = LearningCurves(np.array([[-4.0, -2.0, -2.0], [-6.0, -2.0, -2.0]]), np.full((2, 3), 2))
    worse = LearningCurves(np.array([[-10.0, -6.0, -4.0], [-8.0, -8.0, -4.0]]), np.full((2, 3), 2))
    measures = measures_of(better, worse)
    # Sums -8 and -10 against -20 and -20; above -10 they are 22 and 20 against 10 and 10.
    assert measures.floor == -10.0 and measures.transfer_ratio.effect == pytest.approx(1.1)
    assert measures.transfer_ratio.with_transfer.tolist() == [22.0, 20.0]
    assert measures.transfer_ratio_by_steps.effect == pytest.approx(1.1)
    # Above -20 they are 52 and 50 against 40 and 40.
    assert measures_of(better, worse, floor=-20).transfer_ratio.effect == pytest.approx(11 / 40)
    assert measures.transfer_ratio.p_value == measures.total_reward.p_value
    at_floor = measures_of(better, LearningCurves(np.full((2, 3), -10.0), np.full((2, 3), 2)), floor=-10.0)
    assert at_floor.transfer_ratio.effect == INF and np.isnan(at_floor.transfer_ratio.low)


def test_thresholds_that_some_runs_never_reach():
    steps = np.full((5, 4), 10)
    slow = LearningCurves([[0, 0, 0, 9], [0, 0, 0, 9], [0, 0, 9, 9], [0, 0, 0, 0], [0, 0, 0, 0]], steps)
    fast = LearningCurves([[0, 9, 9, 9], [9, 9, 9, 9], [9, 0, 0, 0], [0, 9, 9, 9], [0, 0, 9, 9]], steps)
    time = measures_of(fast, slow, threshold=9, window=1).time_to_threshold
    assert time.without.tolist() == [40.0, 40.0, 30.0, INF, INF]
    assert time.effect == 20.0 - 40.0 and time.low == -INF and time.high < 0.0
    never = measures_of(fast, LearningCurves(np.zeros((5, 4)), steps), threshold=9, window=1).time_to_threshold
    assert never.effect == -INF and np.isnan([never.low, never.high]).all() and never.p_value < 0.02


def play_cart_pole(file, n_episodes, seed, **arguments):
    """Write a Monitor log of random actions, and return the steps of the episodes that have ended."""
    env = Monitor(gym.make("CartPole-v1"), str(file), **arguments)
    env.action_space.seed(seed)
    lengths = []
    for episode in range(n_episodes):
        env.reset(seed=seed if episode == 0 else None)
        ended = False
        while not ended:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            ended = terminated or truncated
        lengths.append(env.get_episode_lengths()[-1])
    env.reset()
    env.step(0)
    env.close()
    return lengths


def test_each_monitor_file_of_a_folder_is_a_run(tmp_path):
    lengths = [play_cart_pole(tmp_path / f"run_{seed}", 4 + seed, seed, info_keywords=()) for seed in range(3)]
    curves = read_monitor_logs(tmp_path)
    assert curves.n_episodes.tolist() == [4, 5, 6]
    for run in range(3):
        np.testing.assert_array_equal(curves.steps[run, : 4 + run], lengths[run])
    np.testing.assert_array_equal(curves.returns, curves.steps, err_msg="CartPole pays 1 a step")
    files = [tmp_path / "run_2.monitor.csv", str(tmp_path / "run_0.monitor.csv")]
    np.testing.assert_array_equal(read_monitor_logs(files).steps, curves.steps[[2, 0]])
    measures = compare_learning(read_monitor_logs(files), curves, threshold=1.0, n_first=2, n_last=2, window=1)
    assert measures.time_to_threshold.with_transfer.tolist() == [lengths[2][0], lengths[0][0]]


def test_a_folder_in_a_list_is_one_run_in_parallel_environments_as_sb3_reads_it(tmp_path):
    for run in range(2):
        (tmp_path / f"run{run}").mkdir()
        for env in range(3):
            play_cart_pole(tmp_path / f"run{run}" / str(env), 5, seed=10 * run + env)
    curves = read_monitor_logs([tmp_path / "run0", tmp_path / "run1"])
    assert curves.returns.shape == (2, 15)
    for run in range(2):
        theirs = load_results(str(tmp_path / f"run{run}"))
        np.testing.assert_array_equal(curves.steps[run], theirs["l"])
        np.testing.assert_array_equal(curves.returns[run], theirs["r"])
        timesteps, _ = ts2xy(theirs, X_TIMESTEPS)
        np.testing.assert_array_equal(np.cumsum(curves.steps[run]), timesteps)


def test_a_log_that_learning_was_resumed_into_keeps_its_order(tmp_path):
    first = play_cart_pole(tmp_path / "run", 4, seed=0)
    second = play_cart_pole(tmp_path / "run", 3, seed=1, override_existing=False)
    # The clock starts again, so times of the second part may be lower than those of the first.
    file = tmp_path / "run.monitor.csv"
    lines = file.read_text().splitlines()
    lines[2] = ",".join([*lines[2].split(",")[:2], "500.0"])
    file.write_text("\n".join(lines) + "\n")
    np.testing.assert_array_equal(read_monitor_logs([file]).steps, [first + second])


def test_steps_to_reach_counts_up_to_the_end_of_the_first_good_window():
    steps = np.array([[400, 30, 400, 30, 30, 30], [400, 400, 400, 400, 400, 400]])
    np.testing.assert_array_equal(steps_to_reach(steps, 50, 3), [860, np.inf])
    np.testing.assert_array_equal(steps_to_reach(steps, 50, 7), [np.inf, np.inf])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "JSON"),
        ('#{"t_start": 1.0}\nreward,l,t\n1,10,1.0\n', "'r'"),
        ('#{"t_start": 1.0}\nr,l,t\n1,10,1.0\n2,11,1.', "last line has no end"),
        ('#{"t_start": 1.0}\nr,l,t\n', "has no episode"),
        ('#{"t_start": 1.0}\nr,l,t\nnan,10,1.0\n', "not finite"),
    ],
)
def test_files_that_are_no_whole_monitor_log_are_refused(tmp_path, text, message):
    (tmp_path / "monitor.csv").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_monitor_logs(tmp_path)
    assert str(tmp_path / "monitor.csv") in str(error.value)


def test_a_row_ends_where_its_line_does(tmp_path):
    # Monitor's csv writer leaves such separators in the text of an info keyword unquoted.
    (tmp_path / "monitor.csv").write_text('#{"t_start": 1.0}\nr,l,t,note\n1,10,1.0,one\u2028two\n2,20,2.0,x\n', "utf-8")
    # Its other files may have other columns.
    (tmp_path / "1.monitor.csv").write_text('#{"t_start": 1.0}\nl,other,r,t\n15,x,3,1.5\n')
    assert read_monitor_logs([tmp_path]).returns.tolist() == [[1.0, 3.0, 2.0]]


def test_logs_that_are_not_there_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere does not exist"):
        read_monitor_logs(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match=r"has no file \*monitor.csv"):
        read_monitor_logs([tmp_path])
    with pytest.raises(ValueError, match=r"paths.*\[\]"):
        read_monitor_logs([])


@pytest.mark.parametrize(
    ("returns", "steps", "message"),
    [
        ([1.0, 2.0], [1, 1], r"returns.*n_runs, n_episodes.*\(2,\)"),
        (np.ones((2, 0)), np.ones((2, 0)), r"returns.*\(2, 0\)"),
        ([[1.0, 2.0]], [[1]], r"steps.*\(1, 2\).*\(1, 1\)"),
        ([[1.0, 2.0], [NAN, NAN]], [[1, 1], [NAN, NAN]], "returns.*first episode.*run 1, episode 0"),
        ([[1.0, NAN, 2.0]], [[1, NAN, 1]], "returns.*NaN only after"),
        ([[1.0, INF]], [[1, 1]], "returns.*finite.*inf in run 0, episode 1"),
        ([[1.0, 2.0]], [[1, NAN]], "steps.*NaN where returns are"),
        ([[1.0, NAN]], [[1, 1]], "steps.*NaN where returns are"),
        ([[1.0, 2.0]], [[1, 0]], "steps.*at least 1, got 0.0 in run 0, episode 1"),
        ([[1.0, 2.0]], [[1, 2.5]], "steps.*whole.*2.5"),
        ([[1.0, 2.0]], [[1, INF]], "steps.*inf"),
    ],
)
def test_arrays_that_are_no_learning_curves_are_refused(returns, steps, message):
    with pytest.raises(ValueError, match=message):
        LearningCurves(returns, steps)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: LearningCurves.from_rows([[1.0, 2.0]], [[1]]), r"steps.*\[2\].*\[1\]"),
        (lambda: LearningCurves.from_rows([[1.0], []], [[1], []]), r"returns.*\[1, 0\]"),
        (lambda: LearningCurves.from_rows([], []), r"returns.*\[\]"),
        (lambda: initial_return(CURVES, 4), "n_first.*from 1 to 3.*shortest.*4"),
        (lambda: asymptotic_return(CURVES, 0), "n_last.*from 1 to 3.*0"),
        (lambda: total_reward(CURVES, 4), "n_episodes.*from 1 to 3.*4"),
        (lambda: CURVES.first_episodes(4), "n must.*from 1 to 3.*4"),
        (lambda: total_reward_by_steps(CURVES, 16), "n_steps.*from 1 to 15.*16"),
        (lambda: time_to_threshold(CURVES, NAN), "threshold.*finite.*nan"),
        (lambda: time_to_threshold(CURVES, 0.0, 0), "window.*at least 1.*0"),
        (lambda: compare_learning(CURVES, CURVES), "n_first.*from 1 to 3.*5"),
        (lambda: measures_of(CURVES, CURVES, floor=-5.0), "floor.*lowest return.*-9.*-5"),
        (lambda: measures_of(CURVES, CURVES, floor=NAN), "floor.*finite.*nan"),
        (lambda: measures_of(CURVES, CURVES, n_resamples=1), "n_resamples.*1"),
    ],
)
def test_bad_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
