"""A lock for one thread that changes a map while others read it."""

from __future__ import annotations

import os
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_locks: weakref.WeakSet[MapLock] = weakref.WeakSet()


class MapLock:
    """Any number of readers, or one writer. They take turns: waiting writers have priority over new
    readers, and the readers that wait for a writer have priority over the next one.

    A thread may nest reading in reading and in writing, and writing in writing. A copy of a lock is a
    new lock that nobody holds, and so are all locks in a forked process.
    """

    def __init__(self) -> None:
        self.release_all()
        _locks.add(self)

    def release_all(self) -> None:
        """Forget all readers and writers."""
        self._condition = threading.Condition()
        self._readers = 0
        self._waiting = 0  # writers
        self._queued = 0  # readers
        self._admitted = 0  # of these, those that go before the next writer
        self._writer: int | None = None
        self._turn = threading.RLock()  # of those who change the map
        self._own = threading.local()  # .depth: of nested reading in this thread

    def __deepcopy__(self, memo: dict[int, Any]) -> MapLock:
        return MapLock()

    def __reduce__(self) -> tuple[type[MapLock], tuple[()]]:
        return MapLock, ()

    @contextmanager
    def reading(self) -> Iterator[None]:
        """Wait until nobody writes, and keep writers out."""
        own, me = self._own, threading.get_ident()
        depth = getattr(own, "depth", 0)
        if depth == 0 and self._writer != me:
            with self._condition:
                if self._writer is not None or self._waiting:
                    self._queue()
                self._readers += 1
            own.depth = 1
            try:
                yield
            finally:
                own.depth = 0
                with self._condition:
                    self._readers = max(0, self._readers - 1)  # 0 already after a fork
                    self._condition.notify_all()
        else:
            own.depth = depth + 1
            try:
                yield
            finally:
                own.depth = depth

    def _queue(self) -> None:
        """Wait as a reader."""
        self._queued += 1
        try:
            while not self._admitted and (self._writer is not None or self._waiting):
                self._condition.wait()
        finally:
            self._queued -= 1
            self._admitted = max(0, min(self._admitted - 1, self._queued))

    @contextmanager
    def changing(self) -> Iterator[None]:
        """Wait for others who change the map. Readers may go on until `writing`.

        Raises:
            RuntimeError: this thread is reading the map.
        """
        self._check_not_reading()
        with self._turn:
            yield

    def _check_not_reading(self) -> None:
        if getattr(self._own, "depth", 0) and self._writer != threading.get_ident():
            raise RuntimeError("the map must not be changed inside `with map.reading()`")

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Wait until nobody reads or writes, and keep all others out.

        Raises:
            RuntimeError: this thread is reading the map.
        """
        me = threading.get_ident()
        if self._writer == me:
            yield
            return
        self._check_not_reading()
        with self._condition:
            self._waiting += 1
            try:
                while self._writer is not None or self._readers or self._admitted:
                    self._condition.wait()
                self._writer = me
            finally:
                self._waiting -= 1
        try:
            yield
        finally:
            with self._condition:
                self._writer, self._admitted = None, self._queued
                self._condition.notify_all()


def _release_in_child() -> None:
    for lock in list(_locks):
        lock.release_all()


os.register_at_fork(after_in_child=_release_in_child)
