"""``python -m jaxdyna.experiments.cartpole``"""

from jaxdyna.experiments.cartpole import PARTS
from jaxdyna.experiments.engine import main

raise SystemExit(main(*PARTS))
