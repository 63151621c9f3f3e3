"""Errors of depth cameras: the interface, and a model of time-of-flight cameras."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np

from ..errors import InvalidInput
from .cloud import has_reading

Array = np.ndarray
MAX_INTERPOLATED_STEP_M = 0.02  # larger steps between neighbouring pixels are silhouettes


class AbstractNoise(ABC):
    """A sensor's errors: random ones in every image, and a bias that stays with the device.

    Attributes:
        bias_leading_shape: axes of the bias before those of the image.
    """

    bias_leading_shape: ClassVar[tuple[int, ...]] = ()

    @abstractmethod
    def sigma(self, depth: Array) -> Array:
        """Return the standard deviation [...] m of the random error at depths [...] m, away from edges."""

    @abstractmethod
    def apply(self, depth: Array, rng: np.random.Generator, bias: Array | None = None) -> Array:
        """Return a noisy copy of a depth image.

        Args:
            depth: [H, W] m, 0 = nothing is seen.
            rng: source of the random numbers; the same generator state gives the same image.
            bias: [..., H, W] what the device adds to every image of a sequence, drawn once by :meth:`bias_field`;
                needed if :attr:`has_bias`.

        Returns:
            [H, W] float32, m, 0 where nothing is seen or the pixel was lost.
        """

    @abstractmethod
    def bias_field(self, shape: tuple[int, int], rng: np.random.Generator) -> Array:
        """Draw what a device adds to all its images: [..., H, W], smooth, fixed to the image."""

    @property
    @abstractmethod
    def has_bias(self) -> bool:
        """Whether an image needs a bias field."""

    def validate_image(self, depth: Array, bias: Array | None) -> Array:
        """Return the image as float32, with 0 for readings that are not finite.

        Raises:
            InvalidInput: no image, integers, which are not metres, or a bias that is missing or of another shape than
                ``bias_field`` draws.
        """
        has_reading(np.asarray(depth))
        depth = np.asarray(depth, np.float32)
        if depth.ndim != 2:
            raise InvalidInput("depth", got=f"shape {depth.shape}", expected="[H, W]")
        shape = (*self.bias_leading_shape, *depth.shape)
        if (self.has_bias and bias is None) or (bias is not None and np.shape(bias) != shape):
            raise InvalidInput(
                "bias",
                got=None if bias is None else f"shape {np.shape(bias)}",
                expected=f"a field {shape} when a bias amplitude is set",
                remedy="draw one by bias_field(shape, rng)",
            )
        return np.where(np.isfinite(depth), depth, np.float32(0))


@dataclass(frozen=True)
class DepthNoise(AbstractNoise):
    """Errors of a time-of-flight camera: random error, jitter, lost edges, flying pixels and a smooth bias.

    The defaults are a working model of the Azure Kinect DK: sigma(z) = 0.5 mm + 1 mm/m * max(z - 0.5 m, 0), jitter 0.25
    px and dropped edges as in BlenderProc's Azure Kinect post-processing, which cites Toelgyessy et al., Sensors
    21(2):413 (2021). The maker's bounds are wider: standard deviation <= 17 mm, systematic error < 11 mm + 0.1 %
    (Microsoft, "Azure Kinect DK hardware specifications"). Bias and flying pixels are off by default.

    Attributes:
        sigma_base: m, standard deviation of a pixel's depth up to ``sigma_start``.
        sigma_slope: m/m, its growth with depth beyond.
        sigma_start: m.
        jitter: px, standard deviation of the place from which a pixel takes its depth, per axis.
        edge_range: m, a pixel is lost if the depths of its 3 x 3 neighbourhood (without missing neighbours) differ by
            more.
        bias_amplitude: m, standard deviation of the bias field.
        bias_relative: m/m, further standard deviation of the bias per metre of depth.
        bias_length: px, distance over which the bias field varies; the field is fixed to the image, as a calibration
            error is.
        flying_fraction: share of the pixels at a step in depth of more than ``flying_step`` (and less than
            ``edge_range``) that report a mixture of both sides.
        flying_step: m.
    """

    sigma_base: float = 0.5e-3
    sigma_slope: float = 1.0e-3
    sigma_start: float = 0.5
    jitter: float = 0.25
    edge_range: float = 0.8
    bias_amplitude: float = 0.0
    bias_relative: float = 0.0
    bias_length: float = 160.0
    flying_fraction: float = 0.0
    flying_step: float = 0.02

    def __post_init__(self) -> None:
        check_fields(self)
        if self.bias_length < 1:
            raise InvalidInput("bias_length", got=self.bias_length, expected="at least 1 px")
        if self.flying_fraction > 1:
            raise InvalidInput("flying_fraction", got=self.flying_fraction, expected="a share, 0 to 1")

    @classmethod
    def azure_kinect(cls) -> DepthNoise:
        """Return the noise with flying pixels and a bias within the maker's 11 mm + 0.1 % at two standard deviations.

        That half of the pixels at an edge fly is our guess, not a measurement.
        """
        return cls(bias_amplitude=5.5e-3, bias_relative=0.5e-3, flying_fraction=0.5)

    def without_bias(self) -> DepthNoise:
        """Return the same noise with random errors only."""
        return replace(self, bias_amplitude=0.0, bias_relative=0.0)

    @property
    def has_bias(self) -> bool:
        """Whether an image needs a bias field."""
        return bool(self.bias_amplitude or self.bias_relative)

    def sigma(self, depth: Array) -> Array:
        """Return the standard deviation [...] m of the random error at depths [...] m."""
        return self.sigma_base + self.sigma_slope * np.maximum(np.asarray(depth) - self.sigma_start, 0.0)

    def apply(self, depth: Array, rng: np.random.Generator, bias: Array | None = None) -> Array:
        """Return a noisy copy [H, W] float32 m of a depth image [H, W] m, see :meth:`AbstractNoise.apply`."""
        depth = self.validate_image(depth, bias)
        out = _jitter(depth, self.jitter, rng) if self.jitter else depth.copy()
        is_seen = (out > 0) & (depth > 0)
        if self.flying_fraction:
            out = _add_flying_pixels(out, depth, self.flying_fraction, self.flying_step, rng)
        noisy = out + (self.sigma(out) * rng.standard_normal(out.shape)).astype(np.float32)
        if bias is not None:
            noisy += ((self.bias_amplitude + self.bias_relative * out) * bias).astype(np.float32)
        return np.where(is_seen & ~mask_depth_edges(depth, self.edge_range) & (noisy > 0), noisy, 0).astype(np.float32)

    def bias_field(self, shape: tuple[int, int], rng: np.random.Generator) -> Array:
        """Draw a smooth random field [H, W] of unit variance, bilinear over ``bias_length`` px."""
        return draw_smooth_field(shape, self.bias_length, rng)


def draw_smooth_field(shape: tuple[int, int], length: float, rng: np.random.Generator) -> Array:
    """Draw a random field [H, W] of unit variance, bilinear between normal values ``length`` px apart."""
    rows, cols = (int(np.ceil(n / length)) + 1 for n in shape)
    knots = rng.standard_normal((rows, cols))
    r, c = np.arange(shape[0]) / length, np.arange(shape[1]) / length
    i, j = r.astype(int), c.astype(int)
    a, b = (r - i)[:, None], (c - j)[None, :]
    top = knots[i][:, j] * (1 - b) + knots[i][:, j + 1] * b
    field = top * (1 - a) + (knots[i + 1][:, j] * (1 - b) + knots[i + 1][:, j + 1] * b) * a
    return field / np.sqrt((a**2 + (1 - a) ** 2) * (b**2 + (1 - b) ** 2))


def check_fields(noise: AbstractNoise) -> None:
    """Refuse parameters of a dataclass that are negative or not finite.

    Raises:
        InvalidInput: names the first wrong one.
    """
    for item in fields(noise):  # type: ignore[arg-type]
        value = getattr(noise, item.name)
        if not np.isfinite(value) or value < 0:
            raise InvalidInput(item.name, got=value, expected="a finite number that is not negative")


def mask_depth_edges(depth: Array, edge_range: float) -> Array:
    """Return the mask [H, W] of pixels whose 3 x 3 neighbourhood spans more than ``edge_range`` m.

    Pixels without depth do not count.
    """
    near, far = depth_range(depth)
    return far - near > edge_range


def depth_range(depth: Array, reach: int = 1) -> tuple[Array, Array]:
    """Return the nearest and farthest depth [H, W] within ``reach`` px of each pixel; inf and -inf without one."""
    known = has_reading(depth)
    near, far = np.where(known, depth, np.inf), np.where(known, depth, -np.inf)
    for _ in range(reach):
        near, far = _window(near, np.minimum), _window(far, np.maximum)
    return near, far


def _window(image: Array, pick: np.ufunc) -> Array:
    padded = np.pad(image, 1, mode="edge")
    rows = pick(pick(padded[:-2], padded[1:-1]), padded[2:])
    return pick(pick(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])


def _add_flying_pixels(out: Array, depth: Array, share: float, step: float, rng: np.random.Generator) -> Array:
    """Pixels at a step in depth report a mixture of the near and the far side."""
    near, far = depth_range(depth)
    flies = (far - near > step) & (rng.random(depth.shape) < share)
    mixture = rng.random(depth.shape)[flies]
    out = out.copy()
    out[flies] = near[flies] + (far - near)[flies] * mixture
    return out


def _jitter(depth: Array, jitter: float, rng: np.random.Generator) -> Array:
    """Each pixel takes the depth of a place near it: bilinear inside a surface, nearest at a silhouette."""
    height, width = depth.shape
    shift = jitter * rng.standard_normal((2, height, width))
    r = np.clip(np.arange(height)[:, None] + shift[0], 0, height - 1)
    c = np.clip(np.arange(width)[None, :] + shift[1], 0, width - 1)
    i, j = np.minimum(r.astype(int), max(height - 2, 0)), np.minimum(c.astype(int), max(width - 2, 0))
    i1, j1 = np.minimum(i + 1, height - 1), np.minimum(j + 1, width - 1)
    a, b = r - i, c - j
    corners = np.stack([depth[i, j], depth[i, j1], depth[i1, j], depth[i1, j1]])
    weights = np.stack([(1 - a) * (1 - b), (1 - a) * b, a * (1 - b), a * b])
    smooth = (corners * weights).sum(0)
    nearest = depth[np.rint(r).astype(int), np.rint(c).astype(int)]
    # A mean across a silhouette would invent points in the air between two surfaces.
    broken = (corners.min(0) <= 0) | (corners.max(0) - corners.min(0) > MAX_INTERPOLATED_STEP_M)
    return np.where(broken, nearest, smooth).astype(np.float32)
