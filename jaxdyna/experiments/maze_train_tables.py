"""The tables of learning to act in the Maze."""

from __future__ import annotations

from jaxdyna.experiments.maze_train_cost import PARTS
from jaxdyna.experiments.report import Results, interval, markdown_table

Table = tuple[list[str], list[list[str]]]


def greedy(results: Results) -> Table:
    """How good the final policies are."""
    rows = []
    for name, arm in results["arms"].items():
        share, hits = arm["greedy"]["share"], arm["greedy"]["collisions"]
        rows.append(
            [
                name,
                f"{share['mean']:.3f} ({interval(share['ci95'], 3)})",
                f"{hits['mean']:.2f} ({interval(hits['ci95'], 2)})",
            ]
        )
    return ["arm", "share of the oracle's return", "collisions"], rows


def time(results: Results) -> Table:
    """Seconds of each arm."""
    rows = [
        [name, f"{arm['compile_s']:.0f}", f"{arm['run_s']:.0f}"]
        for name, arm in results["timing"]["arms"].items()
    ]
    cores = results["device"]["cpu_cores"]
    return [f"arm ({cores} cores)", "compiling (s)", "running (s)"], rows


def cost(results: Results) -> list[str]:
    """Where the time goes, and the most memory that was taken: paragraphs."""
    rows, rate = [], 0.0
    for name, arm in results["arms"].items():
        seconds, floors = arm["cost"]["seconds"], arm["cost"]["floor_seconds"]
        total, rate = sum(seconds.values()), arm["cost"]["matrix_product_gflops"]
        for part in PARTS:
            if seconds[part]:
                row = [name, part, f"{1e3 * seconds[part]:.0f}", f"{seconds[part] / total:.0%}"]
                rows.append([*row, f"{1e3 * floors[part]:.0f}"])
    peak = results["device"]["peak_memory_gib"]
    paragraphs = [
        "What a real episode takes once there are dreams, one run alone on the machine; the floor "
        "is the floating-point operations over the rate of a large matrix product "
        f"({rate:.0f} GFLOP/s here).",
        markdown_table(["arm", "part", "ms", "share", "floor (ms)"], rows),
    ]
    if peak is not None:
        paragraphs.append(f"The process took {peak:.1f} GiB of memory at the most.")
    return paragraphs
