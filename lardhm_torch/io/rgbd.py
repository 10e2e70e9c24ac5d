"""Folders of depth images from a moving camera: the 7-Scenes and the TUM layout."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.channels import COLOR
from lardhm_torch.io.channel_columns import joined_columns
from lardhm_torch.io.color_images import color_beside, listed_colors, read_colors
from lardhm_torch.io.notes import Note
from lardhm_torch.io.paths import natural_key
from lardhm_torch.io.pose_files import read_trajectory
from lardhm_torch.io.poses import find_beside
from lardhm_torch.io.readout import Readout
from lardhm_torch.io.records import read_table, text_encoding
from lardhm_torch.io.trajectories import MAX_STAMP_GAP, Trajectory, check_rigid, move_points

_INTRINSICS_FILES = ("camera-intrinsics.txt", "intrinsics.txt", "calibration.txt")
_LISTS = ("depth.txt", "associations.txt", "associate.txt", "association.txt")
_TUM_POSES = "groundtruth.txt"
_MAX_PIXELS = 1 << 25
_NO_DEPTH = (0, 65535)


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Settings of the camera of a folder of depth images.

    Args:
        intrinsics: fx, fy, cx, cy of the pinhole [pixels], lens distortion removed; None: a file
            camera-intrinsics.txt beside the images.
        pixel_step: step between the rows and columns that are read; 1: read all pixels.
        depth_scale: units of the images per meter; None: 1000 in the 7-Scenes layout, 5000 in
            TUM's.
    """

    intrinsics: tuple[float, float, float, float] | None = None
    pixel_step: int = 4
    depth_scale: float | None = None

    def __post_init__(self) -> None:
        if self.intrinsics is not None:
            _check_intrinsics(tuple(self.intrinsics), "intrinsics")
        if not isinstance(self.pixel_step, int) or self.pixel_step < 1:
            raise ValueError(f"pixel_step must be 1 pixel or more; got {self.pixel_step!r}")
        if self.depth_scale is not None and not 0 < self.depth_scale < math.inf:
            raise ValueError(
                f"depth_scale must be > 0 units per meter and finite; got {self.depth_scale}"
            )


@dataclass(frozen=True)
class _Frame:
    image: Path
    pose: NDArray[np.float64]  # (4, 4) world_from_camera
    color: Path | None = None
    stamp: float = math.nan  # [s]


def is_rgbd_folder(folder: Path) -> bool:
    """Whether a folder has depth images in a layout that is known."""
    if _image_list(folder) is not None:
        return True
    return any(file.name.endswith(".depth.png") for file in folder.iterdir())


def read_rgbd(folder: Path, camera: Camera) -> Readout:
    """One scan an image: every pixel with a depth is a ray end, the camera is the origin.

    | layout | images | depth | poses, camera to world |
    |---|---|---|---|
    | 7-Scenes | frame-000000.depth.png | mm | frame-000000.pose.txt, 4 x 4 |
    | TUM | as depth.txt or associations.txt lists them | 1/5000 m | groundtruth.txt |

    A pixel of depth 0 or 65535 has none. Images without a pose are left out, with a warning. A
    negative fy means that y points up in the images' poses (ICL-NUIM).

    Color images of the same size are assumed to be registered to the depth images, pixel by pixel:
    frame-000000.color.png or .jpg; of TUM those that rgb.txt or the pairs of the list name.

    Raises:
        ImportError: pillow is not installed.
        ValueError: an image, a pose or the intrinsics cannot be read, or no image has a pose.
    """
    image_list = _image_list(folder)
    if image_list is None:
        frames, without_pose = _seven_scenes_frames(folder)
    else:
        frames, without_pose = _tum_frames(folder, image_list)
    if not frames:
        raise ValueError(f"an image with a pose is needed; got {without_pose} without")
    intrinsics = camera.intrinsics or _read_intrinsics(folder)
    scale = camera.depth_scale or (1000 if image_list is None else 5000)
    ends, counts, channels = [], [], list[dict[str, NDArray]]()
    for frame in frames:
        points, color = _image_points(frame, intrinsics, scale, camera.pixel_step)
        ends.append(move_points(frame.pose, points))
        counts.append(len(points))
        channels.append({} if color is None else {COLOR: color})
    if not any(counts):
        raise ValueError("at least one pixel with a depth is needed; got none")
    return Readout(
        np.concatenate(ends),
        origins=np.stack([frame.pose[:3, 3] for frame in frames]),
        scan_id=np.repeat(np.arange(len(frames)), counts),
        notes=(
            *_notes(camera, image_list, without_pose),
            *_color_notes(frames, sum(map(bool, channels))),
        ),
        channels=joined_columns(list(zip(channels, counts, strict=True))),
        scan_times=None if image_list is None else np.array([frame.stamp for frame in frames]),
    )


