"""``python -m jaxdyna.experiments.catch``"""

from jaxdyna.experiments.catch import PARTS
from jaxdyna.experiments.engine import main

raise SystemExit(main(*PARTS))
