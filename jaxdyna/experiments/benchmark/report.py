"""The tables, and all ratios in one figure."""

from jaxdyna.experiments.benchmark.timing import PYTORCH
from jaxdyna.experiments.engine import Record, Results
from jaxdyna.experiments.report import plots
from jaxdyna.experiments.report.sections import paragraphs
from jaxdyna.experiments.report.tables import markdown_table

SAID = {
    "whole": "CartPole's arms `model_free` and `dyna` by `tuned` from the command line, cold: with "
    "compiling, evaluating, judging and drawing. Beside it the same algorithm in PyTorch and "
    "Gymnasium, **extrapolated**: its pieces, timed in turns with ours, times their numbers in "
    "just these runs, each up to its own end, over the number of cores, as if as many processes "
    "at once took no longer than one. Ours is played three times with the smallest number of runs, "
    "once with more.",
    "steps": "Many environments at once; each step makes what is seen, the last is kept. Given: "
    "poles pushed to and fro for 16 steps from an episode's start, so that none falls. At random: "
    "an action drawn for every step; what is over is reset. NumPy plays one Maze at a time.",
    "dreams": "Steps of the learned CartPole model in `rollout`, the policy acting. The ceiling is "
    "what products of as many rows with 256x256 allow.",
    "frames": "One run on all cores, each batch drawn from its replay: the Maze by `tuned`, Pong's "
    "arm `dyna_l2` by `paper`, without what is only looked at. PyTorch steps dreams together, its "
    "replay is a list of transitions, its Pong the Atari 2600's; ours is the pure game.",
    "sweeps": "CartPole's `dyna` by `tuned`, compiled anew, in runs so short that of ten of them "
    "compiling is the most, dreaming from the middle; once each.",
    "start": "Each in a process of its own. The result is that of a short run of CartPole's two "
    "arms, with a cache of programs that is empty, then full, once each.",
    "memory": "The state of all runs of a short play, beside the peak of its process, most of "
    "which is compiling; once each."}  # fmt: skip
BESIDE = ("whole", "steps", "dreams", "frames")  #: what others are beside
TICKS = (1, 2, 5, 10, 20, 50, 100, 200)  #: of the figure, as far as it goes
LACKING = (
    "PyTorch is missing: `pip install 'jaxdyna[bench]'`, in a checkout, where `docs/examples` is."
)


def section(record: Record, name: str) -> str:
    """The table of a measurement, and what its machine could do meanwhile; empty without."""
    found = record.results.get(name)
    if not found:
        return ""
    rows, rates = found["rows"], found["yardstick"].items()
    shared = any("share" in row for row in rows)
    header = ["what", "jaxdyna", "beside it", "its own", "ratio (lowest to highest)"]
    header += ["of the ceiling"] if shared else []
    lines = [
        [row["what"], told(row["ours"], row["unit"]), row["whose"],
         told(row["theirs"], row["unit"]), ratio(row),
         *([f"{row['share']:.0%}"] if shared else [])]
        for row in rows]  # fmt: skip
    lacks = any(row["whose"].startswith(PYTORCH) and row["theirs"] is None for row in rows)
    said = ", ".join(f"{rate:,.0f} ({product})" for product, rate in rates)
    return paragraphs(
        f"## {name}",
        SAID[name],
        markdown_table(header, lines),
        LACKING if lacks else "",
        f"GFLOP/s of products in single precision just before: {said}.",
    )


def line(row: Results) -> str:
    """A row in one line."""
    ours, theirs = (told(row[side], row["unit"]) for side in ("ours", "theirs"))
    return f"{row['what']}: {ours}; {row['whose']}: {theirs}; ratio {ratio(row)}"


def told(value: float | None, unit: str) -> str:
    """A number and its unit."""
    if value is None:
        return "-"
    return f"{value:,.0f} {unit}" if value >= 100 else f"{value:.3g} {unit}"


def ratio(row: Results) -> str:
    """How many times the other's seconds, or bytes, are ours."""
    if "ratio" not in row:
        return "-"
    low, high = row["ends"]
    said = f"{row['ratio']:.3g}"
    return said if low == high else f"{said} ({low:.3g} to {high:.3g})"


def machine(record: Record) -> str:
    """Where, and how to read the tables."""
    device, rounds = record.results["device"], record.options.rounds
    measured = [record.results.get(name) or {} for name in SAID]
    rivals = {k: v for found in measured for k, v in found.get("rivals", {}).items()}
    used = {name: record.results["versions"][name] for name in ("jax", "gymnasium", "numpy")}
    with_what = ", ".join(f"{name} {number}" for name, number in (used | rivals).items())
    return (
        f"On {device['cpu_cores']} cores ({device['kind']}; PyTorch and NumPy on the CPU), with "
        f"{with_what}. "
        f"Where it is not said otherwise, both sides in turns, {rounds} each; medians. A ratio is "
        "the other's time, or bytes, over ours, turn by turn: above 1 ours is the faster. Seconds "
        "are this machine's, ratios less so; what it does at all in large products stands below "
        "each table."
    )


def figure(record: Record) -> str:
    """All ratios to others, in ``ratios.png``."""
    measured = {name: (record.results.get(name) or {"rows": []})["rows"] for name in SAID}
    rows = [row for name in BESIDE for row in measured[name] if "ratio" in row]
    if not rows:
        return ""
    ends = [end for row in rows for end in row["ends"]]
    drawn, panel = plots.subplots(figsize=(plots.WIDTH, 0.3 * len(rows) + 1.2))
    for place, row in enumerate(rows):
        panel.plot(row["ends"], [place, place], color=plots.FAINT)
        panel.plot(row["ratio"], place, "o", color=plots.GREEN)
    panel.axvline(1, color=plots.MARK, linewidth=1, linestyle=plots.DASHED)
    panel.set_yticks(range(len(rows)), [f"{row['what']} | {row['whose']}" for row in rows])
    panel.set_ylim(len(rows) - 0.4, -0.6)
    panel.set_xscale("log")
    panel.set_xticks(TICKS, map(str, TICKS), minor=False)
    panel.minorticks_off()
    panel.set_xlim(min(0.8, *ends) / 1.1, max(ends) * 1.1)
    plots.finish(panel, x="times as fast (median of the turns; line: lowest to highest)")
    plots.save(drawn, record.out / "ratios.png")
    return "![how many times as fast as others](ratios.png)"
