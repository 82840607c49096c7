"""The hyperparameters that ``-optimize`` searches."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from optuna import Trial


def sample_fitted_rmax_params(trial: Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Draw hyperparameters; what is not drawn stays as the configuration file has it.

    ``resolution``, ``max_value``, ``gamma`` and ``bounds`` belong to the task and are not drawn: a fine grid of many state
    variables would not fit into memory, and an error in the constructor ends the whole study.

    :param trial: Optuna's trial
    :param n_actions: no use, actions are discrete
    :param n_envs: no use
    :param additional_args: no use
    :return: arguments of :class:`~sb3_combrel.FittedRMax`
    """
    return convert_fitted_rmax_params(
        {
            "model_breadth": trial.suggest_float("model_breadth", 0.05, 0.5, log=True),
            "min_fraction": trial.suggest_float("min_fraction", 0.01, 0.3, log=True),
            "exploration_threshold": trial.suggest_float("exploration_threshold", 0.3, 3.0, log=True),
            "planning_tolerance": trial.suggest_float("planning_tolerance", 1e-3, 0.1, log=True),
            "max_backups_power": trial.suggest_int("max_backups_power", 3, 10),
        }
    )


def convert_fitted_rmax_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Arguments of the algorithm from what a trial has stored.

    :param sampled_params: the trial's parameters, by name
    """
    converted = dict(sampled_params)
    converted["max_backups"] = 2 ** converted.pop("max_backups_power")
    return converted
