"""The files that ``sb3-combrel reproduce`` makes of the results: figures, tables, and all runs as CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from sb3_combrel import FittedRMax
from sb3_combrel.common.files import write_whole
from sb3_combrel.common.scaling import StateScaling
from sb3_combrel.comparison.tables import Table, write_tables
from sb3_combrel.experiments.paper import methods as m
from sb3_combrel.experiments.paper.baseline_runs import baselines_table, draw_baselines, evaluation_rows
from sb3_combrel.experiments.paper.curves import draw_curves, draw_selection, draw_times
from sb3_combrel.experiments.paper.diagnosis import diagnosis_table, draw_diagnosis
from sb3_combrel.experiments.paper.domains import DOMAINS, ICUB, Domain
from sb3_combrel.experiments.paper.measures import measures_table
from sb3_combrel.experiments.paper.methods import target_names
from sb3_combrel.experiments.paper.plan import BASELINES, CONTROLS, DIAGNOSIS, Target
from sb3_combrel.experiments.paper.runs import Result, ResultFiles, steps_by_method
from sb3_combrel.experiments.paper.selections import (
    Selection,
    action_mapping_table,
    dependence_table,
    joint_action_table,
    state_mapping_table,
)
from sb3_combrel.experiments.paper.verdicts import CONTROL, PAPERS, judge, summary_table, verdict_table
from sb3_combrel.experiments.report import csv_text
from sb3_combrel.runs.job import chosen_on_purpose, make_env

#: Minutes that the paper gives for 200 episodes (Table 5).
PAPERS_MINUTES = {m.NO_TRANSFER: 24.0, m.TIMBREL_INTUITIVE: 28.1, m.COMBREL_PLAIN: 40.9}
EAST = "East"
#: Figures of learning curves, each with the tests of what its methods show.
CURVES = ("fig2", "fig3", "fig5")


def write_report(
    targets: Sequence[Target], setting: str, results: Mapping[str, Sequence[Result]], output: Path, console: Console
) -> list[Path]:
    """
    Make figures (PNG, SVG) and tables (Markdown, CSV), and write all runs in the folder to one CSV file a domain.

    :param targets: figures and tables to make
    :param setting: name of the setting
    :param results: of all runs that they need, by domain
    :param output: folder to write to
    :param console: where to show the tables
    :return: the files
    """
    made: list[Path] = []
    # Without baselines, and without methods at other breadths.
    own = {name: [each for each in of_domain if each.method in m.METHODS] for name, of_domain in results.items()}
    for name in results:
        # With the runs of earlier calls: they may have been for other figures.
        made.append(_write_runs(ResultFiles(output).read_domain(name), output / f"{name}.csv"))
    for target in targets:
        for name, wanted in target.methods.items():
            have = [result for result in results[name] if result.method in wanted]
            if target.name == DIAGNOSIS:
                made += draw_diagnosis(steps_by_method(results[name]), DOMAINS[name], output / target.name)
            elif target.name.startswith("fig"):
                made += _draw(target, DOMAINS[name], setting, have, output)
        if target.name == BASELINES:
            drawn = (m.NO_TRANSFER, m.COMBREL_PLAIN)
            of_baselines = {name: results[name] for name in target.methods}
            made += draw_baselines(of_baselines, drawn, target.title, output / target.name)
            made.append(output / "evaluations.csv")
            write_whole(made[-1], csv_text(evaluation_rows(of_baselines)).encode())
        of_others = target.name in (BASELINES, DIAGNOSIS)
        tables = _tables(target, setting, {name: (results if of_others else own)[name] for name in target.methods})
        if tables:
            made += write_tables(tables, output / target.name, console)
    if any(target.name == "table6" for target in targets):
        tables = [measures_table(DOMAINS[name], of_domain) for name, of_domain in own.items()]
        made += write_tables(tables, output / "measures", console)
    return made


def _draw(target: Target, domain: Domain, setting: str, results: Sequence[Result], output: Path) -> list[Path]:
    path = output / target.name
    title = f"{target.title} (setting: {setting})"
    if target.name == "fig4":
        return _draw_east(domain, setting, results, title, path)
    found = steps_by_method(results)
    steps = {name: found[name] for name in m.METHODS if name in found and name in target.methods[domain.name]}
    panels = {"methods": {name: samples for name, samples in steps.items() if name not in CONTROLS}}
    controls = {name: samples for name, samples in steps.items() if name in CONTROLS}
    if m.TIMBREL_RANDOM in controls and domain.name == ICUB.name:
        # It is one of the paper's own methods there.
        panels["methods"][m.TIMBREL_RANDOM] = controls[m.TIMBREL_RANDOM]
    if controls:
        panels["controls"] = {m.COMBREL_PLAIN: steps[m.COMBREL_PLAIN], **controls}
    draw = draw_times if target.name == "fig6" else draw_curves
    return draw(panels, domain, title, path)


def _draw_east(domain: Domain, setting: str, results: Sequence[Result], title: str, path: Path) -> list[Path]:
    """Draw what the first run has selected for East in the end, in two planes through the state at rest in the valley."""
    chosen = np.array(min(results, key=lambda result: result.seed).at_sample[EAST])
    points, scaling = _sample_of(domain, setting)
    rest = scaling.to_unit(np.array([-np.pi / 6, -np.pi / 6, 0.0, 0.0]))
    nearest = np.abs(points - rest).min(axis=0)
    at_rest = np.abs(points - rest) <= nearest + 1e-9
    names = sorted(set(chosen.tolist()) - {""})
    place = {name: k for k, name in enumerate(names)} | {"": -1}
    panels = {}
    for label, (a, b) in {"at rest": (0, 1), "y at rest in the valley": (0, 2)}.items():
        others = [k for k in range(points.shape[1]) if k not in (a, b)]
        here = at_rest[:, others].all(axis=1)
        panels[label] = (
            scaling.to_raw(points[here])[:, [a, b]],
            np.array([place[name] for name in chosen[here].tolist()]),
            names,
        )
    return draw_selection(panels, ("x", "y"), ("x", "vx"), title=title, path=path)


def _sample_of(domain: Domain, setting: str) -> tuple[np.ndarray, StateScaling]:
    """The finite sample of states that the learner plans with, unit coordinates, and the scaling."""
    learner = domain.settings[setting].learner
    with chosen_on_purpose():
        model = FittedRMax(make_env(domain.target_id), **learner)
    return model.agent.grid.points(), model.agent.task.scaling


def _tables(target: Target, setting: str, results: Mapping[str, Sequence[Result]]) -> list[Table]:
    if target.name == "table6":
        return _verdict_tables(results, setting)
    (name, of_domain), *_ = results.items()
    have = [result for result in of_domain if result.method in target.methods[name]]
    if target.name in CURVES:
        return _verdict_tables({name: have}, setting)
    variables, actions = target_names(DOMAINS[name])
    if target.name == "table2":
        return [
            action_mapping_table(have, actions),
            state_mapping_table(have),
            dependence_table(Selection.of_results(have), variables),
        ]
    if target.name == "table4":
        return [joint_action_table(have, actions), state_mapping_table(have)]
    if target.name == BASELINES:
        return [baselines_table(results)]
    if target.name == DIAGNOSIS:
        return [diagnosis_table(steps_by_method(of_domain))]
    if target.name == "table5":
        return [running_times_table(have)]
    return []


def _verdict_tables(results: Mapping[str, Sequence[Result]], setting: str) -> list[Table]:
    """Table 6 for all methods there are; for a figure of learning curves, for its own methods alone."""
    steps = {name: steps_by_method(of_domain) for name, of_domain in results.items()}
    papers = verdict_table(judge(steps, PAPERS), f"Table 6: what the paper claims, in setting {setting!r}")
    controls = verdict_table(judge(steps, CONTROL), f"Controls, in setting {setting!r}")
    return [papers, controls, summary_table(steps), uses_table(results)]


def uses_table(results: Mapping[str, Sequence[Result]]) -> Table:
    """
    Make a table of how often transferred instances were used at the agent's states: what they change is at most that.

    :param results: by domain
    """
    rows = []
    for name, of_domain in results.items():
        for method in m.METHODS:
            runs = [result for result in of_domain if result.method == method and result.uses]
            if runs:
                n_uses = np.array([sum(row[-1] for row in result.uses) for result in runs])
                n_mappings = np.array([len({tuple(row[1:4]) for row in result.uses}) for result in runs])
                per_step = np.mean(n_uses / [sum(result.steps) for result in runs])
                row = DOMAINS[name].title, method, f"{n_uses.mean():,.0f}", f"{per_step:.3f}", f"{n_mappings.mean():,.0f}"
                rows.append(row)
    header = ("domain", "method", "uses", "uses a step", "mappings used")
    return Table(
        "State-action pairs at the agent's states for which transferred instances were used, mean of the runs", header, rows
    )


def running_times_table(results: Sequence[Result]) -> Table:
    """Make a table of the running times of all episodes and of the first (the paper's Table 5), mean of the runs."""
    rows = []
    have = {result.method for result in results}
    for method in (name for name in m.METHODS if name in have):
        seconds = np.array([result.seconds for result in results if result.method == method])
        steps = np.array([sum(result.steps) for result in results if result.method == method])
        papers = f"{PAPERS_MINUTES[method]:.1f}" if method in PAPERS_MINUTES else ""
        mean = seconds.mean(axis=0)
        per_step = f"{1000.0 * seconds[:, 0].sum() / steps.sum():.2f}"
        rows.append((method, papers, f"{mean[0] / 60:.2f}", f"{mean[1]:.1f}", per_step, f"{steps.mean():,.0f}"))
    n_episodes = len(results[0].steps) if results else 0
    header = ("method", "paper, minutes", "minutes", "first episode, seconds", "ms a step", "steps")
    return Table(f"Processor time of {n_episodes} episodes, mean of the runs", header, rows)


def _write_runs(results: Sequence[Result], path: Path) -> Path:
    """Write one line for each run: the steps of its episodes, and how many of them ended in a terminal state."""
    rows: list[tuple[object, ...]] = [("method", "seed", "steps", "episodes_terminated", "steps_of_episodes")]
    for result in sorted(results, key=lambda each: (each.method, each.seed)):
        of_episodes = " ".join(map(str, result.steps))
        rows.append((result.method, result.seed, sum(result.steps), sum(result.terminated), of_episodes))
    write_whole(path, csv_text(rows).encode())
    return path
