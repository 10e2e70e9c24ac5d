"""The tensors of a map file from its bytes, several times faster than torch reads a file.

Tiles are read by the thousand, and most of what torch takes for one is an unpickler written in
Python. Here Python's own does it, which is handed nothing but stand-ins: whatever a file names, no
function is called but those below. What is not as `LardHilbertMap.save` writes it is left to torch.
"""

from __future__ import annotations

import io
import math
import pickle
import struct
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

_NAME_LENGTHS = (
    26  # of a zip entry's header: two lengths in bytes, of the name and of an extra field
)
_HEADER = 30  # bytes before them


class _Storage(NamedTuple):
    """Numbers of one tensor: where they begin in the file, how many, of what kind."""

    begin: int
    length: int
    dtype: torch.dtype


def read_tensors(content: bytearray) -> dict[str, Any] | None:
    """The state dict in the bytes of a map file; its tensors are views of them. None: ask torch."""
    try:
        state = _Unpickler(content, dict(_records(content))).load()
    except Exception:  # bytes that are no map file break in a dozen ways; torch's reader names it
        return None
    return state if isinstance(state, dict) else None


def _records(content: bytearray) -> Iterator[tuple[str, slice]]:
    """Names of a zip file's entries, without their first folder, and where their bytes are."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        for entry in archive.infolist():
            if entry.compress_type != zipfile.ZIP_STORED:
                raise ValueError("compressed")
            lengths = struct.unpack_from("<HH", content, entry.header_offset + _NAME_LENGTHS)
            begin = entry.header_offset + _HEADER + sum(lengths)
            yield entry.filename.partition("/")[2], slice(begin, begin + entry.file_size)


def _rebuild_tensor(
    storage: _Storage, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any
) -> tuple[_Storage, tuple[int, ...]]:
    """Stands in for `torch._utils._rebuild_tensor_v2`: whole contiguous tensors alone."""
    whole = [math.prod(size[axis + 1 :]) for axis in range(len(size))]
    if offset != 0 or math.prod(size) != storage.length or list(stride) != whole:
        raise pickle.UnpicklingError("a tensor that is a view of others")
    return storage, tuple(size)


_KNOWN = {
    ("collections", "OrderedDict"): OrderedDict,
    ("torch._utils", "_rebuild_tensor_v2"): _rebuild_tensor,
    ("torch", "FloatStorage"): torch.float32,
    ("torch", "DoubleStorage"): torch.float64,
    ("torch", "LongStorage"): torch.int64,
    ("torch", "BoolStorage"): torch.bool,
}


class _Unpickler(pickle.Unpickler):
    """Of ``data.pkl``, which says what the tensors are called, and which bytes are whose."""

    def __init__(self, content: bytearray, records: dict[str, slice]) -> None:
        if content[records["byteorder"]] != sys.byteorder.encode():
            raise ValueError("bytes in another order")
        super().__init__(io.BytesIO(content[records["data.pkl"]]))
        self.content, self.records = content, records

    def find_class(self, module: str, name: str) -> Any:
        """A stand-in; a KeyError for anything else."""
        return _KNOWN[module, name]

    def persistent_load(self, saved: Any) -> _Storage:
        """Where the bytes of a storage are."""
        kind, dtype, key, _, count = saved
        place = self.records[f"data/{key}"]
        if kind != "storage" or place.stop - place.start != count * dtype.itemsize:
            raise pickle.UnpicklingError("a storage of another size")
        return _Storage(place.start, count, dtype)

    def load(self) -> Any:
        """The state dict with its tensors."""
        state = super().load()
        for name, value in state.items():
            if isinstance(value, tuple):
                state[name] = self._tensor(*value)
        return state

    def _tensor(self, storage: _Storage, size: tuple[int, ...]) -> Tensor:
        begin, count, dtype = storage
        if not count:
            return torch.zeros(size, dtype=dtype)
        flat = torch.frombuffer(self.content, dtype=dtype, count=count, offset=begin)
        return flat.reshape(size)
