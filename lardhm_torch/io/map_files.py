"""Map files: the state dict of a map on disk, written atomically and verified when it is read.

The extension of the path chooses the format (docs/map_format.md describes the content):

- ``.safetensors``: tensors behind a JSON header, with a CRC-32 of everything in its metadata;
- any other: torch's own format, a zip file with a CRC-32 for each entry, which is verified here
  because `torch.load` does not.

Code in a file is never executed.
"""

from __future__ import annotations

import json
import os
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import torch
from safetensors import SafetensorError
from safetensors import torch as safetensors_torch
from torch import Tensor

from lardhm_torch.io.atomic_files import replaced_file

FORMAT_VERSION = 2
# In the extra state of maps with channels or of packed maps, beside the settings.
NOT_SETTINGS = ("channels", "class_scale", "is_packed", "max_age")
STREAM_KEY = "_stream"  # beside the tensors of a checkpoint: how many scans were processed
SAFETENSORS = ".safetensors"
MSDOS_DIRECTORY = 0x10  # attribute of a zip entry, beside its checksum: torch reads 0 bytes of it


def save_state(state: dict[str, Any], path: str | os.PathLike[str]) -> None:
    """Write a state dict atomically: if writing fails, an existing file is unchanged.

    Args:
        state: tensors and plain Python values by name.
        path: a path that ends in ``.safetensors`` gets that format, in which every value that is
            not a tensor is JSON in the metadata; any other path gets torch's format.

    Raises:
        FileNotFoundError: the folder of path does not exist.
        ValueError: a tensor is on the meta device, and has no values.
    """
    empty = [name for name, value in state.items() if isinstance(value, Tensor) and value.is_meta]
    if empty:
        raise ValueError(f"{empty[0]} must have values to be saved; it is on the meta device")
    with replaced_file(path) as partial:
        if _is_safetensors(path):
            _write_safetensors(state, partial)
        else:
            _write_torch(state, partial)


def load_state(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a state dict of tensors and plain values and verify its checksums.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: the file is not a map file, is truncated or damaged, or holds anything but
            tensors and plain values.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"map file {path} does not exist")
    try:
        state = _read_safetensors(path) if _is_safetensors(path) else _read_torch(path)
    except Exception as error:
        # Damaged bytes raise a dozen exception types from pickle, zipfile, torch and safetensors.
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ValueError(
            f"{path} must be a complete map file that is safe to load; {reason}"
        ) from error
    if not isinstance(state, dict) or not all(isinstance(key, str) for key in state):
        raise ValueError(f"{path} must hold a state dict; got {type(state).__name__}")
    return state


def map_settings(state: dict[str, Any]) -> dict[str, Any]:
    """The settings of the map in a state dict, which is left without the keys of a stream.

    Raises:
        ValueError: the state is not that of a map, or of another format version.
    """
    state.pop(STREAM_KEY, None)  # a checkpoint of a stream is a map, too
    settings = check_settings(state.get("_extra_state"))
    if state["centers"].shape[1:] != (settings["dim"],):
        raise ValueError(
            f"centers must be (M, {settings['dim']}); got {tuple(state['centers'].shape)}"
        )
    return settings


def check_settings(extra: Any) -> dict[str, Any]:
    """The settings in the extra state of a map, without the format version and the channels.

    Raises:
        ValueError: there are none, or the format version is not supported.
    """
    if not isinstance(extra, dict) or not isinstance(extra.get("format_version"), int):
        raise ValueError(
            "_extra_state must hold the map's format version and settings; it does not"
        )
    settings = {name: v for name, v in extra.items() if name not in NOT_SETTINGS}
    version = settings.pop("format_version")
    if version != FORMAT_VERSION:
        cure = (
            "A newer map needs a newer lardhm_torch"
            if version > FORMAT_VERSION
            else "Fit the map again: the features of older maps do not fade out"
        )
        raise ValueError(f"format_version must be {FORMAT_VERSION}; got {version}. {cure}")
    return settings


