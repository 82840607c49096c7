"""Fitted R-Max for Stable-Baselines3, with transfer between tasks that have other states and other actions."""

from pathlib import Path

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax
from sb3_combrel.transfer.combrel import COMBREL
from sb3_combrel.transfer.mappings import InterTaskMapping, MappingSet
from sb3_combrel.transfer.source import SourceInstances
from sb3_combrel.transfer.timbrel import TIMBREL

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()
__all__ = ["COMBREL", "TIMBREL", "FittedRMax", "InterTaskMapping", "MappingSet", "SourceInstances"]
