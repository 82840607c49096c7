"""Factored three-way restricted Boltzmann machines: energies, conditionals, and training by contrastive divergence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch as th

STEP_SIZE = 0.01
FIRST_DEVIATION = 0.1
BATCH = 64
N_RECONSTRUCTIONS = 20


class Machine(NamedTuple):
    """
    Parameters of a machine with source and target units that are real numbers and hidden units that are 0 or 1.

    The weight between source unit i, hidden unit j and target unit k is the sum over factors f of
    ``source[i, f] * hidden[j, f] * target[k, f]``.

    :param source: float64, shape (n_source, n_factors); ``hidden``: shape (n_hidden, n_factors)
    :param target: shape (n_target, n_factors)
    :param hidden_bias: shape (n_hidden,); ``target_bias``: shape (n_target,)
    """

    source: th.Tensor
    hidden: th.Tensor
    target: th.Tensor
    hidden_bias: th.Tensor
    target_bias: th.Tensor

    @classmethod
    def random(cls, sizes: tuple[int, int, int], n_factors: int, generator: th.Generator) -> Machine:
        """Draw small weights; ``sizes``: numbers of source, hidden and target units."""
        source, hidden, target = (
            th.randn((n, n_factors), generator=generator, dtype=th.float64) * FIRST_DEVIATION for n in sizes
        )
        return cls(source, hidden, target, *(th.zeros(n, dtype=th.float64) for n in sizes[1:]))


def energy(machine: Machine, source: th.Tensor, hidden: th.Tensor, target: th.Tensor) -> th.Tensor:
    """
    Compute the energy of states of the machine, given the source units: that of the conditional distribution of the others.

    E = |target - target_bias|^2 / 2 - hidden . hidden_bias - sum_f (source W_s)_f (hidden W_h)_f (target W_t)_f

    :param source: shape (n, n_source); ``hidden``: shape (n, n_hidden); ``target``: shape (n, n_target)
    :return: shape (n,)
    """
    factors = (source @ machine.source) * (hidden @ machine.hidden) * (target @ machine.target)
    apart = ((target - machine.target_bias) ** 2).sum(dim=1) / 2.0
    return apart - hidden @ machine.hidden_bias - factors.sum(dim=1)


def hidden_input(machine: Machine, source: th.Tensor, target: th.Tensor) -> th.Tensor:
    """Return the log-odds of the hidden units given all others, shape (n, n_hidden)."""
    return ((source @ machine.source) * (target @ machine.target)) @ machine.hidden.T + machine.hidden_bias


def target_mean(machine: Machine, source: th.Tensor, hidden: th.Tensor) -> th.Tensor:
    """Return the mean of the target units, which are normal with variance 1, given all others, shape (n, n_target)."""
    return machine.target_bias + ((source @ machine.source) * (hidden @ machine.hidden)) @ machine.target.T


def free_energy(machine: Machine, source: th.Tensor, target: th.Tensor) -> th.Tensor:
    """Return minus the logarithm of the sum over all hidden states of exp(-E), shape (n,)."""
    apart = ((target - machine.target_bias) ** 2).sum(dim=1) / 2.0
    return apart - th.nn.functional.softplus(hidden_input(machine, source, target)).sum(dim=1)


def contrastive_divergence(machine: Machine, source: th.Tensor, target: th.Tensor, generator: th.Generator) -> th.Tensor:
    """
    Return what has the gradient of contrastive divergence (CD-1): the mean free energy of data less that of reconstructions.

    Hidden units are drawn given the data, and the target's units are reconstructed by their mean; the source's stay.
    """
    with th.no_grad():
        on = th.sigmoid(hidden_input(machine, source, target))
        drawn = (th.rand(on.shape, generator=generator, dtype=th.float64) < on).double()
        again = target_mean(machine, source, drawn)
    return (free_energy(machine, source, target) - free_energy(machine, source, again)).mean()


def train(
    source: np.ndarray, target: np.ndarray, *, n_hidden: int, n_factors: int, n_updates: int, seed: int, paired: bool = False
) -> Machine:
    """
    Train a machine on samples of both tasks, in batches, by Adam.

    :param source: standardised triplets, one a row; ``target``: the same
    :param n_updates: number of batches
    :param seed: of the first weights, the batches and the hidden units
    :param paired: whether rows of the same number belong together; otherwise rows are paired at random, anew in each batch
    """
    generator = th.Generator().manual_seed(seed)
    sizes = source.shape[1], n_hidden, target.shape[1]
    machine = Machine(*(each.requires_grad_() for each in Machine.random(sizes, n_factors, generator)))
    from_rows, to_rows = th.from_numpy(source), th.from_numpy(target)
    optimizer = th.optim.Adam(machine, lr=STEP_SIZE)
    for _ in range(n_updates):
        of_source = th.randint(len(from_rows), (BATCH,), generator=generator)
        of_target = of_source if paired else th.randint(len(to_rows), (BATCH,), generator=generator)
        optimizer.zero_grad()
        contrastive_divergence(machine, from_rows[of_source], to_rows[of_target], generator).backward()
        optimizer.step()
    return Machine(*(each.detach() for each in machine))


def reconstruct(machine: Machine, source: np.ndarray) -> np.ndarray:
    """
    Return the target units that the machine takes source units for: mean-field iterations from hidden units without a target.

    :param source: standardised triplets, shape (n, n_source)
    :return: shape (n, n_target)
    """
    units = th.from_numpy(np.ascontiguousarray(source))
    target = machine.target_bias.expand(len(units), -1)
    for _ in range(N_RECONSTRUCTIONS):
        target = target_mean(machine, units, th.sigmoid(hidden_input(machine, units, target)))
    return target.numpy().copy()
