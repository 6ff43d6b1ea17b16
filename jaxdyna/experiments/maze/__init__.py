"""The Maze (§4.2): DQN with and without fake episodes, and models of its frames alone."""

from jaxdyna.experiments.maze.acting import MAZE
from jaxdyna.experiments.maze.frames import FRAMES
from jaxdyna.experiments.maze.studies import BASELINES, DYNA_GRID, LADDER, LEVERS

PARTS = (MAZE, FRAMES, LEVERS, LADDER, BASELINES, DYNA_GRID)
