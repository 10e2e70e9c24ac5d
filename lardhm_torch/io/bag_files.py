"""The messages of ROS bags, one after the other, whatever the container.

The containers are read here and not by a library, because a damaged bag must neither allocate the
sizes in its headers nor decompress without limit. `bag_scans` interprets the messages.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lardhm_torch.io.bag_chunks import Message, Unpacker
from lardhm_torch.io.mcap import read_mcap
from lardhm_torch.io.notes import Note
from lardhm_torch.io.paths import natural_key
from lardhm_torch.io.ros1_bag import read_ros1
from lardhm_torch.io.ros2_sqlite import read_sqlite, unmerged_log

_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_STORAGE = (".db3", ".mcap")
_MAX_METADATA_BYTES = 1 << 22


@dataclass(frozen=True)
class BagParts:
    """The storage files of a bag, in order, and what is known about them.

    Args:
        files: the files to read.
        num_messages: how many messages metadata.yaml declares; None if it gives none.
        notes: what was assumed or left out.
    """

    files: list[Path]
    num_messages: int | None = None
    notes: tuple[Note, ...] = ()


def read_messages(path: Path) -> Iterator[Message]:
    """All messages of a .bag, .db3 or .mcap file in the order of the file.

    Raises:
        ValueError: the file is no such bag, is cut short or damaged.
        ImportError: the bag is compressed and lz4 or zstd is not installed.
    """
    log = unmerged_log(path) if path.suffix.lower() == ".db3" else None
    unpack = Unpacker(path.stat().st_size + (0 if log is None else log.stat().st_size))
    for message in _packed_messages(path, unpack):
        # ROS 2 can pack messages one by one, and only metadata.yaml says so; none begins like this.
        if message.content[:4] == _ZSTD_MAGIC:
            yield message._replace(content=unpack(message.content, "zstd", None))
        else:
            yield message


def _packed_messages(path: Path, unpack: Unpacker) -> Iterator[Message]:
    if path.suffix.lower() == ".db3":
        yield from read_sqlite(path, unpack)
        return
    with open(path, "rb") as file:
        yield from (read_ros1 if path.suffix.lower() == ".bag" else read_mcap)(file, unpack)


def is_bag_folder(folder: Path) -> bool:
    """Whether a folder is a ROS 2 bag: with metadata.yaml, or the parts of one bag without it.

    Recorders write metadata.yaml when they stop; one that was killed leaves bag_0.db3, bag_1.db3.
    """
    if (folder / "metadata.yaml").is_file():
        return True
    files = [file for file in folder.iterdir() if file.suffix.lower() in _STORAGE]
    parts = [_part(file) for file in files]
    return 0 in {number for _, number in parts} and len({name for name, _ in parts}) == 1


def _part(file: Path) -> tuple[str, int]:
    """The name of a bag and the number of its part; -1 for a file that is none."""
    name, _, number = file.stem.rpartition("_")
    is_part = bool(name) and number.isascii() and number.isdigit() and len(number) < 10
    return (name, int(number)) if is_part else (file.stem, -1)


def bag_parts(path: Path) -> BagParts:
    """The file itself, or the storage files of a ROS 2 bag's folder: those metadata.yaml lists.

    Raises:
        ValueError: a listed file is missing or still compressed, there is no file, or one part is
            there in both formats and metadata.yaml does not say which one is valid.
    """
    if not path.is_dir():
        notes = _log_notes([path])
        return BagParts([path], notes=notes)
    found = sorted(path.iterdir(), key=lambda file: natural_key(file.name))
    there = [file for file in found if file.suffix.lower() in _STORAGE]
    metadata = _metadata(path / "metadata.yaml")
    listed = metadata.get("relative_file_paths")
    if isinstance(listed, list) and listed:
        files = [_listed_file(path, str(name)) for name in listed]
        others = [file.name for file in there if file not in files]
        text = f"{', '.join(others)} left out: not in metadata.yaml"
        notes = (Note(text),) if others else ()
    else:
        files = _unlisted_files(path, found, there)
        notes = (Note("metadata.yaml lists no files: all parts in the folder are read"),)
        notes += _missing_parts(files)
    count = metadata.get("message_count")
    num_messages = count if isinstance(count, int) and count >= 0 else None
    return BagParts(files, num_messages, notes + _log_notes(files))


def _missing_parts(files: list[Path]) -> tuple[Note, ...]:
    """A warning if the numbers of the parts have a gap."""
    numbers = {_part(file)[1] for file in files}
    missing = [number for number in range(len(numbers)) if number not in numbers]
    if -1 in numbers or not missing:
        return ()
    names = ", ".join(map(str, missing[:5]))
    return (Note(f"parts {names} of {files[0].parent.name} are missing", is_loss=True),)


def _log_notes(files: list[Path]) -> tuple[Note, ...]:
    logs = [log.name for file in files if file.suffix == ".db3" and (log := unmerged_log(file))]
    return (Note(f"the recorder was killed: {', '.join(logs)} is merged"),) if logs else ()


def _metadata(path: Path) -> dict[str, Any]:
    """The entries of metadata.yaml; none if it is missing, empty or of another kind."""
    if not path.is_file():
        return {}
    if path.stat().st_size > _MAX_METADATA_BYTES:
        raise ValueError(f"metadata.yaml has more than {_MAX_METADATA_BYTES} bytes")
    try:
        from ruamel.yaml import YAML  # comes with rosbags
        from ruamel.yaml.error import YAMLError
    except ImportError as error:
        raise ImportError(
            f"{path} needs rosbags. Install it: pip install 'lardhm_torch[io]'"
        ) from error
    try:
        content = YAML(typ="safe").load(path.read_text(encoding="utf-8"))
    except (YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"metadata.yaml is no YAML. Run: ros2 bag reindex ({error})") from error
    entries = content.get("rosbag2_bagfile_information") if isinstance(content, dict) else None
    return entries if isinstance(entries, dict) else {}


def _listed_file(folder: Path, name: str) -> Path:
    """A file of metadata.yaml, or what it was unpacked to; old writers put the folder's name first."""
    file = folder / Path(name).name
    unpacked = file.with_suffix("") if file.suffix == ".zstd" else file
    if unpacked.is_file():
        if unpacked.suffix.lower() not in _STORAGE:
            raise ValueError(f"metadata.yaml lists {name}; .db3 and .mcap files can be read")
        return unpacked
    packed = unpacked.with_name(unpacked.name + ".zstd")
    if packed.is_file():
        raise ValueError(f"{packed.name} is still compressed. Unpack it: zstd -d {packed.name}")
    raise ValueError(
        f"metadata.yaml lists {name}, which is missing. Put it back, or list what is there: "
        "ros2 bag reindex"
    )


def _unlisted_files(folder: Path, found: list[Path], there: list[Path]) -> list[Path]:
    packed = [file.name for file in found if file.suffix == ".zstd"]
    unpacked = {file.name for file in there}
    missing = [name for name in packed if name.removesuffix(".zstd") not in unpacked]
    if missing:
        raise ValueError(f"{', '.join(missing)} is still compressed. Unpack it: zstd -d *.zstd")
    if not there:
        raise ValueError("a ROS 2 bag has a .db3 or .mcap file; this folder has none")
    kinds = {file.suffix.lower() for file in there}
    if len(kinds) > 1:
        raise ValueError(
            f"{folder.name} has {' and '.join(sorted(kinds))} files, and metadata.yaml does not say "
            "which are the bag: one may be a conversion of the other. Name the file to read"
        )
    return there
