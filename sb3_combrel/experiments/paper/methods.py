"""The methods that are compared, by name: those of the paper, and controls."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_combrel import COMBREL, TIMBREL, InterTaskMapping, SourceInstances
from sb3_combrel.experiments.paper.domains import BEST, ICUB, MOUNTAIN_CAR, Domain, Setting
from sb3_combrel.experiments.paper.oracle import best_mappings
from sb3_combrel.experiments.tasks.mountain_car import factored_mapping, intuitive_mapping
from sb3_combrel.mappings.named_sets import resolve
from sb3_combrel.transfer.base import Transfer

NO_TRANSFER = "no transfer"
TIMBREL_INTUITIVE = "TIMBREL"
COMBREL_PLAIN = "COMBREL"
COMBREL_RELEVANCE = "COMBREL with relevance"
TIMBREL_RELEVANCE = "TIMBREL with relevance"
TIMBREL_RANDOM = "TIMBREL random"
TIMBREL_FREQUENT = "TIMBREL frequent"
#: The reading of compliance in which whole action mappings differ, as they do in Table 2.
COMBREL_WHOLE = "COMBREL whole mappings"
ONE_RANDOM = "one random mapping"
ORACLE = "oracle mapping"
UNRELATED = "unrelated source"
NO_TRANSFER_BEST = "no transfer, best setting"


@dataclass(frozen=True)
class Sources:
    """
    What is needed to make the transfer methods of a domain.

    :param own: instances of the domain's source task
    :param unrelated: instances of the other domain's
    :param target: transitions of the target task, for the oracle of a domain whose right mapping nobody knows; None elsewhere
    :param frequent: COMBREL's most frequent mapping, once its runs are complete
    """

    own: SourceInstances
    unrelated: SourceInstances
    target: SourceInstances | None = None
    frequent: InterTaskMapping | None = None


Make = Callable[[Domain, Setting, Sources, int], Transfer]


@dataclass(frozen=True)
class Method:
    """
    A method that is compared.

    :param name: in tables and figures
    :param description: in tables of documentation
    :param make: makes the transfer method for a domain, a setting, sources and a seed; None: no transfer
    :param with_prior: whether it exists with ``use="prior"`` too
    :param domains: names of the domains that it exists in; () for all
    :param learner: arguments of the learner instead of the setting's; None for the setting's
    """

    name: str
    description: str
    make: Make | None
    with_prior: bool = True
    domains: tuple[str, ...] = ()
    learner: Mapping[str, Any] | None = field(default=None)

    def exists_in(self, domain: Domain, setting: Setting) -> bool:
        """Whether the method exists in a domain with a setting."""
        return (not self.domains or domain.name in self.domains) and (self.with_prior or setting.use == "instances")

    def transfer(self, domain: Domain, setting: Setting, sources: Sources, seed: int) -> Transfer | None:
        """Make the transfer method, not bound to a task; None for no transfer."""
        return None if self.make is None else self.make(domain, setting, sources, seed)

    def learner_in(self, domain: Domain, setting: Setting) -> Mapping[str, Any]:
        """Return the learner's arguments."""
        if self.name == NO_TRANSFER_BEST:
            return domain.settings[BEST].learner
        return setting.learner


def combrel(setting: Setting, source: SourceInstances, mappings: str | None = None, **arguments: Any) -> COMBREL:
    """Make COMBREL as the setting says; ``mappings`` and ``arguments`` come before the setting's own."""
    make = COMBREL.paper if setting.paper else COMBREL
    return make(source, mappings or setting.mappings, **{**setting.combrel, **arguments})


def _one_random(domain: Domain, setting: Setting, sources: Sources, seed: int) -> Transfer:
    """A mapping of the set that COMBREL chooses from, drawn once for the run."""
    if setting.use == "prior":
        return TIMBREL(sources.own, "random", mappings=setting.mappings, **setting.timbrel)
    chosen = resolve(setting.mappings, **_sizes(domain, sources.own))
    number = int(np.random.default_rng([seed, len(chosen)]).integers(len(chosen)))
    return TIMBREL(sources.own, chosen[number], **setting.timbrel)


def _oracle(domain: Domain, setting: Setting, sources: Sources, seed: int) -> Transfer:
    assert sources.target is not None
    mappings = best_mappings(sources.own, sources.target, resolve(setting.mappings, **_sizes(domain, sources.own)))
    return TIMBREL(sources.own, mappings, **setting.timbrel)


