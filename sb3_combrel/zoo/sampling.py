"""The hyperparameters that ``-optimize`` searches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from optuna import Trial

OF_TRANSFER = "transfer_"
"""Prefix of the names of a transfer method's arguments in a study."""


def sample_fitted_rmax_params(trial: Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters; those that are not drawn are taken from the configuration file.

    ``max_value``, ``gamma`` and ``bounds`` belong to the task and are not drawn. The grid is drawn relative to the one
    that suits task and breadth: a number that is right for two variables would not fit into memory for six, and an
    error in the constructor ends the whole study.

    :param trial: Optuna's trial
    :param n_actions: not used, actions are discrete
    :param n_envs: not used
    :param additional_args: not used
    :return: arguments of :class:`~sb3_combrel.zoo.algorithm.ZooFittedRMax`
    """
    return convert_fitted_rmax_params(
        {
            "model_breadth": trial.suggest_float("model_breadth", 0.05, 0.5, log=True),
            "min_fraction": trial.suggest_float("min_fraction", 0.01, 0.3, log=True),
            "exploration_threshold": trial.suggest_float("exploration_threshold", 0.3, 3.0, log=True),
            "planning_tolerance": trial.suggest_float("planning_tolerance", 1e-4, 0.1, log=True),
            "max_backups_power": trial.suggest_int("max_backups_power", 3, 10),
            "resolution": trial.suggest_categorical("resolution", [None, "coarser", "finer"]),
        }
    )


def sample_timbrel_params(trial: Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """Draw the same and the breadth of transferred instances; see :func:`sample_fitted_rmax_params`."""
    sampled = sample_fitted_rmax_params(trial, n_actions, n_envs, additional_args)
    return {**sampled, "transfer_kwargs": {"breadth": _transfer_breadth(trial)}}


def sample_combrel_params(trial: Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """Draw the same and arguments of COMBREL; see :func:`sample_fitted_rmax_params`."""
    sampled = sample_fitted_rmax_params(trial, n_actions, n_envs, additional_args)
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
    """
    Convert a trial's parameters to arguments of the algorithm.

    :param sampled_params: the trial's parameters, by name
    :return: arguments of :class:`~sb3_combrel.zoo.algorithm.ZooFittedRMax`, by name
    """
    of_transfer = {name: value for name, value in sampled_params.items() if name.startswith(OF_TRANSFER)}
    converted = {name: value for name, value in sampled_params.items() if name not in of_transfer}
    converted["max_backups"] = 2 ** converted.pop("max_backups_power")
    if of_transfer:
        converted["transfer_kwargs"] = {name.removeprefix(OF_TRANSFER): value for name, value in of_transfer.items()}
    return converted
