"""Other processes: one that uses plain torch, and new ones to measure memory."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch

SPAWN = multiprocessing.get_context("spawn")


@contextmanager
def plain_path(jobs: Callable[..., dict[str, Callable[[], Any]]], *arguments: Any) -> Iterator[Any]:
    """Start a process without the native kernel; yields a call that runs one of the jobs there.

    Args:
        jobs: a function of a module that makes the jobs in the new process, by name.
        arguments: what it is called with.
    """
    ours, theirs = SPAWN.Pipe()
    before = os.environ.get("LARDHM_NATIVE")
    os.environ["LARDHM_NATIVE"] = "0"
    threads = torch.get_num_threads()
    process = SPAWN.Process(target=_serve, args=(theirs, threads, jobs, arguments), daemon=True)
    process.start()
    os.environ.pop("LARDHM_NATIVE")
    if before is not None:
        os.environ["LARDHM_NATIVE"] = before

    def run(name: str) -> None:
        ours.send(name)
        error = ours.recv()
        if error:
            raise RuntimeError(f"the plain path failed at {name!r}: {error}")

    yield run
    ours.send(None)
    process.join()


@torch.no_grad()
def _serve(
    connection: Connection,
    threads: int,
    make_jobs: Callable[..., dict[str, Callable[[], Any]]],
    arguments: tuple[Any, ...],
) -> None:
    torch.set_num_threads(threads)
    jobs: dict[str, Callable[[], Any]] = {}
    while (name := connection.recv()) is not None:
        try:
            jobs = jobs or make_jobs(*arguments)
            jobs[name]()
            connection.send(None)
        except Exception as error:
            connection.send(repr(error))


def peak_memory(job: Callable[..., Callable[[], Any]], *arguments: Any) -> int:
    """Peak memory of a job beyond its prepared input [bytes], in a new process.

    Args:
        job: a function of a module; it prepares the input and returns the call that is measured.
        arguments: what it is called with.
    """
    ours, theirs = SPAWN.Pipe()
    process = SPAWN.Process(
        target=_measure, args=(theirs, torch.get_num_threads(), job, arguments), daemon=True
    )
    process.start()
    theirs.close()
    answer = ours.recv()
    process.join()
    return answer


@torch.no_grad()
def _measure(
    connection: Connection,
    threads: int,
    job: Callable[..., Callable[[], Any]],
    arguments: tuple[Any, ...],
) -> None:
    torch.set_num_threads(threads)
    run = job(*arguments)
    Path("/proc/self/clear_refs").write_text("5")  # resets the peak to the current memory
    before = _status_bytes("VmRSS")
    run()
    connection.send(_status_bytes("VmHWM") - before)


def _status_bytes(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    raise RuntimeError(f"/proc/self/status has no {name}: memory is measured on Linux only")
