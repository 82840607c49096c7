"""A pair of tasks: one or several sources, a target, the known mapping, budget, measure, and what the learner is told."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import EnvSpec

from sb3_combrel import FactoredMapping, InterTaskMapping, SourceInstances
from sb3_combrel.common.attributes import names_of
from sb3_combrel.common.checks import check_count, check_finite, checked_names
from sb3_combrel.experiments.suite.tasks import Source, check_budget
from sb3_combrel.mappings.named_sets import check_mappings
from sb3_combrel.runs.described import described
from sb3_combrel.runs.job import Task, chosen_on_purpose, make_env
from sb3_combrel.transfer.candidates import MappedVariables

#: How a source is recorded, see :func:`recorded`.
LEARNERS: dict[str, Callable[..., SourceInstances]] = {
    "fitted_rmax": SourceInstances.from_fitted_rmax,
    "q_learning": SourceInstances.from_q_learning,
}


def recorded(name: str, task: Task, learner: str = "fitted_rmax", n_instances: int = 1000, **arguments: Any) -> Source:
    """Describe how a source is recorded: for each seed once in an output folder.

    :param name: of its file; sources of the same name must be recorded in the same way
    :param task: the environment, an id or a function that makes it
    :param learner: "fitted_rmax" or "q_learning"
    :param n_instances: instances to keep of all experience
    :param arguments: of :meth:`SourceInstances.from_fitted_rmax` or :meth:`~SourceInstances.from_q_learning`
    :raises ValueError: if the learner is unknown
    """
    if learner not in LEARNERS:
        raise ValueError(f"learner must be one of {', '.join(LEARNERS)}, got {learner!r}")
    check_count("n_instances", n_instances)
    return Source(name, functools.partial(_learn, task, learner, n_instances, arguments))


def _learn(task: Task, learner: str, n_instances: int, arguments: Mapping[str, Any], seed: int) -> SourceInstances:
    with closing(make_env(task)) as env, chosen_on_purpose():
        return LEARNERS[learner](env, n_instances, seed=seed, **arguments)


@dataclass(frozen=True)
class Pair:
    """One or several source tasks and a target task. Exactly one of ``n_steps`` and ``n_episodes`` is given.

    Performance is the mean return of an episode of learning: over the episodes if ``n_episodes`` is given, over environment
    steps (an episode counts as often as it has steps) if ``n_steps`` is.

    :param name: on the command line and in files: letters, digits, "-", "_" and "."
    :param description: in the report: what the tasks are, and what is known of how they correspond
    :param sources: the source tasks, see :func:`recorded`
    :param target: the target task, an id or a function that makes it; its episodes must have a limit
    :param n_steps: environment steps to learn
    :param n_episodes: episodes to learn
    :param threshold: of the time to threshold: a return; None: it is not measured
    :param learner: arguments of :class:`~sb3_combrel.FittedRMax`, chosen for learning without transfer
    :param known: the known mapping, as a prior: a factored mapping, one :class:`InterTaskMapping` for each target action, or
        for several sources one factored mapping for each; None if nobody knows it
    :param known_by_action: the known mapping, for instances: one :class:`InterTaskMapping`, or one for each target action. It
        says which variables an action moves, and by it is decided whether a method has chosen the known mapping: the variables
        that it maps must be mapped to the same source variables, by the same source action. None if nobody knows it
    :param sources_by_action: number of the source of each of ``known_by_action``; () for the first source throughout
    :param mappings: the set that methods choose from with priors, "factored" or "signed_factored"
    :param instance_mappings: the set that they choose from with instances, such as "injective" or "signed_injective"
    :param digest: of the file in which a third party defines it; "" for the package's own
    :raises ValueError: if an argument is out of its range
    """

    name: str
    description: str
    sources: tuple[Source, ...]
    target: Task
    n_steps: int | None = None
    n_episodes: int | None = None
    threshold: float | None = None
    learner: Mapping[str, Any] = field(default_factory=dict)
    known: FactoredMapping | Sequence[InterTaskMapping] | Sequence[FactoredMapping] | None = None
    known_by_action: InterTaskMapping | Sequence[InterTaskMapping] | None = None
    sources_by_action: Sequence[int] = ()
    mappings: str = "factored"
    instance_mappings: str = "injective"
    digest: str = ""

    def __post_init__(self) -> None:
        check_name(self.name)
        try:
            for name in (self.mappings, self.instance_mappings):
                check_mappings(name)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from error
        check_budget(self.name, self.n_steps, self.n_episodes)
        if self.threshold is not None:
            check_finite("threshold", self.threshold)
        are_sources = _are_all(Source, self.sources) and len(self.sources) > 0
        comma = "; a tuple of one has a comma, (recorded(...),)" if isinstance(self.sources, Source) else ""
        right = "sources must be a tuple of at least one Source, see recorded()"
        self._check(are_sources, f"{right}, got {self.sources!r}{comma}")
        is_task = isinstance(self.target, str | EnvSpec) or callable(self.target)
        right = "target must be the id of an environment or a function that makes one, as each run has its own"
        self._check(is_task, f"{right}, got {self.target!r}")
        right = "known must be a factored mapping, a sequence of mappings for actions or of factored mappings, or None"
        is_known = self.known is None or isinstance(self.known, FactoredMapping)
        is_known = is_known or _are_all(FactoredMapping, self.known) or _are_all(InterTaskMapping, self.known)
        self._check(is_known, f"{right}, got {self.known!r}")
        by_action = self.known_by_action
        right = "known_by_action must be an InterTaskMapping, a sequence of one for each target action, or None"
        is_known = by_action is None or isinstance(by_action, InterTaskMapping) or _are_all(InterTaskMapping, by_action)
        self._check(is_known, f"{right}, got {by_action!r}")
        n, numbers = len(self.sources), self.sources_by_action
        if isinstance(self.known, Sequence) and all(isinstance(each, FactoredMapping) for each in self.known):
            right = f"known must have one factored mapping for each of the {n} sources"
            self._check(len(self.known) == n, f"{right}, got {len(self.known)}")
        if numbers and isinstance(self.known_by_action, Sequence):
            right = f"sources_by_action must have one number for each of the {len(self.known_by_action)} mappings"
            self._check(len(numbers) == len(self.known_by_action), f"{right} of known_by_action, got {len(numbers)}")
        right = f"sources_by_action must have numbers of the {n} sources, counted from 0"
        self._check(set(numbers) <= set(range(n)), f"{right}, got {tuple(numbers)!r}")

    def _check(self, is_right: bool, message: str) -> None:
        if not is_right:
            raise ValueError(f"{self.name}: {message}")

    @property
    def budget(self) -> str:
        """How long is learnt, in words."""
        return f"{self.n_episodes} episodes" if self.n_steps is None else f"{self.n_steps:,} environment steps"

    def make_target(self) -> gym.Env:
        """Make the environment of the target task."""
        return make_env(self.target)

    def check_known(self, sources: Sequence[SourceInstances]) -> Pair:
        """Check that ``known_by_action`` has the variables and actions of both tasks; the pair with numbers for its names.

        :param sources: instances of each source; none: nothing is checked
        :raises ValueError: if it has not
        """
        if self.known_by_action is None or not sources:
            return self
        try:
            with closing(self.make_target()) as env:
                n_variables, n_actions = env.observation_space.shape[0], int(env.action_space.n)  # type: ignore
                names = names_of(env)
        except Exception:  # a third party's environment raises what it likes: that of the runs is reported
            return self
        one = isinstance(self.known_by_action, InterTaskMapping)
        by_action: Sequence[InterTaskMapping] = [self.known_by_action] * n_actions if one else self.known_by_action  # type: ignore
        right = f"known_by_action must have one mapping for each of the {n_actions} target actions"
        self._check(len(by_action) == n_actions, f"{right}, got {len(by_action)}")
        right = f"sources_by_action must have one number for each of the {n_actions} target actions, or none"
        self._check(len(self.sources_by_action) in (0, n_actions), f"{right}, got {len(self.sources_by_action)}")
        variables = checked_names("state_names", names.get("state_names", ()), n_variables, "s")
        actions = checked_names("action_names", names.get("action_names", ()), n_actions, "a")
        found = []
        for action, mapping in enumerate(by_action):
            source = sources[self.sources_by_action[action] if self.sources_by_action else 0]
            try:
                if mapping.has_names:
                    mapping = mapping.with_names(source.state_names, variables, source.action_names, actions)
                found.append(mapping)
                mapping.check(
                    n_source_variables=source.n_variables,
                    n_target_variables=n_variables,
                    n_source_actions=source.n_actions,
                    n_target_actions=n_actions,
                )
            except ValueError as error:
                raise ValueError(f"{self.name}: known_by_action: {error}") from error
        # Where there are no names the pair stays as it is: runs in a folder are told by it.
        named = any(mapping.has_names for mapping in by_action)
        return replace(self, known_by_action=found[0] if one else tuple(found)) if named else self

    def agrees(self, mapped: MappedVariables) -> bool:
        """Whether what a method makes of a target action is what the known mapping makes of the variables that it moves."""
        assert self.known_by_action is not None
        one = isinstance(self.known_by_action, InterTaskMapping)
        a = mapped.target_action
        known: InterTaskMapping = self.known_by_action if one else self.known_by_action[a]  # type: ignore[index,assignment]
        of = known.mapped
        return bool(
            (mapped.source[of] == (self.sources_by_action[a] if self.sources_by_action else 0)).all()
            and (mapped.variable[of] == known.state_index[of]).all()
            and (mapped.sign[of] == known.state_sign[of]).all()
            and (mapped.action[of] == known.action[a]).all()
        )

    def settings(self) -> dict[str, Any]:
        """What the results depend on, in words that JSON can hold."""
        values = {name: value for name, value in vars(self).items() if name not in ("description", "sources", "threshold")}
        sources = {source.name: described(source.learn) for source in self.sources}
        return {**{name: described(value) for name, value in values.items()}, "sources": sources}


def _are_all(kind: type, values: object) -> bool:
    """Whether these are a sequence of objects of a class."""
    return isinstance(values, Sequence) and all(isinstance(each, kind) for each in values)


def check_name(name: object) -> None:
    """Raise ValueError if the name of a pair or method, part of file names, has other than letters, digits, "-", "_", "."."""
    if not (isinstance(name, str) and re.fullmatch(r"[\w.-]+", name)):
        raise ValueError(f'name must be of letters, digits, "-", "_" and ".", got {name!r}')
