"""Fine-tuning as a rival of transfer: a network that has learnt the source is where the target's begins, as far as it fits.

Run as ``python -m sb3_combrel.experiments.fine_tuning``; a later call does what is missing. It needs the extra ``benchmarks``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch

from sb3_combrel.experiments.benchmark.pairs import PAIRS, make_car, make_pendulum_of_three
from sb3_combrel.experiments.other_tasks import ALIKE, BUDGETS, BudgetJob, check_budgets, learn_all
from sb3_combrel.experiments.rivals import check_names, learner_of, published
from sb3_combrel.experiments.suite.tasks import CAP, SLIGHT_NOISE
from sb3_combrel.experiments.tasks import cart_pole, icub_arm, mountain_car
from sb3_combrel.experiments.tasks.point_robot import make_point_robot
from sb3_combrel.runs.job import Task, make_env

#: The source's environment of each pair of the benchmark that has one source.
SOURCES: dict[str, Callable[[], gym.Env]] = {
    "mountain-car": partial(make_env, mountain_car.SOURCE_ID, max_episode_steps=CAP),
    "icub": partial(make_env, icub_arm.SOURCE_ID),
    "mirrored-car": make_car,
    "cart-pole": cart_pole.make_cart_pole,
    "pendulum-acrobot": make_pendulum_of_three,
    "point-robot": partial(make_point_robot, 2, SLIGHT_NOISE, "random"),
    "nothing-in-common": partial(make_point_robot, 2, SLIGHT_NOISE, "random"),
}
FROM_NOTHING, FINE_TUNED = "DQN", "fine-tuned"
METHODS = (FROM_NOTHING, FINE_TUNED)
#: Steps of learning the source; more than any source of the benchmark is recorded with.
SOURCE_STEPS = 50_000
SEEDS = tuple(range(24000, 24005))
OUTPUT, TABLE = Path("fine_tuning"), Path("docs/results/fine_tuning.csv")


@dataclass(frozen=True, kw_only=True)
class FineTuningJob(BudgetJob):
    """DQN learns the target of a pair, ``group``, from nothing or from what it has learnt in the source.

    :param source: the source's environment
    :param source_steps: steps of learning there, if ``method`` is :data:`FINE_TUNED`
    """

    source: Task
    source_steps: int

    def make_learner(self, env: gym.Env) -> tuple[Any, dict[str, Any]]:
        """Make the model, which has learnt the source first if it is to be fine-tuned."""
        model, copied = learner_of(FROM_NOTHING, env, self.seed, self.learner), 0
        if self.method == FINE_TUNED:
            with closing(make_env(self.source)) as source_env:
                source = learner_of(FROM_NOTHING, source_env, self.seed, self.learner)
                source.learn(self.source_steps, log_interval=None)
            copied = warm_start(model.q_net, source.q_net)
            model.q_net_target.load_state_dict(model.q_net.state_dict())
        return model, {"copied": copied}


def warm_start(network: torch.nn.Module, learnt: torch.nn.Module) -> int:
    """Give a network the parameters of another of as many layers wherever their shapes are the same; return how many."""
    own, other = network.state_dict(), learnt.state_dict()
    fitting = {name: each for name, each in other.items() if name in own and own[name].shape == each.shape}
    network.load_state_dict({**own, **fitting})
    return len(fitting)


def fine_tuning_jobs(
    pairs: Sequence[str], seeds: Sequence[int], budgets: Sequence[int], source_steps: int
) -> list[FineTuningJob]:
    """Make the jobs, seed by seed.

    :raises ValueError: if a name is unknown, or a budget is not positive
    :raises ModuleNotFoundError: if RL-Zoo is not installed
    """
    check_names("pairs", pairs, SOURCES)
    check_budgets(budgets)
    hyperparameters: dict[str, Any] = published(FROM_NOTHING, ALIKE[FROM_NOTHING])
    return [
        FineTuningJob(
            group=pair,
            method=method,
            seed=seed,
            env=PAIRS[pair].target,
            learner=hyperparameters,
            source=SOURCES[pair],
            source_steps=source_steps,
            budgets=tuple(budgets),
        )
        for seed, pair, method in product(seeds, pairs, METHODS)
    ]


def fine_tuning(
    pairs: list[str] = list(SOURCES),  # noqa: B006 - tyro shows it, nobody changes it
    seeds: list[int] = list(SEEDS),  # noqa: B006
    budgets: list[int] = list(BUDGETS),  # noqa: B006
    source_steps: int = SOURCE_STEPS,
    jobs: int = 1,
    output: Path = OUTPUT,
    table: Path = TABLE,
) -> None:
    """Learn the targets of the benchmark's pairs by DQN, from nothing and from a network that has learnt the source.

    :param pairs: names of the benchmark's pairs with one source
    :param seeds: one run each
    :param budgets: steps after which the frozen policy is evaluated
    :param source_steps: steps of learning the source
    :param jobs: processes at a time
    :param output: folder for the results; a later call goes on from there
    :param table: the CSV file
    """
    learn_all(fine_tuning_jobs(pairs, seeds, budgets, source_steps), jobs, output, table)


def main() -> None:
    """Run the command line."""
    import tyro

    try:
        tyro.cli(fine_tuning)
    except (ValueError, ModuleNotFoundError) as error:
        sys.exit(f"fine_tuning: {error}")


if __name__ == "__main__":
    main()
