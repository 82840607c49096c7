"""One run of the benchmark: a pair's target learnt with one method and one seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any, cast

from stable_baselines3.common.callbacks import BaseCallback

from sb3_combrel import SourceInstances
from sb3_combrel.experiments.benchmark.methods import Method, Sources, run_as
from sb3_combrel.experiments.benchmark.pair import Pair
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.runs.job import Job, Result, TransferLike, chosen_on_purpose


@dataclass(frozen=True, kw_only=True)
class BenchmarkRun(Job):
    """A pair's target that is learnt from nothing with one method and one seed.

    Its result has in ``more``: "known_share", in which part of the decisions, where something was transferred, the known
    mapping was chosen, None where nobody knows it or the method does not say what it chooses; "mapping_steps", target steps
    until the method had a mapping, None for one that has it from the start; "misfit", why the method does not fit the pair.
    """

    pair: Pair
    of_method: Method
    sources: tuple[SourceInstances, ...]

    @property
    def compiled_steps(self) -> int:  # type: ignore[override]
        """Steps of a run after which all that the method needs is compiled and imported."""
        return self.of_method.compiled_steps

    def settings(self) -> dict[str, Any]:
        """What the result depends on."""
        return {**self.pair.settings(), "method": self.of_method.name, "digest of the method": self.of_method.digest}

    def make_transfer(self) -> TransferLike:
        """Make the transfer method."""
        sources: Sources = self.sources[0] if len(self.sources) == 1 else list(self.sources)
        return self.of_method.make(sources, self.pair)

    def callbacks(self) -> list[BaseCallback]:
        """Count the steps until there is a mapping."""
        return [MappingRecorder()] if self.of_method.finds_mapping else []

    def carry_out(self) -> Result:
        """Learn, if the method fits the pair; raises RuntimeError if no episode has ended."""
        with chosen_on_purpose():
            try:
                with closing(self.make_env()) as env:
                    self.make_model(env)
            except ValueError as error:
                # If the learner alone cannot be made, it is not the method that does not fit.
                with closing(self.make_env()) as env:
                    FittedRMax(env, seed=self.seed, **self.learner)
                return self.result(more={"misfit": " ".join(str(error).split())})
        result = super().carry_out()
        if not result.steps:
            raise RuntimeError(f"no episode has ended within n_steps={self.n_steps}: the pair's target needs a shorter limit")
        return result

    def measure(self, model: FittedRMax, result: Result, callbacks: list[BaseCallback]) -> dict[str, Any]:
        """Tell which mappings the method has chosen."""
        transfer: Any = model.agent.transfer
        return {"known_share": known_share(self.pair, transfer), "mapping_steps": _mapping_steps(transfer, result, callbacks)}


def has_mapping(transfer: Any) -> bool:
    """Whether a transfer method has chosen a mapping for any state and action, or used one if it names no choices."""
    if getattr(transfer, "makes_choices", False):
        return bool((transfer.choices() >= 0).any())
    return bool(transfer.uses())


class MappingRecorder(BaseCallback):
    """Counts the steps until a transfer method has a mapping."""

    def __init__(self) -> None:
        super().__init__()
        self.steps: int | None = None

    def _on_step(self) -> bool:
        transfer = self.model.agent.transfer  # type: ignore[attr-defined]
        if self.steps is None and hasattr(transfer, "uses") and has_mapping(transfer):
            self.steps = self.num_timesteps
        return True


def known_share(pair: Pair, transfer: Any) -> float | None:
    """Compute in which part of a method's decisions the known mapping was chosen.

    A decision is a use of a candidate, as ``uses`` counts them: with instances a state and action of the agent for which
    instances were transferred, with a prior a transition of the target while a mapping was chosen.
    """
    if pair.known_by_action is None or not (hasattr(transfer, "uses") and hasattr(transfer, "mapped_variables")):
        return None
    uses: dict[int, int] = transfer.uses()
    total = sum(uses.values())
    if not total:
        return None
    return sum(n for number, n in uses.items() if pair.agrees(transfer.mapped_variables(number))) / total


def _mapping_steps(transfer: Any, result: Result, callbacks: list[BaseCallback]) -> int | None:
    """What the method says of itself; or the steps until it first had a mapping, all if it never had."""
    if hasattr(transfer, "mapping_steps"):
        return int(transfer.mapping_steps())
    if not (callbacks and hasattr(transfer, "uses")):
        return None
    steps = cast(MappingRecorder, callbacks[0]).steps
    return result.n_steps if steps is None else steps


def jobs_of(
    pairs: Sequence[Pair],
    methods: Sequence[Method],
    seeds: Sequence[int],
    sources: Mapping[tuple[str, int], tuple[SourceInstances, ...]],
) -> list[BenchmarkRun]:
    """Make the runs, seed by seed, so that methods can be compared before all are complete; those of equal methods once.

    :param sources: instances of the sources, by the pair's name and the seed
    """
    by_name = {method.name: method for method in methods}
    jobs: dict[tuple[str, str, int], BenchmarkRun] = {}
    for seed in seeds:
        for pair in pairs:
            for method in methods:
                name = run_as(method, methods, pair)
                task: dict[str, Any] = {"env": pair.target, "n_steps": pair.n_steps, "n_episodes": pair.n_episodes}
                own: dict[str, Any] = {"pair": pair, "of_method": by_name[name], "sources": sources[pair.name, seed]}
                job = BenchmarkRun(group=pair.name, method=name, seed=seed, learner=pair.learner, **task, **own)
                jobs.setdefault((pair.name, name, seed), job)
    return list(jobs.values())
