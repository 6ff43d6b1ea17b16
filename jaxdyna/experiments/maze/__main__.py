"""``python -m jaxdyna.experiments.maze``"""

from jaxdyna.experiments.maze import PARTS
from jaxdyna.experiments.engine import main

raise SystemExit(main(*PARTS))
