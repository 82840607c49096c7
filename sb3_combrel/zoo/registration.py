"""Registration with RL-Zoo: algorithms, samplers of hyperparameters, environments."""

from __future__ import annotations

from sb3_combrel.zoo.algorithm import ZooFittedRMax
from sb3_combrel.zoo.sampling import (
    convert_fitted_rmax_params,
    sample_combrel_params,
    sample_fitted_rmax_params,
    sample_timbrel_params,
)

ALGORITHMS = {
    "fitted_rmax": sample_fitted_rmax_params,
    "timbrel": sample_timbrel_params,
    "combrel": sample_combrel_params,
    "master": sample_fitted_rmax_params,
    "mapping_experts": sample_fitted_rmax_params,
    "soft_homomorphism": sample_fitted_rmax_params,
}
"""
Names for ``--algo``, and the function that draws hyperparameters for each.

All are Fitted R-Max; each has its own configuration file, log folder and column in tables.
"""


def register() -> None:
    """
    Add the algorithms to RL-Zoo's tables and the environments to Gymnasium; may be called more than once.

    :raises ImportError: if RL-Zoo is not installed
    """
    from rl_zoo3 import ALGOS
    from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER

    import combrel_envs  # noqa: F401 - registers the environments: benchmark and record_video know no --gym-packages

    for name, sampler in ALGORITHMS.items():
        ALGOS[name] = ZooFittedRMax
        HYPERPARAMS_SAMPLER[name] = sampler
        HYPERPARAMS_CONVERTER[name] = convert_fitted_rmax_params
