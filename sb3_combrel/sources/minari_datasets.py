"""Source instances from and to Minari datasets."""

from __future__ import annotations

import json
import warnings
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from sb3_combrel.common.scaling import Bounds, StateScaling
from sb3_combrel.sources.transitions import Transitions, count_actions

if TYPE_CHECKING:
    from minari import MinariDataset

    from sb3_combrel.sources.source_instances import SourceInstances

_METADATA_KEY = "sb3_combrel"


def read_dataset(dataset: str | MinariDataset, bounds: Bounds | None = None) -> Transitions:
    """All transitions of a Minari dataset; see :meth:`SourceInstances.from_minari`."""
    minari = _import_minari()
    data = minari.load_dataset(dataset) if isinstance(dataset, str) else dataset
    limits = StateScaling.limits_of(data.observation_space, bounds)
    n_actions = count_actions(data.action_space)
    parts = [(e.observations[:-1], e.actions, e.rewards, e.observations[1:], e.terminations) for e in data.iterate_episodes()]
    if not parts:
        raise ValueError(f"the dataset {data.id} has no episodes: there is nothing to transfer")
    states, actions, rewards, next_states, terminated = map(np.concatenate, zip(*parts, strict=True))
    kept = json.loads(data.storage.metadata.get(_METADATA_KEY, "{}"))
    unnamed = {"env": None if data.env_spec is None else data.env_spec.id, "recorder": "Minari dataset", "dataset": data.id}
    names = {name: tuple(each) for name, each in kept.get("names", {}).items()}
    columns = states, actions - int(data.action_space.start), rewards, next_states, terminated
    return Transitions.within(limits, columns, n_actions, names, kept.get("origin", unnamed))


def write_dataset(source: SourceInstances, dataset_id: str, **metadata: Any) -> MinariDataset:
    """Store instances as a local Minari dataset; see :meth:`SourceInstances.to_minari`."""
    minari = _import_minari()
    from minari.data_collector import EpisodeBuffer

    # An episode ends at a terminal state and wherever the next instance does not start where this one ends.
    continues = (source.next_states[:-1] == source.states[1:]).all(axis=1) & ~source.terminated[:-1]
    episodes = []
    for rows in np.split(np.arange(len(source.states)), np.flatnonzero(~continues) + 1):
        truncated = np.zeros(len(rows), dtype=bool)
        truncated[-1] = not source.terminated[rows[-1]]
        observations = np.vstack([source.states[rows], source.next_states[rows[-1:]]])
        given: dict[str, Any] = {"actions": source.actions[rows], "rewards": source.rewards[rows], "truncations": truncated}
        episodes.append(EpisodeBuffer(observations=observations, terminations=source.terminated[rows], **given))
    with warnings.catch_warnings():
        # Minari warns of every piece of metadata that is not given; which ones to give is the caller's choice.
        warnings.simplefilter("ignore", UserWarning)
        box = spaces.Box(source.low, source.high, dtype=np.float64)
        task = {"observation_space": box, "action_space": spaces.Discrete(source.n_actions)}
        dataset = minari.create_dataset_from_buffers(dataset_id, episodes, **task, **metadata)
    names = {name: getattr(source, name) for name in ("state_names", "action_names", "periodic")}
    dataset.storage.update_metadata({_METADATA_KEY: json.dumps({"names": names, "origin": source.origin})})
    return dataset


def _import_minari() -> ModuleType:
    try:
        # Minari's usual file format; without it the error would come from deep inside.
        import h5py  # noqa: F401
        import minari
    except ImportError as error:
        raise ImportError('Minari datasets need Minari with HDF5: pip install "sb3-combrel[minari]"') from error
    return minari
