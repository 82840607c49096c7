"""Fitted R-Max for Stable-Baselines3, with transfer between tasks that have other states and other actions."""

from typing import TYPE_CHECKING, Any

from sb3_combrel.common.version import __version__ as __version__
from sb3_combrel.fitted_rmax import source_learner  # noqa: F401 - sources.SourceInstances.from_fitted_rmax finds it
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.mappings.inter_task_mapping import InterTaskMapping
from sb3_combrel.mappings.mapping_set import MappingSet
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.tensorboard.callback import with_dashboard
from sb3_combrel.tensorboard.explain import explain
from sb3_combrel.transfer.methods.combrel import COMBREL
from sb3_combrel.transfer.methods.experts import MappingExperts
from sb3_combrel.transfer.methods.master import MASTER
from sb3_combrel.transfer.methods.sample_transfer import SampleTransfer
from sb3_combrel.transfer.methods.soft_homomorphism import SoftHomomorphism
from sb3_combrel.transfer.methods.sparse_coding import SparseCodingMapping
from sb3_combrel.transfer.methods.three_way_rbm import ThreeWayRBM
from sb3_combrel.transfer.methods.timbrel import TIMBREL

if TYPE_CHECKING:
    from sb3_combrel.comparison.compare import compare

FittedRMax.default_callbacks.append(with_dashboard)

__all__ = [
    "COMBREL",
    "MASTER",
    "TIMBREL",
    "FactoredMapping",
    "FittedRMax",
    "InterTaskMapping",
    "MappingExperts",
    "MappingSet",
    "SampleTransfer",
    "SoftHomomorphism",
    "SourceInstances",
    "SparseCodingMapping",
    "ThreeWayRBM",
    "compare",
    "explain",
]


def __getattr__(name: str) -> Any:
    # Statistics take a moment to import, and only who compares needs them.
    if name == "compare":
        from sb3_combrel.comparison.compare import compare

        return compare
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
