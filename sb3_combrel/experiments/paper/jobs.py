"""The runs of the paper's methods: what each learns, and what it records of the mappings that its transfer method selects."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import DIAGNOSED, Domain, Setting
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.runs.job import Job, Result

#: The diagnosis: what transfer saves at breadths of the learner's kernel.
BREADTHS = (0.1, 0.2, 0.3, 0.4)
DIAGNOSED_METHODS = (m.NO_TRANSFER, m.COMBREL_PLAIN, m.TIMBREL_RANDOM)
#: The methods differ in the first episodes.
DIAGNOSED_EPISODES = 25


@dataclass(frozen=True, kw_only=True)
class PaperJob(Job):
    """A target task that is learnt by one method. In ``more`` its result has

    - ``uses``: how often instances of each candidate were used, the most used first: [target action, source action, state
      mapping, action mapping or "", times]
    - ``selections``, if they are recorded: each such use with the state, raw units: [number in ``uses``, *state]
    - ``at_sample``, likewise: source action selected in the end for each state of the finite sample, by target action
    - ``mappings_of_episodes``: how many different mappings (source action, state mapping, action mapping) were used in each
    - ``first_episode_seconds``: processor time of the first episode
    """

    setting: str
    records_selections: bool = False

    def callbacks(self) -> list[BaseCallback]:
        return [FirstEpisodeTimer(), MappingCounter(), *([SelectionRecorder()] if self.records_selections else [])]

    def measure(self, model: FittedRMax, result: Result, callbacks: list[BaseCallback]) -> dict[str, Any]:
        timer, counter, *recorders = cast(list[Any], callbacks)
        transfer: Any = model.agent.transfer
        uses = uses_of(transfer)
        more = {"uses": list(uses.values()), "mappings_of_episodes": counter.counts, "first_episode_seconds": timer.seconds}
        if self.records_selections:
            (recorder,) = recorders
            more |= {"selections": recorder.rows(list(uses)), "at_sample": selections_at_sample(transfer)}
        return more


class FirstEpisodeTimer(BaseCallback):
    """Measures the processor time until the end of the first episode: ``seconds``."""

    seconds = 0.0

    def _on_training_start(self) -> None:
        self._start = time.process_time()

    def _on_step(self) -> bool:
        if not self.seconds and self.locals["dones"][0]:
            self.seconds = time.process_time() - self._start
        return True


class MappingCounter(BaseCallback):
    """Counts the different mappings whose instances were used in each episode: ``counts``; of one environment."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: list[int] = []
        self._before: dict[int, int] = {}

    def _on_step(self) -> bool:
        if self.locals["dones"][0]:
            transfer = self.model.agent.transfer  # type: ignore[attr-defined]
            uses = {} if transfer is None else transfer.uses()
            used = (transfer.candidate(number) for number, n in uses.items() if n != self._before.get(number, 0))
            self.counts.append(len({(each.source_action, each.state_mapping, each.action_mapping) for each in used}))
            self._before = uses
        return True


class SelectionRecorder(BaseCallback):
    """Records the state at which instances of a candidate were used, each time that they were; of one environment."""

    def __init__(self) -> None:
        super().__init__()
        self._before: dict[int, int] = {}
        self._rows: list[tuple[int, np.ndarray]] = []

    def _on_training_start(self) -> None:
        self._state = self.model._last_obs[0].copy()  # type: ignore[index]

    def _on_step(self) -> bool:
        # The model was asked about the state in which the step was made, before it was made.
        uses = self.model.agent.transfer.uses()  # type: ignore[attr-defined]
        if uses != self._before:
            new = (number for number, n in uses.items() if n != self._before.get(number, 0))
            self._rows += [(number, self._state) for number in new]
            self._before = uses
        self._state = self.locals["new_obs"][0].copy()
        return True

    def rows(self, candidates: list[int]) -> list[list[float]]:
        """Return the selections, in their order: [place of the candidate in ``candidates``, *state, raw units]."""
        place = {number: k for k, number in enumerate(candidates)}
        return [[place[number], *np.round(state.astype(np.float64), 5).tolist()] for number, state in self._rows]


