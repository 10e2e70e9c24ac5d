"""Processes that share one job: who they are, and which piece of work each takes next.

`torchrun` starts them, on one machine or many; its store is the only thing they talk through while
they work. Without `torchrun` one process does the same alone.
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
        store: what all processes see.
        rank: which of them this is, from 0.
        size: how many there are.
        device: the one of this rank.
    """

    store: dist.Store
    rank: int
    size: int
    device: torch.device

    def take(self, name: str, work: Sequence[Work]) -> Iterator[Work]:
        """Pieces of a list that every rank has, each to one rank: whoever is free takes the next."""
        while (number := self.store.add(f"taken/{name}", 1) - 1) < len(work):
            yield work[number]

    def count(self, name: str, more: int) -> int:
        """Add to a number that all ranks share; what it is then."""
        return self.store.add(f"count/{name}", more)

    def agree(self, name: str, decide: Callable[[], Any]) -> Any:
        """What rank 0 decides, a plain value, on all ranks."""
        if self.rank == 0:
            self.store.set(f"agreed/{name}", json.dumps(decide()))
        return json.loads(self.store.get(f"agreed/{name}"))

    def wait(self) -> None:
        """Until all ranks are here."""
        if self.size > 1:
            dist.barrier()


@contextmanager
def join_ranks() -> Iterator[Ranks]:
    """This process as a rank of the job that `torchrun` started, or as the only one.

    nccl and one device a rank where there are GPUs, gloo elsewhere.
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
    """A block on one thread: sums then do not depend on how many a machine has."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
