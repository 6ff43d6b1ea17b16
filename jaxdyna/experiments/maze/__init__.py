"""The Maze (§4.2): DQN with and without fake episodes, and models of its frames alone."""

from jaxdyna.experiments.maze.acting import MAZE

PARTS = (MAZE,)
