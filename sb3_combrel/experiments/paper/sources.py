"""The instances that the methods transfer, learned once for an output folder."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from sb3_combrel import SourceInstances
from sb3_combrel.experiments.paper.domains import DOMAINS, ICUB, PAPER, Domain
from sb3_combrel.experiments.paper.methods import Sources
from sb3_combrel.runs.source_files import FOLDER, load_or_learn

SOURCE_SEED = 0
#: Seed of the learner whose transitions of the arm's task the oracle has; no run has it.
TARGET_SEED = 1
N_TARGET_TRANSITIONS = 4000


def prepare_sources(domain: Domain, output: Path, console: Console) -> Sources:
    """
    Learn the source tasks of a domain, or load what was learned before.

    :param domain: the domain
    :param output: the output folder
    :param console: where to show what is being done
    """
    (other,) = (each for each in DOMAINS.values() if each.name != domain.name)
    target = None
    if domain.name == ICUB.name:
        target = load_or_learn(output / FOLDER / f"{domain.name}_target.npz", lambda: _record_target(domain), console)
    return Sources(_source(domain, output, console), _source(other, output, console), target)


def _source(domain: Domain, output: Path, console: Console) -> SourceInstances:
    return load_or_learn(output / FOLDER / f"{domain.name}.npz", lambda: domain.learn_source(SOURCE_SEED), console)


def _record_target(domain: Domain) -> SourceInstances:
    max_value = domain.settings[PAPER].learner["max_value"]
    return SourceInstances.from_fitted_rmax(domain.target_id, N_TARGET_TRANSITIONS, TARGET_SEED, max_value=max_value)
