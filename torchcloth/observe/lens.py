"""Lens distortion in OpenCV's order, and its inverse."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from ..errors import InvalidInput

Array = np.ndarray

COEFFICIENT_COUNTS = (0, 4, 5, 8, 12, 14)
MAX_RAY_RADIUS = 10.0  # tan of the angle off axis up to which the model is evaluated, 84 degrees
RADIAL_SAMPLES = 4001  # radii at which the radial part is sampled
MAX_NEWTON_ITERATIONS = 30
MAX_UNDISTORT_RESIDUAL = 1e-10  # in normalised image coordinates: 1e-7 px or less for any common focal length
NEGLIGIBLE_RESIDUAL = 1e-15  # in normalised image coordinates, at which the iteration stops


class Lens:
    """Distortion of normalised image coordinates (x / z, y / z).

    With x, y of the ray, r^2 = x^2 + y^2 and g = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6):

        x' = g x + 2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4
        y' = g y + p1 (r^2 + 2 y^2) + 2 p2 x y + s3 r^2 + s4 r^4

    followed by the homography of a sensor tilted by tx, ty (OpenCV documentation, "Camera Calibration and 3D
    Reconstruction"). The radial part g r is used up to its first turning point (or pole). Beyond it two rays share a
    pixel, and the calibration is meaningless; such rays and pixels are NaN. Tangential and thin-prism terms fold the
    image a little earlier, at 97 % of that radius: there a pixel may still belong to another ray.

    Args:
        coefficients: none, (k1, k2, p1, p2), and further k3, (k4, k5, k6), (s1, s2, s3, s4), (tx, ty) rad.

    Raises:
        InvalidInput: another number of coefficients, or one that is not finite.
    """

    def __init__(self, coefficients: Array) -> None:
        given = np.array(coefficients, dtype=float).ravel()
        if given.size not in COEFFICIENT_COUNTS or not np.isfinite(given).all():
            raise InvalidInput(
                "distortion",
                got=given.tolist(),
                expected="0, 4, 5, 8, 12 or 14 finite numbers in OpenCV's order k1 k2 p1 p2 k3 k4 k5 k6 s1..s4 tx ty",
            )
        full = np.zeros(14)
        full[: given.size] = given
        self.coefficients = given
        self._k = (full[[0, 1, 4]], full[5:8])
        self._p, self._s = full[2:4], full[8:12]
        self._tilt = _tilt(*full[12:]) if full[12:].any() else None

    @property
    def is_identity(self) -> bool:
        """Whether the lens distorts nothing."""
        return not self.coefficients.any()

    @property
    def max_radius(self) -> float:
        """Largest radius of a ray, in normalised coordinates, for which the model is one-to-one."""
        return float(self._radial[0][-1])

    def distort(self, rays: Array) -> Array:
        """Return the image coordinates [..., 2] of rays [..., 2]; NaN beyond ``max_radius``."""
        rays = np.asarray(rays, dtype=float)
        if self.is_identity:
            return rays
        with np.errstate(all="ignore"):
            inside = (rays**2).sum(-1, keepdims=True) <= self.max_radius**2
            return np.where(inside, self._warp(rays[..., 0], rays[..., 1])[0], np.nan)

    def undistort(self, image: Array) -> Array:
        """Return the rays [..., 2] of image coordinates [..., 2].

        Newton's iteration starts from the inverse of the radial part. A ray is NaN if the iteration does not end within
        ``max_radius`` and a residual of 1e-10.
        """
        image = np.asarray(image, dtype=float)
        if self.is_identity:
            return image
        target = image if self._tilt is None else _apply_homography(np.linalg.inv(self._tilt), image)
        radii, image_radii = self._radial
        with np.errstate(all="ignore"):
            distance = np.linalg.norm(target, axis=-1)
            start = np.interp(distance, image_radii, radii) / np.where(distance > 0, distance, 1.0)
            rays = target * np.where(distance > 0, start, 1.0)[..., None]
            for _ in range(MAX_NEWTON_ITERATIONS):
                residual, gradient = self._residual(rays, target)
                if not np.nanmax(np.abs(residual), initial=0.0) > NEGLIGIBLE_RESIDUAL:
                    break
                rays = rays - _solve_2x2(gradient, residual)
            residual, gradient = self._residual(rays, target)
            (a, b), (c, d) = gradient
            good = (
                (np.abs(residual).max(-1) < MAX_UNDISTORT_RESIDUAL)
                & ((rays**2).sum(-1) <= self.max_radius**2)
                & (a * d > b * c)
            )
        return np.where(good[..., None], rays, np.nan)

    @cached_property
    def _radial(self) -> tuple[Array, Array]:
        """Radii of rays and of their images, up to the first turning point."""
        radii = np.linspace(0, MAX_RAY_RADIUS, RADIAL_SAMPLES)
        numerator, denominator = (1 + np.polynomial.polynomial.polyval(radii**2, [0, *k]) for k in self._k)
        with np.errstate(all="ignore"):
            image_radii = radii * numerator / denominator
        stop = np.flatnonzero((np.diff(image_radii) <= 0) | (denominator[1:] <= 0) | ~np.isfinite(image_radii[1:]))
        end = int(stop[0]) + 1 if stop.size else RADIAL_SAMPLES
        return radii[:end], image_radii[:end]

    def _residual(self, rays: Array, target: Array) -> tuple[Array, tuple]:
        position, gradient = self._lens(rays[..., 0], rays[..., 1])
        return position - target, gradient

    def _warp(self, x: Array, y: Array) -> tuple[Array, tuple]:
        position, gradient = self._lens(x, y)
        return (position if self._tilt is None else _apply_homography(self._tilt, position)), gradient

    def _lens(self, x: Array, y: Array) -> tuple[Array, tuple]:
        """Image position [..., 2] before the tilt, and its derivatives ((xx, xy), (yx, yy))."""
        (k1, k2, k3), (k4, k5, k6) = self._k
        (p1, p2), (s1, s2, s3, s4) = self._p, self._s
        q = x * x + y * y
        numerator, denominator = 1 + q * (k1 + q * (k2 + q * k3)), 1 + q * (k4 + q * (k5 + q * k6))
        g = numerator / denominator
        slope = ((k1 + q * (2 * k2 + q * 3 * k3)) - g * (k4 + q * (2 * k5 + q * 3 * k6))) / denominator  # dg / dq
        position = np.stack(
            [
                g * x + 2 * p1 * x * y + p2 * (q + 2 * x * x) + q * (s1 + q * s2),
                g * y + p1 * (q + 2 * y * y) + 2 * p2 * x * y + q * (s3 + q * s4),
            ],
            -1,
        )
        thin_x, thin_y = 2 * (s1 + 2 * q * s2), 2 * (s3 + 2 * q * s4)
        cross = 2 * slope * x * y
        xx = g + 2 * slope * x * x + 2 * p1 * y + 6 * p2 * x + thin_x * x
        xy = cross + 2 * p1 * x + 2 * p2 * y + thin_x * y
        yx = cross + 2 * p1 * x + 2 * p2 * y + thin_y * x
        yy = g + 2 * slope * y * y + 6 * p1 * y + 2 * p2 * x + thin_y * y
        return position, ((xx, xy), (yx, yy))


def _tilt(tx: float, ty: float) -> Array:
    """Homography [3, 3] of a sensor turned by tx about x, then by ty about y."""
    about_x = np.array([[1, 0, 0], [0, np.cos(tx), np.sin(tx)], [0, -np.sin(tx), np.cos(tx)]])
    about_y = np.array([[np.cos(ty), 0, -np.sin(ty)], [0, 1, 0], [np.sin(ty), 0, np.cos(ty)]])
    turn = about_y @ about_x
    return np.array([[turn[2, 2], 0, -turn[0, 2]], [0, turn[2, 2], -turn[1, 2]], [0, 0, 1]]) @ turn


def _apply_homography(homography: Array, image: Array) -> Array:
    full = np.concatenate([image, np.ones((*image.shape[:-1], 1))], -1) @ homography.T
    return full[..., :2] / full[..., 2:]


def _solve_2x2(gradient: tuple, residual: Array) -> Array:
    (a, b), (c, d) = gradient
    return (
        np.stack([d * residual[..., 0] - b * residual[..., 1], a * residual[..., 1] - c * residual[..., 0]], -1)
        / (a * d - b * c)[..., None]
    )
