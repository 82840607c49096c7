"""Transitions from a table with named columns: a CSV file, or a pandas DataFrame."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from sb3_combrel.common.periodic import check_periods, periodic_flags
from sb3_combrel.common.scaling import Bounds, check_bounds
from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.sources.transitions import Floats, Transitions

if TYPE_CHECKING:
    import pandas as pd

    from sb3_combrel.sources.source_instances import SourceInstances

# Importing pandas takes a while, and only who has a table needs it.
Table: TypeAlias = "str | os.PathLike[str] | pd.DataFrame"
ACTION, REWARD, TERMINATED, DONE, TRUNCATED, EPISODE = "action", "reward", "terminated", "done", "truncated", "episode"
NEXT, INDEX = "next_", "Unnamed: "
# What tables write where there is nothing; but an action may have such a name.
_MISSING = ("", "NA", "N/A", "n/a", "NaN", "nan", "NULL", "null", "None", "<NA>")
_NO_STATES = {ACTION, REWARD, TERMINATED, DONE, TRUNCATED, EPISODE}
_TRUE, _FALSE = ("true", "1", "1.0"), ("false", "0", "0.0", "nan", "", "none", "<na>")
_LIKE_ENDS = {"terminal", "terminated", "done", "last", "timeout", "time_out", "truncated", "end", "episode_end", "episode"}


def read_table(
    table: Table,
    state_names: Sequence[str] | None,
    action_names: Sequence[str],
    n_actions: int | None,
    bounds: Bounds | None,
    periodic: Sequence[bool] | None,
) -> Transitions:
    """Read the transitions of a table; for the parameters see :meth:`SourceInstances.from_table`."""
    frame = _read(table, action_names)
    if len(frame) == 0:
        raise ValueError(f"the table has no rows, its columns are {[str(name) for name in frame.columns]}")
    if EPISODE in frame.index.names:
        frame = frame.reset_index(level=EPISODE)
    _check_columns(frame, state_names or ())
    for name in (ACTION, REWARD, *(state_names or ())):
        _require(frame, name)
    names = _state_names(frame) if state_names is None else tuple(state_names)
    _check_names(names)
    if not names:
        raise ValueError(
            f"the table has no column of a state variable, its columns are {[str(name) for name in frame.columns]}"
        )
    flags = periodic_flags(periodic, len(names))
    check_periods(np.array(flags) & (bounds is None))
    _warn_of_ends(frame, names)
    steps, next_states, ended = _with_next_states(frame, names)
    states = _numbers(steps, names)
    actions = _actions(steps, action_names)
    if n_actions is None:
        n_actions = len(action_names) or int(actions.max(initial=0)) + 1
    unknown = np.full(len(names), np.inf)
    limits = (-unknown, unknown) if bounds is None else check_bounds(bounds, len(names))
    columns = states, actions, _numbers(steps, [REWARD])[:, 0], next_states, ended
    given = {"state_names": names, "action_names": tuple(action_names), "periodic": flags}
    origin = {"env": None, "recorder": os.path.basename(table) if isinstance(table, str | os.PathLike) else "table"}
    return Transitions.within(limits, columns, n_actions, given, origin)


def _read(table: Table, action_names: Sequence[str]) -> pd.DataFrame:
    import pandas as pd

    if isinstance(table, pd.DataFrame):
        return table
    if os.path.isdir(table):
        raise ValueError(f"table must be a CSV file or a pandas DataFrame, got the folder {os.fspath(table)}")
    try:
        missing = [word for word in _MISSING if word not in action_names]
        exactly = {"skipinitialspace": True, "float_precision": "round_trip"}
        frame = pd.read_csv(table, keep_default_na=False, na_values=missing, **exactly)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"there is no file {os.fspath(table)}, looked for in {os.getcwd()}") from error
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise ValueError(f"{os.fspath(table)} is no table with named columns: {' '.join(str(error).split())}") from error
    for separator in (";", "\t"):
        if len(frame.columns) == 1 and separator in str(frame.columns[0]):
            raise ValueError(
                f"{os.fspath(table)} must have commas between its columns, got {separator!r}: read it with "
                f"pandas.read_csv(path, sep={separator!r}), and pass that table (where numbers have a comma, with decimal=',')"
            )
    return frame


def _check_columns(frame: pd.DataFrame, state_names: Sequence[str]) -> None:
    """:raises ValueError: if columns are not told apart by text, or one seems to say where episodes end, by another name"""
    columns = frame.columns.tolist()
    if len(set(columns)) < len(columns) or not all(isinstance(name, str) for name in columns):
        raise ValueError(f"the columns of the table must have different names, all of them text, got {columns}")
    if not {TERMINATED, DONE, TRUNCATED, EPISODE}.intersection(columns):
        for name in columns:
            if name not in state_names and name.strip().lower().removeprefix("is_").removesuffix("s") in _LIKE_ENDS:
                raise ValueError(
                    f"the table has a column {name!r}, and none of {TERMINATED!r}, {DONE!r}, {TRUNCATED!r} and {EPISODE!r}: "
                    f"if it says where episodes end, call it {TERMINATED!r}, or {TRUNCATED!r}, and otherwise leave it out"
                )


def _state_names(frame: pd.DataFrame) -> tuple[str, ...]:
    """All columns that are nothing else; a column without a name is the index that pandas has written."""
    columns = [str(name) for name in frame.columns]
    names = [name for name in columns if name not in _NO_STATES and not name.startswith((NEXT, INDEX))]
    without = [name for name in names if f"{NEXT}{name}" not in columns]
    if without and len(without) < len(names):
        raise ValueError(
            f"the columns {without} have no column {[NEXT + name for name in without]} of where they lead, others have: add "
            f"them, or, if they are no state variables, name those that are: from_table(table, state_names={names[:1]} ...)"
        )
    return tuple(names)


def _check_names(names: Sequence[str]) -> None:
    """:raises ValueError: if a state variable has the name of another column"""
    taken = [name for name in names if name in _NO_STATES or name.startswith(NEXT)]
    if taken:
        raise ValueError(
            f"state variables in a table must have other names than {sorted(_NO_STATES)} and no {NEXT!r} in front, got {taken}"
            ": give them others, dataclasses.replace(source, state_names=(...))"
        )


def _require(frame: pd.DataFrame, name: str, others: Sequence[str] = ()) -> None:
    """:param others: names that are right, none of which is this one misspelt"""
    if name not in frame.columns:
        columns = [str(each) for each in frame.columns]
        meant = did_you_mean(name, set(columns).difference(others))
        raise ValueError(f"the table has no column {name!r}, its columns are {columns}{meant}")


def _with_next_states(frame: pd.DataFrame, names: Sequence[str]) -> tuple[pd.DataFrame, Floats, NDArray[np.bool_]]:
    """The rows that are transitions, where each leads, by columns of its own or the next row, and whether it terminates."""
    following = [f"{NEXT}{name}" for name in names]
    if any(name in frame.columns for name in following):
        for name in following:
            _require(frame, name, following)
        return frame, _numbers(frame, following), _terminated(frame)
    ends = _flags(frame, TERMINATED) | _flags(frame, DONE) | _flags(frame, TRUNCATED)
    acts = frame[ACTION].notna().to_numpy()
    # The row after an end is its last state only if nothing was done there.
    follows = _follow(frame) & (~ends[:-1] | ~acts[1:])
    if EPISODE in frame.columns:
        episode = frame[EPISODE]
        if episode.isna().any():
            raise ValueError(f"column {EPISODE!r} must say of every row which episode it is of, got none in some")
        follows &= episode.to_numpy()[1:] == episode.to_numpy()[:-1]
    goes_on = np.append(follows, False)
    # The last step before a time limit may be left out; where an end was reached must be known.
    terminated = _terminated(frame)
    lost = np.flatnonzero(terminated & acts & ~goes_on)
    if len(lost):
        raise ValueError(
            f"the table does not say in which state the episode that terminates in row {frame.index[lost[0]]} arrived: add "
            f"columns {following}, or, after that row, one with this state and an empty action"
        )
    chosen = np.flatnonzero(acts & goes_on)
    if len(chosen) == 0:
        raise ValueError(f"the table has no transition: it needs columns {following}, or two rows of one episode")
    # A last state may say itself that it is one.
    terminated |= np.append(terminated[1:] & ~acts[1:], False)
    return frame.iloc[chosen], _numbers(frame.iloc[chosen + 1], names), terminated[chosen]


def _warn_of_ends(frame: pd.DataFrame, names: Sequence[str]) -> None:
    """Warn of a table that does not say where episodes end, by columns, or by rows with an empty action; or not why."""
    if (
        DONE in frame.columns
        and not {TERMINATED, TRUNCATED}.intersection(frame.columns)
        and (done := _flags(frame, DONE)).any()
    ):
        warn_user(
            f"the table has a column {DONE!r}, but none of {TRUNCATED!r}: all {done.sum()} ends count as terminal states, "
            "time limits as well"
        )
    leads = any(f"{NEXT}{name}" in frame.columns for name in names)
    if {TERMINATED, DONE, TRUNCATED}.intersection(frame.columns) or (EPISODE in frame.columns and not leads):
        return
    if leads:
        what = "no transition is taken to end an episode: add"
    elif frame[ACTION].iloc[:-1].isna().any():
        return
    else:
        what = f"all {len(frame)} rows are taken as one episode that does not end: add {EPISODE!r} or {TRUNCATED!r}, and"
    warn_user(f"no column of the table says where episodes end, and {what} {TERMINATED!r} where they do")


def _follow(frame: pd.DataFrame) -> NDArray[np.bool_]:
    """Whether each row but the first was made right after the one above it: some may have been left out, by their index."""
    import pandas as pd

    index = frame.index
    # Outer levels, as of files that were put together, are like episodes.
    follows = np.ones(len(frame) - 1, dtype=np.bool_)
    if index.nlevels > 1:
        follows = np.asarray(index.droplevel(-1)[1:] == index.droplevel(-1)[:-1], dtype=np.bool_)
    # Times as numbers; of text, no number.
    places = np.asarray(pd.to_numeric(index.get_level_values(-1), errors="coerce"), dtype=np.float64)
    no_numbers = np.flatnonzero(~np.isfinite(places))
    if len(no_numbers) and index.nlevels > 1:
        raise ValueError(
            "the last level of the table's index must be numbers or times, which say which rows follow each other, got "
            f"{index.get_level_values(-1)[no_numbers[0]]!r}: pandas.to_datetime makes times of text"
        )
    if len(no_numbers) or not follows.any():
        return follows
    apart, n_together = np.diff(places), follows.sum()
    follows &= (apart > 0.0) & (apart < 1.5 * np.median(apart[follows]))
    if 2 * follows.sum() < n_together:
        raise ValueError(
            "the table's index must rise evenly where rows follow each other, as it does not: sort the rows, or, if they are "
            "in order, number them: table.reset_index(drop=True)"
        )
    return follows


def _numbers(frame: pd.DataFrame, names: Sequence[str]) -> Floats:
    """Columns as finite numbers, float64, shape (n, n_names)."""
    import pandas as pd

    for name in names:
        column = pd.to_numeric(frame[name], errors="coerce").to_numpy(dtype=np.float64)
        wrong = np.flatnonzero(~np.isfinite(column))
        if len(wrong):
            row = wrong[0]
            no_state = "" if name in _NO_STATES else "; if it is no state variable, name those that are: state_names=[...]"
            got = f"{frame[name].tolist()[row]!r} in row {frame.index[row]}"
            raise ValueError(f"column {name!r} must be finite numbers, got {got}{no_state}")
    return frame[list(names)].to_numpy(dtype=np.float64)


def _flags(frame: pd.DataFrame, name: str) -> np.ndarray:
    """A column of true and false, or 1 and 0; all false if there is none, and where nothing is written."""
    if name not in frame.columns:
        return np.zeros(len(frame), dtype=np.bool_)
    words = frame[name].astype(str).str.strip().str.lower()
    wrong = np.flatnonzero(~words.isin((*_TRUE, *_FALSE)))
    if len(wrong):
        row = wrong[0]
        raise ValueError(f"column {name!r} must be true or false, got {frame[name].tolist()[row]!r} in row {frame.index[row]}")
    return words.isin(_TRUE).to_numpy(dtype=np.bool_)


def _terminated(frame: pd.DataFrame) -> np.ndarray:
    """Whether each transition reached a terminal state: "done" counts where there is no "terminated", but for time limits."""
    if TERMINATED in frame.columns:
        return _flags(frame, TERMINATED)
    return _flags(frame, DONE) & ~_flags(frame, TRUNCATED)


def _actions(frame: pd.DataFrame, action_names: Sequence[str]) -> np.ndarray:
    """Actions by number, from 0 on, or by name; int64."""
    import pandas as pd

    column = frame[ACTION]
    as_numbers = pd.to_numeric(column, errors="coerce").to_numpy(dtype=np.float64)
    by_name = {str(name): float(number) for number, name in enumerate(action_names)}
    numbers = np.where(np.isnan(as_numbers), column.astype(str).map(by_name).to_numpy(dtype=np.float64), as_numbers)
    # Names such as "-1", "0" and "1" are numbers too.
    values = {float(name): number for name, number in by_name.items() if _is_number(name)}
    of_values = np.array([values.get(each, np.nan) for each in as_numbers.tolist()])
    named = np.where(np.isnan(as_numbers), numbers, of_values)
    if not np.isnan(named).any() and (named != numbers).any():
        if np.isin(numbers, list(by_name.values())).all():
            raise ValueError(
                f"column {ACTION!r} must tell names from numbers, got numbers of actions that are names of others among "
                f"{list(action_names)}: write names with a letter, or numbers, and read the table without action_names, "
                "SourceInstances.from_table(table)"
            )
        numbers = named
    wrong = np.flatnonzero(~(numbers == np.floor(numbers)) | (numbers < 0.0))
    if len(wrong):
        got = column.tolist()[wrong[0]]
        names = f", or one of {list(action_names)}" if len(action_names) else ""
        raise ValueError(
            f"column {ACTION!r} must be whole numbers from 0 on{names}, got {got!r} in row {frame.index[wrong[0]]}"
            f"{did_you_mean(got, by_name)}; where those of an environment begin elsewhere, subtract its action_space.start; "
            "continuous actions: write the number of the nearest of those that the agent has"
        )
    return numbers.astype(np.int64)


def _is_number(name: str) -> bool:
    try:
        return np.isfinite(float(name))
    except ValueError:
        return False


def as_frame(source: SourceInstances) -> pd.DataFrame:
    """The table of source instances, see :meth:`SourceInstances.to_table`."""
    import pandas as pd

    _check_names(source.state_names)
    data: dict[str, Any] = {name: source.states[:, k] for k, name in enumerate(source.state_names)}
    data |= {ACTION: source.actions, REWARD: source.rewards}
    data |= {f"{NEXT}{name}": source.next_states[:, k] for k, name in enumerate(source.state_names)}
    return pd.DataFrame({**data, TERMINATED: source.terminated})
