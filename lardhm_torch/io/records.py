"""Equal records in a row: the body of PLY and PCD files, as text or as bytes."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TextIO

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.channel_columns import CHANNEL_COLUMNS
from lardhm_torch.io.readout import COLUMN_NAMES

Columns = dict[str, NDArray]  # float64; channels have the type of the file
_MAX_HEADER_LINES = 10_000
_MAX_LINE_BYTES = 65_536


@dataclass(frozen=True)
class Field:
    """One entry of a record: its name, its NumPy format such as "<f4", how many values it has."""

    name: str
    format: str
    count: int = 1

    @property
    def num_bytes(self) -> int:
        """Bytes of the field in a binary record."""
        return self.count * np.dtype(self.format).itemsize


def record_size(fields: Sequence[Field]) -> int:
    """Bytes of one binary record."""
    return sum(field.num_bytes for field in fields)


def header_lines(file: BinaryIO) -> Iterator[list[str]]:
    """The words of each header line, until the caller has seen the last one.

    Raises:
        ValueError: the file ends, or no end of the header is found.
    """
    for _ in range(_MAX_HEADER_LINES):
        line = file.readline(_MAX_LINE_BYTES)
        if not line.endswith(b"\n"):
            raise ValueError(f"the header must end before the file does; got {line[:40]!r} last")
        yield line.decode("latin-1").split()
    raise ValueError(f"the header must end within {_MAX_HEADER_LINES} lines; it does not")


def header_count(word: str, name: str) -> int:
    """A count in a header: digits only, because int() also takes signs and underscores."""
    if not (word.isascii() and word.isdigit() and len(word) < 16):
        raise ValueError(f"{name} must be a count; got {word[:40]!r}")
    return int(word)


def bytes_left(file: BinaryIO) -> int:
    """How many bytes of the file are still unread."""
    return os.fstat(file.fileno()).st_size - file.tell()


def read_binary(
    file: BinaryIO, fields: Sequence[Field], count: int, max_points: int | None = None
) -> Iterator[Columns]:
    """The named columns of count binary records at the file's position, all or so many at a time.

    Raises:
        ValueError: the file has fewer bytes than that.
    """
    size = record_size(fields)
    if count * size > bytes_left(file):
        raise ValueError(
            f"{count} points of {size} bytes are declared, {count * size} bytes; "
            f"got {bytes_left(file)}"
        )
    wanted, offset = {}, 0
    for field in fields:
        if field.name in COLUMN_NAMES:
            wanted[field.name] = (np.dtype(field.format), offset)
        offset += field.num_bytes
    step = max_points or max(1, count)
    for start in range(0, max(1, count), step):
        rows = min(step, count - start)
        records = np.fromfile(file, np.dtype((np.void, size)), rows)
        yield {
            name: np.ndarray(rows, dtype, records, offset, (size,)).astype(column_type(name, dtype))
            for name, (dtype, offset) in wanted.items()
        }


def read_ascii(
    path: Path, skip_lines: int, fields: Sequence[Field], count: int, left: int
) -> Columns:
    """The named columns of count lines of text after skip_lines, in a file with left bytes left.

    Raises:
        ValueError: there are fewer lines, or a word is no number.
    """
    shortest = 2 * sum(field.count for field in fields)  # a digit and a separator each
    if count * shortest > left + 1:
        raise ValueError(
            f"{count} points of {shortest // 2} numbers are declared; {left} bytes are too few"
        )
    wanted, column = {}, 0
    for field in fields:
        if field.name in COLUMN_NAMES:
            wanted[field.name] = column
        column += field.count
    if count == 0 or not wanted:
        return {name: np.empty(count) for name in wanted}
    table = read_table(path, skip_lines, list(wanted.values()), max_rows=count, comments=None)
    if len(table) != count:
        raise ValueError(f"{count} points are declared; got {len(table)} lines")
    types = {field.name: np.dtype(field.format) for field in fields if field.name in wanted}
    return {
        name: table[:, i].astype(column_type(name, types[name])) for i, name in enumerate(wanted)
    }


def column_type(name: str, of_file: np.dtype) -> np.dtype:
    """The type of a column in memory: that of the file for channels, else float64."""
    return of_file.newbyteorder("=") if name in CHANNEL_COLUMNS else np.dtype(np.float64)


def text_encoding(path: Path) -> str:
    """UTF-8 where a file begins with its mark, which editors on Windows write; else any bytes."""
    with open(path, "rb") as file:
        return "utf-8-sig" if file.read(3) == b"\xef\xbb\xbf" else "latin-1"


def read_table(
    path: Path | TextIO,
    skip_lines: int,
    columns: list[int],
    *,
    delimiter: str | None = None,
    max_rows: int | None = None,
    comments: str | None = "#",
) -> NDArray[np.float64]:
    """(R, C) numbers of a text file, or of the next lines of an open one; blank lines do not count.

    Raises:
        ValueError: a word is no number, or a line is too short.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # blank lines, no line: the caller counts
        return np.loadtxt(
            path,
            dtype=np.float64,
            skiprows=skip_lines,
            usecols=columns,
            delimiter=delimiter,
            max_rows=max_rows,
            comments=comments,
            encoding=text_encoding(path) if isinstance(path, Path) else None,
            ndmin=2,
        )
