"""Moved: see `jaxdyna.experiments.report.frames`."""

from jaxdyna.experiments.report.frames import *  # noqa: F403
