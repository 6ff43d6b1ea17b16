"""``python -m jaxdyna.experiments.planning``"""

from jaxdyna.experiments.planning import PARTS
from jaxdyna.experiments.engine import main

raise SystemExit(main(*PARTS))
