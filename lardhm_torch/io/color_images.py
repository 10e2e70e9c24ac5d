"""Color images beside depth images, of the same camera and size: pixel by pixel."""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.records import text_encoding

_FORMATS = ("PNG", "JPEG", "PPM")
_SUFFIXES = (".color.png", ".color.jpg", ".color.jpeg")
_MAX_STAMP_GAP = 0.05  # [s] between a depth image and its color image


def color_beside(depth: Path) -> Path | None:
    """The color image of a depth image in the 7-Scenes layout."""
    stem = depth.name.removesuffix(".depth.png")
    return next((p for s in _SUFFIXES if (p := depth.with_name(stem + s)).is_file()), None)


def listed_colors(folder: Path, stamps: list[float]) -> list[Path | None]:
    """The color image nearest in time to each stamp, by ``rgb.txt`` of the TUM layout."""
    source = folder / "rgb.txt"
    if not source.is_file() or not stamps:
        return [None] * len(stamps)
    lines = source.read_text(text_encoding(source)).splitlines()
    rows = [words for line in lines if len(words := line.partition("#")[0].split()) == 2]
    try:
        times = np.array([float(stamp) for stamp, _ in rows])
    except ValueError as error:
        raise ValueError(f"rgb.txt must have a stamp and a file in each line: {error}") from None
    if not len(times):
        return [None] * len(stamps)
    nearest = np.abs(times[None] - np.array(stamps)[:, None]).argmin(axis=1)
    inside = [not Path(name).is_absolute() and ".." not in Path(name).parts for _, name in rows]
    return [
        folder / rows[row][1] if inside[row] and abs(times[row] - stamp) <= _MAX_STAMP_GAP else None
        for row, stamp in zip(nearest.tolist(), stamps, strict=True)
    ]


def read_colors(path: Path, shape: tuple[int, int]) -> NDArray[np.float32] | None:
    """(height, width, 3) colors, 0 to 1; None for an image of another size: it is not registered.

    Args:
        path: PNG, JPEG or PPM.
        shape: height and width of the depth image.

    Raises:
        ValueError: the image cannot be read.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(BytesIO(path.read_bytes()), formats=_FORMATS)
        with image:
            if (image.height, image.width) != shape:
                return None
            return np.asarray(image.convert("RGB"), dtype=np.float32) / np.float32(255)
    except FileNotFoundError:
        raise ValueError(f"color image {path} is missing") from None
    except Exception as error:
        raise ValueError(f"color image {path.name} cannot be read: {error}") from error
