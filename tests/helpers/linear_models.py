"""Local linear models, and what they are compared with: kernels, the definition in plain loops, a prior, linear dynamics."""

import numpy as np

from helpers.kernel_models import N_ACTIONS, UNEVEN_GRIDS, assert_same_row, make_grid, pairs_of, row_of, without_staying
from helpers.naive_local_linear import NaiveLocalLinear
from sb3_combrel.common.transferred import PriorPredictions
from sb3_combrel.models.base import ModelSettings
from sb3_combrel.models.local_linear import LocalLinear
from sb3_combrel.planning.mdp import FiniteMDP

ENDS_BY_ARRIVAL = [
    dict(breadth=0.3, min_weight=0.01, n_neighbors=5, outcome_breadth=0.05),
    dict(breadth=0.5, min_weight=0.05, n_neighbors=4, outcome_breadth=0.1),
    dict(breadth=0.8, min_weight=0.3, n_neighbors=12, outcome_breadth=2.0),
    dict(breadth=0.2, min_weight=0.05, n_neighbors=2, outcome_breadth=0.05),
]
LINEAR_KERNELS = [
    *ENDS_BY_ARRIVAL,
    dict(breadth=0.4, min_weight=0.05, n_neighbors=6, outcome_breadth=0.05, ends_by_action=True),
    dict(breadth=0.8, min_weight=0.3, n_neighbors=12, outcome_breadth=0.05, ends_by_action=True),
]

# As in ``kernel_models.GRIDS``, of a few points.
SMALL_GRIDS = [
    ((3,), 1),
    ((2, 2), 0),
    ((2, 1), 1),
    ((1, 1, 1), 0),
    ((3,), 1, (True,)),
    ((2, 2), 1, (True, False)),
    *UNEVEN_GRIDS,
]

# What a model has of each pair.
PAIRS = ("reach", "n_new", "length", "fitted_at", "weight", "known", "surprise")


def make_linear_model(grid, kernel, *, gamma=1.0, max_instances=None, prior=None, threshold=1.0, n_actions=N_ACTIONS):
    """A model on a finite MDP of its own; ``grid`` as in ``kernel_models.GRIDS``."""
    settings = ModelSettings(
        model_breadth=kernel["breadth"],
        min_weight=kernel["min_weight"],
        min_fraction=0.1,
        exploration_threshold=threshold,
        max_instances=max_instances,
        n_neighbors=kernel["n_neighbors"],
        outcome_breadth=kernel["outcome_breadth"],
        ends_by_action=kernel.get("ends_by_action", False),
    )
    return LocalLinear(FiniteMDP(make_grid(grid), n_actions, gamma), settings, prior)


def linear_model_and_definition(grid, kernel, *, prior=None, **kwargs):
    model = make_linear_model(grid, kernel, prior=prior, **kwargs)
    arguments = dict(threshold=model.exploration_threshold, max_instances=model.settings.max_instances)
    return model, NaiveLocalLinear(
        grid, kernel, model.n_actions, prior=None if prior is None else prior.as_naive(), **arguments
    )


def learn_linear(model, naive, transitions):
    """Add transitions to a model, whose rows are kept up to date, and to the definition."""
    for transition in transitions:
        model.update_rows(model.add(*transition))
        naive.add(*transition)


def finish_episode(model):
    model.update_rows(model.end_episode())


def assert_same_rows(model, naive):
    """The row of each pair is that of the definition from the transitions up to which it was fitted.

    :return: how many have a model
    """
    for action, point, pair in pairs_of(naive):
        now, gamma = int(model.pairs.fitted_at[pair]), model.mdp.gamma
        known = model.known[pair]
        assert model.mdp.arrays.modelled[pair] == known
        if now > 0:
            assert known == naive.known(action, point, now)
        if not known:
            assert row_of(model.mdp, point, action) == {}
            continue
        reward, successors, discount = naive.row(action, point, now, gamma)
        reward, successors = without_staying(reward, successors, point, discount)
        # A geometric series magnifies rounding.
        np.testing.assert_allclose(model.mdp.arrays.reward[point, action], reward, rtol=1e-6, atol=1e-8)
        assert_same_row(row_of(model.mdp, point, action), successors)
    return int(model.mdp.arrays.modelled.sum())


def assert_same_prediction(model, naive, state):
    """What is predicted of all actions at a state is that of the definition."""
    prediction, given = model.predict_at(state)
    assert given is None, "instances are asked of no prior"
    for action in range(naive.n_actions):
        expected = naive.at_state(state, action)
        np.testing.assert_allclose(prediction.weight[action], expected.weight, rtol=1e-9)
        assert prediction.modelled[action] == (expected.weight >= naive.threshold * (1.0 - 1e-12))
        np.testing.assert_allclose(prediction.reward[action], expected.reward, rtol=1e-9, atol=1e-9)
        predicts = expected.end < 1.0 and expected.weight > 0.0
        assert prediction.length[action] == (1 if predicts else 0)
        if predicts:
            np.testing.assert_allclose(prediction.probability[action, 0], 1.0 - expected.end, atol=1e-9)
            np.testing.assert_allclose(prediction.effect[action, 0], expected.effect, atol=1e-9)


