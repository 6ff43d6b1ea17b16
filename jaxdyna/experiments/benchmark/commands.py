"""What is measured by commands, each a process of its own: sweeps, starts, and peaks of memory."""

from collections.abc import Iterable
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax

from jaxdyna.experiments.benchmark.frames import WORLDS
from jaxdyna.experiments.benchmark.others import PACKAGE, command, played
from jaxdyna.experiments.benchmark.timing import OURS, in_turns, in_units, row
from jaxdyna.experiments.engine import Results
from jaxdyna.experiments.engine.experiment import chosen
from jaxdyna.experiments.engine.memory import held
from jaxdyna.experiments.engine.session import prepared

IMPORTS = {OURS: "import jaxdyna", "jax, flax and optax": "import jax, flax, optax"}
#: a run of which starting takes the most
SHORT = ("--seeds", 2, "--episodes", 20, "--dyna.num-real-first", 10)
PEAK = "the process, at its peak"
#: runs of ``dyna`` whose memory is looked at
SMALL = {
    "CartPole": ("--seeds", "10", "--episodes", "20", "--dyna.num-real-first", "10"),
    **dict.fromkeys(WORLDS, ("--seeds", "2", "--episodes", "2", "--dyna.num-real-first", "1")),
}


def sweeps(options: Any) -> Iterable[Results]:
    """Seconds a run of CartPole's ``dyna`` in sweeps of many runs, beside those in the smallest."""
    episodes = options.sweep_episodes
    length = "--episodes", episodes, "--dyna.num-real-first", episodes // 2
    costs: dict[str, list[float]] = {"compiling included": [], "without compiling": []}
    for count in options.sizes:
        flags = "--arms", "dyna", "--seeds", count, "--seed", options.seed, *length
        _, results, _ = played("cartpole", *flags)
        spent = results["timing"]
        for kind, also in zip(costs, (spent["compile_s"], 0.0), strict=True):
            costs[kind].append((spent["run_s"] + also) / count)
            first, beside = costs[kind][0], f"{options.sizes[0]} runs"
            what = f"{count:,} runs of {episodes} episodes, a run's share, {kind}"
            theirs = costs[kind][1:] and first
            yield row(what, "s", costs[kind][-1], beside, theirs or None)


def start(options: Any) -> Iterable[Results]:
    """Imports, the help, and the first result by a cache of programs that is empty, then full."""
    calls = {who: ["-c", code] for who, code in IMPORTS.items()}
    calls["help"] = ["-m", f"{PACKAGE}.cartpole", "--help"]
    works = {who: in_units(partial(command, *argv), 1.0) for who, argv in calls.items()}
    seconds = in_turns(works, options.rounds, least_s=0)
    ours, theirs = (seconds[who] for who in IMPORTS)
    yield row("import jaxdyna", "s", ours, [*IMPORTS][1], theirs)
    yield row("--help", "s", seconds["help"], "import jaxdyna", ours)
    with TemporaryDirectory() as cache:
        (first, told, _), (second, again, _) = (
            played("cartpole", *SHORT, cache=Path(cache)) for _ in range(2)
        )
    compiling = (one["timing"]["compile_s"] for one in (again, told))
    yield row("second start, compiling", "s", next(compiling), "first start", next(compiling))
    yield row("second start, result and report", "s", second.seconds, "first start", first.seconds)


def memory(options: Any) -> Iterable[Results]:
    """The state of small runs of ``dyna``, beside the peak of the process that plays them."""
    nothing = command("-c", f"import {PACKAGE}.cartpole").peak_bytes
    yield row("nothing, imported alone", "GiB", None, PEAK, nothing)
    for name in ("CartPole", *(() if options.quick else options.worlds)):
        world, words = name.lower(), ["--arms", "dyna", *SMALL[name]]
        session = prepared(import_module(f"{PACKAGE}.{world}").PARTS, words, world)
        arm = chosen(session.every, session.options.arms)[0].make()
        state = jax.eval_shape(arm.work.init, jax.random.key(0), arm.hparams)
        ran, count = played(world, *words)[0], session.options.seeds
        what = f"{name}, {count} runs' state"
        yield row(what, "GiB", held(state) * count, PEAK, ran.peak_bytes)
