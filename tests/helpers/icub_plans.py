"""Known plans for the ball-striking tasks, and how to replay them."""

from itertools import pairwise

import gymnasium

import combrel_envs  # noqa: F401 - registers the tasks

TORSO, ARM = "combrel/ICubTorsoStrike-v0", "combrel/ICubArmStrike-v0"
IDS = (TORSO, ARM)
NOISY = {TORSO: "combrel/ICubTorsoStrikeNoisy-v0", ARM: "combrel/ICubArmStrikeNoisy-v0"}
TASKS = {TORSO: "torso_strike", ARM: "arm_strike"}

# Found by search over the poses on a grid of 2 degrees; "18 S2-" is 18 times the action S2-.
PLANS = {
    TORSO: "18 S2-, 1 S1+, 1 S2-, 1 S1+, 1 S2-, 1 S1+, 1 S2-, 2 S1+",
    ARM: "7 T2-, 1 T1-, 1 T2-, 1 T1-, 3 T2-, 1 T1-, 2 T2-, 1 T1-, 4 T2-, 1 T3+, 1 T2-, 1 T3+, 1 T2-, 1 T3+, 1 T2-, 2 T3+",
}
LENGTHS = {TORSO: (25, 26), ARM: (29, 30)}


def plan_of(env_id):
    """The numbers of the actions of a task's plan."""
    names = gymnasium.make(env_id).unwrapped.action_names
    runs = (run.split() for run in PLANS[env_id].split(", "))
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
