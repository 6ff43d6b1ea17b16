"""What is measured from the command line, each in a process of its own that knows of nothing: whole
sweeps, starts, and peaks of memory.
"""

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax

from jaxdyna.experiments.benchmark.timing import OURS, Ran, command, in_turns, row
from jaxdyna.experiments.benchmark.frames import WORLDS
from jaxdyna.experiments.engine import Results, storage
from jaxdyna.experiments.engine.experiment import chosen
from jaxdyna.experiments.engine.memory import held
from jaxdyna.experiments.engine.session import prepared

PACKAGE = "jaxdyna.experiments"
IMPORTS = {OURS: "import jaxdyna", "jax, flax and optax": "import jax, flax, optax"}
SHORT = ("--seeds", 2, "--episodes", 20, "--dyna.num-real-first", 10)
"""A run of which starting takes the most."""
SMALL = {
    "CartPole": ("--seeds", "10", "--episodes", "20", "--dyna.num-real-first", "10"),
    **dict.fromkeys(WORLDS, ("--seeds", "2", "--episodes", "2", "--dyna.num-real-first", "1")),
}
"""Runs of ``dyna`` whose memory is looked at."""


def played(
    world: str, *flags: Any, cache: Path | None = None
) -> tuple[Ran, Results, dict[str, Any]]:
    """A world's command: its process, its ``results.json`` and its curves."""
    with TemporaryDirectory() as folder:
        out = Path(folder, "result")
        words = *map(str, flags), *(() if cache else ("--no-cache",)), "--out", str(out)
        ran = command("-m", f"{PACKAGE}.{world}", *words, cache=cache)
        return ran, storage.read_json(out / "results.json"), storage.read_curves(out / "curves.npz")


def sweeps(options: Any) -> Iterable[Results]:
    """Seconds a run of CartPole's ``dyna`` in sweeps of many runs, beside those in the smallest."""
    costs: dict[str, list[float]] = {"compiling included": [], "without compiling": []}
    for count in options.sizes:
        _, results, _ = played(
            "cartpole", "--arms", "dyna", "--seeds", count, "--seed", options.seed,
            "--episodes", options.sweep_episodes, "--dyna.num-real-first", options.sweep_episodes // 2,
        )  # fmt: skip
        spent = results["timing"]
        for kind, also in zip(costs, (spent["compile_s"], 0.0), strict=True):
            costs[kind].append((spent["run_s"] + also) / count)
            yield row(f"{count:,} runs, a run's share, {kind}", "s", costs[kind][-1],
                      f"{options.sizes[0]} runs", costs[kind][0])  # fmt: skip


def start(options: Any) -> Iterable[Results]:
    """Imports, the help, and the first result by a cache of programs that is empty, then full."""
    works: dict[str, Any] = {who: (lambda code=code: command("-c", code) and 1)
                             for who, code in IMPORTS.items()}  # fmt: skip
    works["help"] = lambda: command("-m", f"{PACKAGE}.cartpole", "--help") and 1
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
    """The peak of small runs of ``dyna``, beside the state of these runs."""
    nothing = command("-c", f"import {PACKAGE}.cartpole").peak_bytes
    yield row("nothing, imported alone", "GiB", nothing, "-")
    for name in ("CartPole", *options.worlds):
        world, words = name.lower(), ["--arms", "dyna", *SMALL[name]]
        session = prepared(import_module(f"{PACKAGE}.{world}").PARTS, words, world)
        arm = chosen(session.every, session.options.arms)[0].make()
        state = jax.eval_shape(arm.work.init, jax.random.key(0), arm.hparams)
        yield row(f"{name}, {session.options.seeds} runs", "GiB", played(world, *words)[0].peak_bytes, "their state",
                  held(state) * session.options.seeds)  # fmt: skip
