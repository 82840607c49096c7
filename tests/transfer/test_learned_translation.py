"""Learned translations: what the two methods share, and each of their parts against plain computations."""

import inspect

import numpy as np
import pytest
from helpers import factored as f
from helpers.asking import bound, changed_pairs, transferred_to_pairs
from helpers.naive_transfer import random_source, target_task
from helpers.ring import Ring
from helpers.walk import Walk, learnt_on, same_parameters, small, walk_source
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes

from sb3_combrel import (
    TIMBREL,
    FittedRMax,
    InterTaskMapping,
    SoftHomomorphism,
    SourceInstances,
    SparseCodingMapping,
    ThreeWayRBM,
)
from sb3_combrel.transfer.methods.learned_translation import LearnedTranslation, Standard, Triplets
from sb3_combrel.transfer.methods.sparse_coding import fit_regression, sparse_codes

METHODS = [SparseCodingMapping, ThreeWayRBM]
QUICK = {SparseCodingMapping: {"n_atoms": 8}, ThreeWayRBM: {"n_updates": 50, "n_hidden": 4, "n_factors": 4}}


def quick(method, source, n=20, **arguments):
    """A method that takes a fraction of a second."""
    return method(source, n_random_steps=n, n_source_samples=40, **{**QUICK[method], **arguments})


class Swapping(LearnedTranslation):
    """Knows that the target's two variables are the source's in the other order, and its actions too."""

    def learn_translation(self, source, target, instances):
        self.given = source, target
        n = self.task.n_actions
        return Triplets(instances.state[:, ::-1], n - 1 - instances.action, instances.effect[:, ::-1])


def observe(method, transitions):
    for state, action, effect in zip(*transitions, strict=True):
        method.observe(state, int(action), -1.0, state + effect, False)


def random_transitions(n, d, n_actions, seed=0):
    rng = np.random.default_rng(seed)
    return rng.random((n, d)), rng.integers(n_actions, size=n), 0.1 * rng.normal(size=(n, d))


