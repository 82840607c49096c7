"""Source instances: transitions of a source task, with all that a transfer method must know of that task."""

from __future__ import annotations

import base64
import io
import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_combrel.common.checks import as_count, checked_names
from sb3_combrel.common.files import write_whole
from sb3_combrel.common.periodic import periodic_flags
from sb3_combrel.common.scaling import Bounds, StateScaling
from sb3_combrel.common.serialisation import register_reader, register_writer
from sb3_combrel.common.user_warnings import warn_user
from sb3_combrel.sources import minari_datasets, recording, replay_buffers, tables
from sb3_combrel.sources.q_learning import learn_q_learning
from sb3_combrel.sources.source_checks import action_array, finite_array, terminal_flags
from sb3_combrel.sources.subsets import check_method, covering_rows, random_rows
from sb3_combrel.sources.transitions import LEARNERS, Floats, as_transition_count

if TYPE_CHECKING:
    import pandas as pd
    from minari import MinariDataset
    from stable_baselines3.common.buffers import ReplayBuffer
    from stable_baselines3.common.vec_env import VecEnv

_MAX_ACTIONS = 1_000_000  # each action has a name
_FORMAT, _VERSION = "sb3_combrel.SourceInstances", 1
_ROW_ARRAYS = ("states", "actions", "rewards", "next_states", "terminated")
_ARRAYS = (*_ROW_ARRAYS, "low", "high")


