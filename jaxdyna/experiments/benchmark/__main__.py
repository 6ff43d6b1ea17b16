"""``python -m jaxdyna.experiments.benchmark``"""

import sys

from jaxdyna.experiments.benchmark import PARTS
from jaxdyna.experiments.engine import main

if __name__ == "__main__":
    sys.exit(main(*PARTS))
