"""Tables of past transitions: CSV files and data frames, with and without columns of next states."""

import re

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_combrel import SourceInstances

STEPS = {
    "x": [0.0, 0.1, 0.2, 5.0, 5.1],
    "v": [1.0, 1.0, 1.0, -1.0, -1.0],
    "action": [0, 1, 0, 1, 1],
    "reward": [-1.0, -1.0, 0.0, -1.0, -1.0],
    "next_x": [0.1, 0.2, 0.3, 5.1, 5.2],
    "next_v": [1.0, 1.0, 1.0, -1.0, -1.0],
    "terminated": [False, False, True, False, False],
}


def assert_same(one, other):
    for name in ("states", "actions", "rewards", "next_states", "terminated"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    assert (one.state_names, one.n_actions) == (other.state_names, other.n_actions)


def test_a_file_with_next_states_is_read_column_by_column(tmp_path):
    frame = pd.DataFrame(STEPS)
    frame.to_csv(tmp_path / "log.csv", index=False)
    source = SourceInstances.from_table(tmp_path / "log.csv")
    assert source.state_names == ("x", "v") and source.n_actions == 2 and len(source) == 5
    np.testing.assert_array_equal(source.states, frame[["x", "v"]].to_numpy())
    np.testing.assert_array_equal(source.next_states, frame[["next_x", "next_v"]].to_numpy())
    np.testing.assert_array_equal(source.terminated, STEPS["terminated"])
    assert source.low[0] <= 0.0 and source.high[0] >= 5.2
    assert source.origin["recorder"] == "log.csv"


def test_columns_may_come_in_any_order_and_actions_by_name():
    frame = pd.DataFrame({**STEPS, "action": ["left", "right", "left", "right", "right"]})
    source = SourceInstances.from_table(
        frame[sorted(frame.columns)], state_names=("v", "x"), action_names=("left", "stay", "right")
    )
    np.testing.assert_array_equal(source.actions, [0, 2, 0, 2, 2])
    np.testing.assert_array_equal(source.states[:, 1], STEPS["x"])
    assert source.n_actions == 3


def test_without_next_states_a_step_leads_to_the_next_row_of_its_episode():
    rows = {
        "x": [0.0, 0.1, 0.2, 5.0, 5.1, 7.0, 7.1],
        "action": [0, 1, np.nan, 1, 0, 1, 1],
        "reward": [-1.0, 0.0, np.nan, -1.0, -1.0, -1.0, -1.0],
        "terminated": [0, 1, 0, 0, 0, 0, 0],
        "truncated": [0, 0, 0, 0, 1, 0, 0],
    }
    found = SourceInstances.from_table(pd.DataFrame(rows))
    # Where the episode that a time limit cut arrived, and where the log breaks off, is not known.
    np.testing.assert_array_equal(found.states[:, 0], [0.0, 0.1, 5.0, 7.0])
    np.testing.assert_array_equal(found.next_states[:, 0], [0.1, 0.2, 5.1, 7.1])
    np.testing.assert_array_equal(found.terminated, [False, True, False, False])
    by_number = pd.DataFrame({**rows, "episode": [1, 1, 1, 2, 2, 3, 3]})
    assert_same(SourceInstances.from_table(by_number), found)


def test_done_is_an_end_but_for_time_limits():
    frame = pd.DataFrame(STEPS).drop(columns="terminated").assign(done=[0, 0, 1, 0, 1], truncated=[0, 0, 0, 0, 1])
    np.testing.assert_array_equal(SourceInstances.from_table(frame).terminated, [False, False, True, False, False])


def test_done_without_truncated_may_be_a_time_limit():
    frame = pd.DataFrame(STEPS).drop(columns="terminated").assign(done=[0, 0, 1, 0, 1])
    with pytest.warns(UserWarning, match="all 2 ends count as terminal states, time limits as well") as caught:
        SourceInstances.from_table(frame)
    assert len(caught) == 1


def test_the_index_that_pandas_writes_is_no_state_variable(tmp_path):
    pd.DataFrame(STEPS).to_csv(tmp_path / "log.csv")
    assert SourceInstances.from_table(tmp_path / "log.csv").state_names == ("x", "v")


def test_a_column_without_a_next_one_is_named():
    frame = pd.DataFrame(STEPS).assign(time=range(5))
    with pytest.raises(ValueError, match=r"columns \['time'\] have no column \['next_time'\]"):
        SourceInstances.from_table(frame)
    assert SourceInstances.from_table(frame, state_names=["x", "v"]).state_names == ("x", "v")


def test_a_table_without_rows_is_named():
    with pytest.raises(ValueError, match=r"no rows, its columns are \['x', "):
        SourceInstances.from_table(pd.DataFrame(STEPS).iloc[:0])


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 20), st.integers(1, 4), st.integers(1, 5), st.integers(0, 2**31))
def test_what_is_written_as_a_table_is_read_again(n, d, n_actions, seed):
    rng = np.random.default_rng(seed)
    states, after = rng.normal(size=(2, n, d))
    names = [f"q{k}" for k in range(d)]
    ends = rng.random(n) < 0.3
    low, high = np.full(d, -9.0), np.full(d, 9.0)
    source = SourceInstances(
        states, rng.integers(n_actions, size=n), rng.normal(size=n), after, ends, low, high, n_actions, names
    )
    again = SourceInstances.from_table(source.to_table(), n_actions=n_actions, bounds=(low, high))
    assert_same(again, source)
    np.testing.assert_array_equal((again.low, again.high), (low, high))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"reward": None, "rewards": STEPS["reward"]}, "no column 'reward'.*did you mean 'rewards'"),
        ({"next_v": None}, r"columns \['v'\] have no column \['next_v'\].*state_names=\['x'\]"),
        ({"x": [0.0, np.nan, 0.2, 0.3, 0.4]}, "'x' must be finite numbers, got nan in row 1"),
        ({"x": [0.0, "wall", 0.2, 0.3, 0.4]}, "'x' must be finite numbers, got 'wall' in row 1"),
        ({"action": [0, 1, 0.5, 1, 1]}, "'action' must be whole numbers from 0 on, got 0.5 in row 2"),
        (
            {"action": [0, 1, -1, 1, 1]},
            "got -1 in row 2; where those of an environment begin elsewhere, subtract",
        ),
        ({"action": [0, -1, 0, 1, 1]}, "got -1 in row 1"),
        ({"terminated": ["no", "no", "yes", "no", "no"]}, "'terminated' must be true or false, got 'no' in row 0"),
        ({"next_x": None, "next_v": None}, "terminates in row 2 arrived"),
        ({"next_x": None, "next_v": None, "terminated": None, "episode": [1, 2, 3, 4, 5]}, "no transition"),
    ],
)
def test_what_is_wrong_in_a_table_is_named(change, message):
    columns = {name: column for name, column in {**STEPS, **change}.items() if column is not None}
    with pytest.raises(ValueError, match=message):
        SourceInstances.from_table(pd.DataFrame(columns))


