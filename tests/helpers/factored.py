"""A source with linear dynamics, targets that are made of several copies of it, and the same computations written plainly."""

import numpy as np

from helpers import asking
from helpers import naive_transfer as naive
from helpers.naive_local_linear import RIDGE
from sb3_combrel import FactoredMapping, InterTaskMapping, SourceInstances
from sb3_combrel.mappings.state_mappings import copies_of_source
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums

# x' = x + SLOPES x + PUSH[u], unit coordinates: an oscillator that is left alone, pushed down or pushed up.
SLOPES = np.array([[0.0, 0.15], [-0.12, -0.03]])
CENTER = np.array([0.5, 0.5])
PUSH = np.array([[0.0, 0.0], [0.0, -0.02], [0.0, 0.02]])
LOW, RANGE = np.array([-2.0, 10.0]), np.array([4.0, 5.0])


def oscillate(states, actions):
    """Effects of the source, unit coordinates; ``states``: shape (n, 2)."""
    return (states - CENTER) @ SLOPES.T + PUSH[actions]


def ends(states):
    """Where the source's episodes end."""
    return states[:, 0] > 0.9


def oscillator_source(n=600, seed=0, noise=0.0, effects=oscillate, rewards=None):
    """Instances of the source from everywhere; ``noise``: standard deviation of what is added to effects."""
    rng = np.random.default_rng(seed)
    states, actions = rng.random((n, 2)), rng.integers(3, size=n)
    after = states + effects(states, actions) + noise * rng.normal(size=states.shape)
    rewards = -np.ones(n) if rewards is None else rewards(states)
    states, next_states = LOW + RANGE * states, LOW + RANGE * after
    about = 3, ("x", "v"), ("Wait", "Down", "Up"), {"env": "Oscillator-v0"}
    return SourceInstances(states, actions, rewards, next_states, ends(after), LOW, LOW + RANGE, *about)


def copies_mapping(n_copies, order=None):
    """The mapping of a target of so many copies: action 0 moves none, 1 and 2 the first, 3 and 4 the second, ...

    :param order: the target variable of each variable of the first copy, of the second, ...
    """
    order, copies = list(range(2 * n_copies)) if order is None else list(order), []
    for c in range(n_copies):
        state, action = [None] * (2 * n_copies), [0] * (2 * n_copies + 1)
        state[order[2 * c]], state[order[2 * c + 1]] = 0, 1
        action[2 * c + 1 : 2 * c + 3] = 1, 2
        copies.append(InterTaskMapping(state, action))
    return FactoredMapping(copies)


def target_effects(mapping, states, actions):
    """What happens in a target that is exactly what a factored mapping says."""
    effects = np.zeros_like(states)
    for copy in mapping.copies:
        place = [copy.state.index(k) for k in range(2)]
        effects[:, place] = oscillate(states[:, place], np.array(copy.action)[actions])
    return effects


def target_task(n_variables, n_actions):
    return naive.target_task(np.zeros((3, n_variables)), n_actions)


def walk(mapping, n, seed=0, length=40, spread=0.5):
    """States, actions and effects of such a target, in episodes that start at random and end after ``length`` steps."""
    rng = np.random.default_rng(seed)
    d, n_actions = mapping.copies[0].n_target_variables, mapping.copies[0].n_target_actions
    rows = []
    while len(rows) < n:
        state, action = 0.5 + spread * (rng.random(d) - 0.5), int(rng.integers(n_actions))
        for _ in range(length):
            if rng.random() < 0.3:
                action = int(rng.integers(n_actions))
            effect = target_effects(mapping, state[None], np.array([action]))[0]
            rows.append((state, action, effect))
            state = state + effect
    states, actions, effects = zip(*rows[:n], strict=True)
    return np.array(states), np.array(actions), np.array(effects)


