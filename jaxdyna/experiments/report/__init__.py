"""What a result leaves for people: numbers in words, tables, figures, films."""

from jaxdyna.experiments.report._old import *  # noqa: F403
from jaxdyna.experiments.report._old import Curves, Results  # noqa: F401
