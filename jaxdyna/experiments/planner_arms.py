from jaxdyna.experiments.study.planners import *  # noqa: F403
