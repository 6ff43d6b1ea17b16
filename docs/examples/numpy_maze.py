"""The Maze as people write it: one at a time, in Python and NumPy."""

import numpy as np

MOVES = ((0, -1), (0, 1), (-1, 0), (1, 0), (0, 0))
COLLISION_REWARD = -5.0


class NumpyMaze:
    """The rules of `jaxdyna.envs.Maze`; frames are uint8 ``[size, size, 3]``."""

    num_actions = len(MOVES)

    def __init__(self, seed: int, size: int = 16, obstacles: int = 5, steps: int = 200):
        self.size, self.count, self.steps = size, obstacles, steps
        self.rng = np.random.default_rng(seed)

    def reset(self) -> np.ndarray:
        """Obstacles on free cells, each with a direction."""
        self.agent, self.goal, self.time = (self.size - 1, 0), (0, self.size - 1), 0
        taken = {self.agent, self.goal}
        free = [cell for cell in np.ndindex(self.size, self.size) if cell not in taken]
        self.obstacles = [free[i] for i in self.rng.choice(len(free), self.count, replace=False)]
        self.directions = self.rng.integers(4, size=self.count).tolist()
        return self.frame()

    def step(self, action: int) -> tuple[np.ndarray, float, bool]:
        """One move of all: the frame, the reward, and whether the episode is over."""
        self.agent = self._moved(self.agent, action) or self.agent
        for i, (cell, direction) in enumerate(zip(self.obstacles, self.directions, strict=True)):
            if ahead := self._moved(cell, direction):
                self.obstacles[i] = ahead
            else:
                self.directions[i] = direction ^ 1
        self.time += 1
        reward = COLLISION_REWARD * (self.agent in self.obstacles)
        return self.frame(), reward + (self.agent == self.goal), self.time >= self.steps

    def _moved(self, cell: tuple[int, int], move: int) -> tuple[int, int] | None:
        row, column = cell[0] + MOVES[move][0], cell[1] + MOVES[move][1]
        return (row, column) if 0 <= row < self.size and 0 <= column < self.size else None

    def frame(self) -> np.ndarray:
        """Red obstacles, a green goal, a blue agent."""
        picture = np.zeros((self.size, self.size, 3), np.uint8)
        for row, column in self.obstacles:
            picture[row, column, 0] = 255
        picture[(*self.goal, 1)] = picture[(*self.agent, 2)] = 255
        return picture
