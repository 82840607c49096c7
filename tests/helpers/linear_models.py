"""Local linear models, and what they are compared with: kernels, the definition in plain loops, a prior, linear dynamics."""

import numpy as np

from helpers.kernel_models import N_ACTIONS, assert_same_row, make_grid, pairs_of, row_of, without_staying
from helpers.naive_local_linear import NaiveLocalLinear
from sb3_combrel.common.transferred import PriorPredictions
from sb3_combrel.models.base import ModelSettings
from sb3_combrel.models.local_linear import LocalLinear
from sb3_combrel.planning.mdp import FiniteMDP

LINEAR_KERNELS = [
    dict(breadth=0.3, min_weight=0.01, n_neighbors=5, outcome_breadth=0.05),
    dict(breadth=0.5, min_weight=0.05, n_neighbors=4, outcome_breadth=0.1),
    dict(breadth=0.8, min_weight=0.3, n_neighbors=12, outcome_breadth=2.0),
    dict(breadth=0.2, min_weight=0.05, n_neighbors=2, outcome_breadth=0.05),
]

# As in ``kernel_models.GRIDS``, of a few points.
SMALL_GRIDS = [((3,), 1), ((2, 2), 0), ((2, 1), 1), ((1, 1, 1), 0), ((3,), 1, (True,)), ((2, 2), 1, (True, False))]

# What a model has of each pair, and of its effects.
LEARNED = ("sums", "outcome", "reach", "scale", "n_counted", "limit", "total", "known", "claimed", "prior", "effect_range")


def make_linear_model(
    grid, kernel, *, gamma=1.0, max_instances=None, prior=None, threshold=1.0, n_actions=N_ACTIONS, max_model_steps=1
):
    """A model on a finite MDP of its own; ``grid`` as in ``kernel_models.GRIDS``."""
    settings = ModelSettings(
        model_breadth=kernel["breadth"],
        min_weight=kernel["min_weight"],
        min_fraction=0.1,
        exploration_threshold=threshold,
        max_instances=max_instances,
        n_neighbors=kernel["n_neighbors"],
        outcome_breadth=kernel["outcome_breadth"],
        max_model_steps=max_model_steps,
    )
    return LocalLinear(FiniteMDP(make_grid(grid), n_actions, gamma), settings, prior)


def linear_model_and_definition(grid, kernel, *, threshold=1.0, prior=None, max_model_steps=1, **kwargs):
    model = make_linear_model(grid, kernel, threshold=threshold, prior=prior, max_model_steps=max_model_steps, **kwargs)
    naive = NaiveLocalLinear(
        grid,
        kernel,
        model.n_actions,
        threshold=threshold,
        prior=None if prior is None else prior.as_naive(threshold),
        max_model_steps=max_model_steps,
    )
    return model, naive


def learn_linear(model, naive, transitions):
    """Add transitions to a model, whose rows are kept up to date, and to the definition."""
    for transition in transitions:
        model.update_rows(model.add(*transition))
        naive.add(*transition)


def finish_episode(model):
    model.update_rows(model.end_episode())


