"""What decides by looking ahead."""

from jaxdyna.planners.value_iteration import Plan, solve_maze

__all__ = ["Plan", "solve_maze"]
