"""Memory that is free on this machine, and refusals of what would not fit."""

from __future__ import annotations

from pathlib import Path

MEMINFO = Path("/proc/meminfo")
CONTROL_GROUP = Path("/sys/fs/cgroup")  # limits of containers


def available_memory() -> int | None:
    """Bytes that this process can still allocate; None if the system does not report it."""
    found = []
    try:
        lines = dict(line.split(":", 1) for line in MEMINFO.read_text().splitlines())
        found.append(1024 * int(lines["MemAvailable"].split()[0]))
    except (OSError, KeyError, ValueError):
        pass
    try:
        limit, used = ((CONTROL_GROUP / f"memory.{n}").read_text() for n in ("max", "current"))
        found.append(max(0, int(limit) - int(used)))
    except (OSError, ValueError):  # no control group, or no limit: "max"
        pass
    return min(found, default=None)


def check_memory(what: str, resolution: float, needed: float, power: int) -> None:
    """Raise a ValueError if a result would need more memory than is available.

    Args:
        what: the result, for the message, such as "the mesh would have about 3 million faces".
        resolution: with which it was asked for [m].
        needed: bytes.
        power: the memory is proportional to this power of 1 / resolution.
    """
    free = available_memory()
    if free is None or needed <= free:
        return
    enough = resolution * (needed / max(free, 1)) ** (1 / power)
    raise ValueError(
        f"resolution must be at least {enough:.2g} m for the {free / 1e9:.3g} GB of free memory; got "
        f"{resolution:g} m: {what} and need {needed / 1e9:.3g} GB"
    )
