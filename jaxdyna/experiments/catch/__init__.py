"""Catch, the worked example of an experiment: DQN, with and without a model of its frames."""

from jaxdyna.experiments.catch.acting import CATCH
from jaxdyna.experiments.catch.frames import FRAMES

PARTS = (CATCH, FRAMES)
