"""Assumptions of readers about scan files, and how they are reported.

Every reader attaches a few `Note`s to what it reads. The public functions collect them in a
`ScanReport`, which prints as one line; ``strict=True`` turns every guess into an error.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lardhm_torch.channels import count_missing
from lardhm_torch.scans import Scans


class ScanFileWarning(UserWarning):
    """Part of a scan file was left out. The scans are usable, but incomplete."""


@dataclass(frozen=True)
class Note:
    """One statement about how a file was read.

    Args:
        text: the statement, such as "sensor position from VIEWPOINT". Files with equal texts are
            reported together, so that numbers go into ``count``.
        count: how many points, clouds or images it concerns; printed before the text.
        cure: how to confirm or change a guess, such as "frame='world' confirms it"; empty if nothing
            was guessed, because the file or the caller specifies it.
        is_loss: data that may matter was left out; a `ScanFileWarning` is issued.
    """

    text: str
    count: int | None = None
    cure: str = ""
    is_loss: bool = False

    @property
    def is_guess(self) -> bool:
        """Whether the statement is a guess, specified neither by the file nor by the caller."""
        return bool(self.cure)

    def __str__(self) -> str:
        counted = self.text if self.count is None else f"{self.count} {self.text}"
        return f"{counted} (guess: {self.cure})" if self.cure else counted


def check_notes(file: Path, notes: Iterable[Note], strict: bool) -> None:
    """Warn of what was left out; if strict, refuse what was guessed.

    Raises:
        ValueError: strict, and a note is a guess.
    """
    for note in notes:
        if strict and note.is_guess:
            raise ValueError(f"{file}: strict reading refuses a guess: {note}")
        if note.is_loss:
            warnings.warn(f"{file}: {note}", ScanFileWarning, stacklevel=4)


def no_ray_left(files: Sequence[Path], notes: Sequence[Note]) -> ValueError:
    """The error for files without a usable point; the notes say what was left out."""
    said = "".join(f"; {text}" for text in sorted({str(note) for note in notes}))
    return ValueError(f"{files[0]}: at least one point is needed; got none{said}")


class ScanReport:
    """Contents of scan files and assumptions of the readers; `str(report)` is one line.

    Pass an empty report to `load_scans`, `iter_scans` or `iter_pieces`; they fill it file by file.
    """

    def __init__(self) -> None:
        self.files: list[Path] = []
        self.num_scans = 0
        self.num_rays = 0
        self.channels: dict[str, int] = {}  # number of rays with a value, by channel
        self._corners: list[np.ndarray] = []  # lowest and highest sensor coordinates so far
        self._notes: dict[tuple[str, str], list[int | None]] = {}  # number of files, total count

    def add(self, file: Path, scans: Scans, notes: Sequence[Note]) -> None:
        """Count one file, or the next piece of the file that was added last."""
        is_new = not self.files or self.files[-1] != file
        if is_new:
            self.files.append(file)
            self.num_scans += scans.num_scans
            self._corners += [*scans.origins.numpy()]
            if self._corners:  # a file without a pose in time has no scan
                self._corners = [pick(self._corners, axis=0) for pick in (np.min, np.max)]
        self.num_rays += len(scans)
        for name, lost in count_missing(scans.channels).items():
            self.channels[name] = self.channels.get(name, 0) + len(scans) - lost
        for note in notes:
            tally = self._notes.setdefault((note.text, note.cure), [0, None])
            tally[0] = (tally[0] or 0) + is_new
            if note.count is not None:
                tally[1] = (tally[1] or 0) + note.count

    @property
    def notes(self) -> list[Note]:
        """The notes of all files, those with equal texts merged and their counts added."""
        return [Note(text, total, cure) for (text, cure), (_, total) in self._notes.items()]

    def as_dict(self) -> dict[str, Any]:
        """The report for JSON."""
        return {
            "files": [str(file) for file in self.files],
            "scans": self.num_scans,
            "rays": self.num_rays,
            "channels": dict(self.channels),
            "sensor [m]": [corner.tolist() for corner in self._corners],
            "notes": [
                {"text": note.text, "count": note.count, "guess": note.is_guess, "cure": note.cure}
                for note in self.notes
            ],
        }

    def __str__(self) -> str:
        name = str(self.files[0]) if len(self.files) == 1 else f"{len(self.files)} files"
        parts = [f"{_counted(self.num_scans, 'scan')}, {_counted(self.num_rays, 'ray')}"]
        corners = [f"({', '.join(f'{x:.6g}' for x in corner)})" for corner in self._corners]
        if corners:
            one = corners[0] == corners[1]
            parts.append("sensor at " + (corners[0] if one else " to ".join(corners)) + " m")
        if self.channels:
            parts.append(", ".join(f"{name} of {n} rays" for name, n in self.channels.items()))
        for note, (files, _) in zip(self.notes, self._notes.values(), strict=True):
            in_some = "" if files in (0, len(self.files)) else f" (in {files} of them)"
            parts.append(f"{note}{in_some}")
        return f"{name}: " + "; ".join(parts)


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
