"""CartPole's result from the command line, cold, beside what PyTorch takes for the same runs, for
as much work as each has up to its own end: that is extrapolated, from measured pieces.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from jaxdyna.experiments.benchmark.others import played, rival
from jaxdyna.experiments.benchmark.timing import Work, in_turns, in_units, row
from jaxdyna.experiments.cartpole.options import TUNED
from jaxdyna.experiments.engine import Curves, Results, storage

REAL, MODEL, FAKE, TOGETHER = (
    "real step with its share of a policy update", "model update",
    "fake step with its share, one at a time", "fake step with its share, 8 at a time")  # fmt: skip
WARM_UP = 60  #: real episodes of PyTorch's run before its pieces are timed
#: how often the smallest number of runs is played, but for a quick look; larger ones as often in
#: all, at least once
COLD = 3
SIDES = {"PyTorch, as written": FAKE, "PyTorch, batched dreams": TOGETHER}


def measure(options: Any) -> Iterable[Results]:
    """`model_free` and `dyna` of `tuned`, in each number of runs."""
    torchs = pieces(rival("torch_cartpole"), options)
    for count in options.runs:
        ours: list[float] = []
        theirs: dict[str, list[float]] = {side: [] for side in SIDES}
        for _ in range(1 if options.quick else max(1, COLD * options.runs[0] // count)):
            seconds = in_turns(torchs, options.rounds)
            flags = "--seeds", count, "--seed", options.seed, "--episodes", options.episodes
            ran, results, curves = played("cartpole", *flags)
            ours.append(ran.seconds)
            units = [counted(results["arms"][name], curves[name]) for name in curves]
            for side, fake in SIDES.items():
                if seconds:
                    each = [np.median(seconds[name]) for name in (REAL, MODEL, fake)]
                    theirs[side].append(float(np.sum(units, axis=0) @ each) / storage.cores())
        for side in SIDES:
            yield row(f"{count:,} runs of both arms", "s", ours, side, theirs[side] or None)
    for name, turns in seconds.items():
        yield row(name, "ms", None, "PyTorch", turns)


def counted(arm: Results, curves: Curves) -> tuple[float, float, float]:
    """Real steps, model updates and fake steps of all runs of an arm, each up to its own end: as
    many episodes after it has solved as `tuned` plays on.
    """
    dyna, solved = TUNED.dyna, arm["episodes_to_solve"]["per_seed"]
    ends = np.array([np.inf if one is None else one + TUNED.stop_after_solved for one in solved])
    counts = np.arange(1, curves["real_length"].shape[1] + 1) <= ends[:, None]

    def total(name: str) -> float:
        return float(np.nansum(np.where(counts, curves[name], 0.0)))

    if "fake_length" not in curves:
        return total("real_length"), 0.0, 0.0
    episodes = (counts & np.isfinite(curves["real_length"])).sum()
    fakes = dyna.dream_updates * dyna.dream_episodes * total("fake_length")
    return total("real_length"), float(dyna.model_updates * episodes), fakes


def pieces(torch: Any, options: Any) -> Mapping[str, Work]:
    """PyTorch's, on one core, which is enough; fake episodes last to the end, which costs least."""
    if torch is None:
        return {}
    torch.torch.set_num_threads(1)
    one, together, steady = (
        torch.Run(options.seed, batched, ends_above=1.0) for batched in (False, True, False)
    )
    for number in range(WARM_UP):
        one.episode(number)
    together.starts, together.model = one.starts, one.model
    return {
        REAL: balanced(torch.torch, steady).real_episode, MODEL: in_units(one.train_model, 1.0),
        FAKE: one.learn_from_dreams, TOGETHER: together.learn_from_dreams}  # fmt: skip


def balanced(torch: Any, run: Any) -> Any:
    """A run whose policy holds the pole to the end: most real steps are of long episodes."""
    first, last = run.policy[0].weight, run.policy[2].weight
    with torch.no_grad():
        first.zero_()
        first[0] = torch.tensor([0.1, 0.5, 3.0, 1.0])
        first[1] = -first[0]
        last.zero_()
        last[1, 0] = last[0, 1] = 20.0
    return run
