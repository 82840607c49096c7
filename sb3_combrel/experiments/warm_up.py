"""Compile the inner loops once for all processes: ``python -m sb3_combrel.experiments.warm_up``."""

from __future__ import annotations

from sb3_combrel import COMBREL, TIMBREL, FittedRMax, SourceInstances
from sb3_combrel.experiments.tasks import mountain_car
from sb3_combrel.runs.job import chosen_on_purpose, make_env


def warm_up(relevance: bool = False) -> None:
    """Learn a few steps with each method, also with relevance; Numba stores what it compiles in its cache."""
    env = make_env(mountain_car.SOURCE_ID)
    source = SourceInstances.from_q_learning(env, n_instances=50, seed=0, total_timesteps=100)
    transfers = list(mountain_car.methods(source).values())
    if relevance:
        transfers += [TIMBREL(source, mapping="pool", relevance=True), COMBREL(source, relevance=True)]
    for transfer in transfers:
        target = make_env(mountain_car.TARGET_ID, max_episode_steps=30)
        with chosen_on_purpose():
            model = FittedRMax(target, transfer=transfer, seed=0, **mountain_car.LEARNER)
        model.learn(80).predict(target.reset(seed=0)[0], deterministic=True)


if __name__ == "__main__":
    warm_up(relevance=True)
