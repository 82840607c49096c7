"""Registration with RL-Zoo: algorithms, environments, and the hyperparameters that ``-optimize`` searches."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from sb3_combrel.zoo.algorithm import ZooFittedRMax

if TYPE_CHECKING:
    from optuna import Trial

OF_TRANSFER = "transfer_"
"""Prefix of the names of a transfer method's arguments in a study."""


def sample_fitted_rmax_params(trial: Trial, *_: Any) -> dict[str, Any]:
    """Draw arguments of :class:`~sb3_combrel.zoo.algorithm.ZooFittedRMax`; the others are those of the configuration file.

    The grid is drawn relative to the one that suits task and breadth, as one that is right for two variables does not fit into
    memory for six. ``max_value``, ``gamma`` and ``bounds`` belong to the task.
    """
    return convert_fitted_rmax_params(
        {
            "model_breadth": trial.suggest_float("model_breadth", 0.05, 0.5, log=True),
            "exploration_threshold": trial.suggest_float("exploration_threshold", 0.3, 3.0, log=True),
            "planning_tolerance": trial.suggest_float("planning_tolerance", 1e-4, 0.1, log=True),
            "resolution": trial.suggest_categorical("resolution", [None, "coarser", "finer"]),
        }
    )


def sample_timbrel_params(trial: Trial, *_: Any) -> dict[str, Any]:
    """Draw the same, and the breadth of transferred instances, which counts where these are transferred."""
    return {**sample_fitted_rmax_params(trial), "transfer_kwargs": {"breadth": _transfer_breadth(trial)}}


def sample_combrel_params(trial: Trial, *_: Any) -> dict[str, Any]:
    """Draw the same, and arguments of COMBREL with instances."""
    sampled = sample_fitted_rmax_params(trial)
    of_transfer = {
        "breadth": _transfer_breadth(trial),
        "n_neighbors": trial.suggest_int(f"{OF_TRANSFER}n_neighbors", 1, 10, log=True),
        "choice": trial.suggest_categorical(f"{OF_TRANSFER}choice", ["best", "drawn"]),
        "neighbor_radius": trial.suggest_categorical(f"{OF_TRANSFER}neighbor_radius", [None, 0.2, 0.4, 0.8]),
        "min_compliance": trial.suggest_float(f"{OF_TRANSFER}min_compliance", 0.0, 1.5),
        "relevance": trial.suggest_categorical(f"{OF_TRANSFER}relevance", [False, True]),
    }
    return {**sampled, "transfer_kwargs": of_transfer}


def _transfer_breadth(trial: Trial) -> float:
    return trial.suggest_float(f"{OF_TRANSFER}breadth", 0.05, 0.8, log=True)


def convert_fitted_rmax_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """Convert a trial's parameters, by name, to arguments of :class:`~sb3_combrel.zoo.algorithm.ZooFittedRMax`."""
    of_transfer = {name: value for name, value in sampled_params.items() if name.startswith(OF_TRANSFER)}
    converted = {name: value for name, value in sampled_params.items() if name not in of_transfer}
    if of_transfer:
        converted["transfer_kwargs"] = {name.removeprefix(OF_TRANSFER): value for name, value in of_transfer.items()}
    return converted


ALGORITHMS: dict[str, Callable[..., dict[str, Any]]] = {
    "fitted_rmax": sample_fitted_rmax_params,
    "timbrel": sample_timbrel_params,
    "combrel": sample_combrel_params,
    "master": sample_fitted_rmax_params,
    "mapping_experts": sample_fitted_rmax_params,
    "soft_homomorphism": sample_fitted_rmax_params,
}
"""Names for ``--algo``, each with its own settings, logs and column in tables, and what draws its hyperparameters."""


def register() -> None:
    """Add the algorithms to RL-Zoo's tables and the environments to Gymnasium; may be called more than once."""
    from rl_zoo3 import ALGOS
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    import combrel_envs  # noqa: F401 - registers the environments: benchmark and record_video know no --gym-packages

    for name, sampler in ALGORITHMS.items():
        ALGOS[name] = ZooFittedRMax
        HYPERPARAMS_SAMPLER[name] = sampler
        HYPERPARAMS_CONVERTER[name] = convert_fitted_rmax_params
