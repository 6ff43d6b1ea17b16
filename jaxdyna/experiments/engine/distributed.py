"""A run over several processes, on any hosts that see its folder.

Runs know nothing of each other, so processes say little: who they are, that the first has the
folder ready, and that they are done; what they have played lies in the folder. JAX's own runtime
says it. It knows Slurm, Kubernetes, Open MPI and TPU pods, and notices where a process is lost, but
then it aborts all others. So it lives in a child of each process, which is this file as a program:
where that ends, its parent saves what it plays. To JAX the parent is alone: devices, programs and
bits are those of one process.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, redirect_stderr, suppress
from io import StringIO
from queue import Empty, Queue
from typing import Any

import jax

FLAG = "--distributed"
WHERE = re.compile(r"([^,]+:\d+),([1-9]\d*)/(\d+)")
HEARTBEAT_SECONDS = 20
#: how long a process waits for others, which may have more to play
PATIENCE_MS = 20 * 24 * 3600 * 1000
#: how JAX's runtime names those that it misses, but for the first, which it is part of
LOST = re.compile(r"^(\d+)$|Task (\d+) heartbeat", re.MULTILINE)


def taken(argv: Sequence[str]) -> tuple[list[str], str | None]:
    """A command line without ``--distributed``, which does not change what is played, and what it
    says: empty where the flag stands alone, None where it is not there.
    """
    at = next((at for at, word in enumerate(argv) if word.partition("=")[0] == FLAG), None)
    if at is None:
        return list(argv), None
    said, rest = argv[at].partition("=")[2], list(argv[at + 1 :])
    if argv[at] == FLAG and rest and not rest[0].startswith("-"):
        said = rest.pop(0)
    return [*argv[:at], *rest], said


class Processes:
    """The processes of a run, as one of them sees them; it is the only one until they are `found`.

    Attributes:
        number: this one's, from 1.
        of: how many there are.
        interrupted: set where one is lost.
        lost: which, in words.
        tell: is told the same, in one process.
    """

    number, of, lost = 1, 1, ""
    child: Any = None

    def __init__(self) -> None:
        self.interrupted, self.ending = threading.Event(), threading.Event()
        self.tell: Callable[[str], None] = lambda _: None
        self.replies: Queue[str] = Queue()
        self.hushed = ExitStack()

    @property
    def first(self) -> bool:
        """Whether this one prepares the folder, prints, and writes the record."""
        return self.number == 1

    def rows(self, count: int, block: int) -> list[int]:
        """Which of so many runs this one plays; they are dealt out by blocks."""
        return [row for row in range(count) if row // block % self.of == self.number - 1]

    def found(self, said: str, stack: ExitStack) -> None:
        """Finds out who this one is. Where a cluster gave all the same command line, only the
        first says what is bad about it, until they meet. `ValueError` where nothing says which
        processes there are.

        Args:
            said: by ``--distributed``, as `taken` gives it.
            stack: whose end ends the child.
        """
        match = WHERE.fullmatch(said)
        if said and (match is None or int(match[2]) > int(match[3])):
            raise ValueError(f"{FLAG} {said}: give HOST:PORT,I/N with I from 1 to N, or nothing")
        given = match and (match[1], int(match[3]), int(match[2]) - 1, ())
        kept = {name: value for name, value in os.environ.items()
                if not name.lower().endswith("_proxy")}  # fmt: skip
        self.log = stack.enter_context(tempfile.TemporaryFile("w+"))  # noqa: SIM115
        self.child = subprocess.Popen(
            [sys.executable, "-P", __file__, json.dumps(given)], text=True, start_new_session=True,
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self.log,
            env=kept | {"JAX_ENABLE_PREEMPTION_SERVICE": "0"})  # fmt: skip
        stack.callback(self.child.kill)
        stack.callback(self.ending.set)
        self.of, number, visible = json.loads(self.child.stdout.readline() or "[0, 0, 0]")
        if not self.of:
            raise ValueError(f"{FLAG}: no Slurm, Kubernetes, Open MPI or TPU pod says which "
                             f"processes there are: give {FLAG} HOST:PORT,I/N")  # fmt: skip
        self.number = number + 1
        if visible:
            jax.config.update("jax_cuda_visible_devices", visible)
            jax.config.update("jax_rocm_visible_devices", visible)
        if not (self.first or said):
            stack.enter_context(self.hushed).enter_context(redirect_stderr(StringIO()))
        threading.Thread(target=self._listen, daemon=True).start()

    @contextmanager
    def after_first(self) -> Iterator[None]:
        """Meets the others, and lets the first go ahead. Where it fails, of which it tells, they
        end with code 2. `ValueError` where they do not meet.
        """
        try:
            self._ask("join")
            failed = not self.first and self._ask("ready") == "no"
        except KeyboardInterrupt:
            if not self.lost:
                raise
            raise ValueError(
                f"{FLAG}: {self.of} processes did not meet: start all of them, and give each the "
                "first one's host and a port that is free there"
            ) from None
        if failed:
            self.leave()
            raise SystemExit(2)
        self.hushed.close()
        try:
            yield
        except BaseException:
            if self.first:
                self._ask("no")
                self.leave()
            raise
        if self.first:
            self._ask("yes")

    def leave(self) -> None:
        """Waits until all are here; `KeyboardInterrupt` if one is lost, or this interrupted."""
        self._ask("leave")
        self.ending.set()

    def _ask(self, word: str) -> str:
        if self.child is None:
            return ""
        with suppress(BrokenPipeError):
            print(word, file=self.child.stdin, flush=True)
        while not self.interrupted.is_set():
            with suppress(Empty):
                return self.replies.get(timeout=0.2)
        raise KeyboardInterrupt

    def _listen(self) -> None:
        for line in self.child.stdout:
            self.replies.put(line.strip())
        code = self.child.wait()
        if self.ending.is_set() or self.interrupted.is_set():  # who was told to end is not lost
            return
        self.log.seek(0)
        named = {int(one or other) + 1 for one, other in LOST.findall(self.log.read())}
        gone = named or {self.number if code == -signal.SIGKILL else 1}
        self.lost = f"process {min(gone)} of {self.of} was lost"
        if self.number == min({*range(1, self.of + 1)} - gone, default=0):
            self.tell(self.lost)
        self.interrupted.set()


def _runtime(given: tuple[str, int, int, Sequence[int]] | None) -> None:
    """The child: says which processes there are, and answers its parent until that ends."""
    from jax._src import clusters, distributed  # noqa: PLC0415  (not public; Orbax uses it too)

    for one in (signal.SIGINT, signal.SIGTERM):  # the parent's; clusters send them to both
        signal.signal(one, signal.SIG_IGN)
    detect = clusters.ClusterEnv.auto_detect_unset_distributed_params
    address, of, number, own = given or detect(None, None, None, None, None, 300)
    visible = os.environ.get("JAX_LOCAL_DEVICE_IDS") or ",".join(map(str, own or ()))
    print(json.dumps((of, number, visible)), flush=True)

    def answer(word: str) -> None:
        client: Any = distributed.global_state.client
        reply = "done"
        try:
            if word == "join":
                local = address and address.startswith(("127.", "localhost:"))
                jax.distributed.initialize(
                    address, of, number, cluster_detection_method="deactivate",
                    heartbeat_timeout_seconds=HEARTBEAT_SECONDS,
                    coordinator_bind_address=address if local else None)  # fmt: skip
            elif word == "ready":
                reply = client.blocking_key_value_get("ready", PATIENCE_MS)
            elif word == "leave":
                client.wait_at_barrier("leave", PATIENCE_MS)
                jax.distributed.shutdown()
            else:
                client.key_value_set("ready", word)
            print(reply, flush=True)
        except BaseException:
            traceback.print_exc()
            os._exit(1)

    for line in sys.stdin:  # in threads: its end, the parent's, is seen at any time
        threading.Thread(target=answer, args=(line.strip(),), daemon=True).start()
    os._exit(0)


if __name__ == "__main__":
    _runtime(json.loads(sys.argv[1]))