def test_a_misspelt_action_name_is_named():
    frame = pd.DataFrame({**STEPS, "action": ["left", "rigth", "left", "left", "left"]})
    with pytest.raises(ValueError, match="got 'rigth' in row 1; did you mean 'right'"):
        SourceInstances.from_table(frame, action_names=("left", "right"))


FORCES = ("-1", "0", "1")


@pytest.mark.parametrize(
    ("column", "numbers"),
    [([-1, 0, 1], [0, 1, 2]), (["-1", "0", "1"], [0, 1, 2]), ([0, 1, 2], [0, 1, 2]), ([0.0, -1.0, 0.0], [1, 0, 1])],
)
def test_names_that_are_numbers_are_told_from_numbers_of_actions(column, numbers):
    frame = pd.DataFrame({"x": [0.0, 1.0, 2.0], "action": column, "reward": -1.0, "next_x": 1.0, "terminated": False})
    assert SourceInstances.from_table(frame, action_names=FORCES).actions.tolist() == numbers


@pytest.mark.parametrize("column", [[0, 1, 1], ["0", "1", "0"]])
def test_where_they_may_be_either_it_is_said(column):
    frame = pd.DataFrame({"x": [0.0, 1.0, 2.0], "action": column, "reward": -1.0, "next_x": 1.0, "terminated": False})
    with pytest.raises(ValueError, match="column 'action' must tell names from numbers"):
        SourceInstances.from_table(frame, action_names=FORCES)
    assert SourceInstances.from_table(frame, action_names=("0", "1")).actions.tolist() == [int(each) for each in column]


@pytest.mark.parametrize("content", [b"", b"\x00\xff\xfe\x80abc", b'a,b\n"1,2\n3'])
def test_a_file_that_is_no_table_is_refused(tmp_path, content):
    (tmp_path / "log.csv").write_bytes(content)
    with pytest.raises(ValueError, match=r"log\.csv is no table|no column"):
        SourceInstances.from_table(tmp_path / "log.csv")


