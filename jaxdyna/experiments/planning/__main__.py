"""``python -m jaxdyna.experiments.planning``"""

from jaxdyna.experiments.engine import main
from jaxdyna.experiments.planning import PARTS

raise SystemExit(main(*PARTS))
