"""A folder for compiled code that nobody else can write to.

Loading a library executes code. Therefore a folder is used only if nobody but the user and root can
put a file there or replace the folder: owner and mode of the folder and its parents are checked.
"""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path


def cached_file(name: str, make: Callable[[Path], None]) -> Path:
    """A file of the library cache, which ``make(path)`` writes if it is missing.

    The cache is ``LARDHM_CACHE``, or ``~/.cache/lardhm_torch``. If it cannot be used, a warning gives
    the reason, and a temporary folder is used. The file is written atomically, so a process that is
    killed, or one that runs at the same time, leaves no incomplete file.

    Raises:
        OSError: no folder can be used.
    """
    problems: list[str] = []
    for folder in _folders():
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            kept = folder.resolve() / name
            check_private(kept.parent)
            if not kept.is_file():
                _make_in_one_step(kept, make)
            check_private(kept)
        except OSError as error:
            problems.append(str(error))
            continue
        if problems:
            warnings.warn(
                f"the library cache cannot be used: {'; '.join(problems)}. The compiled library is kept "
                f"in {folder}; set LARDHM_CACHE to a folder of your own",
                stacklevel=6,
            )
        return kept
    raise OSError(f"no folder for the compiled library: {'; '.join(problems)}; set LARDHM_CACHE")


def check_private(path: Path) -> None:
    """Check that only the user and root can change what lies at a path.

    Folders above it may be writable for all if they are sticky, as ``/tmp`` is, and for a group if it
    is the user's own.

    Raises:
        PermissionError: another user owns the path or a folder above it, or can write to one.
    """
    user = os.getuid()
    for place in (path, *path.parents):
        status = place.stat()
        above = place != path
        if status.st_uid not in (0, user):
            raise PermissionError(f"{place} belongs to another user (uid {status.st_uid})")
        own_group = above and status.st_gid == user  # a private group has the number of its user
        writable = status.st_mode & (stat.S_IWOTH if own_group else stat.S_IWOTH | stat.S_IWGRP)
        if writable and not (above and status.st_mode & stat.S_ISVTX):
            raise PermissionError(f"other users can write to {place} (cure: chmod go-w {place})")


def _folders() -> Iterator[Path]:
    """The user's cache; a temporary folder that later processes find; one of this process alone."""
    named = os.environ.get("LARDHM_CACHE")
    yield Path(named) if named else Path.home() / ".cache" / "lardhm_torch"
    yield Path(tempfile.gettempdir()) / f"lardhm_torch-{os.getuid()}"
    yield _process_folder()


@functools.cache
def _process_folder() -> Path:
    """A new private folder, removed when the process ends."""
    folder = tempfile.mkdtemp(prefix="lardhm_torch-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _make_in_one_step(target: Path, make: Callable[[Path], None]) -> None:
    with tempfile.TemporaryDirectory(prefix="build-", dir=target.parent) as scratch:
        made = Path(scratch) / target.name
        make(made)
        made.chmod(0o700)
        os.replace(made, target)
