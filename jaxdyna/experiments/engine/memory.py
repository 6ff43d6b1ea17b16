"""What memory runs take, and what there is: refused before they begin instead of killed later."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import jax

from jaxdyna.experiments.engine.storage import InputError

#: a container's limit and use, below ``/sys/fs/cgroup``: of control groups 2 and 1
GROUPS = (
    ("memory.max", "memory.current"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes"),
)


def held(*trees: Any) -> int:
    """Bytes of arrays, or of their shapes."""
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(trees))


def used_by(program: Any) -> int:
    """Bytes that a compiled program takes while it runs, arguments and results among them."""
    stats = program.memory_analysis()
    if stats is None:
        return 0
    whole = stats.argument_size_in_bytes + stats.output_size_in_bytes + stats.temp_size_in_bytes
    return whole - stats.alias_size_in_bytes


def afford(need: int, block: int, at_once: int, place: jax.Device) -> None:
    """Refuses what does not fit: `InputError` where there is less than all of the blocks take.

    Args:
        need: bytes of a block, at the least.
        block: runs in it.
        at_once: blocks that are played at a time on the device.
        place: the device.
    """
    free = available(place)
    if free is not None and need * at_once > free:
        told, there = need * at_once / 2**30, free / 2**30
        raise InputError(
            f"{at_once} x {block} runs at a time take {told:.1f} GiB of memory or more, and "
            f"{there:.1f} GiB are free: lower --block, --episodes, batches or replays"
        )


def spare(need: int, most: int, place: jax.Device) -> int:
    """How many blocks of ``need`` bytes fit into half of a device's free memory, up to ``most``."""
    free = available(place)
    return most if free is None or need == 0 else min(most, free // (2 * need))


def available(place: jax.Device) -> int | None:
    """Bytes that are free on a device, of a CPU in this container; None where nobody says."""
    if place.platform != "cpu":
        stats = place.memory_stats() or {}
        limit = stats.get("bytes_limit")
        return limit and limit - stats.get("bytes_in_use", 0)
    free = []
    with suppress(OSError, ValueError, IndexError):
        after = Path("/proc/meminfo").read_text().split("MemAvailable:")[1]
        free.append(int(after.split()[0]) * 1024)
    for limit, used in GROUPS:
        with suppress(OSError, ValueError):  # no such group, or no limit
            most, now = (int(Path("/sys/fs/cgroup", name).read_text()) for name in (limit, used))
            free.append(most - now)
    return min(free, default=None)
