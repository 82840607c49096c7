"""Callbacks, to be imported as those of Stable-Baselines3 are."""

from sb3_combrel.tensorboard.callback import DashboardCallback

__all__ = ["DashboardCallback"]
