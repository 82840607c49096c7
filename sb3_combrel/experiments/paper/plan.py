"""Which runs each figure and table needs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from sb3_combrel import InterTaskMapping
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import BEST, DOMAINS, EXPLORE, ICUB, MOUNTAIN_CAR, Domain
from sb3_combrel.experiments.paper.methods import METHODS, Sources, methods_in, target_names
from sb3_combrel.experiments.paper.most_frequent import Use, most_frequent_mapping
from sb3_combrel.experiments.paper.runs import Job, Result

ALL = "all"
#: An experiment that the paper does not have: why claims do not hold.
DIAGNOSIS = "diagnosis"
#: What a user would pick instead.
BASELINES = "baselines"
CONTROLS = (m.TIMBREL_RANDOM, m.ONE_RANDOM, m.ORACLE, m.UNRELATED, m.NO_TRANSFER_BEST)


@dataclass(frozen=True)
class Target:
    """
    A figure or table of the paper.

    :param name: on the command line
    :param title: what it shows
    :param methods: names of the methods whose runs it needs, by domain
    """

    name: str
    title: str
    methods: dict[str, tuple[str, ...]]

    def domains(self) -> list[Domain]:
        """The domains whose runs it needs."""
        return [DOMAINS[name] for name in self.methods]


def _car(name: str, title: str, *methods: str) -> Target:
    return Target(name, title, {MOUNTAIN_CAR.name: methods})


def _robot(name: str, title: str, *methods: str) -> Target:
    return Target(name, title, {ICUB.name: methods})


_CURVES = (m.NO_TRANSFER, m.TIMBREL_INTUITIVE, m.COMBREL_PLAIN, m.COMBREL_RELEVANCE)
_ROBOTS = (m.NO_TRANSFER, m.TIMBREL_RANDOM, m.TIMBREL_FREQUENT, m.COMBREL_PLAIN)
_TARGETS: Sequence[Target] = (
    _car("fig2", "Learning with transfer in Mountain Car 4D", *_CURVES, *CONTROLS),
    _car("fig3", "Relevance in Mountain Car 4D", m.COMBREL_PLAIN, m.COMBREL_RELEVANCE, m.TIMBREL_RELEVANCE),
    _car("fig4", "Source action selected for the target action East", m.COMBREL_PLAIN),
    _robot("fig5", "Learning with transfer on the iCub's arm", *_ROBOTS, *CONTROLS),
    _robot("fig6", "Training needed to reach a threshold on the iCub's arm", *_ROBOTS, *CONTROLS),
    _car("table2", "Action mappings selected in Mountain Car 4D", m.COMBREL_WHOLE),
    _robot("table4", "Action mappings selected on the iCub's arm", m.COMBREL_PLAIN),
    _car("table5", "Running times", m.NO_TRANSFER, m.TIMBREL_INTUITIVE, m.COMBREL_PLAIN),
    Target(
        "table6",
        "What held",
        {
            MOUNTAIN_CAR.name: (*_CURVES, m.TIMBREL_RELEVANCE, *CONTROLS),
            ICUB.name: (*_ROBOTS, *CONTROLS),
        },
    ),
    # Its runs are no methods of the domain: see ``diagnosis``.
    Target(
        BASELINES,
        "Fitted R-Max, COMBREL and what a user would pick instead",
        {MOUNTAIN_CAR.name: (m.NO_TRANSFER, m.COMBREL_PLAIN), ICUB.name: (m.NO_TRANSFER, m.COMBREL_PLAIN)},
    ),
    _car(DIAGNOSIS, "What transfer saves at different breadths of the learner's kernel"),
)
TARGETS = {target.name: target for target in _TARGETS}


def targets_of(name: str, setting: str) -> list[Target]:
    """
    Return the figures and tables that a name on the command line stands for.

    :param name: one of :data:`TARGETS`, or "all" for all that exist in the setting
    :param setting: name of a setting
    :raises ValueError: if the name is unknown, or the figure or table does not exist in the setting
    """
    if name == ALL:
        return [target for target in TARGETS.values() if exists_in(target, setting)]
    if name not in TARGETS:
        raise ValueError(f"target must be one of {', '.join(TARGETS)} or {ALL}, got {name!r}")
    target = TARGETS[name]
    if not exists_in(target, setting):
        raise ValueError(f"{name} does not exist in setting {setting!r}: {_WHY_NOT[name]}; use another --setting")
    return [target]


_NO_SELECTION = "with priors no mapping is selected state by state"
_WHY_NOT = {
    "fig3": "with priors there is no relevance",
    "fig4": _NO_SELECTION,
    "table2": _NO_SELECTION,
    "table4": _NO_SELECTION,
    DIAGNOSIS: f"it varies the breadth of setting {EXPLORE!r}",
    BASELINES: f"they are compared with setting {BEST!r}",
}


def exists_in(target: Target, setting: str) -> bool:
    """Whether a figure or table can be made in a setting."""
    of_one_setting = {DIAGNOSIS: EXPLORE, BASELINES: BEST}
    if target.name in of_one_setting:
        return setting == of_one_setting[target.name]
    return setting != BEST or target.name not in _WHY_NOT


def methods_of(targets: Iterable[Target], domain: Domain, setting: str) -> list[str]:
    """Return the methods whose runs figures and tables need in a domain, in the order of tables."""
    needed = {method for target in targets for method in target.methods.get(domain.name, ())}
    if m.TIMBREL_FREQUENT in needed:
        needed.add(m.COMBREL_PLAIN)
    return [method.name for method in methods_in(domain, domain.settings[setting]) if method.name in needed]


def jobs_of(domain: Domain, setting: str, methods: Sequence[str], sources: Sources, n_runs: int, n_episodes: int) -> list[Job]:
    """
    Make the jobs of some methods, seed by seed, so that the methods can be compared before all are complete.

    :param domain: the domain
    :param setting: name of the setting
    :param methods: names of methods that exist there
    :param sources: what they transfer
    :param n_runs: seeds of each method
    :param n_episodes: episodes of each run
    """
    chosen = domain.settings[setting]
    jobs = []
    for seed in range(domain.first_seed, domain.first_seed + n_runs):
        for name in methods:
            method = METHODS[name]
            jobs.append(
                Job(
                    domain.name,
                    name,
                    seed,
                    domain.target_id,
                    n_episodes,
                    chosen.max_episode_steps,
                    method.learner_in(domain, chosen),
                    method.transfer(domain, chosen, sources, seed),
                    records_selections=name in (m.COMBREL_PLAIN, m.COMBREL_WHOLE) and chosen.use == "instances",
                )
            )
    return jobs


def frequent_mapping(results: Iterable[Result], domain: Domain, sources: Sources) -> InterTaskMapping:
    """
    Find the mapping that COMBREL used most, over all its runs (Section 5.2).

    :param results: of the domain's runs, COMBREL's among them
    :raises ValueError: if COMBREL has used none
    """
    results = list(results)
    uses: Counter[Use] = Counter()
    for result in results:
        if result.method == m.COMBREL_PLAIN:
            for target_action, source_action, state_mapping, _, n in result.uses:
                uses[Use(target_action, source_action, state_mapping)] += n
    if not uses:
        n_episodes = max((len(result.steps) for result in results), default=0)
        raise ValueError(
            f"{m.COMBREL_PLAIN} has used no mapping within episodes={n_episodes}, so {m.TIMBREL_FREQUENT} has no mapping; "
            "use more --episodes"
        )
    variables, actions = target_names(domain)
    return most_frequent_mapping(uses, sources.own.state_names, variables, sources.own.action_names, actions)
