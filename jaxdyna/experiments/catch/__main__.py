"""``python -m jaxdyna.experiments.catch``"""

import sys

from jaxdyna.experiments.catch import PARTS
from jaxdyna.experiments.engine import main

if __name__ == "__main__":
    sys.exit(main(*PARTS))
