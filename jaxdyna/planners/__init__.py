"""What decides by looking ahead."""

from jaxdyna.planners.decision import Decision, Guide, Planner, Value, rollout_value
from jaxdyna.planners.mcts import SearchConfig, gumbel_muzero, muzero, require_mctx
from jaxdyna.planners.mpc import (
    CrossEntropyConfig,
    ShootingConfig,
    cross_entropy,
    random_shooting,
    score,
)
from jaxdyna.planners.value_iteration import Plan, solve_maze

__all__ = [
    "CrossEntropyConfig", "Decision", "Guide", "Plan", "Planner", "SearchConfig", "ShootingConfig",
    "Value", "cross_entropy", "gumbel_muzero", "muzero", "random_shooting", "require_mctx",
    "rollout_value", "score", "solve_maze"]  # fmt: skip
