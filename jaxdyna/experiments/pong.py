"""Pong (§4.3): learning to play it, with and without dreams, or its frames alone.

``python -m jaxdyna.experiments.pong`` plays DQN with and without fake episodes;
``--part model`` trains frame models on a random and on a mixed policy's episodes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise

from jaxdyna.experiments import pong_frames, pong_train


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one of the two from the command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    frames = "--part=model" in arguments or ("--part", "model") in pairwise(arguments)
    return pong_frames.main(arguments) if frames else pong_train.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
