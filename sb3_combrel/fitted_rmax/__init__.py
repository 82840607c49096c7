"""Fitted R-Max; when it is imported it becomes a learner of source tasks."""

from sb3_combrel.fitted_rmax import source_learner  # noqa: F401
