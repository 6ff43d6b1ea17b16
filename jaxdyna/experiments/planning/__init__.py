"""Planners on the learned model against learning from it (§1, §1.1).

What decisions cost and what they earn, in CartPole and in the Maze; and CartPole with a planner
that acts, with one that a policy imitates before it learns on, and with dreams, each with good and
with poor models.
"""

from jaxdyna.experiments.planning.deciding import PLANNING

PARTS = (PLANNING,)
