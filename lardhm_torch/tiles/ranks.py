"""Ranks: processes that share the work on one folder, each taking the next free item.

`torchrun` starts them, on one or several machines. While they work they communicate only through
its store. Without `torchrun`, a single process does the same work alone.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist

Work = TypeVar("Work")


@dataclass(frozen=True)
class Ranks:
    """One process of a job.

    Args:
        store: key-value store that all processes share.
        rank: number of this process, from 0.
        size: number of processes.
        device: device of this process.
    """

    store: dist.Store
    rank: int
    size: int
    device: torch.device

    def take(self, name: str, work: Sequence[Work]) -> Iterator[Work]:
        """Items of a list that is the same on all ranks; each item goes to exactly one rank."""
        while (number := self.store.add(f"taken/{name}", 1) - 1) < len(work):
            yield work[number]

    def count(self, name: str, more: int) -> int:
        """Add to a counter that all ranks share, and return its new value."""
        return self.store.add(f"count/{name}", more)

    def agree(self, name: str, decide: Callable[[], Any]) -> Any:
        """Evaluate ``decide`` on rank 0 and return its result, a JSON value, on all ranks."""
        if self.rank == 0:
            self.store.set(f"agreed/{name}", json.dumps(decide()))
        return json.loads(self.store.get(f"agreed/{name}"))

    def wait(self) -> None:
        """Block until all ranks have called this method."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def join_ranks() -> Iterator[Ranks]:
    """This process as a rank of the job that `torchrun` started, or as its only one.

    With GPUs the backend is nccl and each rank has a GPU of its own; otherwise it is gloo.
    """
    if not dist.is_torchelastic_launched():
        yield Ranks(dist.HashStore(), 0, 1, torch.get_default_device())
        return
    store, rank, size = next(dist.rendezvous("env://"))
    gpu = torch.cuda.is_available()
    device = torch.device("cuda", int(os.environ["LOCAL_RANK"])) if gpu else torch.device("cpu")
    if gpu:
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if gpu else "gloo", store=store, rank=rank, world_size=size)
    try:
        yield Ranks(dist.PrefixStore("tiles", store), rank, size, device)
    finally:
        dist.destroy_process_group()


@contextmanager
def one_thread() -> Iterator[None]:
    """A context with one torch thread, in which sums do not depend on the number of cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
