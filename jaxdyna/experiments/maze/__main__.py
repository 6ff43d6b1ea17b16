"""``python -m jaxdyna.experiments.maze``"""

import sys

from jaxdyna.experiments.engine import main
from jaxdyna.experiments.maze import PARTS

if __name__ == "__main__":
    sys.exit(main(*PARTS))
