"""Fitted R-Max for Stable-Baselines3, with transfer between tasks that have other states and other actions."""

from pathlib import Path

from sb3_combrel.fitted_rmax.fitted_rmax import FittedRMax

__version__ = (Path(__file__).parent / "version.txt").read_text().strip()
__all__ = ["FittedRMax"]