def test_triplets_and_columns_are_each_other():
    states, actions, effects = random_transitions(9, 2, 4)
    columns = Triplets(states, actions, effects).columns(4)
    for row, state, action, effect in zip(columns, states, actions, effects, strict=True):
        assert row.tolist() == [*state, *[float(a == action) for a in range(4)], *effect]
    # Of columns that are predicted the largest decides.
    blurred = columns + 0.2 * np.random.default_rng(1).random(columns.shape)
    blurred[:, [0, 1, 6, 7]] = columns[:, [0, 1, 6, 7]]
    for ours, theirs in zip(Triplets.of_columns(blurred, 4), (states, actions, effects), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_standardised_columns_have_mean_0_and_deviation_1_or_do_not_vary():
    rows = np.random.default_rng(0).normal(3.0, 2.0, size=(50, 3))
    rows[:, 1] = 7.0
    standard = Standard.of(rows)
    found = standard.to(rows)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(found.std(axis=0), [1.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(standard.back(found), rows)


def test_with_the_right_mapping_it_is_timbrel_with_that_mapping():
    """Two permuted variables: the instances transferred, nearest first until the threshold, are those of TIMBREL."""
    source = f.oscillator_source(200)
    task = target_task(np.random.default_rng(0).random((15, 2)), 3)
    ours = bound(Swapping(source, n_random_steps=10, breadth=0.2), task)
    theirs = bound(TIMBREL(source, InterTaskMapping([1, 0], [2, 1, 0]), breadth=0.2), task)
    states, actions, effects = random_transitions(10, 2, 3)
    # Effects of the source are within those seen.
    effects[:2] = [[-0.5, -0.5], [0.5, 0.5]]
    observe(ours, (states, actions, effects))
    pairs, own = np.arange(45), np.linspace(0.0, 1.2, 45)
    inside = np.flatnonzero((source.scaling.to_unit(source.next_states) <= 1.0).all(axis=1))
    assert len(inside) > 150
    one, other = (transferred_to_pairs(method, pairs, own) for method in (ours, theirs))
    np.testing.assert_array_equal(one.length, other.length)
    assert (one.length > 0).sum() > 20
    for row, n in enumerate(one.length[:45]):
        for name in ("weight", "reward", "terminated"):
            np.testing.assert_allclose(getattr(one, name)[row, :n], getattr(other, name)[row, :n], atol=1e-9)
        # States beyond the target's box do not occur in it.
        np.testing.assert_allclose(one.effect[row, :n], other.effect[row, :n], atol=0.1)


def test_it_samples_first_then_translates_once():
    source = random_source(np.random.default_rng(0), 60, 2, 3)
    task = target_task(np.random.default_rng(0).random((5, 2)), 3)
    method = bound(Swapping(source, n_random_steps=12, n_source_samples=40), task)
    states, actions, effects = random_transitions(30, 2, 3)
    observe(method, (states[:11], actions[:11], effects[:11]))
    assert method.translated is None and method.statistics()["transfer/mapping_found"] == 0.0
    assert len(changed_pairs(method)) == 0
    assert transferred_to_pairs(method, np.arange(15), np.zeros(15)).length.tolist() == [0] * 15
    observe(method, (states[11:12], actions[11:12], effects[11:12]))
    assert len(changed_pairs(method)) == 15
    assert len(changed_pairs(method)) == 0
    of_source, of_target = method.given
    assert [len(of_source.state), len(of_target.state)] == [40, 12]
    np.testing.assert_array_equal(of_target.state, states[:12])
    np.testing.assert_array_equal(of_target.action, actions[:12])
    np.testing.assert_allclose(of_target.effect, effects[:12])
    drawn = {tuple(row) for row in of_source.state}
    assert len(drawn) == 40 and drawn <= {tuple(row) for row in source.scaling.to_unit(source.states)}
    before = method.translated
    observe(method, (states[12:], actions[12:], effects[12:]))
    assert method.translated is before and method.mapping_steps() == 12
    np.testing.assert_array_equal(before.rewards, source.rewards)
    np.testing.assert_array_equal(before.terminated, source.terminated)
    found = method.statistics()
    assert found["transfer/steps_to_find_mapping"] == 12 and found["transfer/mapping_found"] == 1.0
    swapped = np.clip(source.scaling.to_unit(source.states), 0.0, 1.0)[:, ::-1]
    expected = (swapped.std(axis=0) / states[:12].std(axis=0)).mean()
    assert found["transfer/translated_spread"] == pytest.approx(expected)


def test_translated_instances_stay_in_the_targets_box_and_within_the_effects_seen():
    source = random_source(np.random.default_rng(1), 80, 2, 3, spread=1.5)
    task = target_task(np.random.default_rng(0).random((5, 2)), 3)
    method = bound(Swapping(source, n_random_steps=10), task)
    states, actions, effects = random_transitions(10, 2, 3)
    observe(method, (states, actions, effects))
    units = task.scaling.to_unit(method.translated.states), task.scaling.to_unit(method.translated.next_states)
    assert min(each.min() for each in units) >= 0.0 and max(each.max() for each in units) <= 1.0
    moved = units[1] - units[0]
    assert (moved >= np.minimum(effects.min(axis=0), 0.0) - 1e-9).all()
    assert (moved <= np.maximum(effects.max(axis=0), 0.0) + 1e-9).all()


@pytest.mark.parametrize("method", METHODS)
def test_actions_are_random_until_the_sample_is_complete(method):
    made = bound(quick(method, f.oscillator_source(60)), f.target_task(2, 3))
    states, actions, effects = random_transitions(20, 2, 3)
    asked = [made.action(states[0]) for _ in range(300)]
    assert np.bincount(asked, minlength=3).min() > 60 and len(np.bincount(asked)) == 3
    assert all(type(action) is int for action in asked)
    observe(made, (states[:19], actions[:19], effects[:19]))
    assert made.action(states[0]) in (0, 1, 2)
    observe(made, (states[19:], actions[19:], effects[19:]))
    assert made.action(states[0]) is None


@pytest.mark.parametrize("method", METHODS)
def test_the_same_seed_gives_the_same_translation(method):
    made = [bound(quick(method, f.oscillator_source(60)), f.target_task(2, 3), seed) for seed in (0, 0, 1)]
    for each in made:
        observe(each, random_transitions(20, 2, 3))
    first, same, other = (each.get_state() for each in made)
    assert all(np.array_equal(first[name], same[name]) for name in first)
    assert not np.array_equal(first["translated"], other["translated"])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("n", [0, 7, 20, 35])
def test_what_is_restored_transfers_and_goes_on_as_if_nothing_had_happened(method, n):
    transitions = random_transitions(50, 2, 3)
    task = target_task(np.random.default_rng(0).random((6, 2)), 3)
    one = bound(quick(method, f.oscillator_source(60)), task)
    observe(one, [column[:n] for column in transitions])
    again = bound(type(one)(**one.arguments()), task, seed=9)
    assert {name: array.shape[1:] for name, array in again.get_state().items()} == {
        name: array.shape[1:] for name, array in one.get_state().items()
    }
    again.set_state(one.get_state())
    again.rng.bit_generator.state = one.rng.bit_generator.state
    for _ in range(2):
        for name, array in one.get_state().items():
            np.testing.assert_array_equal(array, again.get_state()[name])
        both = [transferred_to_pairs(each, np.arange(18), np.zeros(18)) for each in (one, again)]
        np.testing.assert_array_equal(both[0].length, both[1].length)
        for row, k in enumerate(both[0].length[:18]):
            for ours, theirs in zip(both[0][1:], both[1][1:], strict=True):
                np.testing.assert_array_equal(ours[row, :k], theirs[row, :k])
        for each in (one, again):
            observe(each, [column[n:] for column in transitions])
    # Seconds are measured, not restored.
    figures = [each.statistics() for each in (one, again)]
    assert {**figures[0], "transfer/mapping_seconds": 0.0} == pytest.approx(
        {**figures[1], "transfer/mapping_seconds": 0.0}, nan_ok=True
    )


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("steps", [15, 60])
def test_a_model_is_saved_and_loaded_with_it(method, steps, tmp_path):
    path = walk_source().save(tmp_path / "source.npz")
    arguments = {"source": str(path), "n_random_steps": 20, "breadth": 0.2, **QUICK[method]}
    model = small(transfer={f"sb3_combrel.{method.__name__}": arguments}).learn(steps)
    model.save(tmp_path / "model")
    path.unlink()
    loaded = FittedRMax.load(tmp_path / "model", env=Walk())
    assert type(loaded.policy.transfer) is method and loaded.policy.transfer.breadth == 0.2
    assert same_parameters(model, loaded)
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded.policy.transfer.statistics()["transfer/mapping_found"] == 1.0


RESUMED = {
    "SparseCodingMapping": lambda: quick(SparseCodingMapping, walk_source()),
    "ThreeWayRBM": lambda: quick(ThreeWayRBM, walk_source()),
    "SoftHomomorphism": lambda: SoftHomomorphism(walk_source(), n_starts=2),
}


@pytest.mark.parametrize("name", RESUMED)
def test_learning_goes_on_to_the_last_bit(name, tmp_path):
    """Saved at an episode's end, a loaded model learns what the model itself learns when it learns on."""
    model, loaded = learnt_on(
        small(transfer=RESUMED[name]()).learn(10**6, callback=StopTrainingOnMaxEpisodes(3)), tmp_path, 80
    )
    assert same_parameters(model, loaded)
    assert model.agent.model.n_instances > 100


def test_it_learns_with_instances_translated_by_the_right_mapping():
    """The walk's line is its source's, its variables and actions swapped: pairs are modelled by what was translated."""
    source = walk_source()
    columns = {name: getattr(source, name)[:, ::-1] for name in ("states", "next_states")}
    swapped = SourceInstances(**columns, actions=1 - source.actions, rewards=source.rewards, terminated=source.terminated,
                              low=source.low[::-1], high=source.high[::-1], n_actions=2)  # fmt: skip
    models = [small(transfer=Swapping(swapped, n_random_steps=n, breadth=0.15)).learn(12) for n in (10, 20)]
    assert models[0].agent.statistics()["model/transferred"] > 0.1
    assert models[1].agent.statistics()["model/transferred"] == 0.0


BAD_ARGUMENTS = [
    ("n_random_steps", 9),
    ("n_random_steps", 1e3),
    ("n_source_samples", 0),
    ("breadth", 0.0),
    ("breadth", np.nan),
    ("breadth_decay", 1.1),
    ("transfer_terminals", 1),
]
BAD_OF_ONE = [
    (SparseCodingMapping, "n_atoms", 0),
    (SparseCodingMapping, "sparsity", 0.0),
    (ThreeWayRBM, "n_hidden", 0),
    (ThreeWayRBM, "n_factors", None),
    (ThreeWayRBM, "n_updates", -1),
]


@pytest.mark.parametrize(("method", "name", "value"), [(m, *bad) for m in METHODS for bad in BAD_ARGUMENTS] + BAD_OF_ONE)
def test_an_argument_out_of_its_range_is_refused_by_name_and_value(method, name, value):
    with pytest.raises(ValueError, match=f"{name} must be .*, got {value!r}"):
        method(f.oscillator_source(60), **{name: value})


@pytest.mark.parametrize("method", METHODS)
def test_what_does_not_fit_is_refused_when_learning_starts(method):
    name = method.__name__
    source = f.oscillator_source(60)
    with pytest.raises(ValueError, match=f"source must be one source with {name}, got 2"):
        bound(method([source, source]), f.target_task(2, 3))
    with pytest.raises(ValueError, match=f"{name} does not support periodic state variables, .*of the target"):
        FittedRMax(Ring(), transfer=method(source), periodic=[True, False], resolution=3)
    around = SourceInstances(
        **{field: getattr(source, field) for field in inspect.signature(SourceInstances).parameters if field != "periodic"},
        periodic=(True, False),
    )
    with pytest.raises(ValueError, match=r"periodic=\(True, False\) of the source; give both tasks"):
        bound(method(around), f.target_task(2, 3))


@pytest.mark.parametrize("method", METHODS)
def test_a_sample_in_which_nothing_happens_is_no_error(method):
    made = bound(quick(method, f.oscillator_source(60)), f.target_task(2, 3))
    observe(made, (np.full((20, 2), 0.5), np.zeros(20, int), np.zeros((20, 2))))
    np.testing.assert_allclose(made.translated.states, 0.5, atol=0.01)
    np.testing.assert_array_equal(made.translated.states, made.translated.next_states)


def test_codes_are_the_best_for_their_dictionary():
    """At the minimum of |x - code D|^2 / 2 + sparsity |code|_1 the gradient is balanced by the sparsity, entry by entry."""
    rng = np.random.default_rng(0)
    source, target = rng.normal(size=(60, 7)), rng.normal(size=(40, 5))
    found = sparse_codes(source, target, 9, 0.3, seed=0)
    assert found.source.shape == (60, 9) and found.target.shape == (40, 9) and found.dictionary.shape == (9, 5)
    gradient = (found.target @ found.dictionary - target) @ found.dictionary.T
    on = np.abs(found.target) > 1e-9
    assert 0.1 < on.mean() < 0.9
    np.testing.assert_allclose(gradient[on], -0.3 * np.sign(found.target[on]), atol=5e-3)
    assert np.abs(gradient[~on]).max() <= 0.3 + 5e-3


def test_from_the_right_pairs_the_regression_recovers_two_permuted_variables():
    rng = np.random.default_rng(0)
    source, unseen = rng.normal(size=(80, 2)), rng.normal(size=(40, 2))
    regression = fit_regression(source, source[:, ::-1], seed=0)
    np.testing.assert_allclose(regression.predict(unseen), unseen[:, ::-1], atol=0.05)