@dataclass(frozen=True, eq=False)
class SourceInstances:
    """Instances <s, a, r, s'> of a source task (Section 3), in raw units, and the spaces that they come from.

    ::

        source = SourceInstances.record(None, "MountainCar-v0", n_instances=500, seed=0)  # None: random actions
        source.save("source.npz")
        transfer = COMBREL("source.npz")

    The arrays cannot be written to: one source may serve several transfer methods.

    :param states: where each transition starts, raw units, shape (n_instances, n_variables)
    :param actions: its action, from 0 on, shape (n_instances,)
    :param rewards: its reward, shape (n_instances,)
    :param next_states: where it ends, raw units, shape (n_instances, n_variables); of an episode's last transition too
    :param terminated: whether it reached a terminal state, shape (n_instances,); a time limit is no such state
    :param low: lower bound of each state variable, raw units, shape (n_variables,); ``high``: upper bound, the same
    :param n_actions: number of actions of the task, also of those that no instance has
    :param state_names: name of each state variable, by default s0, s1, ...; ``action_names``: of each action, a0, a1, ...
    :param origin: where the instances came from, a dict that JSON can hold
    :param periodic: which state variables are periodic, their bounds one period apart: one bool for each; () for none
    :raises ValueError: if there are no instances, or if an argument does not fit the others or is not finite
    """

    states: Floats
    actions: NDArray[np.int64]
    rewards: Floats
    next_states: Floats
    terminated: NDArray[np.bool_]
    low: Floats
    high: Floats
    n_actions: int
    state_names: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    origin: Mapping[str, Any] = field(default_factory=dict)
    periodic: tuple[bool, ...] = ()

    def __post_init__(self) -> None:
        scaling = StateScaling(self.low, self.high)
        n, d = len(self.states) if hasattr(self.states, "__len__") else 1, scaling.n_variables
        object.__setattr__(self, "n_actions", as_count("n_actions", self.n_actions, max=_MAX_ACTIONS))
        if n == 0:
            raise ValueError("states must hold at least one instance, got none: there is nothing to transfer")
        arrays: dict[str, NDArray[Any]] = {
            "states": finite_array("states", self.states, (n, d)),
            "actions": action_array(self.actions, n, self.n_actions),
            "rewards": finite_array("rewards", self.rewards, (n,)),
            "next_states": finite_array("next_states", self.next_states, (n, d)),
            "terminated": terminal_flags(self.terminated, n),
            "low": scaling.low,
            "high": scaling.high,
        }
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "state_names", checked_names("state_names", self.state_names, d, "s"))
        object.__setattr__(self, "action_names", checked_names("action_names", self.action_names, self.n_actions, "a"))
        object.__setattr__(self, "periodic", periodic_flags(None if self.periodic == () else self.periodic, d))
        try:
            object.__setattr__(self, "origin", json.loads(json.dumps(dict(self.origin))))  # as a file of it would be read
        except (TypeError, ValueError) as error:
            raise ValueError(f"origin must be a dict that JSON can hold, got {self.origin!r}") from error

    @classmethod
    def record(
        cls,
        model: recording.Behaviour | None,
        env: str | gym.Env[Any, Any] | VecEnv,
        n_instances: int = 1000,
        seed: int | None = None,
        *,
        deterministic: bool = False,
        bounds: Bounds | None = None,
    ) -> SourceInstances:
        """Let a behaviour act in the source task and record what happens, from a reset on, through as many episodes as needed.

        To cover more of the task than one behaviour visits, record more and take a :meth:`subset`, or record with
        :class:`~sb3_combrel.sources.source_recorder.SourceRecorder` while a model learns.

        :param model: an SB3 model or policy (anything with its ``predict``), a function from one state, raw units, shape
            (n_variables,), to an action, or None for random actions
        :param env: an environment, a vectorised one, or an id; one that was given is left open. Under ``VecNormalize``
            the model sees normalised states and the original ones are recorded, but of an episode's last one what
            ``clip_obs`` has cut off stays cut off.
        :param n_instances: number of transitions to record
        :param seed: seed of the environment, the random actions, and what Stable-Baselines3's models draw; None for none.
            ``FittedRMax`` and ``QLearning`` draw from generators of their own
        :param deterministic: whether an SB3 model takes its deterministic actions
        :param bounds: ``(low, high)`` of the states; None: those of the observation space, or the range of what is recorded
        :raises ValueError: if the spaces are not a Box of shape (n_variables,) and a Discrete, if ``n_instances``
            is not a whole number of at least 1, or if the environment returns something that is not finite
        """
        return cls(*recording.record(model, env, n_instances, seed, deterministic, bounds))

    @classmethod
    def from_q_learning(
        cls,
        env: str | gym.Env[Any, Any],
        n_instances: int = 1000,
        seed: int | None = None,
        *,
        total_timesteps: int = 30_000,
        method: str = "random",
        **learner: Any,
    ) -> SourceInstances:
        """Learn the source task with Q-learning and keep a sample of all its experience, as in Section 5.1 of the paper.

        :param env: a small task, or its id, e.g. "combrel/MountainCar2D-v0"
        :param n_instances: number of instances to keep
        :param seed: seed of the learner, its environment and the sample
        :param total_timesteps: steps of learning
        :param method: how to choose the instances, see :meth:`subset`
        :param learner: further arguments of :class:`~sb3_combrel.sources.q_learning.QLearning`
        :raises ValueError: as of :meth:`record`, or if ``n_instances`` exceeds ``total_timesteps``
        """
        total_timesteps = as_transition_count("total_timesteps", total_timesteps)
        n_instances = as_count("n_instances", n_instances, max=total_timesteps, why_max="total_timesteps")
        check_method(method)
        return cls(*learn_q_learning(env, seed, total_timesteps, learner)).subset(n_instances, method, seed)

    @classmethod
    def from_fitted_rmax(
        cls,
        env: str | gym.Env[Any, Any],
        n_instances: int = 1000,
        seed: int | None = None,
        *,
        n_episodes: int = 100,
        method: str = "covering",
        **learner: Any,
    ) -> SourceInstances:
        """Learn the source task with Fitted R-Max and keep a choice of all its experience, as in Section 5.2 of the paper.

        :param env: a task, or its id; ``n_instances``, ``seed``: see :meth:`from_q_learning`
        :param n_episodes: episodes of learning
        :param method: see :meth:`subset`; most of the experience is of one path, so by default those that cover most
        :param learner: arguments of :class:`~sb3_combrel.FittedRMax`, such as ``max_value``
        :raises ValueError: as of :meth:`record`
        """
        n_instances = as_transition_count("n_instances", n_instances)
        check_method(method)
        found = cls(*LEARNERS["fitted_rmax"](env, seed, n_episodes, learner))
        if len(found) < n_instances:
            warn_user(f"{n_episodes} episodes had {len(found)} steps, fewer than n_instances={n_instances}: raise n_episodes")
        return found.subset(n_instances, method, seed)

    @classmethod
    def from_minari(
        cls,
        dataset: str | MinariDataset,
        n_instances: int | None = None,
        seed: int | None = None,
        *,
        bounds: Bounds | None = None,
    ) -> SourceInstances:
        """Take the transitions of a Minari dataset (needs ``pip install "sb3-combrel[minari]"``).

        :param dataset: a dataset, or the id of one that has been downloaded
        :param n_instances: size of a random sample of them; None for all
        :param seed: seed of the sample
        :param bounds: ``(low, high)`` of the states; None: those of the observation space, or else the range of the data
        :raises ImportError: if Minari is missing
        :raises ValueError: as of :meth:`record`
        """
        source = cls(*minari_datasets.read_dataset(dataset, bounds))
        return source if n_instances is None else source.subset(n_instances, seed=seed)

    @classmethod
    def from_replay_buffer(
        cls,
        buffer: ReplayBuffer,
        n_instances: int | None = None,
        seed: int | None = None,
        *,
        bounds: Bounds | None = None,
    ) -> SourceInstances:
        """Take the transitions of a replay buffer of Stable-Baselines3, such as ``DQN(...).replay_buffer``.

        :param buffer: of Box observations and Discrete actions; :meth:`from_minari` says what the others are
        :raises ValueError: if it is empty, has other spaces, or does not keep where episodes ended
        """
        source = cls(*replay_buffers.read_buffer(buffer, bounds))
        return source if n_instances is None else source.subset(n_instances, seed=seed)

    @classmethod
    def from_table(
        cls,
        table: tables.Table,
        *,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] = (),
        n_actions: int | None = None,
        bounds: Bounds | None = None,
        periodic: Sequence[bool] | None = None,
    ) -> SourceInstances:
        """Take the transitions of a table with a row for each step, such as a controller's log.

        Columns: each state variable, by its name; ``action``, numbers from 0 on, or names; ``reward``; ``terminated``, whether
        the step reached a terminal state (or ``done``, with ``truncated`` for time limits; without either no step did); and
        where the step led, ``next_`` and the name of each variable. Without these columns a step leads to the state of the
        next row, up to an end, and of the same ``episode`` if there is such a column. A last state of an episode is a row with
        an empty ``action``. Where the table's index, numbers or times, says that rows were left out, no step leads across;
        nor from one of its outer levels to another, ``pandas.concat({file: table, ...})``.

        :param table: path of a CSV file, or a pandas DataFrame
        :param state_names: columns that are state variables, in their order; None: all that are not one of those above
        :param action_names: names of the actions, in the order of their numbers
        :param n_actions: number of actions; None: one for each name, or up to the largest number
        :param bounds: ``(low, high)`` of the states, raw units; None: their range
        :param periodic: which state variables are angles or the like, one bool for each; ``bounds`` are one period apart then
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if a column is missing, or holds something else
        """
        return cls(*tables.read_table(table, state_names, action_names, n_actions, bounds, periodic))

    def to_table(self) -> pd.DataFrame:
        """The instances as a pandas DataFrame that :meth:`from_table` reads; ``.to_csv(path, index=False)`` writes it.

        Names of actions, bounds and which variables are angles are not in it: :meth:`from_table` is told them again.
        """
        return tables.as_frame(self)

    def to_minari(self, dataset_id: str, **metadata: Any) -> MinariDataset:
        """Store the instances as a local Minari dataset (needs ``pip install "sb3-combrel[minari]"``).

        Instances that follow one another become one Minari episode. Names and origin are kept in the metadata.

        :param dataset_id: id of the new dataset, e.g. "mountaincar2d/q-learning-v0"
        :param metadata: arguments of ``minari.create_dataset_from_buffers`` such as ``author``
        :raises ImportError: if Minari is missing
        """
        return minari_datasets.write_dataset(self, dataset_id, **metadata)

    @property
    def scaling(self) -> StateScaling:
        """The map from the task's states to unit coordinates."""
        return StateScaling(self.low, self.high)

    @property
    def n_variables(self) -> int:
        """Number of state variables."""
        return int(self.states.shape[1])

    def __len__(self) -> int:
        return len(self.states)

    def __repr__(self) -> str:
        return (
            f"<{len(self)} source instances of {self.origin.get('env') or 'an unnamed task'}: states "
            f"({', '.join(self.state_names)}), actions ({', '.join(self.action_names)}){self.words_for_missing_actions()}, "
            f"{int(self.terminated.sum())} of them terminal>"
        )

    def words_for_missing_actions(self) -> str:
        """Name the actions that no instance has taken, of which a source says nothing: ", none with open"; "" without any."""
        taken = np.unique(self.actions)
        names = [name for a, name in enumerate(self.action_names) if a not in taken]
        return f", none with {' or '.join(names)}" if names else ""

    def subset(self, n_instances: int, method: str = "random", seed: int | None = None) -> SourceInstances:
        """A choice of the instances, in their order. If any instance is terminal, so is at least one of the choice.

        :param n_instances: number of instances to choose; all are taken if there are no more
        :param method: "random", or "covering" for instances of each action that lie as far apart as possible
        :param seed: seed of the choice
        :raises ValueError: if ``n_instances`` is not a whole number of at least 1, or ``method`` is another
        """
        n_instances = as_count("n_instances", n_instances)
        check_method(method)
        rng = np.random.default_rng(seed)
        if n_instances >= len(self):
            rows = np.arange(len(self))
        elif method == "random":
            rows = random_rows(self.terminated, n_instances, rng)
        else:
            units, flags = self.scaling.to_unit(self.states), np.array(self.periodic)
            rows = covering_rows(units, self.actions, self.terminated, n_instances, rng, flags)
        origin = {**self.origin, "subset": {"method": method, "seed": seed, "chosen_from": len(self)}}
        return replace(self, **{name: getattr(self, name)[rows] for name in _ROW_ARRAYS}, origin=origin)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write a compressed npz file without pickled objects, complete or not at all, and return its path.

        :param path: path of the file; the suffix .npz is added if there is none
        """
        target = _with_suffix(path)
        write_whole(target, self.to_bytes())
        return target

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SourceInstances:
        """Read a file written by :meth:`save`.

        :param path: path of the file; the suffix .npz may be left out
        :raises FileNotFoundError: if there is no such file
        :raises ValueError: if it is another kind of file, or is cut short
        """
        file = Path(path) if Path(path).is_file() else _with_suffix(path)
        if not file.is_file() and Path(path).is_dir():
            raise ValueError(f"path must be that of a file, got the folder {path}")
        if not file.is_file():
            raise FileNotFoundError(f"there is no source file {file}; write one with SourceInstances.record(...).save(path)")
        try:
            return cls.from_bytes(file.read_bytes())
        except ValueError as error:
            table = ", or read a table with SourceInstances.from_table(path)" if file.suffix != ".npz" else ""
            again = f"write it again with SourceInstances.record(...).save(path){table}"
            raise ValueError(f"{file}: {error}; {again}") from error

    def to_bytes(self) -> bytes:
        """The content of the file that :meth:`save` writes."""
        others = ("n_actions", "state_names", "action_names", "origin", "periodic")
        header = json.dumps({"format": _FORMAT, "version": _VERSION, **{name: getattr(self, name) for name in others}})
        content = io.BytesIO()
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        np.savez_compressed(content, allow_pickle=False, header=np.array(header), **arrays)
        return content.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> SourceInstances:
        """What :meth:`to_bytes` wrote; ``ValueError`` if it is something else, or is cut short."""
        if not zipfile.is_zipfile(io.BytesIO(content)):
            raise ValueError("these are not source instances, or they are cut short (it is no npz archive)")
        try:
            # No pickle: a source file may come from anyone.
            with np.load(io.BytesIO(content), allow_pickle=False) as archive:
                header = json.loads(str(archive["header"]))
                if (header.pop("format"), header.pop("version")) != (_FORMAT, _VERSION):
                    raise ValueError("another format")
                return cls(**{name: archive[name] for name in _ARRAYS}, **header)
        except Exception as error:
            # Each layer (zip, decompression, npy, JSON, our own checks) has errors of its own kinds.
            raise ValueError(f"these are not source instances, or they are cut short ({error})") from error


def _with_suffix(path: str | os.PathLike[str]) -> Path:
    target = Path(path)
    if not target.name:
        raise ValueError(f"path must be that of a file, got the folder {target}")
    return target if target.suffix == ".npz" else target.with_name(target.name + ".npz")


register_writer(SourceInstances, lambda one: ("SourceInstances", {"npz": base64.b64encode(one.to_bytes()).decode("ascii")}))
register_reader("SourceInstances", lambda npz: SourceInstances.from_bytes(base64.b64decode(npz, validate=True)))
