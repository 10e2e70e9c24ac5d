"""Range scans: sensor positions and ray ends in a common world frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from lardhm_torch.channels import Channels, check_channels, concatenate_channels, select_channels


@dataclass(frozen=True, eq=False)
class Scans:
    """Rays of one or more scans, in the world frame, as float64.

    Ray r starts at ``origins[scan_id[r]]`` and ends at ``ends[r]``. Coordinates may be far from zero
    (e.g. UTM).

    Args:
        origins: (S, D) sensor position of each scan [m].
        ends: (R, D) end of each ray [m]: a hit, or a point up to which the ray is free.
        scan_id: (R,) scan of each ray, 0 to S - 1; None: all rays belong to scan 0.
        is_return: (R,) True where the ray hit a surface; None: all rays did.
        target_index: (R,) 1 for the first return of a pulse, 2 for the second, ...; None: all 1.
        channels: additional values of the rays by name, such as color, intensity and class (see
            `channels`); a missing value is NaN, or -1 for a class. None: no channels.
        times: (S,) time stamp of each scan [s], NaN if unknown; None: no scan has one.

    Raises:
        ValueError: a tensor has the wrong shape, a scan_id has no origin, or a value of a channel is
            out of range.
    """

    origins: Tensor
    ends: Tensor
    scan_id: Tensor = field(default=None)  # type: ignore[assignment]
    is_return: Tensor = field(default=None)  # type: ignore[assignment]
    target_index: Tensor = field(default=None)  # type: ignore[assignment]
    channels: Channels = field(default=None)  # type: ignore[arg-type]
    times: Tensor | None = None

    def __post_init__(self) -> None:
        ends = torch.as_tensor(self.ends, dtype=torch.float64)
        device = ends.device
        origins = torch.as_tensor(self.origins, dtype=torch.float64, device=device)
        if ends.ndim != 2 or origins.ndim != 2 or ends.shape[1] != origins.shape[1]:
            raise ValueError(
                "ends must be (R, D) and origins (S, D) with one D; "
                f"got {tuple(ends.shape)} and {tuple(origins.shape)}"
            )
        rays = len(ends)
        columns = {
            "scan_id": (self.scan_id, torch.long, 0),
            "is_return": (self.is_return, torch.bool, True),
            "target_index": (self.target_index, torch.long, 1),
        }
        is_checked = rays == 0 or (self.scan_id is None and len(origins) > 0)
        for name, (value, dtype, default) in columns.items():
            if value is None:
                value = torch.full((rays,), default, dtype=dtype, device=device)
            else:
                value = torch.as_tensor(value, device=device).to(dtype)
            if value.shape != (rays,):
                raise ValueError(
                    f"{name} must be ({rays},), one entry per ray; got {tuple(value.shape)}"
                )
            object.__setattr__(self, name, value)
        if not is_checked:
            lowest, highest = map(int, self.scan_id.aminmax())
            if lowest < 0 or highest >= len(origins):
                raise ValueError(
                    f"scan_id must be 0 to {len(origins) - 1}, one origin per scan; "
                    f"got {lowest} to {highest}"
                )
        object.__setattr__(self, "origins", origins)
        object.__setattr__(self, "ends", ends)
        object.__setattr__(self, "channels", check_channels(self.channels, rays, device))
        if self.times is not None:
            times = torch.as_tensor(self.times, dtype=torch.float64, device=device)
            if times.shape != (len(origins),):
                raise ValueError(
                    f"times must be ({len(origins)},), one per scan; got {tuple(times.shape)}"
                )
            object.__setattr__(self, "times", times)

    def __len__(self) -> int:
        """Number of rays R."""
        return len(self.ends)

    @property
    def dim(self) -> int:
        """Number of coordinates D."""
        return self.ends.shape[1]

    @property
    def num_scans(self) -> int:
        """Number of scans S."""
        return len(self.origins)

    @property
    def ray_origins(self) -> Tensor:
        """(R, D) start of each ray [m]."""
        return self.origins[self.scan_id]

    @property
    def ranges(self) -> Tensor:
        """(R,) length of each ray [m]."""
        starts = self.origins if self.num_scans == 1 else self.ray_origins
        return torch.linalg.vector_norm(self.ends - starts, dim=1)

    @property
    def hits(self) -> Tensor:
        """(H, D) ray ends that lie on a surface [m]."""
        return self.ends[self.is_return]

    def select(self, rays: Tensor) -> Scans:
        """The given rays (mask or indices). All origins are kept, so scan_id remains valid."""
        return Scans(
            self.origins,
            self.ends[rays],
            self.scan_id[rays],
            self.is_return[rays],
            self.target_index[rays],
            select_channels(self.channels, rays),
            self.times,
        )

    def with_origins(self, scans: Tensor, scan_id: Tensor) -> Scans:
        """The same rays with the given scans (indices) alone, and their new numbers (R,)."""
        times = None if self.times is None else self.times[scans]
        return replace(self, origins=self.origins[scans], scan_id=scan_id, times=times)

    def drop_constant_column(self) -> Scans:
        """The same scans without the last coordinate, which must be constant, such as z of 2-D scans.

        Raises:
            ValueError: the last coordinate is not constant.
        """
        ends, origins = self.ends, self.origins
        column = torch.cat([ends[:, -1], origins[:, -1]])
        spread = float(column.max() - column.min()) if len(column) else 0.0
        if not spread <= 1e-6:  # NaN is not constant either
            raise ValueError(
                f"the last coordinate must be constant to be dropped; it spans {spread:.3g} m"
            )
        return replace(self, origins=origins[:, :-1], ends=ends[:, :-1])


def concatenate_scans(parts: list[Scans]) -> Scans:
    """Concatenate the rays of several Scans. Scans are renumbered consecutively.

    Rays of a part without a channel have no value in it.

    Raises:
        ValueError: ``parts`` is empty, or the dimensions or the shapes of a channel differ.
    """
    if not parts:
        raise ValueError("parts must hold at least one Scans; got none")
    dims = sorted({part.dim for part in parts})
    if len(dims) > 1:
        raise ValueError(f"all scans must have the same dimension; got {dims}")
    if len(parts) == 1:
        return parts[0]
    before = [0]
    for part in parts:
        before.append(before[-1] + part.num_scans)
    return Scans(
        torch.cat([part.origins for part in parts]),
        torch.cat([part.ends for part in parts]),
        torch.cat([part.scan_id + n for part, n in zip(parts, before, strict=False)]),
        torch.cat([part.is_return for part in parts]),
        torch.cat([part.target_index for part in parts]),
        concatenate_channels([(part.channels, len(part)) for part in parts]),
        _concatenate_times(parts),
    )


def _concatenate_times(parts: list[Scans]) -> Tensor | None:
    if all(part.times is None for part in parts):
        return None
    unknown = [torch.full_like(part.origins[:, 0], torch.nan) for part in parts]
    pairs = zip(parts, unknown, strict=True)
    return torch.cat([none if part.times is None else part.times for part, none in pairs])


def every_scan(scans: Scans, step: int) -> Scans:
    """Every ``step``-th scan, starting with the first. Scans are renumbered."""
    kept = torch.arange(0, scans.num_scans, step, device=scans.ends.device)
    rays = scans.select(scans.scan_id % step == 0)
    scan_id = torch.div(rays.scan_id, step, rounding_mode="floor")
    return rays.with_origins(kept, scan_id)


def thin_rays(scans: Scans, voxel: float | None) -> Scans:
    """Of the rays of a scan that end in one voxel, keep the first.

    Hits and beams without return are thinned separately. Non-finite rays are kept, because sampling
    counts them.

    Args:
        scans: range scans.
        voxel: edge of the voxels, whose corners lie at multiples of it [m]; None: keep all rays.

    Raises:
        ValueError: voxel is not above 0.
    """
    if voxel is None:
        return scans
    if not 0 < voxel < float("inf"):
        raise ValueError(f"voxel must be > 0 m and finite; got {voxel}")
    finite = scans.ends.isfinite().all(dim=1)
    rays = finite.nonzero().squeeze(1)
    cells = (scans.ends[rays] / voxel).floor()
    key = scans.scan_id[rays] * 2 + scans.is_return[rays]
    for axis in range(scans.dim):  # numbered anew after every axis, so that no key overflows
        number = cells[:, axis].unique(return_inverse=True)[1]
        key = (key * (len(rays) + 1) + number).unique(return_inverse=True)[1]
    ascending, order = key.sort(stable=True)
    is_first = torch.ones_like(ascending, dtype=torch.bool)
    is_first[1:] = ascending[1:] != ascending[:-1]
    kept = ~finite
    kept[rays[order[is_first]]] = True
    return scans.select(kept)


def split_rays(scans: Scans, ratio: float = 0.5, seed: int = 0) -> tuple[Scans, Scans]:
    """Split rays at random into two sets.

    Args:
        scans: range scans.
        ratio: fraction of the rays in the first set.
        seed: random seed of the split.

    Returns:
        The first set, and the rest.

    Raises:
        ValueError: ratio is not strictly between 0 and 1.
    """
    if not 0 < ratio < 1:
        raise ValueError(f"ratio must be between 0 and 1, both excluded; got {ratio}")
    rng = torch.Generator().manual_seed(seed)
    order = torch.randperm(len(scans), generator=rng).to(scans.ends.device)
    cut = round(ratio * len(scans))
    return scans.select(order[:cut].sort().values), scans.select(order[cut:].sort().values)


def seeded_generator(
    seed: int, purpose: str, device: torch.device | str = "cpu"
) -> torch.Generator:
    """A generator whose numbers depend on the seed and on their purpose.

    Sampling, clustering and training with the same seed must not draw the same numbers, which would
    be correlated otherwise.

    Args:
        seed: any integer.
        purpose: name of the stream, for example "sampling".
        device: where the numbers are drawn.

    Raises:
        ValueError: seed is not an integer.
    """
    if isinstance(seed, bool) or not isinstance(seed, int):
        raise ValueError(f"seed must be an integer; got {seed!r}")
    digest = hashlib.blake2b(f"{purpose} {seed}".encode(), digest_size=8).digest()
    return torch.Generator(device=device).manual_seed(int.from_bytes(digest, "little") >> 1)
