"""The factored three-way restricted Boltzmann machine, against sums over all weights and all hidden states."""

from itertools import product

import numpy as np
import pytest
import torch as th

from sb3_combrel.transfer.methods import three_way_rbm as machines

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


def test_the_free_energy_sums_over_all_hidden_states():
    machine, (source, target) = some_machine(), some_units()
    expected = [naive_free_energy(machine, *rows) for rows in zip(source, target, strict=True)]
    np.testing.assert_allclose(machines.free_energy(machine, *tensors(source, target)).numpy(), expected)


def test_hidden_units_are_on_with_the_probability_that_the_energies_give():
    machine, (source, target) = some_machine(), some_units()
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


def test_the_gradient_is_that_of_contrastive_divergence():
    """Mean over the data of dE/dweight with hidden units at their probabilities, less that over the reconstructions."""
    source, target = some_units()
    machine = machines.Machine(*(each.requires_grad_() for each in some_machine()))
    machines.contrastive_divergence(machine, *tensors(source, target), th.Generator().manual_seed(3)).backward()
    with th.no_grad():
        generator = th.Generator().manual_seed(3)
        on = th.sigmoid(machines.hidden_input(machine, *tensors(source, target)))
        drawn = (th.rand(on.shape, generator=generator, dtype=th.float64) < on).double()
        again = machines.target_mean(machine, th.from_numpy(source), drawn).numpy()
    expected = [np.zeros(each.shape) for each in machine]
    for sign, of_target in ((1.0, target), (-1.0, again)):
        with th.no_grad():
            on = th.sigmoid(machines.hidden_input(machine, *tensors(source, of_target))).numpy()
        for row in range(6):
            add_slopes(expected, machine, sign / 6.0, (source[row], on[row], of_target[row]))
    for ours, theirs in zip(machine, expected, strict=True):
        np.testing.assert_allclose(ours.grad.numpy(), theirs, atol=1e-12)


def add_slopes(slopes, machine, times, units):
    """Add ``times`` the derivatives of the energy by the parameters, which is linear in the hidden units."""
    _, hidden, target = units
    weights = [each.detach().numpy() for each in machine]
    by = [units[n] @ weights[n] for n in range(3)]
    for n, others in enumerate(((1, 2), (0, 2), (0, 1))):
        for i, f in product(range(SIZES[n]), range(N_FACTORS)):
            slopes[n][i, f] -= times * units[n][i] * by[others[0]][f] * by[others[1]][f]
    slopes[3] -= times * hidden
    slopes[4] -= times * (target - weights[4])


def test_from_pairs_that_belong_together_it_recovers_two_permuted_variables():
    rng = np.random.default_rng(0)
    source, unseen = rng.normal(size=(200, 2)), rng.normal(size=(50, 2))
    sizes = dict(n_hidden=8, n_factors=8, n_updates=1500, seed=0)
    machine = machines.train(source, source[:, ::-1].copy(), paired=True, **sizes)
    found = machines.reconstruct(machine, unseen)
    assert ((found - unseen[:, ::-1]) ** 2).mean() < 0.02
    # With the pairs of the samples unknown there is nothing to be recovered.
    machine = machines.train(source, source[:, ::-1].copy(), **sizes)
    assert ((machines.reconstruct(machine, unseen) - unseen[:, ::-1]) ** 2).mean() > 0.5


def test_training_depends_on_its_seed_alone_and_leaves_pytorchs_generator_and_threads_alone():
    source, target = some_units(30)
    state, threads = th.get_rng_state(), th.get_num_threads()
    made = [machines.train(source, target, n_hidden=3, n_factors=3, n_updates=20, seed=seed) for seed in (0, 0, 1)]
    assert th.equal(th.get_rng_state(), state) and th.get_num_threads() == threads
    assert all(th.equal(one, same) for one, same in zip(made[0], made[1], strict=True))
    assert not th.equal(made[0].source, made[2].source)


@pytest.mark.parametrize("n", [1, 7])
def test_a_reconstruction_is_a_fixed_point_of_its_iterations_where_weights_are_small(n):
    machine = machines.Machine(*(0.3 * each for each in some_machine()))
    source = some_units(n)[0]
    found = machines.reconstruct(machine, source)
    units, target = tensors(source, found)
    again = machines.target_mean(machine, units, th.sigmoid(machines.hidden_input(machine, units, target)))
    np.testing.assert_allclose(found, again.numpy(), atol=1e-9)