def _intuitive(domain: Domain, setting: Setting, sources: Sources, seed: int) -> Transfer:
    mapping = factored_mapping(2) if setting.use == "prior" else intuitive_mapping()
    return TIMBREL(sources.own, mapping, **setting.timbrel)


def _frequent(domain: Domain, setting: Setting, sources: Sources, seed: int) -> Transfer:
    assert sources.frequent is not None
    return TIMBREL(sources.own, sources.frequent, **setting.timbrel)


def _unrelated(domain: Domain, setting: Setting, sources: Sources, seed: int) -> Transfer:
    # The paper's sets are made for the domain's own source.
    mappings = "injective" if setting.mappings.startswith("paper") else setting.mappings
    return combrel(setting, sources.unrelated, mappings)


def _random(domain: Domain, setting: Setting, sources: Sources, seed: int) -> Transfer:
    return TIMBREL(sources.own, "random", mappings=setting.mappings, **setting.timbrel)


def _pooled(domain: Domain, setting: Setting, sources: Sources, seed: int) -> Transfer:
    return TIMBREL(sources.own, "pool", mappings=setting.mappings, relevance=True, **setting.timbrel)


_CAR, _ROBOT = (MOUNTAIN_CAR.name,), (ICUB.name,)
_METHODS: Sequence[Method] = (
    Method(NO_TRANSFER, "Fitted R-Max alone", None),
    Method(TIMBREL_INTUITIVE, "TIMBREL with the mapping that a person would choose, the oracle", _intuitive, domains=_CAR),
    Method(COMBREL_PLAIN, "COMBREL without relevance", lambda d, s, sources, seed: combrel(s, sources.own)),
    Method(
        COMBREL_RELEVANCE,
        "COMBREL, instances ordered by relevance",
        lambda d, s, sources, seed: combrel(s, sources.own, relevance=True),
        with_prior=False,
        domains=_CAR,
    ),
    Method(
        TIMBREL_RELEVANCE,
        "TIMBREL with relevance on the pooled translations by all mappings",
        _pooled,
        with_prior=False,
        domains=_CAR,
    ),
    Method(
        COMBREL_WHOLE,
        "COMBREL, its neighbours over states and actions",
        lambda d, s, sources, seed: combrel(s, sources.own, neighbors="state_action"),
        with_prior=False,
        domains=_CAR,
    ),
    Method(TIMBREL_RANDOM, "a random mapping of COMBREL's set, drawn state by state", _random, with_prior=False),
    Method(ONE_RANDOM, "a random mapping of COMBREL's set, one for the run", _one_random),
    Method(TIMBREL_FREQUENT, "TIMBREL with the mapping that COMBREL used most", _frequent, with_prior=False, domains=_ROBOT),
    Method(
        ORACLE,
        "for each action the mapping of COMBREL's set that predicts the target's transitions best",
        _oracle,
        with_prior=False,
        domains=_ROBOT,
    ),
    Method(UNRELATED, "COMBREL from the source of the other domain", _unrelated),
    Method(NO_TRANSFER_BEST, "Fitted R-Max alone, local linear model (default arguments)", None, with_prior=False),
)
METHODS: Mapping[str, Method] = {method.name: method for method in _METHODS}


def methods_in(domain: Domain, setting: Setting) -> list[Method]:
    """Return the methods that exist in a domain with a setting, in the order of tables."""
    return [method for method in METHODS.values() if method.exists_in(domain, setting)]


def _sizes(domain: Domain, source: SourceInstances) -> dict[str, int]:
    names = target_names(domain)
    return {
        "n_source_variables": source.n_variables,
        "n_target_variables": len(names[0]),
        "n_source_actions": source.n_actions,
        "n_target_actions": len(names[1]),
    }


def target_names(domain: Domain) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the target's state variables and actions."""
    if domain.name == ICUB.name:
        from combrel_envs.icub_tasks import TASKS

        return TASKS["arm_strike"].state_names, TASKS["arm_strike"].action_names
    from combrel_envs.mountain_car_dynamics import ACTION_NAMES, STATE_NAMES

    return STATE_NAMES[2], ACTION_NAMES[2]
