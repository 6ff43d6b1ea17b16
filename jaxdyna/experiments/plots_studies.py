"""Moved: see `jaxdyna.experiments.report.studies`."""

from jaxdyna.experiments.report.studies import *  # noqa: F403
