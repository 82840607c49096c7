"""A deterministic walk in the unit square, in plain Python on arrays, and agents that learn it."""

import numpy as np

from helpers.agents import make_agent
from sb3_combrel import COMBREL, TIMBREL, InterTaskMapping, SourceInstances

MOVES = np.array([[-0.1, 0.0], [0.1, 0.0], [0.0, -0.1], [0.0, 0.1]])
START = np.array([0.05, 0.05])
FEWEST_STEPS = 18
STEP_LIMIT = 60


def step(state, action):
    """Next state, reward, and whether it is the goal: the upper right corner."""
    next_state = np.clip(state + MOVES[action], 0.0, 1.0)
    return next_state, -1.0, bool((next_state > 0.9).all())


def learn(agent, n_episodes, before_each=lambda state: None):
    """The actions of so many episodes of learning; ``before_each`` is called with each state."""
    agent.prepare()
    actions = []
    for _ in range(n_episodes):
        state, terminated = START, False
        actions.append([])
        while not terminated and len(actions[-1]) < STEP_LIMIT:
            before_each(state)
            action = agent.act(state)
            next_state, reward, terminated = step(state, action)
            before_each(next_state)
            agent.update(state, action, reward, next_state, terminated)
            actions[-1].append(action)
            state = next_state
        agent.end_episode(truncated=not terminated)
    return actions


def evaluate(agent, start=START):
    """Steps to the goal without exploration; the limit if it is not reached."""
    state, terminated, n = start, False, 0
    while not terminated and n < STEP_LIMIT:
        state, _, terminated = step(state, agent.act(state, explore=False))
        n += 1
    return n


def square_source(n=200):
    rng = np.random.default_rng(0)
    states, actions = rng.random((n, 2)), rng.integers(4, size=n)
    after = [step(state, action) for state, action in zip(states, actions, strict=True)]
    ends, rewards, terminated = map(np.array, zip(*after, strict=True))
    return SourceInstances(states, actions, rewards, ends, terminated, [0.0, 0.0], [1.0, 1.0], 4)


SAME = InterTaskMapping([0, 1], [0, 1, 2, 3])
METHODS = {
    "none": lambda: None,
    "TIMBREL": lambda: TIMBREL(square_source(), SAME),
    "TIMBREL random": lambda: TIMBREL(square_source(), "random"),
    "TIMBREL pool": lambda: TIMBREL(square_source(), "pool"),
    "COMBREL": lambda: COMBREL(square_source(), use="instances"),
    "COMBREL drawn": lambda: COMBREL(square_source(), choice="drawn"),
    "COMBREL by relevance": lambda: COMBREL(square_source(), relevance=True),
}


def square_agent(method="none", rng=0, **settings):
    return make_agent(2, 4, METHODS[method](), rng, **dict(model_breadth=0.15, resolution=3) | settings)