def assert_same_to_the_last_bit(one, other):
    """Rows, pairs and predictions of two models."""
    for name in PAIRS:
        np.testing.assert_array_equal(getattr(one.pairs, name), getattr(other.pairs, name), err_msg=name)
    modelled = one.mdp.arrays.modelled
    np.testing.assert_array_equal(one.pairs.fit[modelled], other.pairs.fit[modelled], err_msg="fit")
    for name in ("length", "reward", "modelled", "n_optimistic"):
        np.testing.assert_array_equal(getattr(one.mdp.arrays, name), getattr(other.mdp.arrays, name), err_msg=name)
    used = np.arange(one.mdp.arrays.to.shape[-1]) < one.mdp.arrays.length[..., None]
    for name in ("to", "weight"):
        np.testing.assert_array_equal(getattr(one.mdp.arrays, name)[used], getattr(other.mdp.arrays, name)[used], err_msg=name)
    assert_same_predictions(one, other)


def assert_same_predictions(one, other):
    for state in np.random.default_rng(0).random((5, one.grid.n_variables)):
        (found, _), (expected, _) = one.predict_at(state), other.predict_at(state)
        for name in ("modelled", "weight", "reward", "length"):
            np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
        for action, n in enumerate(found.length.tolist()):
            np.testing.assert_array_equal(found.probability[action, :n], expected.probability[action, :n])
            np.testing.assert_array_equal(found.effect[action, :n], expected.effect[action, :n])


def assert_restored(model, restored, transitions):
    """``restored``, a new model, has what ``model`` has learned, and learns the same of some more transitions."""
    restored.set_state({name: array.copy() for name, array in model.get_state().items()})
    for name, array in restored.get_state().items():
        assert array.dtype == np.float64
        np.testing.assert_array_equal(array, model.get_state()[name], err_msg=name)
    assert_same_to_the_last_bit(model, restored)
    for transition in transitions:
        changed, same = model.add(*transition), restored.add(*transition)
        np.testing.assert_array_equal(changed, same)
        model.update_rows(changed)
        restored.update_rows(same)
    finish_episode(model)
    finish_episode(restored)
    assert_same_to_the_last_bit(model, restored)


def left_half(state, action):
    return 2.0 * (state[0] < 0.5)


def nothing(state, action):
    return 0.0


def renew(model, prior):
    """Have a model ask its prior again, and update the rows of what is known."""
    prior.version += 1
    changed = model.renew_prior()
    np.testing.assert_array_equal(np.sort(changed), np.flatnonzero(model.known))
    model.update_rows(changed)


class StubPrior:
    """A transfer method with ``use="prior"``, from functions of state and action.

    :param effect: function of (state, action)
    :param weight: function of (state, action): as how many own instances it counts, of the last variable half as many
    """

    use = "prior"

    def __init__(self, effect, weight=lambda state, action: 1.0):
        self.effect, self.weight = effect, weight
        self.version = 0

    def prior(self, states, actions):
        asked = list(zip(states, actions, strict=True))
        n, d = states.shape
        return PriorPredictions(
            effect=np.array([self.effect(state, int(action)) for state, action in asked]).reshape(n, d),
            weight=np.array([self.weights(state, int(action)) for state, action in asked]).reshape(n, d),
        )

    def weights(self, state, action):
        return self.weight(state, action) * np.append(np.ones(len(state) - 1), 0.5)

    def prior_version(self):
        return self.version

    def as_naive(self):
        """The same as a function for the definition."""
        return lambda state, action: (self.effect(state, action), self.weights(state, action))


class LinearDynamics:
    """One matrix an action: the effect is ``offset[action] + state @ matrix[action]``, small enough to stay near the box."""

    def __init__(self, seed, d, n_actions=N_ACTIONS, size=0.1):
        rng = np.random.default_rng(seed)
        self.matrix = rng.uniform(-size, size, (n_actions, d, d))
        self.offset = rng.uniform(-size, size, (n_actions, d))

    def effect(self, state, action):
        return self.offset[action] + state @ self.matrix[action]

    def transitions(self, states, reward=-1.0):
        """One transition of each action from each of some states."""
        return [(s, a, reward, s + self.effect(s, a), False) for s in states for a in range(len(self.matrix))]


class CurvedDynamics(LinearDynamics):
    """Effects that are not linear between the points of a grid."""

    def effect(self, state, action):
        return super().effect(state, action) + 0.05 * np.sin(9.0 * state[::-1] + action)


def small_steps(seed, d, n, ends=False):
    """Transitions whose effects are much smaller than a cell; a few end the episode."""
    rng = np.random.default_rng(seed)
    states = rng.random((n, d))
    effects = 0.03 * rng.normal(size=(N_ACTIONS, d)) + 0.05 * (states[:, None] - 0.5)
    return [(s, i % N_ACTIONS, -1.0, s + effects[i, i % N_ACTIONS], ends and i % 9 == 8) for i, s in enumerate(states)]
