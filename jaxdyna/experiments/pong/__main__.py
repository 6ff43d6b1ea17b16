"""``python -m jaxdyna.experiments.pong``"""

from jaxdyna.experiments.pong import PARTS
from jaxdyna.experiments.engine import main

raise SystemExit(main(*PARTS))