def naive_prediction(states, effects, rewards, terminated, at, breadth, n_neighbors, outcome_breadth):
    """Effect, reward, end and weight that a local linear model predicts at ``at``, from the instances of one action."""
    squared = ((states - at) ** 2).sum(axis=1)
    near = np.argsort(squared, kind="stable")[:n_neighbors]
    squared, scale = squared[near], 1.0 / breadth**2
    if len(near) == n_neighbors:
        scale = min(max(scale, -np.log(0.05) / squared[-1]), scale / 1e-6**2)
    weights = np.exp(-(squared - squared[0]) * scale)
    x, e = states[near], effects[near]
    mean_x, mean_e = np.average(x, axis=0, weights=weights), np.average(e, axis=0, weights=weights)
    ridge, root = RIDGE / scale, np.sqrt(weights)[:, None]
    design = np.vstack([root * (x - mean_x), np.sqrt(ridge) * np.eye(len(at))])
    slopes = np.linalg.lstsq(design, np.vstack([root * (e - mean_e), np.zeros((len(at), e.shape[1]))]), rcond=None)[0]
    effect = np.clip(mean_e + (at - mean_x) @ slopes, e.min(axis=0), e.max(axis=0))
    outcome = np.exp(-(squared - squared[0]) / min(breadth, outcome_breadth) ** 2)
    spread = np.linalg.solve(design.T @ design / weights.sum(), at - mean_x)
    weight = np.exp(-squared / breadth**2).sum() / (1.0 + (at - mean_x) @ spread)
    return effect, np.average(rewards[near], weights=outcome), np.average(terminated[near], weights=outcome), weight


def measured(n_copies, n, noise=0.0, order=None, seed=0):
    """The sums over transitions of a target that is so many copies of the source, and these transitions."""
    mapping = copies_mapping(n_copies, order)
    states, actions, effects = walk(mapping, n, seed)
    effects = effects + noise * np.random.default_rng(seed).normal(size=effects.shape)
    rows = copies_of_source(2, 2 * n_copies)
    copies = Copies([oscillator_source()], np.zeros(len(rows), dtype=np.int64), rows, np.ones_like(rows), 0.2)
    sums = CopySums.zero(len(copies), 3, mapping.copies[0].n_target_actions, 2 * n_copies)
    for state, action, effect in zip(states, actions.tolist(), effects, strict=True):
        copies.measure(state, action, effect, sums)
    return mapping, copies, sums, (states, actions, effects)


def predicted_by(copies, copy, source_action, states):
    """Effects that a copy with one source action predicts, computed one state after the other; NaN: not in the copy."""
    [source] = copies.sources
    row = copies.state[copy]
    used = np.unique(row[row >= 0])
    mask = source.actions == source_action
    units = source.scaling.to_unit(source.states)[mask][:, used]
    effects = (source.scaling.to_unit(source.next_states) - source.scaling.to_unit(source.states))[mask][:, used]
    found = np.full(states.shape, np.nan)
    for i, state in enumerate(states):
        at, nowhere = np.array([state[list(row).index(k)] for k in used]), np.zeros(len(units))
        effect, *_ = naive_prediction(units, effects, nowhere, nowhere, at, 0.2, 24, 0.05)
        for k, value in zip(used, effect, strict=True):
            found[i, list(row).index(k)] = value
    return found


def bound(transfer, d=4, n_actions=5, seed=0):
    return asking.bound(transfer, target_task(d, n_actions), seed)


def show(transfer, transitions, rewards=None, ends=None, own_error=None):
    """Let it observe transitions; the version after each; ``own_error``: of what own instances predict, None: nothing."""
    states, actions, effects = transitions
    versions = []
    for i, (state, action, effect) in enumerate(zip(states, actions.tolist(), effects, strict=True)):
        reward = -1.0 if rewards is None else float(rewards[i])
        transfer.note_prediction(effect + (own_error or 0.0), 0.0 if own_error is None else 1.0)
        transfer.observe(state, action, reward, state + effect, False if ends is None else bool(ends[i]))
        versions.append(transfer.prior_version())
    return versions


def inside(n, d, n_actions, seed=9):
    rng = np.random.default_rng(seed)
    return 0.25 + 0.5 * rng.random((n, d)), rng.integers(n_actions, size=n)
