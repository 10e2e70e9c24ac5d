"""Checks of output paths, made before a command starts its work."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

MAP_SUFFIXES = (".pt", ".pth", ".safetensors")
SCAN_OUTPUTS = (".npz", ".ply", ".pcd")


def check_output(
    path: str | os.PathLike[str],
    suffixes: Sequence[str],
    inputs: Iterable[str | os.PathLike[str]] = (),
    *,
    option: str = "--output",
) -> None:
    """Raise an error if a command could not, or must not, write its output to a path.

    Args:
        path: the output file.
        suffixes: extensions that are allowed, in lower case.
        inputs: files and folders that the command reads; they are never overwritten.
        option: name of the option in the error.

    Raises:
        ValueError: another extension, or the output is one of the inputs.
        FileNotFoundError: the folder of path does not exist.
        IsADirectoryError: path is a folder.
        PermissionError: the folder of path is not writable.
    """
    target = Path(path)
    if target.suffix.lower() not in suffixes:
        raise ValueError(f"{option} must end in {' or '.join(suffixes)}; got {target}")
    if target.is_dir():
        raise IsADirectoryError(f"{option} must be a file; {target} is a folder")
    folder = target.resolve().parent
    if not folder.is_dir():
        raise FileNotFoundError(f"{option} must be in an existing folder; there is no {folder}")
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{option} must be in a writable folder; {folder} is read-only")
    _check_not_an_input(target, inputs, option)


def check_folder(path: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str]]) -> None:
    """Raise an error if a path cannot become the folder of a tiled map.

    Raises:
        ValueError: the folder is one of the inputs.
        NotADirectoryError: path is a file.
    """
    _check_not_an_input(Path(path), inputs, "--output")
    if Path(path).exists() and not Path(path).is_dir():
        raise NotADirectoryError(f"--output must be a folder; {path} is a file")


def _check_not_an_input(path: Path, inputs: Iterable[str | os.PathLike[str]], option: str) -> None:
    """Raise a ValueError if a path is one of the inputs, or an existing scan in an input folder.

    A command that reads a folder of scans may write a new file into it. Links, hard links and other
    spellings of an input are that input.
    """
    target = path.resolve()
    for given in inputs:
        source = Path(given).resolve()
        is_in_input = source.is_dir() and target.is_file() and source in target.parents
        is_scan = is_in_input and target.suffix.lower() not in MAP_SUFFIXES
        if target == source or is_scan or _is_same_file(target, source):
            raise ValueError(f"{option} must not overwrite an input; got {path}")


def _is_same_file(first: Path, second: Path) -> bool:
    try:
        return first.samefile(second)
    except OSError:  # one of them does not exist
        return False