def assert_same_sums(model, naive):
    """The sums of all pairs are those of the instances within the reach of each."""
    reach, n_counted = (array.reshape(naive.known.shape) for array in (model.fits.reach, model.fits.n_counted))
    np.testing.assert_allclose(reach, naive.reach, rtol=1e-12)
    for action, point, pair in pairs_of(naive):
        sums, outcome = naive.sums(action, point)
        assert n_counted[action, point] == len(naive.counted(action, point))
        np.testing.assert_allclose(model.fits.sums[pair], sums, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(model.fits.outcome[pair], outcome, rtol=1e-9, atol=1e-9)


def assert_same_fits(model, naive, gamma=1.0):
    """All modelled pairs, and none else, have the prediction and the row of the definition.

    :return: how many these are
    """
    n_modelled = 0
    for action, point, pair in pairs_of(naive):
        modelled = naive.known[action, point] or naive.claimed(action, point)
        assert model.mdp.arrays.modelled[pair] == modelled
        if not modelled:
            assert row_of(model.mdp, point, action) == {}
            continue
        expected = naive.at_pair(action, point)
        prediction = [*expected.effect, expected.reward, expected.end]
        np.testing.assert_allclose(model.fits.row[pair], prediction, rtol=1e-7, atol=1e-8)
        *row, steps = naive.row(action, point, gamma)
        reward, successors = without_staying(*row, point, gamma**steps)
        # A geometric series magnifies rounding.
        np.testing.assert_allclose(model.mdp.arrays.reward[pair], reward, rtol=1e-5, atol=1e-7)
        assert_same_row(row_of(model.mdp, point, action), successors)
        n_modelled += 1
    return n_modelled


def assert_same_prediction(model, naive, state):
    """What is predicted of all actions at a state is that of the definition."""
    prediction, _ = model.predict_at(state)
    for action in range(naive.n_actions):
        expected, claimed = naive.at_state(state, action), naive.prior_at(state, action)[3]
        assert abs(prediction.weight[action] - expected.weight) <= 1e-9 * expected.weight
        assert prediction.modelled[action] == (claimed or expected.weight >= naive.threshold)
        if not claimed and expected.weight == 0.0:
            assert prediction.length[action] == 0 and prediction.reward[action] == 0.0
            continue
        np.testing.assert_allclose(prediction.reward[action], expected.reward, atol=1e-9)
        assert prediction.length[action] == (1 if expected.end < 1.0 else 0)
        if expected.end < 1.0:
            np.testing.assert_allclose(prediction.probability[action, 0], 1.0 - expected.end, atol=1e-9)
            np.testing.assert_allclose(prediction.effect[action, 0], expected.effect, rtol=1e-7, atol=1e-8)


def assert_same_to_the_last_bit(one, other):
    for name in LEARNED:
        np.testing.assert_array_equal(getattr(one.fits, name), getattr(other.fits, name), err_msg=name)
    np.testing.assert_array_equal(one.instances.rows(), other.instances.rows())
    modelled = one.known | one.fits.claimed
    for name in ("fit", "row", "unexplained"):
        of_one, of_other = getattr(one.fits, name), getattr(other.fits, name)
        np.testing.assert_array_equal(of_one[modelled], of_other[modelled], err_msg=name)
    for name in ("modelled", "reward"):
        np.testing.assert_array_equal(getattr(one.mdp.arrays, name), getattr(other.mdp.arrays, name), err_msg=name)
    assert all(row_of(one.mdp, pair) == row_of(other.mdp, pair) for pair in range(len(one.known)))
    for state in np.random.default_rng(0).random((5, one.grid.n_variables)):
        for array, same in zip(one.predict_at(state)[0], other.predict_at(state)[0], strict=True):
            np.testing.assert_array_equal(array, same)


def assert_restored(model, restored, transitions):
    """``restored`` has what ``model`` has learned, and learns the same of some more transitions."""
    finish_episode(model)
    saved = model.get_state()
    restored.set_state({name: array.copy() for name, array in saved.items()})
    assert saved.keys() == restored.get_state().keys()
    for name, array in restored.get_state().items():
        assert array.dtype == np.float64
        np.testing.assert_array_equal(array, saved[name], err_msg=name)
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
    return state[0] < 0.5


def nothing(state, action):
    return False


def renew(model, prior):
    """Have a model ask its prior again, and update all rows."""
    prior.version += 1
    changed = model.renew_prior()
    np.testing.assert_array_equal(np.sort(changed), np.arange(len(model.known)))
    model.update_rows(changed)


class StubPrior:
    """A transfer method with ``use="prior"``, from functions of state and action.

    :param effect: function of (state, action)
    :param claims: function of (state, action): whether to claim to know
    """

    use = "prior"

    def __init__(self, effect, claims=lambda state, action: True, reward=-1.0, end=0.0):
        self.effect, self.claims, self.reward, self.end = effect, claims, reward, end
        self.version = 0

    def prior(self, states, actions):
        asked = list(zip(states, actions, strict=True))
        n, d = states.shape
        return PriorPredictions(
            effect=np.array([self.effect(state, int(action)) for state, action in asked]).reshape(n, d),
            reward=np.full(n, self.reward),
            end=np.full(n, self.end),
            weight=np.array([100.0 if self.claims(state, int(action)) else 0.0 for state, action in asked]),
        )

    def prior_version(self):
        return self.version

    def as_naive(self, threshold):
        """The same as a function for the definition."""
        return lambda state, action: (self.effect(state, action), self.reward, self.end, bool(self.claims(state, action)))


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
