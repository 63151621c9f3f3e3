"""What a time-of-flight camera does to a perfect depth image."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from ..errors import InvalidInput

Array = np.ndarray


@dataclass(frozen=True)
class DepthNoise:
    """Random error, pixel jitter, lost edges and a slowly varying bias of a depth camera.

    The defaults are a working model of the Azure Kinect DK: sigma(z) = 0.5 mm + 1 mm/m * max(z - 0.5 m, 0), jitter
    0.25 px and dropped edges as in BlenderProc's Azure Kinect post-processing, which cites Toelgyessy et al., Sensors
    21(2):413 (2021). The maker's bounds are wider: standard deviation <= 17 mm, systematic error < 11 mm + 0.1 %
    (Microsoft, "Azure Kinect DK hardware specifications"). The bias is off unless asked for.

    Attributes:
        sigma_base: m, standard deviation of a pixel's depth up to ``sigma_start``.
        sigma_slope: m/m, its growth with depth beyond.
        sigma_start: m.
        jitter: px, standard deviation of the place from which a pixel takes its depth, per axis.
        edge_range: m, a pixel is lost where the depths of its 3 x 3 neighbourhood (missing neighbours aside) differ by
            more.
        bias_amplitude: m, standard deviation of the bias field.
        bias_relative: m/m, further standard deviation of the bias per metre of depth.
        bias_length: px, distance over which the bias field varies; the field is fixed to the image, as a calibration
            error is.
    """

    sigma_base: float = 0.5e-3
    sigma_slope: float = 1.0e-3
    sigma_start: float = 0.5
    jitter: float = 0.25
    edge_range: float = 0.8
    bias_amplitude: float = 0.0
    bias_relative: float = 0.0
    bias_length: float = 160.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not np.isfinite(value) or value < 0:
                raise InvalidInput(item.name, got=value, expected="a finite number that is not negative")
        if self.bias_length < 1:
            raise InvalidInput("bias_length", got=self.bias_length, expected="at least 1 px")

    def sigma(self, depth: Array) -> Array:
        """Standard deviation [...] m of the random error at depths [...] m."""
        return self.sigma_base + self.sigma_slope * np.maximum(np.asarray(depth) - self.sigma_start, 0.0)

    def apply(self, depth: Array, rng: np.random.Generator, bias: Array | None = None) -> Array:
        """A noisy copy of a depth image.

        Args:
            depth: [H, W] m, 0 where nothing is seen.
            rng: source of the random numbers; the same generator state gives the same image.
            bias: [H, W] unit-variance field of :meth:`bias_field`; needed when a bias amplitude is set, so that all
                images of a sequence share it.

        Returns:
            [H, W] float32, m, 0 where nothing is seen or the pixel was lost.
        """
        depth = np.asarray(depth, np.float32)
        if depth.ndim != 2:
            raise InvalidInput("depth", got=f"shape {depth.shape}", expected="[H, W]")
        if (self.bias_amplitude or self.bias_relative) and bias is None:
            raise InvalidInput(
                "bias", expected="a field when a bias amplitude is set", remedy="draw one by bias_field(shape, rng)"
            )
        out = _jittered(depth, self.jitter, rng) if self.jitter else depth.copy()
        seen = (out > 0) & (depth > 0)
        noisy = out + (self.sigma(out) * rng.standard_normal(out.shape)).astype(np.float32)
        if bias is not None:
            noisy += ((self.bias_amplitude + self.bias_relative * out) * bias).astype(np.float32)
        return np.where(seen & ~lost_edges(depth, self.edge_range) & (noisy > 0), noisy, 0).astype(np.float32)

    def bias_field(self, shape: tuple[int, int], rng: np.random.Generator) -> Array:
        """A smooth random field [H, W] of about unit variance: bilinear between random values ``bias_length`` px
        apart.
        """
        rows, cols = (int(np.ceil(n / self.bias_length)) + 1 for n in shape)
        knots = rng.standard_normal((rows, cols))
        r, c = np.arange(shape[0]) / self.bias_length, np.arange(shape[1]) / self.bias_length
        i, j = r.astype(int), c.astype(int)
        a, b = (r - i)[:, None], (c - j)[None, :]
        top = knots[i][:, j] * (1 - b) + knots[i][:, j + 1] * b
        return top * (1 - a) + (knots[i + 1][:, j] * (1 - b) + knots[i + 1][:, j + 1] * b) * a


def lost_edges(depth: Array, edge_range: float) -> Array:
    """Mask [H, W] of pixels whose 3 x 3 neighbourhood spans more than ``edge_range`` m; pixels without depth do not
    count.
    """
    far = np.where(depth > 0, depth, -np.inf)
    near = np.where(depth > 0, depth, np.inf)
    return _window(far, np.maximum) - _window(near, np.minimum) > edge_range


def _window(image: Array, pick: np.ufunc) -> Array:
    padded = np.pad(image, 1, mode="edge")
    rows = pick(pick(padded[:-2], padded[1:-1]), padded[2:])
    return pick(pick(rows[:, :-2], rows[:, 1:-1]), rows[:, 2:])


def _jittered(depth: Array, jitter: float, rng: np.random.Generator) -> Array:
    """Each pixel takes the depth found a little beside it: bilinear inside a surface, nearest where a neighbour is
    missing or far.
    """
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
    # a mean across a silhouette would invent points in the air between two surfaces
    broken = (corners.min(0) <= 0) | (corners.max(0) - corners.min(0) > 0.02)
    return np.where(broken, nearest, smooth).astype(np.float32)
