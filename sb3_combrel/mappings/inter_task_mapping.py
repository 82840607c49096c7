"""One inter-task mapping: the source variable of each target variable and the source action of each target action."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import index as as_index
from typing import Any, NamedTuple, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_combrel.common.serialisation import register_reader, register_writer
from sb3_combrel.mappings.named_entries import Entries, as_entries, as_given, has_names, numbers

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Names = Iterable[str]
Signs = Sequence[int] | Mapping[Any, int] | None

UNMAPPED = -1  # represents None in integer arrays of state mappings

_MAX_INDEX = 2**31 - 1


class TaskSizes(TypedDict):
    """Numbers of variables and actions of the two tasks."""

    n_source_variables: int
    n_target_variables: int
    n_source_actions: int
    n_target_actions: int


class MappingNames(NamedTuple):
    """Names of the variables and actions on both sides of a mapping, in the order of the spaces; for display only."""

    source_variables: tuple[str, ...]
    target_variables: tuple[str, ...]
    source_actions: tuple[str, ...]
    target_actions: tuple[str, ...]


@dataclass(frozen=True, repr=False)
class InterTaskMapping:
    """A pair (X_S, X_A) of a state and an action mapping, from the target task to the source task (Section 2.2).

    All coordinates are unit coordinates (:class:`~sb3_combrel.common.scaling.StateScaling`), so the ranges of the two
    tasks may differ. A target variable that is mapped to None keeps the value of the current target state, and a
    translated instance predicts no change for it; distances are taken over the mapped variables only.

    Variables and actions may also be given by name, or as a dict from those of the target to those of the source, without
    the variables that are not mapped. Names stand for numbers as soon as both tasks are known: a transfer method finds out
    when it is given to an algorithm, :meth:`with_names` at once::

        along_x = InterTaskMapping(
            state={"x": "x", "vx": "v"},
            action={"Neutral": "Neutral", "West": "Left", "East": "Right", "South": "Neutral", "North": "Neutral"},
        )

    :param state: for each target variable the index or name of its source variable, or None; or a dict
    :param action: for each target action its source action, by number or name; or a dict
    :param sign: for each target variable +1, or -1 to mirror it in its range (unit coordinate u becomes 1 - u and
        displacements change sign); None for +1 throughout; or a dict, without those that are +1. The sign of an unmapped
        variable has no effect and is stored as +1.
    :param names: names for ``repr``; they play no part in comparisons, see :meth:`with_names`
    :raises ValueError: if an entry is not of the kind above, if no variable is mapped, or if there is no action; where names
        have not been replaced yet, if something is asked that needs their numbers
    """

    state: tuple[int | None, ...]  # with names that have not been replaced yet these are what the user gave, dicts as pairs
    action: tuple[int, ...]
    sign: tuple[int, ...] | None
    names: MappingNames | None = field(default=None, compare=False, kw_only=True)

    def __init__(self, state: Entries, action: Entries, sign: Signs = None, *, names: MappingNames | None = None) -> None:
        states, actions = as_entries("state", state), as_entries("action", action)
        signs = None if sign is None else as_entries("sign", sign)
        if names is not None:
            names = MappingNames(*(tuple(map(str, group)) for group in names))
            states = numbers("state", states, names.target_variables, names.source_variables)
            actions = numbers("action", actions, names.target_actions, names.source_actions)
            signs = None if signs is None else numbers("sign", signs, names.target_variables, (), default=1)
        if names is not None or not any(map(has_names, (states, actions, signs or ()))):
            states = tuple(None if i is None else _index("state", i) for i in states)
            actions = tuple(_index("action", a) for a in actions)
            if all(i is None for i in states) or not actions:
                raise ValueError(
                    "state must map at least one target variable to a source variable, and action must hold one source action "
                    f"for each target action, got state={state!r}, action={action!r}"
                )
            signs = _signs(signs, states)
        if names is not None:
            _check_names(names, states, actions)
        for name, value in {"state": states, "action": actions, "sign": signs, "names": names}.items():
            object.__setattr__(self, name, value)

    @property
    def has_names(self) -> bool:
        """Whether there are names that have not been replaced by numbers yet."""
        return any(has_names(entries) for entries in (self.state, self.action, self.sign or ()))

    def _check_numbers(self) -> None:
        if self.has_names:
            raise ValueError(
                f"{self!r} has names, which stand for numbers only when both tasks are known: give it to a transfer method, "
                "or call with_names(source_variables, target_variables, source_actions, target_actions) first"
            )

    @property
    def n_target_variables(self) -> int:
        """Number of variables of the target task."""
        self._check_numbers()
        return len(self.state)

    @property
    def n_target_actions(self) -> int:
        """Number of actions of the target task."""
        self._check_numbers()
        return len(self.action)

    @property
    def state_index(self) -> Ints:
        """``state`` as an array for compiled loops, shape (n_target_variables,), -1 for None."""
        self._check_numbers()
        return np.array([UNMAPPED if i is None else i for i in self.state], dtype=np.int64)

    @property
    def state_sign(self) -> Floats:
        """``sign`` as an array for compiled loops, shape (n_target_variables,)."""
        self._check_numbers()
        return np.array(self.sign, dtype=np.float64)

    @property
    def mapped(self) -> NDArray[np.bool_]:
        """Which target variables have a source variable, shape (n_target_variables,)."""
        return self.state_index != UNMAPPED

    def target_to_source(self, target_units: ArrayLike, n_source_variables: int) -> Floats:
        """Express target states in the coordinates of the source task.

        A source variable that several target variables map to is their mean; one that none maps to is NaN.

        :param target_units: unit coordinates, shape (..., n_target_variables)
        :param n_source_variables: number of variables of the source task
        :return: unit coordinates, shape (..., n_source_variables)
        :raises ValueError: if the shape does not fit, or if ``state`` names a source variable that does not exist
        """
        target = _columns("target_units", target_units, self.n_target_variables)
        if n_source_variables <= self.state_index.max():
            raise ValueError(
                f"n_source_variables must be above {self.state_index.max()}, the largest source variable in "
                f"state={self.state}, got {n_source_variables}"
            )
        mirrored = np.where(self.state_sign < 0, 1.0 - target, target)
        source = np.full((*target.shape[:-1], n_source_variables), np.nan)
        for variable in np.unique(self.state_index[self.mapped]):
            source[..., variable] = mirrored[..., self.state_index == variable].mean(axis=-1)
        return source

    def source_to_target(self, source_units: ArrayLike, target_state: ArrayLike) -> Floats:
        """Express source states in the coordinates of the target task; start and outcome with the same ``target_state``.

        :param source_units: unit coordinates, shape (..., n_source_variables)
        :param target_state: unit coordinates of the current target state, which unmapped variables keep; shape
            (n_target_variables,) or any that broadcasts with the source states
        :return: unit coordinates, shape (..., n_target_variables)
        :raises ValueError: if a shape does not fit
        """
        source = self._source_columns("source_units", source_units)
        current = _columns("target_state", target_state, self.n_target_variables)
        return np.where(self.mapped, np.where(self.state_sign < 0, 1.0 - source, source), current)

    def displacement_to_target(self, source_displacements: ArrayLike) -> Floats:
        """Express changes of the source state (s'_j - s_j of Eq. 2) as changes of the target state, 0 for unmapped variables.

        :param source_displacements: differences of unit coordinates, shape (..., n_source_variables)
        :raises ValueError: if the shape does not fit
        """
        source = self._source_columns("source_displacements", source_displacements)
        return np.where(self.mapped, self.state_sign * source, 0.0)

    def source_action(self, target_action: int) -> int:
        """The source action that a target action maps to."""
        self._check_numbers()
        return self.action[target_action]

    def target_actions(self, source_action: int) -> Ints:
        """The target actions that map to a source action, ascending; a source instance is translated to each of them."""
        self._check_numbers()
        return np.flatnonzero(np.array(self.action) == source_action).astype(np.int64)

    def check(self, **sizes: Unpack[TaskSizes]) -> None:
        """Check the mapping against the spaces of the two tasks.

        :raises ValueError: if a length or an index does not fit; the message names the argument and what would be right
        """
        self._check_numbers()
        check_sizes(self.state, self.action, **sizes)

    def with_names(
        self, source_variables: Names, target_variables: Names, source_actions: Names, target_actions: Names
    ) -> InterTaskMapping:
        """The same mapping with the two tasks' names for ``repr``; entries that were given by name become their numbers.

        :raises ValueError: if there are fewer names than the mapping uses, or it has a name that is none of these
        """
        names = MappingNames(*map(tuple, (source_variables, target_variables, source_actions, target_actions)))
        return InterTaskMapping(self.state, self.action, self.sign, names=names)

    def __repr__(self) -> str:
        if self.has_names:
            parts = {"state": self.state, "action": self.action, "sign": self.sign}
            given = {name: entries for name, entries in parts.items() if entries is not None}
            return f"InterTaskMapping({', '.join(f'{name}={as_given(entries)!r}' for name, entries in given.items())})"
        if self.names is None:
            mirrored = f", sign={self.sign}" if -1 in self.state_sign else ""
            return f"InterTaskMapping(state={self.state}, action={self.action}{mirrored})"
        pairs = zip(self.names.target_actions, self.action, strict=True)
        actions = [f"{name}<-{self.names.source_actions[source]}" for name, source in pairs]
        return f"InterTaskMapping({self.variables_by_name()}; {', '.join(actions)})"

    def variables_by_name(self) -> str:
        """The pairs of variables of a mapping that has both tasks' names: "x<-x, vx<-(-v)"."""
        assert self.names is not None
        source, pairs = self.names.source_variables, zip(self.names.target_variables, self.state, self.state_sign, strict=True)
        return ", ".join(f"{v}<-{source[k]}" if sign > 0 else f"{v}<-(-{source[k]})" for v, k, sign in pairs if k is not None)

    def _source_columns(self, name: str, values: ArrayLike) -> Floats:
        """The source column of each target variable; unmapped ones get an arbitrary column, to be masked."""
        array = np.asarray(values, dtype=np.float64)
        needed = int(self.state_index.max()) + 1
        if array.ndim == 0 or array.shape[-1] < needed:
            raise ValueError(
                f"{name} must have the shape (..., n_source_variables) with at least {needed} variables "
                f"for state={self.state}, got {array.shape}"
            )
        return array[..., np.maximum(self.state_index, 0)]


def _index(name: str, value: object) -> int:
    """A non-negative integer; bool is refused, it would pass as 0 or 1."""
    none = " or None" if name == "state" else ""
    try:
        number = -1 if isinstance(value, bool) else as_index(value)  # type: ignore[arg-type]
    except TypeError:
        number = -1
    if number < 0:
        raise ValueError(f"{name} must hold integers from 0 on{none}, got the entry {value!r}")
    if number > _MAX_INDEX:
        raise ValueError(f"{name} must hold indices up to {_MAX_INDEX}{none}, got a larger entry")
    return number


def _signs(sign: Sequence[int] | None, state: tuple[int | None, ...]) -> tuple[int, ...]:
    if sign is None:
        return (1,) * len(state)
    if len(sign) != len(state) or any(entry not in (1, -1) for entry in sign):
        raise ValueError(
            f"sign must have {len(state)} entries, +1 or -1, one for each entry of state={state}, got sign={sign!r}"
        )
    return tuple(1 if i is None or entry == 1 else -1 for i, entry in zip(state, sign, strict=True))


def _check_names(names: MappingNames, state: Sequence[int | None], action: Sequence[int]) -> None:
    used = max(i for i in state if i is not None) + 1, len(state), max(action) + 1, len(action)
    for kind, group, n_used in zip(MappingNames._fields, names, used, strict=True):
        exact = kind.startswith("target")
        if len(group) < n_used or (exact and len(group) > n_used):
            raise ValueError(f"{kind} must hold {'' if exact else 'at least '}{n_used} names, got {group}")


def _columns(name: str, values: ArrayLike, n_columns: int) -> Floats:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != n_columns:
        raise ValueError(f"{name} must have the shape (..., {n_columns}), got {array.shape}")
    return array


def check_sizes(state: Sequence[int | None], action: Sequence[int], **sizes: Unpack[TaskSizes]) -> None:
    """See :meth:`InterTaskMapping.check`."""
    for name, kind, entries, n_target, n_source in (
        ("state", "variables", state, sizes["n_target_variables"], sizes["n_source_variables"]),
        ("action", "actions", action, sizes["n_target_actions"], sizes["n_source_actions"]),
    ):
        largest = max(entry for entry in entries if entry is not None)
        if len(entries) != n_target:
            fault = f"have {n_target} entries, one for each of the target task's {kind}, got {len(entries)}:"
        elif largest >= n_source:
            fault = f"hold indices from 0 to {n_source - 1}, the source task has {n_source} {kind}, got {largest} in"
        else:
            continue
        raise ValueError(f"{name} must {fault} {name}={tuple(entries)}")


def index_table(name: str, values: ArrayLike, shape: str) -> Ints:
    """A table of indices as an array of its own, two-dimensional and not empty; ``shape`` says in words what is right."""
    try:
        array = np.array(values)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim != 2 or 0 in array.shape or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{name} must be integers of shape {shape}, got {values!r}")
    if array.max() > _MAX_INDEX:
        raise ValueError(f"{name} must hold indices up to {_MAX_INDEX}, got {array.max()}")
    return array.astype(np.int64)


def as_mapping(mapping: InterTaskMapping | Mapping[str, Any], what: str) -> InterTaskMapping:
    """A mapping that may be given as a dict of its arguments, as in a YAML file; ``what`` it is one of, for the message."""
    if isinstance(mapping, InterTaskMapping):
        return mapping
    if isinstance(mapping, Mapping) and {"state", "action"} <= set(mapping) <= {"state", "action", "sign"}:
        return InterTaskMapping(**mapping)
    raise ValueError(
        f"each of the {what} must be an InterTaskMapping or a dict of state, action and (optional) sign, got {mapping!r}"
    )


register_writer(
    InterTaskMapping,
    lambda mapping: ("InterTaskMapping", {"state": mapping.state, "action": mapping.action, "sign": mapping.sign}),
)
register_reader("InterTaskMapping", InterTaskMapping)
