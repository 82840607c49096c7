"""Rivals that a reviewer would ask for, and a pair of theirs, as plug-ins of the benchmark.

``sb3-combrel benchmark --methods none sb3_combrel.experiments.benchmark.rival_methods:GAME``, and so on with the other names.
Both methods find one mapping by random transitions of the target, as MASTER does, and then transfer as it does: they differ in
how a mapping is found, and in nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import gymnasium as gym
import numpy as np

from sb3_combrel import MASTER
from sb3_combrel.experiments.benchmark.methods import COMPILED_STEPS, Method, the_one
from sb3_combrel.experiments.benchmark.pair import Pair, recorded
from sb3_combrel.experiments.tasks.dm_suite import make_dm_control
from sb3_combrel.experiments.tasks.swing_ups import with_forces
from sb3_combrel.mappings.mapping_set import MappingSet
from sb3_combrel.transfer.candidates import MappingsLike
from sb3_combrel.transfer.methods.master import DEFAULT_RANDOM_STEPS, choose_least, squared_errors
from sb3_combrel.transfer.prior.copies import Copies
from sb3_combrel.transfer.prior.copy_sums import CopySums
from sb3_combrel.transfer.prior.prior_choice import Choice, Chooser
from sb3_combrel.transfer.source_policy import SourcePolicy

#: As in GAME's search for Mountain Car: mappings of a generation, how many compete to be a parent, the probability that two
#: parents are crossed and that a part of a mapping mutates, and how many mappings are judged in all.
POPULATION, TOURNAMENT, CROSSED, MUTATED, JUDGED = 10, 4, 0.8, 1 / 7, 240
#: Without discounting the source's least and largest values are not bounded by its rewards.
LARGEST_GAMMA = 0.99


class Member(NamedTuple):
    """A mapping of a population: source variable of each target variable, source action of each target action, error."""

    state: tuple[int, ...]
    action: tuple[int, ...]
    error: float


@dataclass(repr=False, eq=False)
class EvolvedMapping(MASTER):
    """A genetic algorithm searches for the mapping that predicts random transitions of the target best.

    After M. Hua's project "Genetic algorithms for mapping evolution" (GAME, https://github.com/duyminh1998/GAME), as its code
    has it: every target variable has a source variable and every target action a source action; the fittest of some that are
    drawn are parents, each part of a child is that of one of them, the fitter one more often, and may mutate; the best of a
    generation lives on. What differs: a mapping is judged by what the source's model predicts of the target's transitions,
    where the project judges what a target's model, fitted beforehand, predicts of the source's; and Fitted R-Max learns in the
    target.
    """

    mappings: MappingsLike = field(default="surjective", init=False)
    use: str | None = field(default="prior", init=False)  # type: ignore[assignment]

    def _chooser(self, copies: Copies, sets: Sequence[MappingSet]) -> Chooser:
        return partial(evolve, copies, self.rng)


def evolve(copies: Copies, rng: np.random.Generator, sums: CopySums) -> Choice:
    """Search among all mappings for the one with the least squared error, as far as :data:`JUDGED` of them tell."""
    errors = squared_errors(copies, sums)
    n_actions = errors.shape[1]
    rows = {tuple(row): number for number, row in enumerate(copies.state.tolist())}
    possible = int(copies.table.n_actions[0]), 1 + int(copies.state.max())

    def judged(state: Sequence[int], action: Sequence[int]) -> Member:
        row = rows.get(tuple(state))
        # A mapping that says nothing of some source variable predicts nothing.
        error = np.inf if row is None else errors[row, np.arange(n_actions), list(action)].sum()
        return Member(tuple(state), tuple(action), float(error))

    def drawn(n: int, of: int) -> list[int]:
        return [int(each) for each in rng.integers(of, size=n)]

    def parent() -> Member:
        return min((members[number] for number in drawn(TOURNAMENT, POPULATION)), key=lambda each: each.error)

    def child() -> Member:
        one, other = parent(), parent()
        fitness = 1.0 / (1e-12 + one.error), 1.0 / (1e-12 + other.error)
        share = fitness[0] / sum(fitness) if sum(fitness) > 0.0 else 0.5
        crossed = rng.random() < CROSSED
        parts = []
        for ours, theirs, of in ((one.state, other.state, possible[1]), (one.action, other.action, possible[0])):
            taken = np.where((rng.random(len(ours)) < share) | (not crossed), ours, theirs)
            parts.append(np.where(rng.random(len(ours)) < MUTATED, drawn(len(ours), of), taken).tolist())
        return judged(*parts)

    n_variables = copies.state.shape[1]
    members = [judged(drawn(n_variables, possible[1]), drawn(n_actions, possible[0])) for _ in range(POPULATION)]
    for _ in range((JUDGED - POPULATION) // (POPULATION - 1)):
        best = min(members, key=lambda each: each.error)
        members = [best, *(child() for _ in range(POPULATION - 1))]
    best = min(members, key=lambda each: each.error)
    chosen = np.full((n_actions, 1), rows[best.state], dtype=np.int64)
    return Choice(chosen, np.array(best.action, dtype=np.int64)[:, None])


@dataclass(repr=False, eq=False)
class BellmanConsistent(MASTER):
    """The mapping through which the source's action values fit the target's rewards and successors best is transferred with.

    The idea of cross-domain Bellman consistency: Chen, Pan, Huang, Liu & Hsieh, "Cross-domain policy optimization via Bellman
    consistency and hybrid critics" (QAvatar, ICLR 2026), which learns a continuous mapping by it and mixes the critics of both
    tasks; here it is a score by which one mapping of a set is chosen, in place of how well transitions are predicted.
    """

    use: str | None = field(default="prior", init=False)  # type: ignore[assignment]

    def _chooser(self, copies: Copies, sets: Sequence[MappingSet]) -> Chooser:
        return lambda sums: choose_least(self._bellman_errors(copies), copies, sets)

    def _bellman_errors(self, copies: Copies) -> np.ndarray:
        """Squared errors of r + gamma max Q(s', b) - Q(s, a), added up, of the shape of :func:`squared_errors`."""
        task, seen = self._bound_task, self.source_prior.transitions
        states, actions, rewards, effects = (
            each[: seen.n] for each in (seen.states, seen.actions, seen.rewards, seen.effects)
        )
        periodic = np.array(task.periodic)
        successors = np.where(periodic, (states + effects) % 1.0, np.clip(states + effects, 0.0, 1.0))
        gamma = min(task.gamma, LARGEST_GAMMA)
        discount = np.where(seen.ended[: seen.n], 0.0, gamma)
        found = np.zeros((len(copies), task.n_actions, copies.most_actions))
        policies = [SourcePolicy(source, gamma, float(self.source_breadth)) for source in self.sources]
        for copy, number in enumerate(copies.source.tolist()):
            policy, n = policies[number], self.sources[number].n_actions
            before, after = (values_of(policy, copies.as_copy(copy, each)) for each in (states, successors))
            targets = rewards + discount * after.max(axis=1)
            errors = (targets[:, None] - before) ** 2
            for action in range(task.n_actions):
                found[copy, action, :n] = errors[actions == action].sum(axis=0)
        return found


def values_of(policy: SourcePolicy, states: np.ndarray) -> np.ndarray:
    """Action values at states of a source, shape (n, n_actions); an action without data is worth the least of all."""
    values = np.array([policy.q_values(np.ascontiguousarray(state[: policy.grid.n_variables])) for state in states])
    return np.where(np.isfinite(values), values, policy.values.min())


GAME = Method(
    "GAME",
    "The mapping that a genetic algorithm finds by its prediction error on 100 random transitions, as a prior "
    '(after the project "Genetic algorithms for mapping evolution" of M. Hua).',
    lambda sources, pair: EvolvedMapping(the_one(sources, "GAME")),
    finds_mapping=True,
    compiled_steps=DEFAULT_RANDOM_STEPS + COMPILED_STEPS,
)
BELLMAN = Method(
    "Bellman-consistency",
    "The mapping through which the source's action values are most consistent with 100 random transitions, as a prior "
    '(after Chen et al., "Cross-domain policy optimization via Bellman consistency and hybrid critics", ICLR 2026).',
    lambda sources, pair: BellmanConsistent(sources, pair.instance_mappings),
    finds_mapping=True,
    compiled_steps=DEFAULT_RANDOM_STEPS + COMPILED_STEPS,
)


def make_swing_up(domain: str) -> gym.Env:
    """Make a task of dm_control's suite, to be swung up by three forces or torques."""
    return with_forces(make_dm_control(domain, "swingup"), (-1.0, 0.0, 1.0))


PENDULUM_CART_POLE = Pair(
    name="pendulum-cart-pole",
    description=(
        "dm_control's pendulum to its cart with a pole, both to be swung up (a pair of Fickinger et al., ICLR 2022). A torque "
        "turns the pendulum, and a force on the cart the pole: nobody knows a mapping of the actions for all angles."
    ),
    sources=(recorded("dm_pendulum", partial(make_swing_up, "pendulum"), n_episodes=10),),
    target=partial(make_swing_up, "cartpole"),
    n_steps=5000,
)
