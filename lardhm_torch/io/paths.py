"""Which files a path stands for, and in which order; errors that name the file."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

POSE_FILES = ("poses.txt", "groundtruth.txt", "trajectory.txt")
# Text files that often lie beside scans but are not scans.
_NOT_SCANS = re.compile(
    r"(.*\.)?(poses?|groundtruth|trajectory|calib|times|timestamps|readme|licen[cs]e)\.txt", re.I
)


def natural_key(name: str) -> tuple[list[str | int], str]:
    """Sorts scan_10 after scan_9.

    >>> sorted(["scan_10", "scan_9"], key=natural_key)
    ['scan_9', 'scan_10']
    """
    parts = re.split(r"(\d+)", name.lower(), flags=re.ASCII)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], name


def folders_of(path: Path | str) -> tuple[str, str]:
    """The folder of a file and the one above."""
    folder = os.path.dirname(path) or "."
    return folder, os.path.dirname(folder) or "."


def first_file(folders: tuple[str, ...], names: tuple[str, ...]) -> str | None:
    """The first of some files that is there; with strings, which is faster for many small scans."""
    for folder in folders:
        for name in names:
            beside = os.path.join(folder, name)
            if os.access(beside, os.F_OK) and os.path.isfile(beside):  # the former is faster
                return beside
    return None


def expand_paths(
    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    supported: Collection[str],
    kind_of_folder: Callable[[Path], str | None] = lambda folder: None,
) -> list[Path]:
    """The files a file, a folder or a list of both stands for; folders of a kind stay folders.

    Raises:
        FileNotFoundError: there is no such file or folder.
        ValueError: a file's extension is not supported, a folder has no scan, the list is empty.
    """
    if isinstance(path, (str, os.PathLike)):
        path = [path]
    files = [file for entry in path for file in _expand(Path(entry), supported, kind_of_folder)]
    if not files:
        raise ValueError("path must name at least one file or folder; got an empty list")
    return files


def _expand(
    path: Path, supported: Collection[str], kind_of_folder: Callable[[Path], str | None]
) -> list[Path]:
    """One file as it is, or the scan files of a folder."""
    if not path.exists():
        raise FileNotFoundError(f"path must name a file or folder; there is no {path}")
    if path.is_dir():
        return [path] if kind_of_folder(path) else _scans_in(path, supported)
    if path.suffix.lower() not in supported:
        raise ValueError(
            f"path must end in one of {' '.join(sorted(supported))}; got {path}. "
            "Other formats: convert them to .npz, .ply or .csv."
        )
    return [path]


def _scans_in(folder: Path, supported: Collection[str]) -> list[Path]:
    """Scan files of a folder in natural order; .txt only if there is no other kind."""
    files = [
        file
        for file in sorted(folder.iterdir(), key=lambda file: natural_key(file.name))
        if file.suffix.lower() in supported
        and not file.name.startswith(".")
        and not _NOT_SCANS.fullmatch(file.name)
        and file.is_file()
    ]
    files = [file for file in files if file.suffix.lower() != ".txt"] or files
    if not files:
        raise ValueError(
            f"path must hold at least one scan ({' '.join(sorted(supported))}); {folder} has none"
        )
    return files


@contextmanager
def naming_errors(file: Path) -> Iterator[None]:
    """A block that reads a file: errors name it."""
    try:
        with np.errstate(invalid="ignore", over="ignore"):  # sampling counts NaN and inf
            yield
    except ImportError:
        raise
    except OSError as error:
        if error.filename is not None:
            raise
        raise ValueError(f"{file} cannot be read: {error}") from error
    except Exception as error:
        # Broken bytes surface from zipfile, zlib, NumPy and laspy under a dozen unrelated types.
        reason = str(error) or type(error).__name__
        raise ValueError(f"{file} cannot be read: {reason}") from error
