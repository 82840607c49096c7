"""A mapping between tasks by a three-way restricted Boltzmann machine on random samples of both (Ammar et al. 2013)."""

from __future__ import annotations

from sb3_combrel.common.checks import check_count
from sb3_combrel.transfer.candidates import SourceLike
from sb3_combrel.transfer.methods.learned_translation import DEFAULT_SAMPLE_STEPS, LearnedTranslation, Standard, Triplets
from sb3_combrel.transfer.methods.mapping_transfer import DEFAULT_BREADTH, DEFAULT_BREADTH_DECAY
from sb3_combrel.transfer.methods.three_way_machine import reconstruct, train


class ThreeWayRBM(LearnedTranslation):
    """
    Trains a three-way restricted Boltzmann machine on random transitions of both tasks; it turns source into target data.

    Paper: Ammar, Mocanu, Taylor, Driessens, Tuyls & Weiss, "Automatically mapped transfer between reinforcement learning tasks
    via three-way restricted Boltzmann machines" (ECML 2013). One layer of units holds a source triplet (state, action, next
    state), one a target triplet, and hidden units gate the weights between them; the tensor of weights is factored. It is
    trained on random samples of both tasks by contrastive divergence; source data are then clamped, and the target's layer is
    reconstructed. Nothing is learned about the mapping afterwards.

    What was changed. Triplets are of unit coordinates, with the effect in place of the next state and one column for each
    action, standardised. The machine is of the target's units given the source's: with real units in both layers the joint
    energy has no lower bound for some weights, the conditional one always has. Reconstruction is a fixed number of mean-field
    iterations. Translated data are instances that join the target's own, nearest first, instead of what fitted Q-iteration
    starts from. Rewards and ends are the source's.

    What to expect. Nobody says which source and target triplets belong together, so those that the machine is shown together
    are drawn independently of each other: any relation that it learns is one of chance, and what it reconstructs lies near the
    mean of the target's sample, whatever the source triplet (``transfer/translated_spread`` tells how near). Given pairs that
    belong together it does learn what relates them, but no task gives such pairs.

    Cost: ``n_random_steps`` steps of the target with random actions, and some seconds once (MountainCar2D to 4D: 2 to 4 s).

    Example::

        model = FittedRMax("combrel/MountainCar4D-v0", transfer=ThreeWayRBM(source, n_random_steps=100))
        model.learn(total_timesteps=5_000)

    :param source: source instances, or a path to them
    :param n_random_steps: steps of the target that its sample takes
    :param n_source_samples: source instances that the machine is trained on, at most
    :param n_hidden: hidden units
    :param n_factors: factors of the tensor of weights
    :param n_updates: batches of 64 that it is trained on
    :param breadth: kernel breadth of transferred instances, unit coordinates of the target
    :param breadth_decay: see :class:`~sb3_combrel.transfer.methods.timbrel.TIMBREL`
    :param transfer_terminals: whether a source instance that ended its episode ends the target's
    :raises ValueError: if an argument is out of range; when learning starts, if a state variable of either task is periodic
    """

    def __init__(
        self,
        source: SourceLike,
        *,
        n_random_steps: int = DEFAULT_SAMPLE_STEPS,
        n_source_samples: int = 1000,
        n_hidden: int = 30,
        n_factors: int = 30,
        n_updates: int = 3000,
        breadth: float = DEFAULT_BREADTH,
        breadth_decay: float = DEFAULT_BREADTH_DECAY,
        transfer_terminals: bool = True,
    ):
        super().__init__(
            source,
            n_random_steps=n_random_steps,
            n_source_samples=n_source_samples,
            breadth=breadth,
            breadth_decay=breadth_decay,
            transfer_terminals=transfer_terminals,
        )
        check_count("n_hidden", n_hidden)
        check_count("n_factors", n_factors)
        check_count("n_updates", n_updates)
        self.n_hidden = n_hidden
        self.n_factors = n_factors
        self.n_updates = n_updates

    def learn_translation(self, source: Triplets, target: Triplets, instances: Triplets) -> Triplets:
        assert self.task is not None
        n_target, n_source = self.task.n_actions, self._source.n_actions
        source_columns, target_columns = source.columns(n_source), target.columns(n_target)
        of_source, of_target = Standard.of(source_columns), Standard.of(target_columns)
        machine = train(
            of_source.to(source_columns),
            of_target.to(target_columns),
            n_hidden=self.n_hidden,
            n_factors=self.n_factors,
            n_updates=self.n_updates,
            seed=int(self.rng.integers(2**63)),
        )
        found = reconstruct(machine, of_source.to(instances.columns(n_source)))
        return Triplets.of_columns(of_target.back(found), n_target)