def _color_notes(frames: list[_Frame], used: int) -> list[Note]:
    """What was assumed of the color images, and that the others are not used."""
    unused = sum(frame.color is not None for frame in frames) - used
    notes = (
        [Note("color images assumed to be registered to the depth images", used)] if used else []
    )
    if unused:
        notes.append(
            Note("color images of another size than the depth images are left out", unused)
        )
    return notes


def _notes(camera: Camera, image_list: Path | None, without_pose: int) -> tuple[Note, ...]:
    """What was assumed of a folder of images."""
    layout, scale = ("7-Scenes", 1000) if image_list is None else ("TUM", 5000)
    notes = [Note("camera poses from " + ("pose files" if image_list is None else _TUM_POSES))]
    if camera.depth_scale is None:
        text = f"{scale} depth units per meter, as in the {layout} layout"
        notes.append(Note(text, cure=f"--depth-scale {scale} confirms it"))
    if without_pose:
        text = "depth images have no pose and are left out"
        notes.append(Note(text, without_pose, is_loss=True))
    return tuple(notes)


def _image_list(folder: Path) -> Path | None:
    """The file that lists the images of the TUM layout."""
    return next((folder / name for name in _LISTS if (folder / name).is_file()), None)


def _seven_scenes_frames(folder: Path) -> tuple[list[_Frame], int]:
    """The images in natural order, and how many have a pose that is not finite (tracking lost)."""
    images = sorted(folder.glob("*.depth.png"), key=lambda file: natural_key(file.name))
    frames = []
    for image in images:
        source = image.with_name(image.name.removesuffix(".depth.png") + ".pose.txt")
        if not source.is_file():
            raise ValueError(
                f"{image.name} must have its pose beside it; there is no {source.name}"
            )
        try:
            pose = read_table(source, 0, [0, 1, 2, 3])
        except ValueError as error:
            raise ValueError(f"{source.name} must hold 4 x 4 numbers: {error}") from error
        if pose.shape != (4, 4):
            raise ValueError(f"{source.name} must hold 4 x 4 numbers; got {pose.shape}")
        if np.isfinite(pose).all():
            check_rigid(pose[None], source.name)
            frames.append(_Frame(image, pose, color_beside(image)))
    return frames, len(images) - len(frames)


def _tum_frames(folder: Path, image_list: Path) -> tuple[list[_Frame], int]:
    """The images that are listed, and how many are too far in time from a pose."""
    stamps, images, paired = [], [], []
    for line in image_list.read_text(text_encoding(image_list)).splitlines():
        words = line.partition("#")[0].replace(",", " ").split()
        if words:
            (stamp, name), other = _depth_entry(words, image_list.name)
            stamps.append(stamp)
            images.append(folder / name)
            paired.append(None if other is None else folder / other)
    source = find_beside(image_list, (_TUM_POSES,))
    poses = None if source is None else read_trajectory(source)
    if not isinstance(poses, Trajectory) or not len(poses.stamps):
        raise ValueError(
            f"poses are needed beside {image_list.name}: {_TUM_POSES}, "
            "stamp tx ty tz qx qy qz qw a line"
        )
    found, gaps = poses.at(np.array(stamps))
    colors = [a or b for a, b in zip(paired, listed_colors(folder, stamps), strict=True)]
    frames = [
        _Frame(image, pose, color if color is not None and color.is_file() else None, stamp)
        for image, pose, gap, color, stamp in zip(images, found, gaps, colors, stamps, strict=True)
        if gap <= MAX_STAMP_GAP
    ]
    return frames, len(images) - len(frames)


