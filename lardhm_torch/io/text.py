"""Text tables: .xyz, .txt, .csv, .pts; delimiter, header and count lines are detected."""

from __future__ import annotations

import re
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.notes import Note
from lardhm_torch.io.readout import COLUMN_NAMES, Readout, readout_from_columns
from lardhm_torch.io.records import read_table, text_encoding

_PEEK_BYTES = 65_536
_COMMENT_MARKS = ("#", "//", "%", ";", "!")
_UNIT = re.compile(r"[\[(][^\])]*[\])]")  # [m], (m)
_NOT_METERS = re.compile(  # x [mm], "Y (ft)"
    r"\b([xyz])[\"']?\s*[\[(]\s*([munpkcd]m|millim\w+|centim\w+|us-ft|ft|feet|foot|in|inch\w*)\s*[\])]",
    re.I,
)
_ARRAYS = ("points", "coords", "points_m_xyz")  # of ParaView, PDAL, VeloView
_OTHER_NAMES = {f"{name}{mark}{i}": "xyz"[i] for name in _ARRAYS for mark in ":_" for i in range(3)}
_OTHER_NAMES |= {"easting": "x", "northing": "y", "east": "x", "north": "y"}
_OTHER_NAMES |= dict.fromkeys(("height", "elevation", "altitude", "up"), "z")
_OTHER_NAMES |= {"r": "red", "g": "green", "b": "blue"}
_UNIT_ENDING = re.compile(r"(_m|/m)$")
_POSITION = re.compile(r"(?:pos|position|point|coord|cartesian)_?([xyz])")
_COUNTED = 3  # a first column that counts so many rows or more is no coordinate


@dataclass(frozen=True)
class _Layout:
    """How a table is written.

    Args:
        delimiter: between two entries; None: spaces.
        names: of the columns, lower case; of the first ones, if there are more.
        skip_lines: before the numbers.
        count: of the points, from a count line; None without one.
        notes: what was assumed.
    """

    delimiter: str | None
    names: list[str]
    skip_lines: int
    count: int | None
    notes: tuple[Note, ...]


def read_text(path: Path) -> Readout:
    """Columns x y [z], and where a header names them ox oy oz, scan_id, is_return, target_index.

    Values are separated by commas, semicolons, tabs or spaces. The header is the first line, or the
    last comment (# // % ; or !) that names x and y and fits the columns; it may give units in
    brackets, which must be meters for coordinates. A line with one whole number before the table is
    its count of points (PTS); the file may hold several such tables, each of them a scan. Without a
    header the first three columns (or two, if there are no more) are the coordinates, and further
    ones are not read.

    Raises:
        ValueError: the file is empty or no text, a word is no number, x or y is missing, a count is
            not kept, or the first of several unnamed columns only counts the rows.
    """
    layout = _layout_of(_first_lines(path), path.suffix.lower())
    wanted = {name: i for i, name in enumerate(layout.names) if name in COLUMN_NAMES}
    if not {"x", "y"} <= wanted.keys():
        raise ValueError(f"columns x and y are needed; got {', '.join(layout.names[:12])}")
    columns = list(wanted.values())
    if layout.count is not None:
        return _read_counted(path, layout, wanted)
    table = read_table(path, layout.skip_lines, columns, delimiter=layout.delimiter)
    if layout.notes and _counts_rows(table[:, 0]):
        raise ValueError(
            "its first column counts the rows, and no header names the columns. Name them in the "
            "first line, such as: id x y z"
        )
    return readout_from_columns({name: table[:, i] for i, name in enumerate(wanted)}).noting(
        *layout.notes
    )


def _layout_of(lines: list[str], suffix: str) -> _Layout:
    """Delimiter, names and count from the first lines of a file."""
    is_comment = [line.startswith(_COMMENT_MARKS) or not line for line in lines]
    num_comments = len(list(takewhile(bool, is_comment)))
    if num_comments == len(lines):
        raise ValueError("a line of numbers is needed; the file has none in its first 64 KiB")
    comments, rest = lines[:num_comments], lines[num_comments:]
    skip_lines, names = num_comments, list[str]()
    if not all(map(_is_number, _words(rest[0], _delimiter(rest[0])))):
        _check_units(rest[0])
        delimiter = _delimiter(rest[0])
        names = [_name(word) for word in _words(_UNIT.sub("", rest[0]), delimiter)]
        rest, skip_lines = rest[1:], skip_lines + 1
    count = None
    if rest and _is_count(rest[0]) and (len(rest) == 1 or len(_entries(rest[1])) > 1):
        count, rest, skip_lines = int(rest[0]), rest[1:], skip_lines + 1
    row = rest[0] if rest else ""
    width = len(_entries(row))
    notes: tuple[Note, ...] = ()
    names = names or _names_in_comments(comments, width)
    if not names:
        names = ["x", "y", "z"][:width]
        if width > 3 and suffix not in (".xyz", ".pts"):
            cure = "name the columns in the first line"
            notes = (Note("first three columns assumed to be x y z", cure=cure),)
    return _Layout(_delimiter(row), names, skip_lines, count, notes)