def decode_safetensors(content: bytes) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata in the bytes of a ``.safetensors`` file; the checksum is not verified.

    Raises:
        ValueError: the bytes are not such a file.
    """
    try:
        tensors = safetensors_torch.load(content)
    except SafetensorError as error:
        raise ValueError(str(error)) from error
    header_end = 8 + int.from_bytes(content[:8], "little")
    return tensors, json.loads(content[8:header_end]).get("__metadata__", {})


def _is_safetensors(path: str | os.PathLike[str]) -> bool:
    return Path(path).suffix.lower() == SAFETENSORS


def _write_torch(state: Mapping[str, Any], path: Path) -> None:
    compact = {name: without_spare_memory(value) for name, value in state.items()}
    with_checksums = torch.serialization.get_crc32_options()
    torch.serialization.set_crc32_options(True)  # the default; verified by `_read_torch`
    try:
        with open(path, "wb") as file:
            torch.save(compact, file)
    except RuntimeError as error:  # torch's own after a failed write, as on a full disk
        raise error.__context__ if isinstance(error.__context__, OSError) else error from None
    finally:
        torch.serialization.set_crc32_options(with_checksums)


def without_spare_memory(value: Any) -> Any:
    """A copy of a tensor that is a view of a larger storage, which torch would write as a whole."""
    if isinstance(value, Tensor) and value.untyped_storage().nbytes() > value.nbytes:
        return value.clone()
    return value


def _read_torch(path: Path) -> Any:
    with open(path, "rb") as file:
        _verify_zip(file)
        file.seek(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about pickle protocols; the error is enough
            state = torch.load(file, map_location="cpu", weights_only=True)
    for name, value in state.items() if isinstance(state, dict) else ():
        _check_stored(name, value)
    return state


def _check_stored(name: str, value: Any) -> None:
    """A ValueError for a tensor that is larger than its bytes in the file, and would fill the memory."""
    if isinstance(value, Tensor) and value.layout == torch.strided and not value.is_meta:
        stored = value.untyped_storage().nbytes()
        if value.nbytes > stored:
            raise ValueError(
                f"{name} must store all its values; {tuple(value.shape)} need {value.nbytes} bytes, "
                f"and the file has {stored}"
            )


def _verify_zip(file: BinaryIO) -> None:
    """A ValueError where a checksum differs, or torch would take an entry for an empty folder."""
    with zipfile.ZipFile(file) as archive:
        for entry in archive.infolist():
            if entry.compress_type != zipfile.ZIP_STORED:  # a few bytes could fill the memory
                raise ValueError(f"its entry {entry.filename} must not be compressed")
        damaged = archive.testzip()
        if damaged is not None:
            raise ValueError(f"the checksum of its entry {damaged} differs: the file is damaged")
        for entry in archive.infolist():
            if entry.external_attr & MSDOS_DIRECTORY:
                raise ValueError(f"its entry {entry.filename} must be a file, not a folder")


def _write_safetensors(state: Mapping[str, Any], path: Path) -> None:
    tensors = {
        name: value.detach().cpu().contiguous()
        for name, value in state.items()
        if isinstance(value, Tensor)
    }
    other = {name: json.dumps(value) for name, value in state.items() if name not in tensors}
    metadata = {"format": "pt", "checksum": _checksum(tensors, other), **other}
    # `save_file` would replace the file by one that only its owner can read.
    path.write_bytes(_with_sorted_metadata(safetensors_torch.save(tensors, metadata)))


def _with_sorted_metadata(content: bytes) -> bytes:
    """The same file with metadata in order: safetensors writes them in random order.

    Equal maps then have equal files, as joining and comparing folders of tiles requires.
    """
    header_end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:header_end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    return content[:8] + text.ljust(header_end - 8) + content[header_end:]


def _read_safetensors(path: Path) -> dict[str, Any]:
    tensors, metadata = decode_safetensors(path.read_bytes())
    other = {k: text for k, text in metadata.items() if k not in ("format", "checksum")}
    if "checksum" not in metadata:
        raise ValueError("its metadata must hold a checksum; write it with LardHilbertMap.save")
    if metadata["checksum"] != _checksum(tensors, other):
        raise ValueError("the checksum of its content differs: the file is damaged")
    return {**tensors, **{name: json.loads(text) for name, text in other.items()}}


def _checksum(tensors: Mapping[str, Tensor], other: Mapping[str, str]) -> str:
    """CRC-32, hexadecimal, of names, types, shapes, other values and the bytes of all tensors."""
    names = sorted(tensors)
    described = [[name, str(tensors[name].dtype), list(tensors[name].shape)] for name in names]
    value = zlib.crc32(json.dumps([described, sorted(other.items())]).encode())
    for name in names:
        value = zlib.crc32(tensors[name].reshape(-1).view(torch.uint8).numpy().data, value)
    return f"{value:08x}"
