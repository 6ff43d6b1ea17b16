"""``python -m jaxdyna.experiments.merge DIR... --out DIR``: one record of a run's shards."""

import shlex
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro

from jaxdyna.experiments.engine import Curves, Experiment, Record, Results, cli, folders, storage
from jaxdyna.experiments.engine.progress import BOARD, gather
from jaxdyna.experiments.engine.record import different, recorded, results_of, write_report
from jaxdyna.experiments.engine.trained import FOLDER
from jaxdyna.experiments.engine.work import SHOWN, joined
from jaxdyna.fields import setting

PROG = "python -m jaxdyna.experiments.merge"
WHOSE = ("experiment", "part")
ALIKE = ("experiment", "part", "preset", "sweep", "source")
Shards = Mapping[Path, Results]


@dataclass(frozen=True)
class Call:
    """Makes one record of the folders that --shard 1/N to N/N left."""

    folders: tyro.conf.Positional[tuple[Path, ...]] = setting(help="of the shards")
    out: Path = setting(help="folder for the record")


@cli.command(Call, PROG, "DIR... --out DIR")
def main(call: Call, argv: Sequence[str]) -> int:
    """Makes the record; `ValueError` where the folders are not those of one run."""
    if not call.folders or len({one.resolve() for one in call.folders}) < len(call.folders):
        raise ValueError("give the folder of each shard, each of them once")
    shards = {folder: storage.read_json(folder / "results.json") for folder in call.folders}
    _check(shards, call.out)
    experiment, record = _merged(shards, f"{PROG} {shlex.join(argv)}", call.out)
    with folders.held(call.out):
        folders.claim(call.out, {name: record.results[name] for name in WHOSE}, fresh=False)
        for left in (folder / name for folder in shards for name in (FOLDER, BOARD)):
            if left.is_dir():
                shutil.copytree(left, call.out / left.name, dirs_exist_ok=True)
        gather([*shards], call.out)
        whose = storage.identity(record.results)
        storage.write_curves(call.out / "curves.npz", record.curves, whose)
        storage.write_json(call.out / "results.json", record.results)
        write_report(experiment, record)
    print(f"Report: {call.out / 'report.md'}")
    return 0


def _check(shards: Mapping[Path, Results | None], out: Path) -> None:
    """Raises ValueError unless these are the shards of one run, all of them and finished."""
    where: dict[int, Path] = {}
    first, one = next(iter(shards.items()))
    for folder, results in shards.items():
        if results is None or one is None or "runs" not in results:
            raise ValueError(f"{folder} has no results of a shard")
        if (folder / "checkpoints").exists():
            raise ValueError(f"{folder} is not finished: play it on with --resume")
        if folder.resolve() == out.resolve():
            raise ValueError(f"--out {out} is one of the shards: choose another folder")
        before, now = ({**said["config"], "arms": None} for said in (one, results))
        differ = [name for name in ALIKE if results[name] != one[name]]
        differ += [f"--{path.replace('_', '-')}" for path in different(before, now)]
        if differ:
            raise ValueError(f"{folder} has another {', '.join(differ)} than {first}: play all by "
                             "the same settings and code")  # fmt: skip
        if lacking := one["arms"].keys() ^ results["arms"].keys():
            raise ValueError(f"{', '.join(sorted(lacking))}: not in both {first} and {folder}")
        for seed in results["runs"]["seeds"]:
            if seed in where:
                raise ValueError(f"seed {seed} is in both {where[seed]} and {folder}")
            where[seed] = folder
    if one and (missing := sorted(set(range(one["runs"]["of"])) - where.keys())):
        raise ValueError(f"no shard has the seeds {', '.join(map(str, missing))}: give them all")


def _merged(shards: Shards, command: str, out: Path) -> tuple[Experiment, Record]:
    """The record of all shards together, and the experiment whose it is."""
    shards = dict(sorted(shards.items(), key=lambda shard: min(shard[1]["runs"]["seeds"])))
    first, *_ = every = list(shards.values())
    experiment, options, entries = recorded(first)
    spent = {
        name: {part: sum(one["timing"]["arms"].get(name, {}).get(part, 0.0) for one in every)
               for part in seconds}
        for one in every for name, seconds in one["timing"]["arms"].items()}  # fmt: skip
    total_s = sum(one["timing"]["total_s"] for one in every)
    peaks = [peak for one in every if (peak := one["device"]["peak_memory_gib"]) is not None]
    kept = ("experiment", "part", "module", "versions", "commit", "source", "sweep")
    about = {name: first[name] for name in (*kept, *experiment.measures) if name in first} | {
        "command": " && ".join([*(one["command"] for one in every), command]),
        "device": first["device"] | {"peak_memory_gib": max(peaks, default=None)},
        "runs": first["runs"] | {"seeds": list(range(first["runs"]["of"])), "shard": [1, 1]},
        "timing": {"arms": spent, "total_s": total_s, "shards": len(every)},
    }
    curves = _together(shards, list(first["arms"]))
    results = results_of(experiment, options, entries, curves, about)
    return experiment, Record(options, results, curves, out)


def _together(shards: Shards, arms: Sequence[str]) -> dict[str, Curves]:
    """The curves of all shards by arm, run by run in the order of the seeds."""
    runs: dict[str, dict[int, Curves]] = {arm: {} for arm in arms}
    for folder, results in shards.items():
        curves = storage.read_curves(folder / "curves.npz", storage.identity(results))
        if lacking := set(arms) - curves.keys():
            said = ", ".join(sorted(lacking))
            raise ValueError(f"{folder / 'curves.npz'} lacks {said}: copy or play it again")
        for row, seed in enumerate(results["runs"]["seeds"]):
            for arm in arms:
                runs[arm][seed] = {
                    name: values if name.startswith(SHOWN) else values[row]
                    for name, values in curves[arm].items()
                    if seed == 0 or not name.startswith(SHOWN)
                }
    return {arm: joined([own[seed] for seed in sorted(own)]) for arm, own in runs.items()}


if __name__ == "__main__":
    sys.exit(main())
