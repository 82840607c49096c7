"""Fitted R-Max for Stable-Baselines3, with transfer between tasks that have other states and other actions."""

from pathlib import Path

from sb3_combrel._moved import keep_old_names
from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.mappings.named_sets import InterTaskMapping, MappingSet
from sb3_combrel.sources.source_instances import SourceInstances
from sb3_combrel.transfer.combrel import COMBREL
from sb3_combrel.transfer.timbrel import TIMBREL

keep_old_names()

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()
__all__ = ["COMBREL", "TIMBREL", "FittedRMax", "InterTaskMapping", "MappingSet", "SourceInstances"]
