"""An experiment in shards by submitit (``pip install submitit``), on a Slurm cluster or, without
one, on this machine:

    python docs/examples/submitit_sweep.py 4 runs/cartpole cartpole --seeds 40

plays ``python -m jaxdyna.experiments.cartpole --seeds 40`` in four shards and leaves one record in
runs/cartpole, as if it had been played at once. A shard that Slurm preempts goes on where it was;
called again, so do those that failed. ``SUBMITIT`` in the environment holds what the executor is
told, as JSON, such as ``{"slurm_partition": "long", "timeout_min": 600, "cpus_per_task": 2}``, or
``{"cluster": "local"}``.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import submitit
from submitit.helpers import DelayedSubmission


@dataclass(frozen=True)
class Shard:
    """The N-th part of an experiment's runs; called, it plays them in a process of its own."""

    number: int
    of: int
    out: Path
    words: tuple[str, ...]

    @property
    def folder(self) -> Path:
        """Where they are played."""
        return self.out / "parts" / f"{self.number}-of-{self.of}"

    def __call__(self) -> None:
        begun = (self.folder / "checkpoints").exists()
        if begun or not (self.folder / "results.json").exists():
            which = ["--shard", f"{self.number}/{self.of}", "--out", str(self.folder)]
            play(*self.words, *which, *["--resume"] * begun)

    def checkpoint(self) -> DelayedSubmission:
        """What is submitted in its place once it was preempted: itself, which goes on."""
        return DelayedSubmission(self)


def play(experiment: str, *flags: str) -> None:
    """Runs one of the package's commands."""
    command = [sys.executable, "-m", f"jaxdyna.experiments.{experiment}", *flags]
    with subprocess.Popen(command) as child:
        try:
            code = child.wait()
        except BaseException:  # preempted: what it has played is saved
            child.terminate()
            raise
    if code:
        sys.exit(f"{' '.join(command)} ended with code {code}")


def main(of: int, out: Path, words: tuple[str, ...]) -> None:
    """Submits the shards, waits for them, and merges them."""
    told = json.loads(os.environ.get("SUBMITIT", "{}"))
    executor = submitit.AutoExecutor(out / "parts" / "logs", told.pop("cluster", None))
    executor.update_parameters(**told)
    shards = [Shard(number, of, out, words) for number in range(1, of + 1)]
    with executor.batch():
        jobs = [executor.submit(shard) for shard in shards]
    for job in jobs:
        job.result()
    play("merge", *(str(shard.folder) for shard in shards), "--out", str(out))


if __name__ == "__main__":
    if len(sys.argv) < 4 or not sys.argv[1].isdecimal():
        sys.exit(f"usage: {sys.argv[0]} SHARDS OUT EXPERIMENT [FLAG ...]")
    main(int(sys.argv[1]), Path(sys.argv[2]), tuple(sys.argv[3:]))
