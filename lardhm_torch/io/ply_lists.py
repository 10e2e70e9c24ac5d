"""PLY elements with list properties, whose records differ in length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import BinaryIO

import numpy as np

from lardhm_torch.io.readout import COLUMN_NAMES
from lardhm_torch.io.records import Columns, Field, bytes_left, column_type

_LONGEST = 1 << 16  # entries of one list


@dataclass(frozen=True)
class ListField:
    """A list property: its name and the NumPy formats of its length and of its entries."""

    name: str
    count_format: str
    format: str

    @property
    def num_bytes(self) -> int:
        """Bytes of an empty list."""
        return np.dtype(self.count_format).itemsize


def read_ascii_lists(file: BinaryIO, fields: Sequence[Field | ListField], count: int) -> Columns:
    """The named columns of the next count lines of a file, one record each.

    Raises:
        ValueError: there are fewer lines, one is too short, or a word is no number.
    """
    columns: dict[str, list[float]] = {name: [] for name in _wanted(fields)}
    if count > bytes_left(file):
        raise ValueError(f"{count} records are declared; got {bytes_left(file)} bytes")
    for number in range(count):
        words, at = file.readline().split(), 0
        try:
            for field in fields:
                if isinstance(field, ListField):
                    at += 1 + int(words[at])
                else:
                    if field.name in columns:
                        columns[field.name].append(float(words[at]))
                    at += 1
        except (ValueError, IndexError) as error:
            raise ValueError(f"record {number} has too few numbers or a wrong one") from error
    return {name: np.array(values, dtype=np.float64) for name, values in columns.items()}


def read_binary_lists(file: BinaryIO, fields: Sequence[Field | ListField], count: int) -> Columns:
    """The named columns of count binary records at the file's position, which moves past them.

    Raises:
        ValueError: the file ends before they do, or a list has more than 65536 entries.
    """
    names = _wanted(fields)
    if count * max(1, sum(field.num_bytes for field in fields)) > bytes_left(file):
        raise ValueError(f"{count} records are declared; got {bytes_left(file)} bytes")
    start, content, at = file.tell(), file.read(), 0
    wanted = {name: np.empty(count) for name in names}
    same = _equal_records(content, fields, count)
    if same is not None:
        record, length = same
        at = count * length
        records = np.frombuffer(content, np.uint8, at).reshape(count, length)
        for field, offset in record:
            if field.name in wanted and isinstance(field, Field):
                bytes_of = records[:, offset : offset + field.num_bytes]
                wanted[field.name] = np.ascontiguousarray(bytes_of).view(field.format)[:, 0]
    else:
        for number in range(count):
            record, length = _record_at(content, at, fields)
            for field, offset in record:
                if field.name in wanted:
                    value = np.frombuffer(content, field.format, 1, at + offset)[0]
                    wanted[field.name][number] = value
            at += length
    file.seek(start + at)
    types = {f.name: np.dtype(f.format) for f in fields if f.name in wanted}
    return {name: v.astype(column_type(name, types[name])) for name, v in wanted.items()}


def _wanted(fields: Sequence[Field | ListField]) -> list[str]:
    """The names of the columns that are read; none of them may be a list."""
    names = [field for field in fields if field.name in COLUMN_NAMES]
    lists = [field.name for field in names if isinstance(field, ListField)]
    if lists:
        raise ValueError(
            f"vertices with list properties must have one number {lists[0]} each; {lists[0]} is a list"
        )
    return [field.name for field in names]


_Record = list[tuple[Field | ListField, int]]


def _record_at(
    content: bytes, start: int, fields: Sequence[Field | ListField]
) -> tuple[_Record, int]:
    """The fields of the record that begins at a byte, with their offsets; and its length."""
    record, offset = _Record(), 0
    for field in fields:
        record.append((field, offset))
        offset += field.num_bytes
        if start + offset > len(content):
            raise ValueError("the file ends in the middle of a record")
        if isinstance(field, ListField):
            at = start + offset - field.num_bytes
            entries = int(np.frombuffer(content, field.count_format, 1, at)[0])
            if not 0 <= entries <= _LONGEST:
                raise ValueError(f"list {field.name} has {entries} entries, {_LONGEST} at most")
            offset += entries * np.dtype(field.format).itemsize
    if start + offset > len(content):
        raise ValueError("the file ends in the middle of a record")
    return record, offset


def _equal_records(
    content: bytes, fields: Sequence[Field | ListField], count: int
) -> tuple[_Record, int] | None:
    """The layout of the first record and its length, if all records have it."""
    if not count:
        return None
    record, length = _record_at(content, 0, fields)
    if length == 0 or count * length > len(content):
        return None
    records = np.frombuffer(content, np.uint8, count * length).reshape(count, length)
    for field, offset in record:
        if isinstance(field, ListField):
            lengths = records[:, offset : offset + field.num_bytes]
            if (lengths != lengths[0]).any():
                return None
    return record, length
