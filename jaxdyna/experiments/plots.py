"""Moved: see `jaxdyna.experiments.report.plots`."""

from jaxdyna.experiments.report.plots import *  # noqa: F403
