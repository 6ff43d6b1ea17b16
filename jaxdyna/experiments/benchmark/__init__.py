"""What things cost: whole sweeps by their number of runs, training steps beside PyTorch's."""

from jaxdyna.experiments.benchmark.steps import STEPS
from jaxdyna.experiments.benchmark.sweep import SWEEP

PARTS = (SWEEP, STEPS)
