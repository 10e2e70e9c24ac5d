"""PLY: ascii, binary little and big endian; the element "vertex" with properties x, y, z."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from lardhm_torch.io.ply_lists import ListField, read_ascii_lists, read_binary_lists
from lardhm_torch.io.readout import Readout, readout_from_columns
from lardhm_torch.io.records import (
    Columns,
    Field,
    bytes_left,
    header_count,
    header_lines,
    read_ascii,
    read_binary,
    record_size,
)

_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_FORMATS = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1"},
    **{"short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2"},
    **{"int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}


@dataclass
class _Element:
    name: str
    count: int
    fields: list[Field | ListField] = field(default_factory=list)

    @property
    def has_list(self) -> bool:
        """Whether its records may differ in length."""
        return any(isinstance(entry, ListField) for entry in self.fields)

    @property
    def plain_fields(self) -> list[Field]:
        """Its fields without the lists: all of them where it has none."""
        return [entry for entry in self.fields if isinstance(entry, Field)]


@dataclass
class _Header:
    encoding: str
    num_lines: int
    elements: list[_Element]


def read_ply(path: Path) -> Readout:
    """The vertices of a PLY file as ray ends; ox, oy, oz of each vertex as sensor positions.

    List properties and elements before the vertices are skipped; what comes after the vertices
    (faces) is not read.

    Raises:
        ValueError: the header is not one of PLY, or the file is shorter than it says.

    Source: http://paulbourke.net/dataformats/ply/
    """
    with open(path, "rb") as file:
        (columns,) = _read_vertices(path, file, _read_header(file), max_points=None)
    return readout_from_columns(columns)


def ply_pieces(path: Path, max_points: int) -> Iterator[Readout]:
    """The same a piece of at most ``max_points`` at a time; a file of text all at once."""
    with open(path, "rb") as file:
        for columns in _read_vertices(path, file, _read_header(file), max_points):
            yield readout_from_columns(columns)


def _read_header(file: BinaryIO) -> _Header:
    """Everything up to end_header."""
    lines = header_lines(file)
    if next(lines) != ["ply"]:
        raise ValueError("a PLY file must begin with the line 'ply'; this one does not")
    encoding, elements = "", list[_Element]()
    for number, words in enumerate(lines, start=2):
        match words:
            case ["end_header"]:
                if not encoding:
                    raise ValueError("the header needs a line 'format'; got none")
                return _Header(encoding, number, elements)
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", str(name), *_] if name in _BYTE_ORDERS and not elements:
                encoding = name
            case ["element", name, count]:
                elements.append(_Element(name, header_count(count, f"element {name}")))
            case ["property", "list", counts, kind, name] if elements and _is_list(counts, kind):
                order = _BYTE_ORDERS[encoding or "ascii"]
                formats = (order + _FORMATS[counts], order + _FORMATS[kind])
                elements[-1].fields.append(ListField(name.lower(), *formats))
            case ["property", kind, name] if elements and kind in _FORMATS:
                format = _BYTE_ORDERS[encoding or "ascii"] + _FORMATS[kind]
                elements[-1].fields.append(Field(name.lower(), format))
            case _:
                raise ValueError(f"line {number} of the header is not understood: {words[:6]}")
    raise AssertionError("header_lines raises before it ends")


def _read_vertices(
    path: Path, file: BinaryIO, header: _Header, max_points: int | None
) -> Iterator[Columns]:
    """The named columns of the element vertex, in one piece or several."""
    skip_lines = header.num_lines
    for element in header.elements:
        if element.name == "vertex":
            if element.has_list:
                yield _read_lists(file, element, skip_lines - header.num_lines, header.encoding)
            elif header.encoding == "ascii":
                fields = element.plain_fields
                yield read_ascii(path, skip_lines, fields, element.count, bytes_left(file))
            else:
                yield from read_binary(file, element.plain_fields, element.count, max_points)
            return
        skip_lines += element.count
        if header.encoding != "ascii":
            _skip_binary(file, element)
        elif skip_lines - header.num_lines > bytes_left(file):
            raise ValueError(
                f"element {element.name} needs {element.count} lines; "
                f"{bytes_left(file)} bytes are too few"
            )
    found = ", ".join(element.name for element in header.elements)
    raise ValueError(f"an element vertex is needed; got {found or 'none'}")


def _is_list(counts: str, kind: str) -> bool:
    """Whether a list may have these types: whole numbers count its entries."""
    return kind in _FORMATS and _FORMATS.get(counts, "f")[0] in "iu"


def _read_lists(file: BinaryIO, element: _Element, skip_lines: int, encoding: str) -> Columns:
    """The named columns of an element with lists, after some lines of elements before it."""
    if encoding != "ascii":
        return read_binary_lists(file, element.fields, element.count)
    for _ in range(skip_lines):
        file.readline()
    return read_ascii_lists(file, element.fields, element.count)


def _skip_binary(file: BinaryIO, element: _Element) -> None:
    """Go past a binary element."""
    if element.has_list:
        read_binary_lists(file, element.fields, element.count)
        return
    size = element.count * record_size(element.plain_fields)
    if size > bytes_left(file):
        raise ValueError(f"element {element.name} needs {size} bytes; got {bytes_left(file)}")
    file.seek(size, 1)
