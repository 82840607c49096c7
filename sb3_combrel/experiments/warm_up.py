"""Compile the inner loops once for all processes: ``python -m sb3_combrel.experiments.warm_up``."""

from __future__ import annotations

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, SourceInstances
from sb3_combrel.common.compiled import remove_outdated
from sb3_combrel.experiments import mountain_car
from sb3_combrel.experiments.runs import coarse_on_purpose, make_task


def warm_up(relevance: bool = False) -> None:
    """
    Learn a few steps with each method; Numba stores what it compiles in its cache.

    :param relevance: also compile what only the variants with relevance use
    """
    env = make_task(mountain_car.SOURCE_ID)
    source = SourceInstances.from_q_learning(env, n_instances=50, seed=0, total_timesteps=100)
    transfers = list(mountain_car.methods(source).values())
    if relevance:
        transfers += [TIMBREL(source, mapping="pool", relevance=True), COMBREL(source, relevance=True)]
    for transfer in transfers:
        target = make_task(mountain_car.TARGET_ID, max_episode_steps=30)
        with coarse_on_purpose():
            model = FittedRMax(target, transfer=transfer, seed=0, **mountain_car.LEARNER)
        model.learn(80).predict(target.reset(seed=0)[0], deterministic=True)


if __name__ == "__main__":
    remove_outdated()
    warm_up(relevance=True)
