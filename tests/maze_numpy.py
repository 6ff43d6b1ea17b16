"""The Maze's rules once more, in plain Python and NumPy, for the tests to compare with."""

import numpy as np

STEPS = {0: (0, -1), 1: (0, 1), 2: (-1, 0), 3: (1, 0), 4: (0, 0)}
BACK = {0: 1, 1: 0, 2: 3, 3: 2}


class PlainMaze:
    """One maze, played cell by cell."""

    def __init__(self, size, agent, goal, obstacles, directions, max_steps=200):
        self.size, self.max_steps, self.time = size, max_steps, 0
        self.agent, self.goal = tuple(map(int, agent)), tuple(map(int, goal))
        self.obstacles = [tuple(map(int, cell)) for cell in obstacles]
        self.directions = [int(direction) for direction in directions]

    def inside(self, cell):
        return all(0 <= part < self.size for part in cell)

    def step(self, action, collision_reward=-5.0, goal_reward=1.0):
        row, column = self.agent
        down, right = STEPS[int(action)]
        if self.inside((row + down, column + right)):
            self.agent = (row + down, column + right)
        for number, (row, column) in enumerate(self.obstacles):
            down, right = STEPS[self.directions[number]]
            if self.inside((row + down, column + right)):
                self.obstacles[number] = (row + down, column + right)
            else:
                self.directions[number] = BACK[self.directions[number]]
        self.time += 1
        reward = collision_reward if self.agent in self.obstacles else 0.0
        reward += goal_reward if self.agent == self.goal else 0.0
        return reward, self.time >= self.max_steps

    def frame(self):
        picture = np.zeros((self.size, self.size, 3), np.uint8)
        for cell in self.obstacles:
            picture[(*cell, 0)] = 255
        picture[(*self.goal, 1)] = 255
        picture[(*self.agent, 2)] = 255
        return picture


def best_return(maze, steps, collision_reward=-5.0, goal_reward=1.0):
    """By memoised search over the agent's cells, forward in time."""
    hits = []
    for _ in range(steps):
        maze.step(4)
        hits.append(set(maze.obstacles))
    reached = {maze.agent: 0.0}
    for hit in hits:
        after = {}
        for (row, column), earned in reached.items():
            for down, right in STEPS.values():
                cell = (row + down, column + right)
                cell = cell if maze.inside(cell) else (row, column)
                gain = (collision_reward if cell in hit else 0) + (
                    goal_reward if cell == maze.goal else 0
                )
                after[cell] = max(after.get(cell, -np.inf), earned + gain)
        reached = after
    return max(reached.values())
