"""The files that ``sb3-combrel reproduce`` makes of the results: figures, tables, and all runs as CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from sb3_combrel import FittedRMax
from sb3_combrel.comparison.tables import Table, write_csv, write_tables
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper import selections, tables
from sb3_combrel.experiments.paper.domains import DOMAINS, ICUB, Domain
from sb3_combrel.experiments.paper.figures import draw_baselines, draw_curves, draw_diagnosis, draw_selection, draw_times
from sb3_combrel.experiments.paper.jobs import steps_by_method
from sb3_combrel.experiments.paper.targets import BASELINES, CONTROLS, DIAGNOSIS, Target
from sb3_combrel.experiments.paper.verdicts import CONTROL, PAPERS, WINDOWS, judge, verdict_table
from sb3_combrel.runs.job import Result, chosen_on_purpose, make_env
from sb3_combrel.runs.runner import read_results

EAST = "East"


def write_report(
    targets: Sequence[Target], setting: str, results: Sequence[Result], output: Path, console: Console
) -> list[Path]:
    """Make figures (PNG, SVG) and tables (Markdown, CSV), and write all runs in the folder to one CSV file a domain."""
    names = [name for name in DOMAINS if any(name in target.methods for target in targets)]
    by_domain = {name: [result for result in results if result.group == name] for name in names}
    # With the runs of earlier calls: they may have been for other figures.
    every = {name: [result for _, result in read_results(output, f"{name}_")] for name in names}
    made = [write_csv(tables.runs_frame(every[name]), output / f"{name}.csv") for name in names]
    for target in targets:
        have = {name: by_domain[name] for name in target.methods}
        if target.name not in (BASELINES, DIAGNOSIS):
            # Table 6 has all methods that have been run.
            wanted = {name: m.METHODS if target.name == "table6" else methods for name, methods in target.methods.items()}
            have = {name: [result for result in have[name] if result.method in wanted[name]] for name in have}
        made += _draw(target, setting, have, output / target.name)
        made_tables = _tables(target, setting, have)
        if target.name == BASELINES:
            made.append(write_csv(tables.evaluations_frame(have), output / "evaluations.csv"))
        if made_tables:
            made += write_tables(made_tables, output / target.name, console)
        if target.name == "table6":
            of_measures = [tables.measures_table(DOMAINS[name], each) for name, each in have.items()]
            made += write_tables(of_measures, output / "measures", console)
    return made


def _draw(target: Target, setting: str, results: Mapping[str, Sequence[Result]], path: Path) -> list[Path]:
    title = f"{target.title} (setting: {setting})"
    name, of_domain = next(iter(results.items()))
    domain = DOMAINS[name]
    if target.name == BASELINES:
        return draw_baselines(results, target.methods[name], target.title, path)
    if target.name == DIAGNOSIS:
        return draw_diagnosis(steps_by_method(of_domain), domain, path)
    if target.name == "fig4":
        return _draw_east(domain, setting, of_domain, title, path)
    if not target.name.startswith("fig"):
        return []
    found = steps_by_method(of_domain)
    steps = {method: found[method] for method in m.METHODS if method in found}
    # Random mappings are one of the paper's own methods on the iCub.
    of_paper = [m.TIMBREL_RANDOM] if domain.name == ICUB.name else []
    methods = [method for method in steps if method not in CONTROLS] + [method for method in of_paper if method in steps]
    controls = [method for method in steps if method in CONTROLS]
    panels = {"methods": {method: steps[method] for method in methods}}
    if controls:
        panels["controls"] = {method: steps[method] for method in (m.COMBREL_PLAIN, *controls)}
    return (draw_times if target.name == "fig6" else draw_curves)(panels, domain, title, path)


def _draw_east(domain: Domain, setting: str, results: Sequence[Result], title: str, path: Path) -> list[Path]:
    """Draw what the first run has selected for East in the end, in two planes through the state at rest in the valley."""
    chosen = np.array(min(results, key=lambda result: result.seed).more["at_sample"][EAST])
    with chosen_on_purpose():
        agent = FittedRMax(make_env(domain.target_id), **domain.settings[setting].learner).agent
    points, scaling = agent.grid.points(), agent.task.scaling
    rest = scaling.to_unit(np.array([-np.pi / 6, -np.pi / 6, 0.0, 0.0]))
    distance = np.abs(points - rest)
    at_rest = distance <= distance.min(axis=0) + 1e-9
    names = sorted(set(chosen.tolist()) - {""})
    place = np.array([names.index(each) if each else -1 for each in chosen.tolist()])
    panels = {}
    for label, plane in {"at rest": [0, 1], "y at rest in the valley": [0, 2]}.items():
        here = np.delete(at_rest, plane, axis=1).all(axis=1)
        panels[label] = scaling.to_raw(points[here])[:, plane], place[here], names
    return draw_selection(panels, ("x", "y"), ("x", "vx"), title=title, path=path)


def _tables(target: Target, setting: str, results: Mapping[str, Sequence[Result]]) -> list[Table]:
    name, of_domain = next(iter(results.items()))
    variables, actions = DOMAINS[name].target_names()
    match target.name:
        case "fig2" | "fig3" | "fig5" | "table6":
            steps = {name: steps_by_method(of_domain) for name, of_domain in results.items()}
            papers = verdict_table(judge(steps, PAPERS), f"Table 6: what the paper claims, in setting {setting!r}")
            controls = verdict_table(judge(steps, CONTROL), f"Controls, in setting {setting!r}")
            found = [papers, controls, tables.summary_table(results), tables.uses_table(results)]
            windows = judge(steps, WINDOWS)
            return [*found, verdict_table(windows, "Table 6 by the paper's own windows")] if windows else found
        case "fig6":
            return [tables.thresholds_table(DOMAINS[name], of_domain)]
        case "table2":
            dependence = selections.dependence_table(selections.selections_of(of_domain, variables))
            mappings = selections.action_mapping_table(of_domain, actions)
            return [mappings, selections.state_mapping_table(of_domain), dependence]
        case "table4":
            return [selections.joint_action_table(of_domain, actions), selections.state_mapping_table(of_domain)]
        case "table5":
            return [tables.running_times_table(of_domain)]
        case "baselines":
            return [tables.baselines_table(results)]
        case "diagnosis":
            return [tables.diagnosis_table(of_domain)]
    return []
