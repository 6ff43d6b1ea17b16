"""``python -m jaxdyna.experiments.pong``"""

import sys

from jaxdyna.experiments.engine import main
from jaxdyna.experiments.pong import PARTS

if __name__ == "__main__":
    sys.exit(main(*PARTS))
