"""``python -m jaxdyna.experiments.pong``"""

from jaxdyna.experiments.engine import main
from jaxdyna.experiments.pong import PARTS

raise SystemExit(main(*PARTS))
