"""A map sent while it grows: packets with what changed since the packet before.

A packet is a packed map, or its differences from the last one (`io.packed_files`). A receiver that
applies all packets holds exactly the integers of the sender's packed map, and so gives the same answers.
"""

from __future__ import annotations

import os
from pathlib import Path

from lardhm_torch import packing
from lardhm_torch.hilbert_map import LardHilbertMap
from lardhm_torch.io import packed_files
from lardhm_torch.io.atomic_files import replaced_file


class PacketSender:
    """Makes the packets of a map that changes.

    Args:
        precision: fractional bits of the rounded parameters, 1 to 16, see `LardHilbertMap.pack`.

    Attributes:
        number: number of the last packet, -1 before the first.
    """

    def __init__(self, precision: int = packing.PRECISION) -> None:
        packing.check_precision(precision)
        self.precision = precision
        self.number = -1
        self._last: packed_files.Packed | None = None

    def packet(self, model: LardHilbertMap, *, whole: bool = False) -> bytes:
        """The next packet: what changed in the map since the last one.

        Args:
            model: the map, of any number of clusters.
            whole: write the whole map, for receivers that missed packets. It is written anyway if the
                origin or the settings of the map have changed.
        """
        packed = packing.rounded(model, self.precision)
        last = None if whole else self._last
        if last is not None and last.frame != packed.frame:
            last = None
        content = packed_files.encode(packed, self.number + 1, last)
        self.number, self._last = self.number + 1, packed
        return content


class PacketReceiver:
    """Holds the map of the packets that were applied."""

    def __init__(self) -> None:
        self._last: tuple[int, packed_files.Packed] | None = None

    @property
    def number(self) -> int:
        """Number of the last packet, -1 before the first."""
        return -1 if self._last is None else self._last[0]

    def apply(self, packet: bytes) -> None:
        """Apply the next packet. A packet with a whole map may come at any time.

        Raises:
            ValueError: the packet is damaged, of another stream, or not the next one. The map is
                unchanged.
        """
        self._last = packed_files.decode(packet, self._last)

    def map(self) -> LardHilbertMap:
        """The packed map, which answers but does not learn.

        Raises:
            RuntimeError: no packet has been applied.
        """
        if self._last is None:
            raise RuntimeError("map needs a packet; call apply first")
        return LardHilbertMap.from_state(packing.state_dict_of(self._last[1]))


class PacketWriter:
    """Writes the packets of a map to a file or a folder, for `stream_scans(after_scan=writer.send)`.

    Args:
        path: a folder gets one file per packet; a file, ``.lhm``, gets all packets one after the other.
            `LardHilbertMap.load` reads both.
        precision: fractional bits, see `LardHilbertMap.pack`.
        resume: continue after the packets that are there. An unfinished packet at the end of a file
            is removed. Otherwise they are replaced.

    Raises:
        FileNotFoundError: the folder of path does not exist.
        ValueError: the packets that are there are damaged, or of another precision.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        precision: int = packing.PRECISION,
        resume: bool = False,
    ) -> None:
        self.path = Path(path)
        self._sender = PacketSender(precision)
        self._in_folder = self.path.suffix != packed_files.SUFFIX
        if resume and packed_files.is_packed(self.path):
            self._resume()
        elif self._in_folder:
            self.path.mkdir(exist_ok=True)
            for file in packed_files.packet_files(self.path):
                file.unlink()
        else:
            with replaced_file(self.path):
                pass

    def send(self, model: LardHilbertMap) -> None:
        """Write the next packet."""
        content = self._sender.packet(model)
        if self._in_folder:
            with replaced_file(packed_files.packet_path(self.path, self._sender.number)) as partial:
                partial.write_bytes(content)
            return
        with open(self.path, "ab") as file:
            file.write(content)

    def _resume(self) -> None:
        if not self._in_folder:
            packed_files.drop_unfinished(self.path)
        number, packed = packed_files.load_packed(self.path)
        if packed.precision != self._sender.precision:
            raise ValueError(
                f"precision must be that of the packets in {self.path}, {packed.precision}; "
                f"got {self._sender.precision}"
            )
        self._sender.number, self._sender._last = number, packed
