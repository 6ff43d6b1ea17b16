"""What things cost: whole sweeps by their number of runs."""

from jaxdyna.experiments.benchmark.sweep import SWEEP

PARTS = (SWEEP,)
