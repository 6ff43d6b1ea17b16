"""Pong (§4.3): learning to play it, with and without dreams, and predicting its frames."""

from jaxdyna.experiments.pong.frames import FRAMES
from jaxdyna.experiments.pong.learning import BASELINES, DYNA_GRID, PONG

PARTS = (PONG, FRAMES, BASELINES, DYNA_GRID)
