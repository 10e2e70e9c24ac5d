"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_PARTIAL = re.compile(r"\.[0-9a-f]{8}\..+")  # name of a file that is not yet whole


@contextmanager
def replaced_file(path: str | os.PathLike[str], *, durable: bool = True) -> Iterator[Path]:
    """A new file beside path, which takes path's name at the end of the block, in one step.

    After a failure or a kill the old file is still there, whole. Who has it open keeps its
    content. Through a link, what it points to is replaced and the link stays.

        with replaced_file("map.pt") as partial:
            torch.save(state, partial)

    Args:
        path: of the file.
        durable: False saves the milliseconds that it takes to have the bytes on the disk: after a
            power failure (not after a kill) the file may then be empty or cut.

    Yields:
        A path of the same folder and extension, to an empty file.

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
    partial = target.with_name(f".{secrets.token_hex(4)}.{target.name}")
    os.close(os.open(partial, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))  # as the umask allows
    try:
        yield partial
        if durable:
            with open(partial, "rb+") as file:
                os.fsync(file.fileno())
        os.replace(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def remove_partials(folder: str | os.PathLike[str]) -> None:
    """Remove what writers that were killed left in a folder. No one may be writing there."""
    for path in Path(folder).iterdir():
        if _PARTIAL.fullmatch(path.name) and path.is_file():
            path.unlink()
