"""The methods that are compared, by name: those of the paper, and controls; and what they transfer."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
from rich.console import Console

from sb3_combrel import COMBREL, TIMBREL, InterTaskMapping, SourceInstances
from sb3_combrel.experiments.paper.domains import BEST, DOMAINS, ICUB, MOUNTAIN_CAR, PAPER, Domain, Setting
from sb3_combrel.experiments.paper.mappings import best_mappings
from sb3_combrel.experiments.tasks.mountain_car import factored_mapping, intuitive_mapping
from sb3_combrel.mappings.named_sets import resolve
from sb3_combrel.runs.runner import Backend
from sb3_combrel.runs.source_files import FOLDER, SourceJob, load_or_learn
from sb3_combrel.transfer.base import Transfer

NO_TRANSFER = "no transfer"
#: The mapping that a person would choose.
TIMBREL_INTUITIVE = "TIMBREL"
COMBREL_PLAIN = "COMBREL"
COMBREL_RELEVANCE = "COMBREL with relevance"
TIMBREL_RELEVANCE = "TIMBREL with relevance"
#: The reading of compliance in which whole action mappings differ, as they do in Table 2.
COMBREL_WHOLE = "COMBREL whole mappings"
#: A mapping of COMBREL's set, drawn state by state; and one drawn once for the run.
TIMBREL_RANDOM = "TIMBREL random"
ONE_RANDOM = "one random mapping"
#: The mapping that COMBREL used most.
TIMBREL_FREQUENT = "TIMBREL frequent"
#: For each action the mapping of COMBREL's set that predicts the target's transitions best.
ORACLE = "oracle mapping"
#: COMBREL from the source of the other domain.
UNRELATED = "unrelated source"
#: Fitted R-Max with its default arguments.
NO_TRANSFER_BEST = "no transfer, best setting"

#: All methods, in the order of tables.
METHODS = (
    *(NO_TRANSFER, TIMBREL_INTUITIVE, COMBREL_PLAIN, COMBREL_RELEVANCE, TIMBREL_RELEVANCE, COMBREL_WHOLE, TIMBREL_RANDOM),
    *(ONE_RANDOM, TIMBREL_FREQUENT, ORACLE, UNRELATED, NO_TRANSFER_BEST),
)
# Those that exist with ``use="prior"`` too, and those that exist in one domain alone.
_WITH_PRIOR = (NO_TRANSFER, TIMBREL_INTUITIVE, COMBREL_PLAIN, ONE_RANDOM, UNRELATED)
_ONLY_IN = dict.fromkeys((TIMBREL_INTUITIVE, COMBREL_RELEVANCE, TIMBREL_RELEVANCE, COMBREL_WHOLE), MOUNTAIN_CAR.name)
_ONLY_IN |= dict.fromkeys((TIMBREL_FREQUENT, ORACLE), ICUB.name)

#: Seed of the learner whose transitions of the arm's task the oracle has; no run has it.
TARGET_SEED = 1
N_TARGET_TRANSITIONS = 4000


@dataclass(frozen=True)
class Sources:
    """What is needed to make the transfer methods of a domain with one seed."""

    own: SourceInstances  # instances of the domain's source task
    unrelated: SourceInstances  # instances of the other domain's
    target: SourceInstances | None = None  # target transitions, for the oracle where nobody knows the mapping
    frequent: InterTaskMapping | None = None  # COMBREL's most frequent mapping, once its runs are complete


def prepare_sources(
    domain: Domain, seeds: Iterable[int], output: Path, backend: Backend, console: Console
) -> dict[int, Sources]:
    """Learn the source tasks of a domain with each seed, or load what was learned before from the output folder."""

    def record_target(seed: int) -> SourceInstances:
        max_value = domain.settings[PAPER].learner["max_value"]
        return SourceInstances.from_fitted_rmax(domain.target_id, N_TARGET_TRANSITIONS, seed, max_value=max_value)

    (other,) = (each for each in DOMAINS.values() if each.name != domain.name)
    seeds = list(seeds)
    wanted = [
        SourceJob(group=each.name, seed=seed, path=output / FOLDER / f"{each.name}_seed{seed}.npz", learn=each.learn_source)
        for each in (domain, other)
        for seed in seeds
    ]
    if domain.name == ICUB.name:
        path = output / FOLDER / f"{domain.name}_target.npz"
        wanted.append(SourceJob(group=domain.name, method="target", seed=TARGET_SEED, path=path, learn=record_target))
    found = load_or_learn(wanted, backend, console)
    own, unrelated, target = found[: len(seeds)], found[len(seeds) : 2 * len(seeds)], found[2 * len(seeds) :]
    return {
        seed: Sources(of_domain, of_other, target[0] if target else None)
        for seed, of_domain, of_other in zip(seeds, own, unrelated, strict=True)
    }


def methods_in(domain: Domain, setting: Setting) -> list[str]:
    """Return the methods that exist in a domain with a setting, in the order of tables."""
    return [
        name
        for name in METHODS
        if _ONLY_IN.get(name, domain.name) == domain.name and (name in _WITH_PRIOR or setting.use == "instances")
    ]


def learner_of(method: str, domain: Domain, setting: Setting) -> Mapping[str, Any]:
    """Return the learner's arguments of a method."""
    return domain.settings[BEST].learner if method == NO_TRANSFER_BEST else setting.learner


