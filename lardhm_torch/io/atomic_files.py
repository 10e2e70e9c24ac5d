"""Atomic writing of files."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PARTIAL = re.compile(r"\.[0-9a-f]{8}\.(.+)", re.DOTALL)  # temporary file of the file in group 1


@contextmanager
def replaced_file(path: str | os.PathLike[str], *, durable: bool = True) -> Iterator[Path]:
    """A temporary file that replaces ``path`` in one step when the block ends.

    If the block fails or the process is killed, an existing file stays as it was. Processes that
    have it open keep reading the old content. If path is a symbolic link, its target is replaced.

        with replaced_file("map.pt") as partial:
            torch.save(state, partial)

    Args:
        path: the file to write.
        durable: call ``fsync`` before the file is renamed. False saves some milliseconds, but after
            a power failure (not after a kill) the file may be empty or truncated.

    Yields:
        Path of an empty temporary file in the same folder, with the same extension.

    Raises:
        FileNotFoundError: the folder of path does not exist.
        IsADirectoryError: path is a folder.
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(
            f"path must be in a folder that exists; there is no {target.parent}"
        )
    if target.is_dir():
        raise IsADirectoryError(f"path must be a file to write; {target} is a folder")
    partial = target.with_name(f".{secrets.token_hex(4)}.{target.name}")  # matches _PARTIAL
    os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # as the umask allows
    try:
        yield partial
        if durable:
            with open(partial, "rb+") as file:
                os.fsync(file.fileno())
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def remove_partials(path: str | os.PathLike[str]) -> None:
    """Remove the temporary files that killed writers left behind.

    No other process may be writing them at the same time.

    Args:
        path: a file, whose temporary files are removed; or a folder: those of all its files (not
            of its subfolders).
    """
    target = Path(os.path.realpath(path))
    is_folder = target.is_dir()
    for file in (target if is_folder else target.parent).iterdir():
        found = _PARTIAL.fullmatch(file.name)
        if found and (is_folder or found[1] == target.name) and file.is_file():
            file.unlink()
