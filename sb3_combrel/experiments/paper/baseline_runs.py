"""What a user would pick instead, beside the paper's methods: DQN and QR-DQN, also with a replay buffer filled by COMBREL."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_combrel.comparison.figures import panels_of, save
from sb3_combrel.comparison.statistics import bootstrap_band
from sb3_combrel.comparison.tables import Table
from sb3_combrel.experiments.paper.baselines import (
    ALGORITHMS,
    OF_SOURCE,
    OWN,
    PLAIN,
    PREFILLED,
    QUANTILE,
    BaselineJob,
    Evaluations,
    learn,
)
from sb3_combrel.experiments.paper.curves import STYLES
from sb3_combrel.experiments.paper.domains import DOMAINS, ICUB, MOUNTAIN_CAR, Domain
from sb3_combrel.experiments.paper.methods import Sources
from sb3_combrel.experiments.paper.runs import Result
from sb3_combrel.experiments.result_files import run_name

N_RUNS = 5
#: Environment steps, by domain. What exploration and learning rate are at a step depends on them.
TOTAL_TIMESTEPS = {MOUNTAIN_CAR.name: 300_000, ICUB.name: 100_000}
_FEWEST_STEPS = 5000
_STYLES = {PLAIN: ("#56B4E9", "-"), QUANTILE: ("#E69F00", "-"), PREFILLED: ("#CC79A7", "-"), OWN: ("#CC79A7", "--")}


@dataclass(frozen=True)
class BaselineRun:
    """
    A baseline that learns a domain's target with one seed.

    :param domain: name of the domain
    :param job: what is learnt
    """

    domain: str
    job: BaselineJob

    @property
    def method(self) -> str:
        """Name of the algorithm."""
        return self.job.algorithm

    @property
    def seed(self) -> int:
        """Seed of the algorithm and its environment."""
        return self.job.seed

    @property
    def title(self) -> str:
        """What the run is called in messages."""
        return f"{self.domain}, {self.method}, seed {self.seed}"

    @property
    def name(self) -> str:
        """Name of the run in files."""
        return run_name(self.domain, self.method, self.seed)

    def answered_by(self, result: Result) -> bool:
        """Whether a result is that of this run: its last evaluation was after the last step."""
        return bool(result.evaluations) and result.evaluations[-1][0] == self.job.total_timesteps


def baseline_runs(domain: Domain, setting: str, sources: Sources, n_runs: int | None, n_episodes: int) -> list[BaselineRun]:
    """
    Make the runs of all baselines.

    :param domain: the domain
    :param setting: name of the setting, whose time limit holds
    :param sources: what is transferred to fill the replay buffer
    :param n_runs: seeds of each; at most :data:`N_RUNS`
    :param n_episodes: episodes of the other methods; where they are fewer than by default, so are the steps of the baselines
    """
    total = round(TOTAL_TIMESTEPS[domain.name] * min(1.0, n_episodes / domain.n_episodes))
    cap = domain.settings[setting].max_episode_steps
    seeds = range(domain.first_seed, domain.first_seed + min(n_runs or N_RUNS, N_RUNS))
    return [
        BaselineRun(
            domain.name,
            BaselineJob(
                algorithm,
                domain.target_id,
                seed,
                max(total, _FEWEST_STEPS),
                cap,
                sources.own if algorithm in OF_SOURCE else None,
            ),
        )
        for seed in seeds
        for algorithm in ALGORITHMS
    ]


def carry_out_baseline(run: BaselineRun) -> Result:
    """Learn as a run says. Nothing is written, as with :func:`~sb3_combrel.experiments.paper.runs.carry_out`."""
    start = time.process_time()
    learnt = learn(run.job)
    seconds = time.process_time() - start
    episodes = learnt.episodes
    return Result(
        run.name,
        run.domain,
        run.method,
        run.seed,
        [int(n) for n in episodes.steps],
        [float(r) for r in episodes.returns],
        [bool(t) for t in episodes.terminated],
        evaluations=[[int(n), float(r), float(f)] for n, r, f in zip(*learnt.evaluations, strict=True)],
        seconds=(seconds, 0.0),
    )


def always_reached_from(result: Result) -> float:
    """Return the steps from which on every evaluation reached the goal always; inf if the last did not."""
    return Evaluations(*np.array(result.evaluations).T).always_reached_from()


def baselines_table(results: Mapping[str, Sequence[Result]]) -> Table:
    """
    Make a table of what the baselines reach.

    :param results: by domain, of the baselines' runs
    """
    rows = []
    for domain, of_domain in results.items():
        for algorithm in ALGORITHMS:
            runs = [result for result in of_domain if result.method == algorithm]
            if not runs:
                continue
            needed = np.array([always_reached_from(result) for result in runs])
            returns = np.array([result.evaluations[-1][1] for result in runs])
            times = f"{np.median(needed):,.0f}" if np.isfinite(np.median(needed)) else "never"
            total = max(result.evaluations[-1][0] for result in runs)
            cells = f"{np.isfinite(needed).sum()} of {len(runs)}", times
            rows.append((DOMAINS[domain].title, algorithm, f"{total:,.0f}", *cells, f"{np.median(returns):,.0f}"))
    header = (
        "domain",
        "algorithm",
        "steps",
        "runs that reach it always",
        "from step, median",
        "greedy return at the end, median",
    )
    return Table("Baselines: greedy policy, five episodes at ten numbers of steps", header, rows)


def evaluation_rows(results: Mapping[str, Sequence[Result]]) -> list[tuple[object, ...]]:
    """
    Return what the baselines' evaluations were, a row each, below a header: what figure and table are made of.

    :param results: by domain, of the baselines' runs
    """
    rows: list[tuple[object, ...]] = [("domain", "algorithm", "seed", "steps", "greedy_return", "fraction_reached")]
    for domain, of_domain in results.items():
        for algorithm in ALGORITHMS:
            for run in sorted((each for each in of_domain if each.method == algorithm), key=lambda each: each.seed):
                rows += [(domain, algorithm, run.seed, int(n), *measured) for n, *measured in run.evaluations]
    return rows


def draw_baselines(results: Mapping[str, Sequence[Result]], methods: Sequence[str], title: str, path: Path) -> list[Path]:
    """
    Draw returns against environment steps, on a logarithmic axis.

    Of the baselines the greedy policy, mean of the runs with the range of these; of the methods the episodes of learning,
    exploration included, mean of the runs with 95% bootstrap bands.

    :param results: by domain, of baselines and methods
    :param methods: names of the methods to draw
    :param title: title of the figure
    :param path: file to write, without its suffix
    :return: the PNG and the SVG file
    """
    figure, all_axes = panels_of(len(results), title, sharey=False)
    for axes, (domain, of_domain) in zip(all_axes, results.items(), strict=True):
        for method in methods:
            runs = [result for result in of_domain if result.method == method]
            if runs:
                steps, returns = _on_one_axis(runs)
                band = bootstrap_band(returns)
                colour, line = STYLES[method]
                axes.plot(steps, band.mean, line, color=colour, label=f"{method}, learning ({len(runs)} runs)")
                axes.fill_between(steps, band.low, band.high, color=colour, alpha=0.15, linewidth=0)
        for algorithm, (colour, line) in _STYLES.items():
            runs = [result for result in of_domain if result.method == algorithm]
            if runs:
                steps, returns = _evaluations_of(runs)
                axes.plot(steps, returns.mean(axis=0), line, color=colour, label=f"{algorithm}, greedy ({len(runs)} runs)")
                axes.fill_between(steps, returns.min(axis=0), returns.max(axis=0), color=colour, alpha=0.12, linewidth=0)
        axes.set_title(DOMAINS[domain].title, fontsize="medium")
        axes.set_xscale("log")
        axes.set_xlabel("environment steps")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False, fontsize="small", loc="upper left", bbox_to_anchor=(0.0, -0.15), ncols=2)
    all_axes[0].set_ylabel("return of an episode")
    return save(figure, path)


def _on_one_axis(runs: Sequence[Result], n_points: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Returns of runs at the same numbers of steps: of the episode that ends next, shape (n_runs, n_points)."""
    ends = [np.cumsum(run.steps) for run in runs]
    steps = np.geomspace(max(each[0] for each in ends), min(each[-1] for each in ends), n_points)
    at = [np.minimum(np.searchsorted(each, steps), len(each) - 1) for each in ends]
    return steps, np.array([np.array(run.returns)[places] for run, places in zip(runs, at, strict=True)])


def _evaluations_of(runs: Sequence[Result]) -> tuple[np.ndarray, np.ndarray]:
    """Mean returns of the evaluations that all runs have, shape (n_runs, n): those with a filled buffer begin later."""
    steps = sorted(set.intersection(*({int(each[0]) for each in run.evaluations} for run in runs)))
    returns = [[r for n, r, _ in run.evaluations if int(n) in steps] for run in runs]
    return np.array(steps), np.array(returns)
