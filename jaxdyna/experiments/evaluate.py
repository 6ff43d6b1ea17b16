"""``python -m jaxdyna.experiments.evaluate DIR``: a run's kept policies, in numbers or a film."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from jaxdyna.envs.gymnasium import play
from jaxdyna.experiments.engine import cli, programs
from jaxdyna.experiments.engine.loaded import Loaded, load
from jaxdyna.experiments.engine.trained import EPISODES, RETURN
from jaxdyna.experiments.report.tables import markdown_table
from jaxdyna.fields import setting

PROG = "python -m jaxdyna.experiments.evaluate"


@dataclass(frozen=True)
class Call:
    """Plays a run's kept policies in new episodes and says what they earn, or films one an arm."""

    folder: tyro.conf.Positional[Path] = setting(help="of the run")
    episodes: int = setting(EPISODES, "that each plays", at_least=1)
    arms: tuple[str, ...] = setting((), "whose; all without")
    seed: int | None = setting(None, "of the run; all without, of a film the first")
    stage: int | None = setting(
        None, "the real episode after which; a run is played again up to there", at_least=1
    )
    gymnasium: bool = setting(False, "in Gymnasium's own world, where it has the same one")
    film: Path | None = setting(None, "the GIF or MP4 that is made instead")


@cli.command(
    Call,
    PROG,
    f"DIR [--arms ARM...] [--seed N] [--stage EPISODE] [--episodes {EPISODES}] [--gymnasium] "
    "[--film FILE]",
)
def main(call: Call, argv: Sequence[str]) -> int:
    """Prints what each earns, and what the report says, or films it. `ValueError` where nothing is
    kept in the folder, or Gymnasium has no such world.
    """
    left, rows = load(call.folder), []
    left = left.at(call.stage) if call.stage else left
    if call.stage:
        print("Runs are played again up to there, which takes compiling first.", file=sys.stderr)
    seeds = left.results["runs"]["seeds"]
    with programs.kept():
        if call.film is not None:
            left.film(call.film, call.arms, call.seed)
            print(f"Film: {call.film}")
            return 0
        for arm in call.arms or left.kept:
            kept = left.kept.get(arm, [None])
            for seed in kept if call.seed is None else [call.seed]:
                earned = returns(left, arm, seed, call)
                said = left.curves[arm].get(RETURN, np.full(len(seeds), np.nan))
                numbers = said[seeds.index(seed)], earned.mean(), earned.min(), earned.max()
                told = ("-" if np.isnan(one) else f"{one:.10g}" for one in numbers)
                rows.append([arm, str(seed), *told])
    if not rows:
        raise ValueError(f"{call.folder} keeps no policy: play with --keep-runs above 0")
    where = "Gymnasium's own world" if call.gymnasium else "the true world"
    where += f" after {call.stage} real episodes, or a run's last" if call.stage else ""
    header = ["arm", "seed", "report, in the end", f"{call.episodes} episodes", "least", "most"]
    print(f"Returns in {where}:\n\n{markdown_table(header, rows)}")
    return 0


def returns(left: Loaded, arm: str, seed: int | None, call: Call) -> np.ndarray:
    """Of a kept policy, ``[episodes]``; `ValueError` where it, or Gymnasium's world, is missing."""
    if not call.gymnasium:
        return left.returns(arm, seed, call.episodes)
    run = left.trained(arm, seed)
    world: Any = run.env
    if getattr(world, "num_frames", 0) == 1:
        world = world.env
    name = getattr(world, "gymnasium_id", None)
    if name is None:
        raise ValueError(f"--gymnasium: it has no {type(world).__name__} of its own")
    return play(name, run.policy, left.options.seed, call.episodes, int(run.params.max_steps))


if __name__ == "__main__":
    sys.exit(main())