def _read_counted(path: Path, layout: _Layout, wanted: dict[str, int]) -> Readout:
    """Tables that each have a count line before them, one scan each."""
    tables, count, skip = list[NDArray[np.float64]](), layout.count, layout.skip_lines
    size = path.stat().st_size
    with open(path, encoding=text_encoding(path)) as file:
        for _ in range(skip):
            file.readline()
        while count is not None:
            if 4 * count > size:  # "0 0" and a line break
                raise ValueError(f"{count} points are declared; {size} bytes are too few")
            columns = list(wanted.values())
            table = read_table(file, 0, columns, delimiter=layout.delimiter, max_rows=count)
            if len(table) != count:
                raise ValueError(f"{count} points are declared; got {len(table)} lines")
            tables.append(table)
            line = next((text for text in iter(file.readline, "") if text.strip()), "")
            if line and not _is_count(line.strip()):
                raise ValueError(f"{count} points are declared; more lines follow: {line[:40]!r}")
            count = int(line) if line else None
    table = np.concatenate(tables)
    readout = readout_from_columns({name: table[:, i] for i, name in enumerate(wanted)})
    if len(tables) == 1 or readout.scan_id is not None:
        return readout
    note = Note("tables of points, each read as a scan", len(tables))
    scan_id = np.repeat(np.arange(len(tables)), [len(table) for table in tables])
    return Readout(readout.ends, scan_id=scan_id, notes=(note,), channels=readout.channels)


def _first_lines(path: Path) -> list[str]:
    """Stripped lines of the file's beginning, without one that may be cut."""
    with open(path, "rb") as file:
        start = file.read(_PEEK_BYTES)
    if b"\0" in start:
        raise ValueError("text is needed; the file holds zero bytes")
    text = start.decode(text_encoding(path), errors="replace")
    lines = [line.strip() for line in re.split(r"\r\n|\r|\n", text)]
    return lines[:-1] if len(lines) > 1 and (len(start) == _PEEK_BYTES or not lines[-1]) else lines


def _delimiter(line: str) -> str | None:
    return next((mark for mark in ";,\t" if mark in line), None)


def _words(line: str, delimiter: str | None) -> list[str]:
    """The entries of a line, lower case, without quotes; one empty at the end does not count."""
    words = [word.strip().strip("\"'").strip().lower() for word in line.split(delimiter)]
    return words[:-1] if len(words) > 1 and not words[-1] else words


def _entries(line: str) -> list[str]:
    return _words(line, _delimiter(line))


def _name(word: str) -> str:
    """The name of a column as we call it: "points:0" of ParaView, "x_m" and "easting" are x."""
    word = _UNIT_ENDING.sub("", word)
    plain = _POSITION.fullmatch(word)
    return plain[1] if plain else _OTHER_NAMES.get(word, word)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _is_count(line: str) -> bool:
    return line.isascii() and line.isdigit() and len(line) < 12


def _names_in_comments(comments: list[str], width: int) -> list[str]:
    """Column names of the last comment that has them for all columns, or for the first ones.

    Words before the names do not count ("columns: id x y z"), nor units in brackets. A comment in
    prose that mentions x and y names nothing.
    """
    for line in reversed(comments):
        plain = _UNIT.sub("", line.lstrip("#/%;! \t")).lower()
        words = [_name(word.strip("\"':")) for word in re.split(r"[\s,;]+", plain) if word]
        for names in (words[-width:], words):
            fits = len(names) == width or (len(names) < width and names[:1] == ["x"])
            if fits and {"x", "y"} <= set(names):
                _check_units(line)
                return names
    return []


def _check_units(header: str) -> None:
    """Raise a ValueError where a header gives coordinates in another unit than meters."""
    other = _NOT_METERS.search(header)
    if other:
        raise ValueError(
            f"column {other[1].lower()} is in {other[2]}: coordinates must be in meters. Convert them, "
            "and the header"
        )


def _counts_rows(column: NDArray[np.float64]) -> bool:
    """Whether a column goes up by one with every row, in whole numbers."""
    if len(column) < _COUNTED or column[0] != np.floor(column[0]):
        return False
    return bool((np.diff(column) == 1).all())
