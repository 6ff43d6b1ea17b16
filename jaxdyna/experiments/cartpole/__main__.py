"""``python -m jaxdyna.experiments.cartpole``"""

import sys

from jaxdyna.experiments.cartpole import PARTS
from jaxdyna.experiments.engine import main

if __name__ == "__main__":
    sys.exit(main(*PARTS))
