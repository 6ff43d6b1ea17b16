"""``python -m jaxdyna.experiments.benchmark``"""

from jaxdyna.experiments.benchmark import PARTS
from jaxdyna.experiments.engine import main

raise SystemExit(main(*PARTS))
