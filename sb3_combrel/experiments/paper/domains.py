"""The two domains of the paper, and the settings in which each is learnt."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from sb3_combrel import SourceInstances
from sb3_combrel.experiments.tasks import icub_arm, mountain_car

#: As in the paper; and this package's defaults.
PAPER, BEST = SETTINGS = ("paper", "best")


@dataclass(frozen=True)
class Setting:
    """How the methods are set in one domain."""

    learner: Mapping[str, Any]  # arguments of :class:`~sb3_combrel.FittedRMax`
    n_runs: int  # runs of each method, by default
    max_episode_steps: int  # steps after which an episode is cut off
    mappings: str  # the set that COMBREL chooses from, and from which random mappings are drawn
    combrel: Mapping[str, Any] = field(default_factory=dict)  # arguments of :class:`~sb3_combrel.COMBREL` besides the set
    timbrel: Mapping[str, Any] = field(default_factory=dict)  # arguments of :class:`~sb3_combrel.TIMBREL` besides the mapping
    paper: bool = False  # whether COMBREL is that of ``COMBREL.paper``

    @property
    def use(self) -> str:
        """What is transferred: "instances" or "prior"."""
        return str(self.timbrel.get("use", "instances"))


@dataclass(frozen=True)
class Domain:
    """A source task and a target task."""

    name: str  # in file names
    title: str  # in figures
    target_id: str  # id of the target task
    learn_source: Callable[[int], SourceInstances]  # learns the source and returns its instances; a function of the seed
    n_episodes: int  # episodes of each run, by default
    first_seed: int  # seed of the first run; no setting was chosen with this seed or those after it
    thresholds: tuple[int, ...]  # steps of an episode; the training needed to get there is reported for each
    goal_reward: float  # what the last step of an episode that reaches the goal earns besides the cost of a step, 1
    unit: str  # what a step is called
    settings: Mapping[str, Setting]  # by name

    def target_names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Return the names of the target's state variables and actions."""
        if self.name == ICUB.name:
            from combrel_envs.icub_tasks import TASKS

            return TASKS["arm_strike"].state_names, TASKS["arm_strike"].action_names
        from combrel_envs.mountain_car_dynamics import ACTION_NAMES, STATE_NAMES

        return STATE_NAMES[2], ACTION_NAMES[2]


# Table 1 of the paper. It names no breadth for transferred instances: the only one that it names is taken for both. States are
# scaled by the bounds of their variables, whether instances are transferred or not.
_CAR_PAPER = Setting(
    learner={
        "degree": 0,
        "model_breadth": 0.4,
        "min_fraction": 0.1,
        "min_weight": 0.01,
        "bounds": [[-1.2, -1.2, -0.07, -0.07], [0.6, 0.6, 0.07, 0.07]],
    },
    n_runs=5,
    max_episode_steps=4000,
    mappings="paper_mountain_car",
    combrel={"breadth": 0.4, "n_neighbors": 3},
    timbrel={"breadth": 0.4, "breadth_decay": 1.0},
    paper=True,
)
_CAR_BEST = Setting(learner={}, n_runs=15, max_episode_steps=2000, mappings="signed_factored", timbrel={"use": "prior"})

# Table 3.
_ICUB_PAPER = Setting(
    learner={
        "degree": 0,
        "model_breadth": 0.1,
        "min_fraction": 0.01,
        "min_weight": 0.01,
        "bounds": [[-95.5, 0.0, -37.0, 15.0], [10.0, 160.8, 80.0, 106.0]],
        **icub_arm.LEARNER,
    },
    n_runs=10,
    max_episode_steps=icub_arm.MAX_EPISODE_STEPS,
    mappings="paper_icub",
    combrel={"breadth": 0.1, "n_neighbors": 3},
    timbrel={"breadth": 0.1, "breadth_decay": 1.0},
    paper=True,
)
_ICUB_BEST = Setting(
    learner={},
    n_runs=10,
    max_episode_steps=icub_arm.MAX_EPISODE_STEPS,
    mappings="signed_factored",
    timbrel={"use": "prior"},
)

#: This package's instance transfer from Mountain Car, at breadths of the learner's kernel that are told beside it.
DIAGNOSED = Setting(
    learner={"degree": 0},
    n_runs=_CAR_PAPER.n_runs,
    max_episode_steps=2000,
    mappings="injective",
    combrel={"use": "instances"},
)

MOUNTAIN_CAR = Domain(
    name="mountain_car",
    title="Mountain Car 4D",
    target_id=mountain_car.TARGET_ID,
    learn_source=mountain_car.learn_source,
    n_episodes=200,
    first_seed=26000,
    thresholds=(400, 300, 250),
    goal_reward=0.0,
    unit="steps",
    settings={PAPER: _CAR_PAPER, BEST: _CAR_BEST},
)
ICUB = Domain(
    name="icub",
    title="iCub, arm",
    target_id=icub_arm.TARGET_ID,
    learn_source=icub_arm.learn_source,
    n_episodes=300,
    first_seed=26000,
    thresholds=(200, 150, 100, 75, 50, 40),
    goal_reward=100.0,
    unit="commands",
    settings={PAPER: _ICUB_PAPER, BEST: _ICUB_BEST},
)
#: The other domain's source is the one that has nothing to do with a target.
DOMAINS = {domain.name: domain for domain in (MOUNTAIN_CAR, ICUB)}
