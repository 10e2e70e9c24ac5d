"""Map files: a state dict written atomically and read without running any code from the file."""

from __future__ import annotations

import importlib
import json
import os
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lardhm_torch.files import replaced_file

FORMAT_VERSION = 2
STREAM_KEY = "_stream"  # beside a map's tensors: how much of a stream of scans is in it


def save_state(state: dict[str, Any], path: str | os.PathLike[str]) -> None:
    """Write a state dict; after a failure or a kill the old file is still there, whole.

    A path that ends in ``.safetensors`` gets that format, whose metadata holds all that is no
    tensor, as JSON under its own key. Any other path gets torch's.

    Raises:
        FileNotFoundError: the folder of path does not exist.
        ImportError: safetensors is asked for and not installed.
    """
    with replaced_file(path) as partial:
        if _is_safetensors(path):
            _write_safetensors(state, partial)
        else:
            with open(partial, "wb") as file:
                torch.save({name: _without_reserve(value) for name, value in state.items()}, file)


def _without_reserve(value: Any) -> Any:
    """A tensor that is a view of more memory (a map that grows) as a copy: torch writes all of it."""
    if isinstance(value, Tensor) and value.untyped_storage().nbytes() > value.nbytes:
        return value.clone()
    return value


def load_state(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a state dict of tensors and plain values; nothing in the file is executed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a map file, is cut short, or holds more than tensors and plain
            values.
        ImportError: the file ends in .safetensors, which is not installed.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"map file {path} does not exist")
    read = _read_safetensors if _is_safetensors(path) else _read_torch
    try:
        state = read(path)
    except ImportError:
        raise
    except Exception as error:
        # Broken bytes surface from pickle, zipfile, torch and safetensors under a dozen types.
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
        cure = (
            "A newer map needs a newer lardhm_torch"
            if version > FORMAT_VERSION
            else "Neighbors of older maps do not fade: fit the map again"
        )
        raise ValueError(f"format_version must be {FORMAT_VERSION}; got {version}. {cure}")
    return settings


def _read_torch(path: Path) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of pickle protocols; the error says enough
        return torch.load(path, map_location="cpu", weights_only=True)


def _is_safetensors(path: str | os.PathLike[str]) -> bool:
    return Path(path).suffix.lower() == ".safetensors"


def _write_safetensors(state: dict[str, Any], path: Path) -> None:
    torch_files = _import_safetensors("torch")
    tensors = {k: v.detach().contiguous() for k, v in state.items() if isinstance(v, Tensor)}
    other = {k: json.dumps(v) for k, v in state.items() if not isinstance(v, Tensor)}
    torch_files.save_file(tensors, path, metadata={"format": "pt", **other})


def _read_safetensors(path: Path) -> dict[str, Any]:
    with _import_safetensors().safe_open(path, framework="pt") as file:
        # Copies: the file is mapped into memory, and may be replaced.
        state = {name: file.get_tensor(name).clone() for name in file.keys()}  # noqa: SIM118
        metadata = file.metadata() or {}
    return {**state, **{k: json.loads(v) for k, v in metadata.items() if k != "format"}}


def _import_safetensors(part: str = "") -> Any:
    try:
        return importlib.import_module(f"safetensors.{part}".rstrip("."))
    except ImportError as error:
        raise ImportError(
            'map files in .safetensors need safetensors: pip install "lardhm_torch[io]"'
        ) from error
