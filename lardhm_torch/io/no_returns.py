"""Directions of beams without return, from the angular grid of a scanner."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lardhm_torch.io.notes import Note
from lardhm_torch.io.readout import Readout

NO_RETURNS = "beams without return, assumed to be free up to the longest range of their scan"
_LARGEST_MISFIT = 0.5  # of a step of the grid


def grid_directions(
    points: NDArray[np.float64], shape: tuple[int, int]
) -> NDArray[np.float64] | None:
    """(C R, 3) unit vectors of all beams of a grid; None if it is no grid of angles.

    All beams of a column have one azimuth, all of a row one elevation: both are the medians of
    the points that were measured. Rows of NaN: no beam of that column or row met anything.

    Args:
        points: (C R, 3), column by column, scanner frame [m]; zero or NaN where nothing was met.
        shape: columns C and rows R.
    """
    grid = np.where((points == 0).all(axis=1)[:, None], np.nan, points).reshape(*shape, 3)
    x, y, z = np.moveaxis(grid, -1, 0)
    # Azimuth and elevation over the top: a column of a panorama may hold both halves of a circle.
    azimuth, elevation = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # columns and rows without a point
        middle = np.nanmedian(np.cos(azimuth), axis=1), np.nanmedian(np.sin(azimuth), axis=1)
        of_column = np.arctan2(middle[1], middle[0])
        of_row = np.nanmedian(elevation, axis=0)
        misfit_azimuth = np.angle(np.exp(1j * (azimuth - of_column[:, None])))
        steps = [np.nanmedian(np.abs(np.diff(np.unwrap(a)))) for a in (of_column, of_row)]
        misfits = [np.abs(misfit_azimuth), np.abs(elevation - of_row)]
        fits = [
            np.nanquantile(misfit, 0.95) < _LARGEST_MISFIT * max(step, 1e-4)
            for misfit, step in zip(misfits, steps, strict=True)
        ]
    if not all(fits):
        return None
    flat = np.cos(of_row)
    directions = np.empty_like(grid)
    directions[..., 0] = flat * np.cos(of_column)[:, None]
    directions[..., 1] = flat * np.sin(of_column)[:, None]
    directions[..., 2] = np.sin(of_row)
    return directions.reshape(-1, 3)


def seen_beams(readout: Readout) -> Readout:
    """`with_free_beams` for the known position of the only sensor; placeholders are not known."""
    if readout.origins is None or len(readout.origins) != 1 or readout.origin_is_placeholder:
        return readout
    return with_free_beams(readout, readout.origins[0])


def with_free_beams(readout: Readout, sensor: NDArray[np.float64]) -> Readout:
    """The readout of an organized cloud with its points of NaN as beams without return.

    Their directions follow from the grid, if it is one of angles around the sensor; else, and in
    rows and columns without a point, they stay NaN.

    Args:
        readout: of one scan.
        sensor: (3,) its position in the frame of the points [m].
    """
    if readout.grid is None or readout.is_return is not None or readout.dim != 3:
        return readout
    is_lost = np.asarray(~np.isfinite(readout.ends).all(axis=1))
    if not is_lost.any() or is_lost.all():
        return readout
    points = readout.ends - sensor
    by_column = np.arange(len(points)).reshape(readout.grid).T.ravel()
    directions = np.full_like(points, np.nan)
    found = grid_directions(points[by_column], readout.grid[::-1])
    if found is not None:
        directions[by_column] = found
    elif (found := grid_directions(points, readout.grid)) is not None:  # one azimuth a row
        directions = found
    is_beam = np.asarray(is_lost & np.isfinite(directions).all(axis=1))
    if not is_beam.any():
        return readout
    longest = np.linalg.norm(points[~is_lost], axis=1).max()
    ends = readout.ends.copy()
    ends[is_beam] = sensor + longest * directions[is_beam]
    cure = "a field is_return specifies it"
    note = Note(NO_RETURNS, int(is_beam.sum()), cure=cure)
    return replace(readout, ends=ends, is_return=~is_beam).noting(note)
