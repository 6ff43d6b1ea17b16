"""``python -m jaxdyna.experiments.planning``"""

import sys

from jaxdyna.experiments.engine import main
from jaxdyna.experiments.planning import PARTS

if __name__ == "__main__":
    sys.exit(main(*PARTS))
