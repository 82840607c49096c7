"""Made-up results of the paper's experiments, and what their tests share."""

import io
from xml.etree import ElementTree

import numpy as np
from imageio.v3 import imread
from rich.console import Console

from sb3_combrel import SourceInstances
from sb3_combrel.runs.job import Result, file_name


def quiet():
    """A console that writes nothing."""
    return Console(file=io.StringIO(), width=200)


def made_up(domain, method, seed, steps, returns=None, seconds=1.0, **more):
    """A result: each step costs 1, and an episode of fewer steps than the longest has ended in a terminal state."""
    steps = [int(n) for n in steps]
    returns = [-float(n) for n in steps] if returns is None else returns
    terminated = [n < max(steps) for n in steps]
    name = file_name(domain, method, seed)
    more = {"uses": [], "mappings_of_episodes": [0] * len(steps), "first_episode_seconds": 1.0, **more}
    return Result(name, domain, method, seed, steps, returns, terminated, sum(steps), more, seconds)


def made_up_runs(domain, steps):
    """Results of the steps of each method's runs, shape (n_runs, n_episodes), by method."""
    return [made_up(domain, method, seed, row) for method, rows in steps.items() for seed, row in enumerate(rows)]


def from_equations(n, seed, n_actions=2, d=2, effects=None):
    """Transitions from random states in [0, 1]^d whose effects are given by a function of states and actions."""
    states = np.random.default_rng(seed).uniform(0.2, 0.8, size=(n, d))
    actions = np.arange(n) % n_actions
    moves = effects(states, actions)
    return SourceInstances(
        states, actions, -np.ones(n), states + moves, np.zeros(n, dtype=bool), np.zeros(d), np.ones(d), n_actions
    )


def check_figure(folder, name, *texts):
    """Both files exist, the image has something on it, and the drawing is XML with the texts."""
    image = imread(folder / f"{name}.png")
    assert image.shape[0] > 400 and image.shape[1] > 600
    assert len(np.unique(image.reshape(-1, image.shape[-1]), axis=0)) > 10
    drawing = (folder / f"{name}.svg").read_text()
    ElementTree.fromstring(drawing)
    assert all(text in drawing for text in texts)
    return drawing
