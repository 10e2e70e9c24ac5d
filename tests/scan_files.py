"""Whole files of every format, by hand: what the reader tests read and break."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch

from lardhm_torch.io.scan_files import save_scans
from lardhm_torch.scans import Scans

RAMP = np.arange(160, dtype="<u2").tobytes()


UTM = np.array([500_000.0, 4_500_000.0, 100.0])


HAS_LASPY = all(importlib.util.find_spec(name) for name in ("laspy", "lazrs"))


needs_laspy = pytest.mark.skipif(not HAS_LASPY, reason="laspy[lazrs] is not installed")


def some_points(count: int = 200, dim: int = 3) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, dim)).round(3)


def real_scans(data: Path, name: str) -> dict[str, np.ndarray]:
    with np.load(data / name / "scans.npz") as archive:
        return dict(archive)


def ply_header(encoding: str, count: int, names="x y z", kind: str = "double") -> bytes:
    lines = ["ply", f"format {encoding} 1.0", "comment by hand", "obj_info too"]
    lines += [f"element vertex {count}", *(f"property {kind} {name}" for name in names.split())]
    return "\n".join([*lines, "end_header", ""]).encode()


def pcd_header(
    encoding: str, count: int, names="x y z", size=8, viewpoint: str | None = "1 2 3 1 0 0 0"
) -> bytes:
    columns = len(names.split())
    lines = ["# .PCD v0.7 - Point Cloud Data file format", "VERSION 0.7", f"FIELDS {names}"]
    lines += [f"SIZE{f' {size}' * columns}", f"TYPE{' F' * columns}", f"COUNT{' 1' * columns}"]
    lines += [f"WIDTH {count}", "HEIGHT 1", f"POINTS {count}", f"DATA {encoding}", ""]
    if viewpoint is not None:
        lines.insert(6, f"VIEWPOINT {viewpoint}")
    return "\n".join(lines).encode()


def lzf_literals(content: bytes) -> bytes:
    """LZF without a single copy."""
    runs = [content[i : i + 32] for i in range(0, len(content), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def as_text(points: np.ndarray, delimiter: str = " ") -> bytes:
    return "".join(delimiter.join(map(repr, row)) + "\n" for row in points.tolist()).encode()


def packed_body(values: np.ndarray) -> bytes:
    content = np.ascontiguousarray(values.T).tobytes()
    packed = lzf_literals(content)
    return len(packed).to_bytes(4, "little") + len(content).to_bytes(4, "little") + packed


def file_content(name: str, points: np.ndarray) -> bytes:
    """The bytes of a whole file by hand; name is extension-variant."""
    count, names = len(points), " ".join("xyz"[: points.shape[1]])
    little, big = points.astype("<f8").tobytes(), points.astype(">f8").tobytes()
    text = as_text(points)
    return {
        "ply-ascii": lambda: ply_header("ascii", count, names) + text,
        "ply-little": lambda: ply_header("binary_little_endian", count, names) + little,
        "ply-big": lambda: ply_header("binary_big_endian", count, names) + big,
        "pcd-ascii": lambda: pcd_header("ascii", count, names) + text,
        "pcd-binary": lambda: pcd_header("binary", count, names) + little,
        "pcd-packed": lambda: pcd_header("binary_compressed", count, names) + packed_body(points),
        "xyz-spaces": lambda: text,
        "txt-tabs": lambda: as_text(points, "\t"),
        "csv-header": lambda: ",".join(names.split()).encode() + b"\n" + as_text(points, ","),
        "csv-semicolons": lambda: as_text(points, ";"),
        "csv-mark": lambda: b"\xef\xbb\xbfX;Y;Z\r\n" + as_text(points, ";").replace(b"\n", b"\r\n"),
        "csv-quotes": lambda: b'"x", "y", "z"\n' + as_text(points, ","),
        "xyz-comments": lambda: b"# made here\n\n//X Y Z\n" + text,
    }[name]()


HAND_MADE = [
    *("ply-ascii", "ply-little", "ply-big", "pcd-ascii", "pcd-binary", "pcd-packed"),
    *("xyz-spaces", "txt-tabs", "csv-header", "csv-semicolons", "csv-mark", "csv-quotes"),
    "xyz-comments",
]


def write_by_hand(folder: Path, name: str, points: np.ndarray) -> Path:
    path = folder / f"scan.{name.partition('-')[0]}"
    path.write_bytes(file_content(name, points))
    return path


def write_las(path: Path, points: np.ndarray, returns=1, point_format: int = 6) -> Path:
    import laspy

    las = laspy.create(file_version="1.4", point_format=point_format)
    las.header.scales, las.header.offsets = [1e-3] * 3, UTM
    las.x, las.y, las.z = points.T
    las.return_number = np.broadcast_to(returns, len(points)).astype(np.uint8)
    las.write(path)
    return path


def write_kitti(folder: Path, stems: list[str], points: np.ndarray, poses: np.ndarray) -> None:
    """One .bin a stem, its points moved from the world into its sensor's frame."""
    folder.mkdir(exist_ok=True)
    for stem, pose in zip(stems, poses, strict=True):
        sensor = (points - pose[:3, 3]) @ pose[:3, :3]
        np.c_[sensor, np.zeros(len(points))].astype("<f4").tofile(folder / f"{stem}.bin")


def write_poses(path: Path, poses: np.ndarray) -> None:
    np.savetxt(path, poses[:, :3].reshape(-1, 12), fmt="%.17g")


def turning_poses(count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i, (pose, angle) in enumerate(zip(poses, np.linspace(0, 2, count), strict=True)):
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        pose[:3, 3] = i, 2 * i, 0.5
    return poses


def whole_file(folder: Path, name: str) -> Path:
    if name == "npz":
        save_scans(Scans(torch.ones(1, 3), torch.as_tensor(some_points())), folder / "scan.npz")
    elif name == "npy":
        np.save(folder / "scan.npy", some_points())
    elif name == "bin":
        write_kitti(folder, ["scan"], some_points(), np.eye(4)[None])
    elif name in ("las", "laz"):
        return write_las(folder / f"scan.{name}", some_points() + UTM)
    else:
        return write_by_hand(folder, name, some_points())
    return folder / f"scan.{name}"


CUT = ["npz", "npy", "bin", *(name for name in HAND_MADE if name[:3] in ("ply", "pcd"))]


LAS = [pytest.param(name, marks=needs_laspy) for name in ("las", "laz")]
