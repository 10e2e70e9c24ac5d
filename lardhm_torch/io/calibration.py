"""The pose of the lidar from those of a camera or a vehicle: KITTI's calibration files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.records import text_encoding
from lardhm_torch.io.trajectories import is_rigid

CALIBRATION_FILES = (
    *("calib.txt", "calib_velo_to_cam.txt", "calib_cam_to_cam.txt"),
    *("calib_cam_to_velo.txt", "calib_cam_to_pose.txt"),
)
_LIDAR_TO_CAMERA = ("tr", "tr_velo_to_cam", "tr_velo_cam")
_RECTIFIED = ("r0_rect", "r_rect", "r_rect_00")


def find_calibration(name: str, *files: Path) -> Path | None:
    """A calibration file beside one of some files, one folder up, or in calibration there."""
    folders = [folder for file in files for folder in (file.parent, file.parent.parent)]
    places = [place for f in folders for place in (f / name, f / "calibration" / name)]
    return next((place for place in places if place.is_file()), None)


def camera_from_lidar(calib: Path) -> NDArray[np.float64] | None:
    """(4, 4) Tr of a calib.txt: the (rectified) camera 0 from the laser; None if it has no Tr.

    The odometry benchmark calls it Tr; the object and tracking benchmarks Tr_velo_to_cam or
    Tr_velo_cam, to be followed by R0_rect or R_rect; raw recordings have R and T.

    Raises:
        ValueError: an entry has the wrong number of numbers, or is no rotation.

    Source: readme.txt of https://www.cvlibs.net/datasets/kitti.
    """
    entries = _entries(calib)
    name = next((name for name in _LIDAR_TO_CAMERA if name in entries), None)
    if name is not None:
        found = _rigid(calib, name, entries[name])
    elif "r" in entries and "t" in entries:
        found = _rigid(calib, "R", entries["r"])
        found[:3, 3] = _numbers(calib, "T", entries["t"], 3)
        camera = find_calibration("calib_cam_to_cam.txt", calib)
        entries = {} if camera is None else _entries(camera)
    else:
        return None
    rectified = next((name for name in _RECTIFIED if name in entries), None)
    if name == "tr" or rectified is None:
        return found
    return _rigid(calib, rectified, entries[rectified]) @ found


def vehicle_from_lidar(*files: Path) -> NDArray[np.float64] | None:
    """(4, 4) pose of KITTI-360's laser on its vehicle; None if a calibration file is missing.

    Source: https://www.cvlibs.net/datasets/kitti-360/documentation.php: calib_cam_to_velo.txt is
    laser from camera, calib_cam_to_pose.txt vehicle from each camera.
    """
    to_laser = find_calibration("calib_cam_to_velo.txt", *files)
    to_vehicle = find_calibration("calib_cam_to_pose.txt", *files)
    if to_laser is None or to_vehicle is None:
        return None
    laser_from_camera = _rigid(
        to_laser, "the file", to_laser.read_text(text_encoding(to_laser)).split()
    )
    entries = _entries(to_vehicle)
    if "image_00" not in entries:
        raise ValueError(f"{to_vehicle} must have an entry image_00:; got {', '.join(entries)}")
    vehicle_from_camera = _rigid(to_vehicle, "image_00", entries["image_00"])
    return vehicle_from_camera @ np.linalg.inv(laser_from_camera)


def _entries(path: Path) -> dict[str, list[str]]:
    """Lines "name: numbers" (or without the colon), names in lower case."""
    lines = [line.split() for line in path.read_text(text_encoding(path)).splitlines()]
    return {words[0].rstrip(":").lower(): words[1:] for words in lines if words}


def _numbers(path: Path, name: str, words: list[str], count: int) -> NDArray[np.float64]:
    try:
        values = np.array(words, dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{path} must have {count} numbers after {name}: {error}") from error
    if len(values) != count:
        raise ValueError(f"{path} must have {count} numbers after {name}; got {len(values)}")
    return values


def _rigid(path: Path, name: str, words: list[str]) -> NDArray[np.float64]:
    """(4, 4) from 12 numbers, or from the 9 of a rotation."""
    values = _numbers(path, name, words, 9 if len(words) == 9 else 12)
    matrix = np.eye(4)
    matrix[:3, : len(values) // 3] = values.reshape(3, -1)
    if not is_rigid(matrix[None])[0]:
        raise ValueError(f"{path} must have a rotation and a position after {name}; it has not")
    return matrix
