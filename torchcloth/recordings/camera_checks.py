"""Checks of a camera matrix against the size of the camera's images, for every reader."""

from __future__ import annotations

import warnings

import numpy as np

from ..errors import RecordingError

MAX_NORMALISED_FOCAL_LENGTH = 4.0  # of the image's side; a longer lens sees less than 15 degrees
MIN_CHECKED_SIDE_PX = 16  # of images; those of tests may be smaller
MAX_CENTRE_FRACTION = 0.9  # of the image; a matrix of images twice as large has its principal point at 1
CENTRED_FRACTIONS = (0.35, 0.65)  # of the image, between which principal points of whole images lie
EXCHANGE_TOLERANCE = 0.15  # relative


def check_matrix_fits_images(K: np.ndarray, size: tuple[int, int], place: str) -> None:
    """Refuse a camera matrix that belongs to other images, and warn of a doubtful one.

    Args:
        K: [3, 3] px, upper triangular, with positive focal lengths.
        size: (width, height) of the images, px.
        place: file and key, for messages.

    Raises:
        RecordingError: K is normalised, belongs to larger images, or has focal length and principal point exchanged.
    """
    sides = np.array(size, dtype=float)
    focal, centre = K[[0, 1], [0, 1]], K[:2, 2]
    fractions = centre / sides
    got = f"fx {focal[0]:.5g}, fy {focal[1]:.5g}, cx {centre[0]:.5g}, cy {centre[1]:.5g}"
    images = f"px of images of {size[0]} x {size[1]}"
    if sides.min() < MIN_CHECKED_SIDE_PX:
        return
    if focal.max() < MAX_NORMALISED_FOCAL_LENGTH:
        remedy = "multiply its first row by the width and its second by the height"
        raise RecordingError(f"{place} looks normalised", got=got, expected=images, remedy=remedy)
    if _is_close(focal, sides / 2) and _is_close(centre[:1], centre[1:]) and not _is_close(focal[:1], focal[1:]):
        expected = "[[fx, s, cx], [0, fy, cy], [0, 0, 1]]"
        raise RecordingError(f"{place} has fx, fy and cx, cy exchanged", got=got, expected=expected, remedy="mend it")
    if not _is_close(fractions[:1], fractions[1:]):
        return  # the principal point is not at one fraction of both sides, as another resolution would have it
    low, high = CENTRED_FRACTIONS
    factor = float(2 * fractions.mean())
    text = f"{place} looks like that of images {factor:.3g} times as large"
    if fractions.min() > MAX_CENTRE_FRACTION:
        remedy = f"divide its first two rows by {factor:.3g}"
        raise RecordingError(text, got=got, expected=images, remedy=remedy)
    if fractions.max() < low or fractions.min() > high:
        warnings.warn(f"{text}: got {got}; expected {images}, unless these were cut out of larger ones", stacklevel=2)


def _is_close(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((np.abs(a - b) <= EXCHANGE_TOLERANCE * np.abs(b)).all())
