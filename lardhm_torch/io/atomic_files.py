"""Atomic writing of files."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import fcntl
except ImportError:  # not on Windows: leftovers of killed writers are not recognized there
    fcntl = None  # type: ignore[assignment]

_PARTIAL = re.compile(r"\.[0-9a-f]{8}\.(.+)", re.DOTALL)  # temporary file of the file in group 1


def _partial_of(target: Path, number: int) -> Path:
    return target.with_name(f".{number:08x}.{target.name}")  # matches _PARTIAL


@contextmanager
def replaced_file(path: str | os.PathLike[str], *, durable: bool = True) -> Iterator[Path]:
    """A temporary file that replaces ``path`` in one step when the block ends.

    If the block fails or the process is killed, an existing file stays as it was. Processes that
    have it open keep reading the old content. If path is a symbolic link, its target is replaced.
    What a killed writer left behind is removed by the next writer of the same file.

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
        OSError: writing failed, as on a full disk or in a read-only folder; the error names path.
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(
            f"{path} must be in a folder that exists; there is no {target.parent}"
        )
    if target.is_dir():
        raise IsADirectoryError(f"path must be a file to write; {target} is a folder")
    try:
        with _reserved(target) as partial:
            yield partial
            if durable:
                with open(partial, "rb+") as file:
                    os.fsync(file.fileno())
            os.replace(partial, target)
    except OSError as error:
        if error.errno is not None and _concerns(error, target):
            raise OSError(error.errno, error.strerror, os.fspath(path)) from error
        if type(error) is OSError and error.errno is None:  # of NumPy, without number and name
            raise OSError(f"{os.fspath(path)} cannot be written: {error}") from error
        raise


def _concerns(error: OSError, target: Path) -> bool:
    """Whether an error names no file at all, or a temporary file of the target."""
    if not isinstance(error.filename, (str, bytes)):
        return True
    name = Path(os.fsdecode(error.filename))
    found = _PARTIAL.fullmatch(name.name)
    return found is not None and found[1] == target.name


@contextmanager
def _reserved(target: Path) -> Iterator[Path]:
    """A new temporary file for a target, locked until the block ends, and then removed."""
    for number in itertools.count():
        partial = _partial_of(target, number)
        if partial.is_symlink() or partial.exists():
            _remove_if_abandoned(partial)
        try:  # with the permissions of the umask
            file = os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
        except FileExistsError:  # of another writer
            continue
        try:
            if _lock(file, wait=True) and not _is_still(partial, file):
                continue  # removed by another writer before it was locked
            try:
                yield partial
            finally:
                partial.unlink(missing_ok=True)
            return
        finally:
            os.close(file)


def _lock(file: int, wait: bool = False) -> bool:
    """Lock an open file until it is closed or the process ends; False if that is not possible."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (OSError, AttributeError):  # in use, or there are no locks
        return False
    return True


def _is_still(path: Path, file: int) -> bool:
    try:
        return os.path.samestat(os.lstat(path), os.fstat(file))
    except FileNotFoundError:
        return False


def _remove_if_abandoned(partial: Path) -> None:
    """Remove a temporary file whose writer has ended, so that it is not locked any more."""
    try:
        file = os.open(partial, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return
    try:
        if _lock(file) and _is_still(partial, file):
            partial.unlink(missing_ok=True)
    finally:
        os.close(file)


def remove_partials(path: str | os.PathLike[str]) -> None:
    """Remove the temporary files that killed writers left behind; those in use stay.

    Args:
        path: a file, whose temporary files are removed; or a folder: those of all its files (not
            of its subfolders).
    """
    target = Path(os.path.realpath(path))
    is_folder = target.is_dir()
    for file in (target if is_folder else target.parent).iterdir():
        found = _PARTIAL.fullmatch(file.name)
        if found and (is_folder or found[1] == target.name) and file.is_file():
            _remove_if_abandoned(file)
