"""The Maze (§4.2): learning to act in it, with and without dreams, or its frames alone.

``python -m jaxdyna.experiments.maze`` plays DQN with and without fake episodes;
``--part model`` trains frame models on a random policy's episodes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import pairwise

from jaxdyna.experiments import maze_frames, maze_train


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one of the two from the command line; returns the exit code."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    frames = "--part=model" in arguments or ("--part", "model") in pairwise(arguments)
    return maze_frames.main(arguments) if frames else maze_train.main(arguments)


if __name__ == "__main__":
    sys.exit(main())
