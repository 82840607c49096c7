"""A small task for tests of the dashboard, and what reads its event files back."""

import gymnasium as gym
from stable_baselines3.common.callbacks import BaseCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from helpers.walk import Walk, small

METHODS = ["none", "TIMBREL", "random", "pool", "COMBREL"]


class NamedWalk(Walk):
    """The walk with names."""

    state_names = ("place", "height")
    action_names = ("back", "forth")


class Still(gym.Env):
    """Nothing happens, whatever the action."""

    def __init__(self, low, high, action_names=("wait",)):
        self.observation_space, self.action_space = gym.spaces.Box(low, high), gym.spaces.Discrete(len(action_names))
        self.action_names = tuple(action_names)

    def reset(self, *, seed=None, options=None):
        return self.observation_space.low, {}

    def step(self, action):
        return self.observation_space.low, 0.0, False, False, {}


def walker(log=None, transfer=None, env=None, **kwargs):
    """A model of the walk, with a TensorBoard log in the folder ``log``."""
    return small(NamedWalk() if env is None else env, transfer=transfer, tensorboard_log=log and str(log), **kwargs)


def run_folder(log):
    """The folder of the only run in a log."""
    (folder,) = (path for path in log.iterdir() if path.is_dir())
    return folder


def events(folder):
    """All that the event files of a folder have."""
    return EventAccumulator(str(folder), size_guidance={"images": 0, "tensors": 0, "scalars": 0}).Reload()


def scalars(found, tag, at=None):
    """The values of a scalar by step; at some steps only, if they are given."""
    return {event.step: event.value for event in found.Scalars(tag) if at is None or event.step in at}


class Witness(BaseCallback):
    """Computes at every log what the log should have."""

    def __init__(self, of):
        super().__init__()
        self.of, self.seen = of, {}

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        if self.locals["logs"]:
            self.seen[self.num_timesteps] = self.of(self.model)


def slow_q(agent, point, action):
    """Q of a pair of the grid, entry by entry; None if it is optimistic."""
    mdp = agent.mdp.arrays
    if not mdp.modelled[action * agent.grid.n_points + point]:
        return None
    entries = range(mdp.length[point, action])
    following = (mdp.weight[point, action, k] * agent.planner.values[mdp.to[point, action, k]] for k in entries)
    return mdp.reward[point, action] + sum(following)
