"""Catch: DQN with and without a learned model of its frames, as the worked example of an experiment."""

from jaxdyna.experiments.catch.acting import CATCH

PARTS = (CATCH,)