@pytest.mark.parametrize("separator", [";", "\t"])
def test_other_separators_than_commas_are_named_and_what_reads_them(tmp_path, separator):
    pd.DataFrame(STEPS).to_csv(tmp_path / "log.csv", index=False, sep=separator)
    with pytest.raises(ValueError, match=re.escape(f"sep={separator!r}")):
        SourceInstances.from_table(tmp_path / "log.csv")
    assert len(SourceInstances.from_table(pd.read_csv(tmp_path / "log.csv", sep=separator))) == len(STEPS["x"])


def test_a_file_that_is_not_there_is_named_with_its_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=re.escape(f"no file lgo.csv, looked for in {tmp_path}")):
        SourceInstances.from_table("lgo.csv")


def log(**columns):
    """Seven rows of a log without columns of next states."""
    return pd.DataFrame({"x": 0.1 * np.arange(7), "action": 0, "reward": -1.0, **columns})


def effects(table, **arguments):
    """The effects of the transitions of a table, rounded."""
    source = SourceInstances.from_table(table, **arguments)
    return np.round(source.next_states - source.states, 6)[:, 0].tolist()


def test_no_transition_leads_across_rows_that_were_left_out():
    table = log()
    assert effects(table) == [0.1] * 6
    assert effects(table.drop(index=[3, 4])) == [0.1] * 3
    assert effects(pd.concat([table, table + {"x": 5.0, "action": 0, "reward": 0.0}])) == [0.1] * 12
    with pytest.raises(ValueError, match="sort the rows"):
        SourceInstances.from_table(table.sample(frac=1.0, random_state=0))
    # Every second row of a recording, and times of them: nothing says that some are missing.
    assert effects(table.iloc[::2]) == [0.2] * 3
    assert effects(table.set_index(pd.Index(20 * np.arange(7)))) == [0.1] * 6


@pytest.mark.parametrize(
    "times",
    [pd.date_range("2026", periods=7, freq="100ms", tz="CET"), pd.to_timedelta(np.arange(7), unit="s"), 0.1 * np.arange(7)],
    ids=lambda times: str(times.dtype),
)
def test_times_as_index_say_as_much_as_whole_numbers(times):
    table = log().set_index(pd.Index(times))
    assert effects(table) == [0.1] * 6
    assert effects(table.drop(index=times[[3, 4]])) == [0.1] * 3
    with pytest.raises(ValueError, match="sort the rows"):
        SourceInstances.from_table(table[::-1])
    # Clocks are not exact; text is no time.
    jitter = np.array([0.0, 0.2, -0.1, 0.1, -0.2, 0.1, 0.0]) * (times[1] - times[0])
    assert effects(table.set_index(pd.Index(times + jitter))) == [0.1] * 6
    assert effects(table.set_index(pd.Index(list("gfedcba")))) == [0.1] * 6


def test_an_end_is_one_whatever_the_numbers_of_episodes_say():
    ends = [False] * 3 + [True] + [False] * 3
    assert effects(log(episode=0, truncated=ends)) == [0.1] * 5
    with pytest.raises(ValueError, match="terminates in row 3 arrived"):
        SourceInstances.from_table(log(episode=0, terminated=ends))
    arrived = log(episode=0, terminated=ends)
    arrived["action"] = arrived["action"].astype(float).mask(arrived.index == 4)
    assert effects(arrived) == [0.1] * 5


def test_episodes_may_be_an_index_and_every_row_needs_one():
    table = log(episode=[0] * 4 + [1] * 3, step=[0, 1, 2, 3, 0, 1, 2]).set_index(["episode", "step"])
    assert effects(table) == [0.1] * 5
    with pytest.raises(ValueError, match="'episode' must say of every row"):
        SourceInstances.from_table(log(episode=[0] + [None] * 6))


def test_no_transition_leads_from_one_file_to_another():
    one, other = log().drop(index=[3, 4]), log() + {"x": 5.0, "action": 0, "reward": 0.0}
    assert effects(pd.concat({"monday.csv": one, "tuesday.csv": other})) == [0.1] * (3 + 6)
    # The second begins with the number that would be next in the first.
    assert effects(pd.concat({"monday.csv": log(), "tuesday.csv": other.set_index(other.index + 7)})) == [0.1] * 12


def test_an_index_of_several_levels_ends_with_numbers_or_times():
    """Two robots' rows in turn: which row is next of the same robot is not to be seen."""
    turns = pd.MultiIndex.from_product([["10:00", "10:01", "10:02"], ["left robot", "right robot"]])
    with pytest.raises(ValueError, match=r"must be numbers or times, which .* got 'left robot'"):
        SourceInstances.from_table(log().iloc[:6].set_index(turns))


