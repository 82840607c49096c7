"""Warnings that point at the user's own line, however deep in the package something is found."""

from __future__ import annotations

import sys
import warnings

OWN = (__name__.partition(".")[0], "stable_baselines3")


def warn_user(message: str) -> None:
    """Warn with the line, outside this package and Stable-Baselines3, that has led here."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).partition(".")[0] in OWN:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)
