"""Learned translations: what they share, sparse codes, and the three-way machine, against plain computations."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch as th
from helpers import factored as f
from helpers.asking import bound, changed_pairs, transferred_to_pairs
from helpers.naive_transfer import random_source, target_task
from helpers.ring import Ring

from sb3_combrel import TIMBREL, FittedRMax, InterTaskMapping, SparseCodingMapping, ThreeWayRBM
from sb3_combrel.transfer.methods import three_way_rbm as machines
from sb3_combrel.transfer.methods.learned_translation import LearnedTranslation, Standard, triplets
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
        states, actions, effects = np.split(instances, [2, instances.shape[1] - 2], axis=1)
        return np.hstack([states[:, ::-1], actions[:, ::-1], effects[:, ::-1]])


def observe(method, transitions):
    for state, action, effect in zip(*transitions, strict=True):
        method.observe(state, int(action), -1.0, state + effect, False)


def random_transitions(n, d, n_actions, seed=0):
    rng = np.random.default_rng(seed)
    return rng.random((n, d)), rng.integers(n_actions, size=n), 0.1 * rng.normal(size=(n, d))


def test_a_triplet_has_a_column_for_each_action():
    states, actions, effects = random_transitions(9, 2, 4)
    for row, state, action, effect in zip(triplets(states, actions, effects, 4), states, actions, effects, strict=True):
        assert row.tolist() == [*state, *[float(a == action) for a in range(4)], *effect]


def test_of_the_columns_of_actions_the_largest_decides():
    class Blurring(Swapping):
        def learn_translation(self, source, target, instances):
            found = super().learn_translation(source, target, instances)
            found[:, 2:5] += 0.2 * np.random.default_rng(1).random((len(found), 3))
            return found

    source = random_source(np.random.default_rng(0), 60, 2, 3)
    task = target_task(np.random.default_rng(0).random((5, 2)), 3)
    made = [bound(method(source, n_random_steps=12), task) for method in (Swapping, Blurring)]
    for method in made:
        observe(method, random_transitions(12, 2, 3))
    np.testing.assert_array_equal(made[0].translated.actions, 2 - source.actions)
    np.testing.assert_array_equal(made[1].translated.actions, made[0].translated.actions)


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
    source, task = f.oscillator_source(200), target_task(np.random.default_rng(0).random((15, 2)), 3)
    ours = bound(Swapping(source, n_random_steps=10, breadth=0.2), task)
    theirs = bound(TIMBREL(source, InterTaskMapping([1, 0], [2, 1, 0]), breadth=0.2), task)
    states, actions, effects = random_transitions(10, 2, 3)
    # Effects of the source are within those seen.
    effects[:2] = [[-0.5, -0.5], [0.5, 0.5]]
    observe(ours, (states, actions, effects))
    pairs, own = np.arange(45), np.linspace(0.0, 1.2, 45)
    assert len(np.flatnonzero((source.scaling.to_unit(source.next_states) <= 1.0).all(axis=1))) > 150
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
    assert [len(changed_pairs(method)) for _ in range(2)] == [15, 0]
    of_source, of_target = method.given
    assert [len(of_source), len(of_target)] == [40, 12]
    np.testing.assert_allclose(of_target, triplets(states[:12], actions[:12], effects[:12], 3))
    drawn = {tuple(row) for row in of_source[:, :2]}
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
def test_periodic_variables_are_refused(method):
    source = f.oscillator_source(60)
    with pytest.raises(ValueError, match=f"{method.__name__} does not support periodic state variables, .*of the target"):
        FittedRMax(Ring(), transfer=method(source), periodic=[True, False], resolution=3)
    with pytest.raises(ValueError, match=r"periodic=\(True, False\) of the source; give both tasks"):
        bound(method(replace(source, periodic=(True, False))), f.target_task(2, 3))


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


SIZES = 3, 4, 2
N_FACTORS = 5


def some_machine(seed=0):
    """A machine with weights of any size, and biases."""
    rng = np.random.default_rng(seed)
    shapes = [(n, N_FACTORS) for n in SIZES] + [(SIZES[1],), (SIZES[2],)]
    return machines.Machine(*(th.from_numpy(0.5 * rng.normal(size=shape)) for shape in shapes))


def some_units(n=6, seed=1):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, SIZES[0])), rng.normal(size=(n, SIZES[2]))


def naive_energy(machine, source, hidden, target):
    """The energy with the whole tensor of weights, one unit after the other."""
    w_source, w_hidden, w_target, hidden_bias, target_bias = (each.detach().numpy() for each in machine)
    energy = 0.0
    for i, j, k in product(*map(range, SIZES)):
        weight = sum(w_source[i, f] * w_hidden[j, f] * w_target[k, f] for f in range(N_FACTORS))
        energy -= weight * source[i] * hidden[j] * target[k]
    energy -= sum(hidden[j] * hidden_bias[j] for j in range(SIZES[1]))
    return energy + sum((target[k] - target_bias[k]) ** 2 / 2.0 for k in range(SIZES[2]))


def all_hidden():
    return [np.array(state, dtype=float) for state in product((0, 1), repeat=SIZES[1])]


def naive_free_energy(machine, source, target):
    return -np.log(sum(np.exp(-naive_energy(machine, source, hidden, target)) for hidden in all_hidden()))


def tensors(*arrays):
    return [th.from_numpy(np.asarray(each, dtype=float)) for each in arrays]


def test_the_free_energy_and_hidden_units_are_those_that_all_hidden_states_give():
    machine, (source, target) = some_machine(), some_units()
    expected = [naive_free_energy(machine, *rows) for rows in zip(source, target, strict=True)]
    np.testing.assert_allclose(machines.free_energy(machine, *tensors(source, target)).numpy(), expected)
    found = th.sigmoid(machines.hidden_input(machine, *tensors(source, target))).numpy()
    for row in range(6):
        weights = [np.exp(-naive_energy(machine, source[row], hidden, target[row])) for hidden in all_hidden()]
        expected = sum(w * hidden for w, hidden in zip(weights, all_hidden(), strict=True)) / sum(weights)
        np.testing.assert_allclose(found[row], expected)


def test_the_mean_of_the_target_units_is_where_the_energy_is_least():
    machine, (source, _) = some_machine(), some_units()
    hidden = np.random.default_rng(2).integers(2, size=(6, SIZES[1])).astype(float)
    found = machines.target_mean(machine, *tensors(source, hidden)).numpy()
    for row in range(6):
        least = naive_energy(machine, source[row], hidden[row], found[row])
        for k in range(SIZES[2]):
            moved = [found[row] + step * np.eye(SIZES[2])[k] for step in (-0.1, 0.1)]
            rises = [naive_energy(machine, source[row], hidden[row], each) - least for each in moved]
            np.testing.assert_allclose(rises, 0.005)


def test_contrastive_divergence_is_the_mean_free_energy_of_the_data_less_that_of_reconstructions_which_are_data_as_well():
    source, target = some_units()
    machine = machines.Machine(*(each.requires_grad_() for each in some_machine()))
    found = machines.contrastive_divergence(machine, *tensors(source, target), th.Generator().manual_seed(3))
    on = th.sigmoid(machines.hidden_input(machine, *tensors(source, target)))
    drawn = (th.rand(on.shape, generator=th.Generator().manual_seed(3), dtype=th.float64) < on).double()
    again = machines.target_mean(machine, th.from_numpy(source), drawn).detach()
    energies = [naive_free_energy(machine, *rows) for rows in zip(source, target, strict=True)]
    energies += [-naive_free_energy(machine, *rows) for rows in zip(source, again.numpy(), strict=True)]
    assert found.item() == pytest.approx(sum(energies) / 6)
    each = [machines.free_energy(machine, th.from_numpy(source), to) for to in (th.from_numpy(target), again)]
    expected = th.autograd.grad((each[0] - each[1]).mean(), machine)
    for ours, theirs in zip(th.autograd.grad(found, machine), expected, strict=True):
        np.testing.assert_allclose(ours.numpy(), theirs.numpy(), atol=1e-12)


def test_from_pairs_that_belong_together_it_recovers_two_permuted_variables():
    rng = np.random.default_rng(0)
    source, unseen = rng.normal(size=(200, 2)), rng.normal(size=(50, 2))
    sizes, errors = dict(n_hidden=8, n_factors=8, seed=0), []
    for paired, n_updates in ((True, 800), (False, 100)):
        machine = machines.train(source, source[:, ::-1].copy(), paired=paired, n_updates=n_updates, **sizes)
        errors.append(((machines.reconstruct(machine, unseen) - unseen[:, ::-1]) ** 2).mean())
    # With the pairs of the samples unknown there is nothing to be recovered.
    assert errors[0] < 0.02 and errors[1] > 0.5


def test_training_depends_on_its_seed_alone_and_leaves_pytorchs_generator_and_threads_alone():
    source, target = some_units(30)
    state, threads = th.get_rng_state(), th.get_num_threads()
    made = [machines.train(source, target, n_hidden=3, n_factors=3, n_updates=20, seed=seed) for seed in (0, 0, 1)]
    assert th.equal(th.get_rng_state(), state) and th.get_num_threads() == threads
    assert all(th.equal(one, same) for one, same in zip(made[0], made[1], strict=True))
    assert not th.equal(made[0].source, made[2].source)


@pytest.mark.parametrize("n", [1, 7])
def test_a_reconstruction_is_a_fixed_point_of_its_iterations_where_weights_are_small(n):
    machine, source = machines.Machine(*(0.3 * each for each in some_machine())), some_units(n)[0]
    found = machines.reconstruct(machine, source)
    units, target = tensors(source, found)
    again = machines.target_mean(machine, units, th.sigmoid(machines.hidden_input(machine, units, target)))
    np.testing.assert_allclose(found, again.numpy(), atol=1e-9)
