"""``python -m jaxdyna.experiments.maze``"""

from jaxdyna.experiments.engine import main
from jaxdyna.experiments.maze import PARTS

raise SystemExit(main(*PARTS))
