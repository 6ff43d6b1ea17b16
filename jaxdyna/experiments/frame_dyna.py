from jaxdyna.experiments.study.frames import *  # noqa: D100, F403
