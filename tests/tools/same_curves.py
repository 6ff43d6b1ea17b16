"""Whether two trees compute the same: plays the smoke commands of both on this machine, each on one
core and so on one device, and names the first array, run and episode that differ.

``python tests/tools/same_curves.py BASE``
"""

import argparse
import io
import json
import os
import shlex
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

import numpy as np

TOOLS = Path(__file__).resolve().parent
sys.path += [str(TOOLS), str(TOOLS.parent)]

import renamed  # noqa: E402
import tiny  # noqa: E402
from compared import Verdict, compare  # noqa: E402

COMMANDS = tiny.NET | tiny.LONG
FLAGS = (TOOLS.parent / "xla_flags").read_text().strip()
"""Of XLA, where the environment says nothing else: these compile more than they compute."""


def main() -> int:
    """The exit code: 1 where anything differs."""
    asked = arguments()
    with tempfile.TemporaryDirectory(prefix="same-curves-") as folder:
        commit = git("rev-parse", "--short", asked.base).decode().strip()
        base, keep = checked_out(commit, Path(folder) / commit), asked.keep or Path(folder)
        cores = sorted(os.sched_getaffinity(0))[:2]
        wrong = []
        for name in asked.only or tiny.NET:
            new = COMMANDS[name] if asked.old_spelling else todays(name)
            outs = [keep.absolute() / one / name for one in (commit, "new")]
            processes = [begin(base, COMMANDS[name], outs[0], cores[0], again=False)]
            if len(cores) == 1 and processes[0]:
                processes[0].wait()
            processes.append(begin(asked.tree.absolute(), new, outs[1], cores[-1]))
            failed = [out for out, process in zip(outs, processes, strict=True)
                      if process and process.wait()]  # fmt: skip
            if failed:
                verdict = Verdict(differences=[(-1, 0, f"failed: {last_line(failed[0])}")])
            else:
                verdict = compare(*map(left, outs), asked.tolerance, COMMANDS[name][0])
            wrong += [name] if verdict.first else []
            counts = f"{verdict.equal:3} of {verdict.total:3} arrays equal"
            print(f"{name:22} {counts}  {verdict.first}", flush=True)
            for note, arms in verdict.notes.items():
                print(f"    {note} ({len(arms)} arms)" if len(arms) > 2 else f"    {note} {arms}")
    print(f"different: {', '.join(wrong)}" if wrong else "all the same")
    return 1 if wrong else 0


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("base", help="a commit")
    parser.add_argument("--only", nargs="+", choices=COMMANDS, metavar="NAME",
                        help="commands of tests/tiny.py, also of its LONG ones")  # fmt: skip
    parser.add_argument("--tree", type=Path, default=TOOLS.parents[1],
                        help="what is compared with it, by default this checkout")  # fmt: skip
    parser.add_argument("--keep", type=Path, metavar="DIR",
                        help="keep the results; the base's are not made twice")  # fmt: skip
    parser.add_argument("--tolerance", type=float, help="see compared.compare")
    parser.add_argument("--old-spelling", action="store_true",
                        help="the other tree is told the commands as the base is")  # fmt: skip
    return parser.parse_args()


def todays(name: str) -> list[str]:
    """A command as it is typed today, with the base's block."""
    command = renamed.respelled(COMMANDS[name])
    assert command is not None, f"{name} was cut"
    return [*command, "--block", str(tiny.BLOCKS.get(name, 1))]


def begin(
    tree: Path, command: list[str], out: Path, core: int, again: bool = True
) -> subprocess.Popen | None:
    """Starts to play a command; None where that was done and is not wanted ``again``."""
    module, log, typed = command[0], out.with_suffix(".log"), shlex.join(command)
    if not again and (out / "curves.npz").exists() and log.read_text().startswith(f"{typed}\n"):
        return None
    frames = "model" in command and (tree / "jaxdyna/experiments/frame_session.py").exists()
    run = [str(TOOLS / "keep_losses.py")] if frames else ["-m"]
    run.append(module if frames else f"jaxdyna.experiments.{module}")
    out.parent.mkdir(parents=True, exist_ok=True)
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})  # the process that is started inherits it
    try:
        with log.open("w") as file:
            print(typed, file=file, flush=True)
            return subprocess.Popen(
                [sys.executable, *run, *command[1:], "--out", str(out)],
                cwd=tree,
                env={"XLA_FLAGS": FLAGS, **os.environ, "PYTHONPATH": str(tree)},
                stdout=file,
                stderr=file,
            )
    finally:
        os.sched_setaffinity(0, cores)


def left(out: Path) -> dict[str, dict[str, np.ndarray]]:
    """The arrays that a command left, by arm, and what decisions earned."""
    arms: dict[str, dict[str, np.ndarray]] = {}
    with np.load(out / "curves.npz") as file:
        for key in file.files:
            arm, _, name = key.rpartition("/")
            arms.setdefault(arm, {})[name] = file[key]
    for row in json.loads((out / "results.json").read_text()).get("budgets") or ():
        who = f"decisions: {row['environment']}, {row['who']}, {row['world']}, {row['steps']}"
        arms.setdefault("budgets", {})[who] = np.array(row["returns"])
    return arms


def checked_out(commit: str, folder: Path) -> Path:
    """The package as it was then."""
    with tarfile.open(fileobj=io.BytesIO(git("archive", commit, "jaxdyna"))) as file:
        file.extractall(folder, filter="data")
    return folder


def git(*words: str) -> bytes:
    """What git says in this checkout."""
    command = ["git", "-C", str(TOOLS.parents[1]), *words]
    return subprocess.run(command, check=True, capture_output=True).stdout


def last_line(out: Path) -> str:
    """Of its log."""
    return out.with_suffix(".log").read_text().strip().splitlines()[-1]


if __name__ == "__main__":
    sys.exit(main())
