"""Ids, limits and known plans of this project's environments, and how to replay them."""

from itertools import pairwise
from typing import NamedTuple

import gymnasium

import combrel_envs  # noqa: F401 - registers the tasks

CARS = CAR_2D, CAR_4D, CAR_6D = tuple(f"combrel/MountainCar{n}D-v0" for n in (2, 4, 6))
ICUBS = TORSO, ARM = "combrel/ICubTorsoStrike-v0", "combrel/ICubArmStrike-v0"
NOISY = {each: each.replace("-v0", "Noisy-v0") for each in ICUBS}
IDS = (*CARS, *ICUBS)


class Expected(NamedTuple):
    """What is expected of an environment; ``plan``, such as "19 Right, 2 Left", was found by search, as short as possible."""

    task: tuple[str, str]
    state_names: str
    action_names: str
    low: list
    high: list
    max_steps: int
    plan: str


EXPECTED = {
    CAR_2D: Expected(
        ("mountain_car", "climb_2d"),
        "x v",
        "Neutral Left Right",
        [-1.2, -0.07],
        [0.6, 0.07],
        4000,
        "19 Right, 36 Left, 2 Neutral, 45 Right, 1 Neutral",
    ),
    CAR_4D: Expected(
        ("mountain_car", "climb_4d"),
        "x y vx vy",
        "Neutral West East South North",
        [-1.2, -1.2, -0.07, -0.07],
        [0.6, 0.6, 0.07, 0.07],
        4000,
        "9 West, 21 North, 16 East, 21 South, 20 West, 25 North, 27 East, 6 North, 1 Neutral",
    ),
    CAR_6D: Expected(
        ("mountain_car", "climb_6d"),
        "x y z vx vy vz",
        "Neutral West East South North Down Up",
        [-1.2] * 3 + [-0.07] * 3,
        [0.6] * 3 + [0.07] * 3,
        4000,
        "10 East, 11 Up, 14 South, 12 West, 9 Down, 17 North, 10 East, 15 Up, 12 South, 14 West, 10 Down, 20 North, 15 East, "
        "31 Up",
    ),
    TORSO: Expected(
        ("icub", "torso_strike"),
        "torso_pitch torso_yaw",
        "S1- S1+ S2- S2+",
        [-20, -50],
        [70, 50],
        400,
        "18 S2-, 1 S1+, 1 S2-, 1 S1+, 1 S2-, 1 S1+, 1 S2-, 2 S1+",
    ),
    ARM: Expected(
        ("icub", "arm_strike"),
        "r_shoulder_pitch r_shoulder_roll r_shoulder_yaw r_elbow",
        "T1- T1+ T2- T2+ T3- T3+ T4- T4+",
        [-95.5, 0, -37, 15],
        [10, 160.8, 80, 106],
        400,
        "7 T2-, 1 T1-, 1 T2-, 1 T1-, 3 T2-, 1 T1-, 2 T2-, 1 T1-, 4 T2-, 1 T3+, 1 T2-, 1 T3+, 1 T2-, 1 T3+, 1 T2-, 2 T3+",
    ),
}


def start_of_plan(env_id):
    """Arguments with which an environment starts where its plan does."""
    return {"start": "fixed"} if env_id in CARS else {}


def plan_of(env_id):
    """The numbers of the actions of a task's plan."""
    names = EXPECTED[env_id].action_names.split()
    runs = (run.split() for run in EXPECTED[env_id].plan.split(", "))
    return [names.index(name) for count, name in runs for _ in range(int(count))]


def replay(env_id, actions, seed=0, **kwargs):
    """The steps of an episode; a first one for its reset."""
    env = gymnasium.make(env_id, **kwargs)
    steps = [(env.reset(seed=seed)[0], 0.0, False, False, {})]
    steps += [env.step(action) for action in actions]
    env.close()
    assert all(not (before[2] or before[3]) for before, _ in pairwise(steps))
    return steps


def observations(env_id, actions, **kwargs):
    return [step[0].tolist() for step in replay(env_id, actions, **kwargs)]
