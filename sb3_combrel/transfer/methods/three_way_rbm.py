"""A mapping between tasks by a three-way restricted Boltzmann machine on random samples of both (Ammar et al. 2013)."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_combrel.common.checks import check_count
from sb3_combrel.transfer.methods.learned_translation import LearnedTranslation, Standard

STEP_SIZE = 0.01
FIRST_DEVIATION = 0.1
BATCH = 64
N_RECONSTRUCTIONS = 20


@dataclass(repr=False, eq=False)
class ThreeWayRBM(LearnedTranslation):
    """Trains a three-way restricted Boltzmann machine on random transitions of both tasks; it turns source into target data.

    Paper: Ammar, Mocanu, Taylor, Driessens, Tuyls & Weiss, "Automatically mapped transfer between reinforcement learning tasks
    via three-way restricted Boltzmann machines" (ECML 2013). One layer of units holds a source triplet (state, action, next
    state), one a target triplet, and hidden units gate the factored weights between them. It is trained by contrastive
    divergence; source data are then clamped, and the target's layer is reconstructed.

    What differs from the paper: triplets are of unit coordinates, with the effect in place of the next state and one column
    for each action, standardised. The energy is of the target's units given the source's (the joint one has no lower bound).
    Translated data are instances that join the target's own, instead of starting fitted Q-iteration. Rewards and ends are the
    source's.

    What to expect: source and target triplets are shown together at random, so any relation that it learns is one of chance,
    and what it reconstructs lies near the mean of the target's sample (``transfer/translated_spread`` tells how near).

    Arguments that are not listed here: see :class:`~sb3_combrel.transfer.methods.learned_translation.LearnedTranslation`.

    Example::

        model = FittedRMax("combrel/MountainCar4D-v0", transfer=ThreeWayRBM(source, n_random_steps=100))
        model.learn(total_timesteps=5_000)

    :param n_hidden: hidden units
    :param n_factors: factors of the tensor of weights
    :param n_updates: batches of 64 that it is trained on
    :raises ValueError: if an argument is out of range; when learning starts, if a state variable of either task is periodic
    """

    _: KW_ONLY
    n_source_samples: int = 1000
    n_hidden: int = 30
    n_factors: int = 30
    n_updates: int = 3000

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("n_hidden", "n_factors", "n_updates"):
            check_count(name, getattr(self, name))

    def learn_translation(self, source: np.ndarray, target: np.ndarray, instances: np.ndarray) -> np.ndarray:
        of_source, of_target = Standard.of(source), Standard.of(target)
        rows, seed = (of_source.to(source), of_target.to(target)), int(self.rng.integers(2**63))
        machine = train(*rows, n_hidden=self.n_hidden, n_factors=self.n_factors, n_updates=self.n_updates, seed=seed)
        return of_target.back(reconstruct(machine, of_source.to(instances)))


class Machine(NamedTuple):
    """Parameters; a weight is the sum over factors of ``source[i] * hidden[j] * target[k]``; hidden units are 0 or 1."""

    source: th.Tensor  # float64, shape (n_source, n_factors)
    hidden: th.Tensor  # shape (n_hidden, n_factors)
    target: th.Tensor  # shape (n_target, n_factors)
    hidden_bias: th.Tensor  # shape (n_hidden,)
    target_bias: th.Tensor  # shape (n_target,)


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
    """Return what has CD-1's gradient: mean free energy of data less that of target units reconstructed from them."""
    with th.no_grad():
        on = th.sigmoid(hidden_input(machine, source, target))
        again = target_mean(machine, source, (th.rand(on.shape, generator=generator, dtype=th.float64) < on).double())
    return (free_energy(machine, source, target) - free_energy(machine, source, again)).mean()


def train(
    source: np.ndarray, target: np.ndarray, *, n_hidden: int, n_factors: int, n_updates: int, seed: int, paired: bool = False
) -> Machine:
    """Train a machine by Adam on standardised triplets, one a row; unless ``paired``, rows meet at random."""
    generator = th.Generator().manual_seed(seed)
    sizes = source.shape[1], n_hidden, target.shape[1]
    weights = [th.randn((n, n_factors), generator=generator, dtype=th.float64) * FIRST_DEVIATION for n in sizes]
    biases = [th.zeros(n, dtype=th.float64) for n in sizes[1:]]
    machine = Machine(*(each.requires_grad_() for each in (*weights, *biases)))
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
    """Return the target units, shape (n, n_target), that mean-field iterations find for source units, (n, n_source)."""
    units = th.from_numpy(np.ascontiguousarray(source))
    target = machine.target_bias.expand(len(units), -1)
    for _ in range(N_RECONSTRUCTIONS):
        target = target_mean(machine, units, th.sigmoid(hidden_input(machine, units, target)))
    return target.numpy().copy()
