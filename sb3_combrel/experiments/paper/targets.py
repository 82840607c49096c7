"""The figures and tables of the paper, and which runs each needs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sb3_combrel.common.suggestions import did_you_mean
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.domains import BEST, ICUB, MOUNTAIN_CAR, PAPER, Domain

ALL = "all"
#: An experiment that the paper does not have: why claims do not hold.
DIAGNOSIS = "diagnosis"
#: What a user would pick instead.
BASELINES = "baselines"
CONTROLS = (m.TIMBREL_RANDOM, m.ONE_RANDOM, m.ORACLE, m.UNRELATED, m.NO_TRANSFER_BEST)


@dataclass(frozen=True)
class Target:
    """A figure or table of the paper."""

    name: str  # on the command line
    title: str  # what it shows
    methods: dict[str, tuple[str, ...]]  # names of the methods whose runs it needs, by domain


_CAR, _ROBOT = MOUNTAIN_CAR.name, ICUB.name
_LEARNERS = (m.NO_TRANSFER, m.COMBREL_PLAIN)
_IN_FIG2 = (m.NO_TRANSFER, m.TIMBREL_INTUITIVE, m.COMBREL_PLAIN, m.COMBREL_RELEVANCE, *CONTROLS)
_IN_FIG3 = (m.COMBREL_PLAIN, m.COMBREL_RELEVANCE, m.TIMBREL_RELEVANCE)
_IN_FIG5 = (m.NO_TRANSFER, m.TIMBREL_RANDOM, m.TIMBREL_FREQUENT, m.COMBREL_PLAIN, *CONTROLS)
_TARGETS = (
    Target("fig2", "Learning with transfer in Mountain Car 4D", {_CAR: _IN_FIG2}),
    Target("fig3", "Relevance in Mountain Car 4D", {_CAR: _IN_FIG3}),
    Target("fig4", "Source action selected for the target action East", {_CAR: (m.COMBREL_PLAIN,)}),
    Target("fig5", "Learning with transfer on the iCub's arm", {_ROBOT: _IN_FIG5}),
    Target("fig6", "Training needed to reach a threshold on the iCub's arm", {_ROBOT: _IN_FIG5}),
    Target("table2", "Action mappings selected in Mountain Car 4D", {_CAR: (m.COMBREL_WHOLE,)}),
    Target("table4", "Action mappings selected on the iCub's arm", {_ROBOT: (m.COMBREL_PLAIN,)}),
    Target("table5", "Running times", {_CAR: (m.NO_TRANSFER, m.TIMBREL_INTUITIVE, m.COMBREL_PLAIN)}),
    Target("table6", "What held", {_CAR: (*_IN_FIG2, *_IN_FIG3), _ROBOT: _IN_FIG5}),
    # Of these two the other runs are no methods of the domain.
    Target(BASELINES, "Fitted R-Max, COMBREL and what a user would pick instead", {_CAR: _LEARNERS, _ROBOT: _LEARNERS}),
    Target(DIAGNOSIS, "What transfer saves at different breadths of the learner's kernel", {_CAR: ()}),
)
TARGETS = {target.name: target for target in _TARGETS}

_WHY_NOT = {
    "fig3": "with priors there is no relevance",
    **dict.fromkeys(("fig4", "table2", "table4"), "with priors no mapping is selected state by state"),
    DIAGNOSIS: f"it explains the results of setting {PAPER!r}",
    BASELINES: f"they are compared with setting {BEST!r}",
}


def targets_of(name: str, setting: str) -> list[Target]:
    """Return the figures and tables of a name or "all"; ValueError if unknown, or not in the setting."""
    if name == ALL:
        return [target for target in TARGETS.values() if exists_in(target.name, setting)]
    if name not in TARGETS:
        close = did_you_mean(name, (*TARGETS, ALL))
        raise ValueError(f"target must be one of {', '.join(TARGETS)} or {ALL}, got {name!r}{close}")
    if not exists_in(name, setting):
        raise ValueError(f"{name} does not exist in setting {setting!r}: {_WHY_NOT[name]}; use another --setting")
    return [TARGETS[name]]


def exists_in(target: str, setting: str) -> bool:
    """Whether a figure or table can be made in a setting."""
    of_one_setting = {DIAGNOSIS: PAPER, BASELINES: BEST}
    if target in of_one_setting:
        return setting == of_one_setting[target]
    return setting != BEST or target not in _WHY_NOT


def methods_of(targets: Iterable[Target], domain: Domain, setting: str) -> list[str]:
    """Return the methods whose runs figures and tables need in a domain, in the order of tables."""
    needed = {method for target in targets for method in target.methods.get(domain.name, ())}
    return [method for method in m.methods_in(domain, domain.settings[setting]) if method in needed]
