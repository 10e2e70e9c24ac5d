"""Map files: a state dict written atomically and read without running any code from the file."""

from __future__ import annotations

import os
import pickle
import tempfile
import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch

FORMAT_VERSION = 1


def save_state(state: dict[str, Any], path: str | os.PathLike[str]) -> None:
    """Write a state dict; after a failure or a kill the old file is still there, whole.

    The new file is written beside the old one and takes its name in one step.
    """
    path = Path(path)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            torch.save(state, file)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o666 & ~_umask())
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def load_state(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a state dict of tensors and plain values; nothing in the file is executed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a map file, is cut short, or holds more than tensors and plain
            values.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"map file {path} does not exist")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pickle protocols; the error below says enough
            state = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, zipfile.BadZipFile, ValueError,
            KeyError, IndexError, TypeError, AttributeError, OSError) as error:  # fmt: skip
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ValueError(f"{path} must be a map file, whole and safe to load; {reason}") from error
    if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
        raise ValueError(f"{path} must hold a state dict; got {type(state).__name__}")
    return state


def check_settings(extra: Any) -> dict[str, Any]:
    """The settings in a map's extra state, without the format version, or a ValueError."""
    if not isinstance(extra, dict) or not isinstance(extra.get("format_version"), int):
        raise ValueError(
            "_extra_state must hold the map's format version and settings; it does not"
        )
    settings = dict(extra)
    version = settings.pop("format_version")
    if version != FORMAT_VERSION:
        raise ValueError(
            f"format_version must be {FORMAT_VERSION}; got {version}. "
            "A newer map needs a newer lardhm_torch"
        )
    return settings


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