def transfer_of(method: str, domain: Domain, setting: Setting, sources: Sources, seed: int) -> Transfer | None:
    """Make the transfer method of a method, not bound to a task; None for no transfer."""
    own, with_prior = sources.own, setting.use == "prior"

    def combrel(source: SourceInstances = own, mappings: str = setting.mappings, **arguments: Any) -> Transfer:
        make = COMBREL.paper if setting.paper else COMBREL
        return make(source, mappings, **{**setting.combrel, **arguments})

    def timbrel(mapping: Any, **arguments: Any) -> Transfer:
        return TIMBREL(own, mapping, **arguments, **setting.timbrel)

    def of_set(mapping: str, **arguments: Any) -> Transfer:
        return timbrel(mapping, mappings=setting.mappings, **arguments)

    def all_mappings() -> Any:
        variables, actions = domain.target_names()
        of_source = {"n_source_variables": own.n_variables, "n_source_actions": own.n_actions}
        return resolve(setting.mappings, **of_source, n_target_variables=len(variables), n_target_actions=len(actions))

    def one_random() -> Transfer:
        mappings = all_mappings()
        return timbrel(mappings[int(np.random.default_rng([seed, len(mappings)]).integers(len(mappings)))])

    # The paper's sets are made for the domain's own source.
    any_source = "injective" if setting.mappings.startswith("paper") else setting.mappings
    make: Mapping[str, Callable[[], Transfer | None]] = {
        NO_TRANSFER: lambda: None,
        TIMBREL_INTUITIVE: lambda: timbrel(factored_mapping(2) if with_prior else intuitive_mapping()),
        COMBREL_PLAIN: combrel,
        COMBREL_RELEVANCE: lambda: combrel(relevance=True),
        # On the translations by all mappings together.
        TIMBREL_RELEVANCE: lambda: of_set("pool", relevance=True),
        COMBREL_WHOLE: lambda: combrel(neighbors="state_action"),
        TIMBREL_RANDOM: lambda: of_set("random"),
        ONE_RANDOM: lambda: of_set("random") if with_prior else one_random(),
        TIMBREL_FREQUENT: lambda: timbrel(sources.frequent),
        ORACLE: lambda: timbrel(best_mappings(own, cast(SourceInstances, sources.target), all_mappings())),
        UNRELATED: lambda: combrel(sources.unrelated, any_source),
        NO_TRANSFER_BEST: lambda: None,
    }
    return make[method]()
