"""Inter-task mappings, sets of them, and what a user may write for a set."""

from sb3_combrel.mappings.action_mappings import (
    ActionMappings,
    AllActionMappings,
    BalancedActionMappings,
    ListedActionMappings,
)
from sb3_combrel.mappings.factored_mapping import FactoredMapping
from sb3_combrel.mappings.inter_task_mapping import UNMAPPED, InterTaskMapping, MappingNames
from sb3_combrel.mappings.mapping_set import Candidates, MappingSet
from sb3_combrel.mappings.named_sets import resolve

__all__ = [
    "UNMAPPED",
    "ActionMappings",
    "AllActionMappings",
    "BalancedActionMappings",
    "Candidates",
    "FactoredMapping",
    "InterTaskMapping",
    "ListedActionMappings",
    "MappingNames",
    "MappingSet",
    "resolve",
]