def uses_of(transfer: Any) -> dict[int, list[Any]]:
    """Return ``uses`` of :class:`PaperJob` by number of the candidate; empty without transfer (None)."""
    times = {} if transfer is None else transfer.uses()
    found = {}
    for number, n in sorted(times.items(), key=lambda use: (-use[1], use[0])):
        parts = transfer.candidate(number)
        target_action = transfer.task.action_names[parts.target_action]
        found[number] = [target_action, parts.source_action, parts.state_mapping, ", ".join(parts.action_mapping), n]
    return found


def selections_at_sample(transfer: Any) -> dict[str, list[str]]:
    """Return ``at_sample`` of :class:`PaperJob`; "" where nothing is selected."""
    if not transfer.makes_choices:
        return {}
    points = transfer.task.sample_states
    found = {}
    for action, name in enumerate(transfer.task.action_names):
        numbers = transfer.selected(points, np.full(len(points), action)).tolist()
        source_action = {number: transfer.candidate(number).source_action for number in set(numbers) - {-1}}
        found[name] = [source_action.get(number, "") for number in numbers]
    return found


def jobs_of(
    domain: Domain,
    setting: str,
    methods: Sequence[str],
    sources: Mapping[int, m.Sources],
    n_episodes: int,
    arguments: Setting | None = None,
) -> list[PaperJob]:
    """Make the jobs of some methods, seed by seed, so that the methods can be compared before all are complete.

    :param sources: by seed, of all seeds that the methods are run with
    :param arguments: how the methods are set, if not as the setting says
    """
    chosen = arguments or domain.settings[setting]
    task: dict[str, Any] = {"group": domain.name, "env": domain.target_id, "n_episodes": n_episodes, "setting": setting}
    task["max_episode_steps"] = chosen.max_episode_steps

    def job_of(name: str, seed: int) -> PaperJob:
        records = name in (m.COMBREL_PLAIN, m.COMBREL_WHOLE) and chosen.use == "instances"
        learner, transfer = m.learner_of(name, domain, chosen), m.transfer_of(name, domain, chosen, sources[seed], seed)
        own: dict[str, Any] = {"method": name, "seed": seed, "learner": learner, "transfer": transfer}
        return PaperJob(**task, **own, records_selections=records)

    return [job_of(name, seed) for seed in sources for name in methods]


def diagnosis_jobs(domain: Domain, setting: str, sources: Mapping[int, m.Sources], n_episodes: int) -> list[PaperJob]:
    """Make the jobs of the diagnosis, see :func:`jobs_of`: of the episodes at most :data:`DIAGNOSED_EPISODES`."""
    n_episodes = min(n_episodes, DIAGNOSED_EPISODES)
    jobs = jobs_of(domain, setting, DIAGNOSED_METHODS, sources, n_episodes, DIAGNOSED)

    def at(breadth: float, job: PaperJob) -> PaperJob:
        learner = {**job.learner, "model_breadth": breadth}
        return replace(job, method=method_at(job.method, breadth), learner=learner, records_selections=False)

    return [at(breadth, job) for breadth in BREADTHS for job in jobs]


def method_at(method: str, breadth: float) -> str:
    """Name of a method at a breadth."""
    return f"{method} at {breadth:g}"


def steps_by_method(results: Iterable[Result]) -> dict[str, np.ndarray]:
    """Return for each method of a domain the steps of each run's episodes, shape (n_runs, n_episodes), by seed."""
    by_method: dict[str, list[list[int]]] = {}
    for result in sorted(results, key=lambda each: each.seed):
        by_method.setdefault(result.method, []).append(result.steps)
    return {method: np.array(steps) for method, steps in by_method.items()}
