"""Text tables: .xyz, .txt, .csv; delimiter and header are detected."""

from __future__ import annotations

import re
from itertools import takewhile
from pathlib import Path

from lardhm_torch.io.readout import COLUMN_NAMES, Readout, readout_from_columns
from lardhm_torch.io.records import read_table

_PEEK_BYTES = 65_536


def read_text(path: Path) -> Readout:
    """Columns x y [z], and where a header names them ox oy oz, scan_id, is_return, target_index.

    Values are parted by commas, semicolons, tabs or spaces. The header is the first line, or the
    last comment (# or //) before the numbers. Without a header the first three columns (or two, if
    there are no more) are the coordinates, and further ones are not read.

    Raises:
        ValueError: the file is empty or no text, a word is no number, or x or y is missing.
    """
    lines = _first_lines(path)
    is_comment = [line.startswith(("#", "//")) or not line for line in lines]
    num_comments = len(list(takewhile(bool, is_comment)))
    if num_comments == len(lines):
        raise ValueError("a line of numbers is needed; the file has none in its first 64 KiB")
    first = lines[num_comments]
    delimiter = next((mark for mark in ";,\t" if mark in first), None)
    words = _words(first, delimiter)
    skip_lines = num_comments
    if not all(map(_is_number, words)):
        names, skip_lines = words, num_comments + 1
    else:
        names = _names_in_comment(lines[:num_comments]) or ["x", "y", "z"][: len(words)]
    wanted = {name: i for i, name in enumerate(names) if name in COLUMN_NAMES}
    if not {"x", "y"} <= wanted.keys():
        raise ValueError(f"columns x and y are needed; got {', '.join(names[:12])}")
    table = read_table(path, skip_lines, list(wanted.values()), delimiter=delimiter)
    return readout_from_columns({name: table[:, i] for i, name in enumerate(wanted)})


def _first_lines(path: Path) -> list[str]:
    """Stripped lines of the file's beginning, without one that may be cut."""
    with open(path, "rb") as file:
        start = file.read(_PEEK_BYTES)
    if b"\0" in start:
        raise ValueError("text is needed; the file holds zero bytes")
    text = start.decode("latin-1").removeprefix("\xef\xbb\xbf")  # a UTF-8 mark of some editors
    lines = [line.strip() for line in re.split(r"\r\n|\r|\n", text)]
    return lines[:-1] if len(lines) > 1 and (len(start) == _PEEK_BYTES or not lines[-1]) else lines


def _words(line: str, delimiter: str | None) -> list[str]:
    """The entries of a line, lower case, without quotes; one empty at the end does not count."""
    words = [word.strip().strip("\"'").lower() for word in line.split(delimiter)]
    return words[:-1] if len(words) > 1 and not words[-1] else words


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _names_in_comment(lines: list[str]) -> list[str]:
    """Column names of the last comment, if that is what it holds."""
    words = re.split(r"[\s,;]+", lines[-1].lstrip("#/ \t").lower()) if lines else []
    return words if {"x", "y"} <= set(words) else []