@pytest.mark.parametrize("name", ["terminal", "Done", "is_last", "timeouts"])
def test_a_column_that_seems_to_say_where_episodes_end_is_not_left_out_without_a_word(name):
    with pytest.raises(ValueError, match=f"has a column '{name}', and none of 'terminated'"):
        SourceInstances.from_table(log(**{name: 0.0}), state_names=["x"])
    assert SourceInstances.from_table(log(**{name: 0.0}), state_names=["x", name]).n_variables == 2


@pytest.mark.parametrize("columns", [["x", "action", "reward", 3], ["x", "action", "reward", "x"]])
def test_columns_are_told_apart_by_text(columns):
    with pytest.raises(ValueError, match="must have different names, all of them text"):
        SourceInstances.from_table(pd.DataFrame(np.zeros((3, 4)), columns=columns))


def test_an_angle_of_a_table_is_one_with_its_period():
    table = log(x=[3.0, 3.1, -3.1, -3.0, 2.9, 3.0, 3.1])
    around = (-np.pi, np.pi)
    source = SourceInstances.from_table(table, bounds=around, periodic=[True])
    assert source.periodic == (True,) and source.low[0] == -np.pi
    with pytest.raises(ValueError, match="periodic variables must have finite bounds"):
        SourceInstances.from_table(table, periodic=[True])
    with pytest.raises(ValueError, match="periodic must be None or 1 booleans"):
        SourceInstances.from_table(table, bounds=around, periodic=[True, False])


@pytest.mark.parametrize("bounds", [(100.0, -100.0), (np.nan, 1e40), (0.0, [1.0, 2.0])])
def test_bounds_of_a_table_are_checked(bounds):
    with pytest.raises(ValueError, match="bounds"):
        SourceInstances.from_table(log(), bounds=bounds)


def test_flags_may_be_missing_in_columns_that_allow_it():
    table = log(terminated=pd.array([False] * 6 + [pd.NA], dtype="boolean"))
    assert len(SourceInstances.from_table(table)) == 6


@pytest.mark.parametrize("name", ["terminated", "done"])
def test_the_row_of_a_last_state_may_say_that_it_is_an_end(name, recwarn):
    """As a loop writes it that notes each observation, and what was done there, if anything was."""
    table = pd.DataFrame({"x": [0.0, 0.1, 0.2] * 2, "action": [1, 0, None] * 2, "reward": 0.0, name: [0, 0, 1, 0, 0, 0]})
    source = SourceInstances.from_table(table.assign(truncated=[0, 0, 0, 0, 0, 1]))
    assert source.terminated.tolist() == [False, True, False, False] and len(source) == 4
    np.testing.assert_allclose(source.next_states[:, 0], [0.1, 0.2] * 2)


@pytest.mark.parametrize("name", ["None", "NA", "null", "N/A", "none"])
def test_actions_may_have_names_that_pandas_takes_for_missing(name, tmp_path):
    text = f"x,action,reward,terminated\n0,Left,-1,0\n1,Left,-1,0\n2,{name},-1,1\n3,,,\n0,Left,-1,0\n1,,,\n"
    (tmp_path / "log.csv").write_text(text)
    source = SourceInstances.from_table(tmp_path / "log.csv", action_names=[name, "Left"])
    np.testing.assert_array_equal(source.states.ravel(), [0.0, 1.0, 2.0, 0.0])
    np.testing.assert_array_equal(source.actions, [1, 1, 0, 1])
    np.testing.assert_array_equal(source.terminated, [False, False, True, False])


@pytest.mark.parametrize("nothing", ["", "NA", "None", "nan", "NULL"])
def test_what_is_no_name_of_an_action_is_missing(nothing, tmp_path):
    (tmp_path / "log.csv").write_text(f"x,action,reward,terminated\n0,0,-1,0\n1,1,-1,1\n2,{nothing},{nothing},0\n")
    source = SourceInstances.from_table(tmp_path / "log.csv")
    np.testing.assert_array_equal(source.states.ravel(), [0.0, 1.0])
    np.testing.assert_array_equal(source.terminated, [False, True])


def test_numbers_come_back_from_a_file_to_the_last_digit(tmp_path):
    source = SourceInstances.record(None, "MountainCar-v0", 300, 0)
    source.to_table().to_csv(tmp_path / "log.csv", index=False)
    read = SourceInstances.from_table(tmp_path / "log.csv", bounds=(source.low, source.high), n_actions=3)
    np.testing.assert_array_equal(read.states, source.states)
    np.testing.assert_array_equal(read.next_states, source.next_states)