def _depth_entry(words: list[str], name: str) -> tuple[tuple[float, str], str | None]:
    """Stamp and file of the depth image in a line of one or two pairs of them, and the other file.

    Of two images the one whose path says depth is it, else the first.
    """
    pairs = list(zip(words[::2], words[1::2], strict=False))
    are_pairs = len(words) in (2, 4) and all(_is_stamp(s) and _is_inside(f) for s, f in pairs)
    if not are_pairs:
        raise ValueError(
            f"{name} must have a stamp and a file in each line; got {' '.join(words)!r}"
        )
    named = [pair for pair in pairs if "depth" in pair[1].lower()]
    chosen = named[0] if len(named) == 1 else pairs[0]
    others = [image for pair in pairs if pair is not chosen for image in pair[1:]]
    return (float(chosen[0]), chosen[1]), others[0] if others else None


def _is_stamp(word: str) -> bool:
    try:
        return math.isfinite(float(word))
    except ValueError:
        return False


def _is_inside(name: str) -> bool:
    """Whether a listed file stays in the folder."""
    return not Path(name).is_absolute() and ".." not in Path(name).parts


def _read_intrinsics(folder: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy from a 3 x 3 (or 4 x 4) matrix or a line of four numbers and more."""
    source = find_beside(folder / "images", _INTRINSICS_FILES)
    if source is None:
        raise ValueError(
            f"the camera is not known: put {_INTRINSICS_FILES[0]} (3 x 3) beside the images or give "
            "it: load_scans(path, camera=Camera(intrinsics=(fx, fy, cx, cy))), "
            "--camera FX,FY,CX,CY on the command line"
        )
    lines = source.read_text(text_encoding(source)).splitlines()
    rows = [line.partition("#")[0].replace(",", " ").split() for line in lines]
    rows = [row for row in rows if row]
    try:
        if len(rows) == 1:
            values = tuple(map(float, rows[0][:4]))
        else:
            values = tuple(float(rows[i][j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    except (ValueError, IndexError):
        values = ()
    return _check_intrinsics(values, source.name)


def _check_intrinsics(values: tuple[Any, ...], name: str) -> tuple[float, float, float, float]:
    if len(values) != 4 or not all(map(math.isfinite, values)) or not (values[0] > 0 and values[1]):
        raise ValueError(
            f"{name} must give fx, fy > 0 and cx, cy [pixels], or fy < 0 where y points up; got {values}"
        )
    fx, fy, cx, cy = values
    return fx, fy, cx, cy


def _image_points(
    frame: _Frame, intrinsics: tuple[float, float, float, float], per_meter: float, pixel_step: int
) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
    """(n, 3) points of the pixels with a depth, camera frame: x right, y down, z ahead [m]; colors."""
    whole = _read_depth(frame.image)
    colors = None if frame.color is None else read_colors(frame.color, whole.shape)
    depth = whole[::pixel_step, ::pixel_step]
    rows, columns = np.nonzero((depth != _NO_DEPTH[0]) & (depth != _NO_DEPTH[1]))
    fx, fy, cx, cy = intrinsics
    ahead = depth[rows, columns] / per_meter
    right = (columns * pixel_step - cx) / fx * ahead
    down = (rows * pixel_step - cy) / fy * ahead
    points = np.stack([right, down, ahead], axis=1)
    if colors is None:
        return points, None
    return points, colors[::pixel_step, ::pixel_step][rows, columns]


def _read_depth(path: Path) -> NDArray[np.float64]:
    """(height, width) stored depths of a 16-bit PNG."""
    try:
        from PIL import Image
    except ImportError as error:
        raise ImportError(
            f"{path} needs pillow. Install it: pip install 'lardhm_torch[io]'"
        ) from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            # From memory: of a file Pillow would allocate whatever length a broken chunk declares.
            image = Image.open(BytesIO(path.read_bytes()), formats=["PNG"])
        with image:
            if image.width * image.height > _MAX_PIXELS or not image.mode.startswith("I"):
                raise ValueError(
                    f"16 bits a pixel and at most {_MAX_PIXELS} pixels are needed; "
                    f"got mode {image.mode}, {image.width} x {image.height}"
                )
            return np.asarray(image).astype(np.float64)
    except FileNotFoundError:
        raise ValueError(f"depth image {path} is missing") from None
    except Exception as error:
        raise ValueError(f"depth image {path.name} cannot be read: {error}") from error
