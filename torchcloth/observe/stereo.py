"""Errors of active stereo cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import ClassVar

import numpy as np

from ..errors import InvalidInput
from .noise import AbstractNoise, check_fields, depth_range, draw_smooth_field

Array = np.ndarray


@dataclass(frozen=True)
class StereoNoise(AbstractNoise):
    """Errors of disparity: sub-pixel noise in patches, quantisation, fattened edges, shadows, holes; and a wrong scale.

    Depth is z = f b / d, so an error of disparity e becomes z^2 e / (f b). The defaults are a RealSense D435 at 848 x
    480: b = 50 mm (Intel, "RealSense D400 series datasheet"), f = 424 px, sub-pixel error 0.08 px (Intel, "Tuning depth
    cameras for best performance", gives RMS = z^2 sub-pixel / (f b), and below 0.1 px for a well-tuned camera), steps
    of 1/32 px (Intel, "Subpixel linearity improvement"). Patch size, fattening and holes are working values of ours:
    the matcher compares windows of several pixels, so that its errors are correlated over as many.

    Attributes:
        focal: px, focal length.
        baseline: m, between the imagers; the depth image is that of the left one.
        subpixel: px, standard deviation of the disparity.
        patch: px, standard deviation of the Gaussian over which the disparity's error is correlated (0: not at all).
        step: px, disparities are multiples of it (0: continuous).
        fattening: px, by how much a nearer surface spreads over what is behind it.
        edge: px, difference in disparity that makes an edge.
        holes: share of the pixels that are lost, in spots of about ``patch``.
        bias_scale: relative error of depth, standard deviation over devices.
        bias_disparity: px, standard deviation of a field of disparity that varies slowly over the image.
        bias_length: px, distance over which it varies.
    """

    focal: float = 424.0
    baseline: float = 0.050
    subpixel: float = 0.08
    patch: float = 2.0
    step: float = 1 / 32
    fattening: int = 2
    edge: float = 1.0
    holes: float = 0.005
    bias_scale: float = 0.0
    bias_disparity: float = 0.0
    bias_length: float = 160.0

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("focal", "baseline", "edge"):
            if getattr(self, name) <= 0:
                raise InvalidInput(name, got=getattr(self, name), expected="a positive number")
        if self.fattening != int(self.fattening):
            raise InvalidInput("fattening", got=self.fattening, expected="a whole number of px")
        if self.holes >= 1:
            raise InvalidInput("holes", got=self.holes, expected="a share below 1")
        if self.bias_length < 1:
            raise InvalidInput("bias_length", got=self.bias_length, expected="at least 1 px")

    bias_leading_shape: ClassVar[tuple[int, ...]] = (2,)

    @classmethod
    def d435(cls) -> StereoNoise:
        """Return the noise with the bias of a device out of the box: scale 1.93 % (one sigma) and 0.1 px of warp.

        One D435 read 980.7 mm at 1000 mm, averaged over a million readings (calvert.ch, "Improving the depth map
        accuracy of RealSense cameras", 2018). Other devices differ, hence a standard deviation. The warp is our guess.
        """
        return cls(bias_scale=0.0193, bias_disparity=0.1)

    def without_bias(self) -> StereoNoise:
        """Return the same noise with random errors only."""
        return replace(self, bias_scale=0.0, bias_disparity=0.0)

    @property
    def has_bias(self) -> bool:
        """Whether an image needs a bias field."""
        return bool(self.bias_scale or self.bias_disparity)

    def sigma(self, depth: Array) -> Array:
        """Return the standard deviation [...] m of the random error at depths [...] m, with quantisation."""
        disparity = np.hypot(self.subpixel, self.step / np.sqrt(12))
        return np.asarray(depth) ** 2 * disparity / (self.focal * self.baseline)

    def bias_field(self, shape: tuple[int, int], rng: np.random.Generator) -> Array:
        """Draw the device's error [2, H, W]: of depth, relative and the same everywhere, and of disparity [px]."""
        scale = np.full(shape, self.bias_scale * rng.standard_normal())
        return np.stack([scale, self.bias_disparity * draw_smooth_field(shape, self.bias_length, rng)])

    def apply(self, depth: Array, rng: np.random.Generator, bias: Array | None = None) -> Array:
        """Return a noisy copy [H, W] float32 m of a depth image [H, W] m, see :meth:`AbstractNoise.apply`."""
        depth = self.validate_image(depth, bias)
        scale, warp = (0.0, 0.0) if bias is None else bias
        true = np.divide(self.focal * self.baseline, depth, out=np.zeros(depth.shape), where=depth > 0)
        nearest = _max_disparity(true, self.fattening)
        surface = np.where(nearest - true > self.edge, nearest, true)
        matched = surface + warp + self.subpixel * draw_patch_noise(depth.shape, self.patch, rng)
        if self.step:
            matched = np.rint(matched / self.step) * self.step
        is_lost = mask_stereo_shadow(true, self.edge) & (matched - true < self.edge)
        if self.holes:
            is_lost |= draw_patch_noise(depth.shape, self.patch, rng) < NormalDist().inv_cdf(self.holes)
        good = (matched > 0) & (surface > 0) & ~is_lost
        z = np.divide(self.focal * self.baseline, matched, out=np.zeros(depth.shape), where=good)
        return (z * (1 + scale)).astype(np.float32)


def mask_stereo_shadow(disparity: Array, edge: float = 1.0) -> Array:
    """Return the pixels [H, W] of the left image that the right one cannot see: occluded, or out of its view.

    Left column u is seen in the right image at u - d. Of all pixels that fall on one place there, one that is ``edge``
    px nearer hides the rest. This makes a band to the left of every near edge, as wide as the step in disparity, and a
    band at the image's left rim.
    """
    height, width = disparity.shape
    column = np.rint(np.arange(width) - disparity).astype(int)
    inside = column >= 0
    row = np.broadcast_to(np.arange(height)[:, None], column.shape)
    front = np.zeros((height, width))
    np.maximum.at(front, (row[inside], column[inside]), disparity[inside])
    return ~inside | (front[row, np.maximum(column, 0)] - disparity > edge)


def draw_patch_noise(shape: tuple[int, int], size: float, rng: np.random.Generator) -> Array:
    """Draw white noise [H, W] smoothed by a Gaussian of ``size`` px, of unit variance, periodic over the image."""
    white = rng.standard_normal(shape)
    if size == 0:
        return white
    rows, columns = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :]
    smooth = np.exp(-2 * (np.pi * size) ** 2 * (rows**2 + columns**2))
    impulse = np.fft.irfft2(smooth, shape)
    return np.fft.irfft2(np.fft.rfft2(white) * smooth, shape) / np.sqrt((impulse**2).sum())


def _max_disparity(disparity: Array, reach: int) -> Array:
    """Largest disparity within ``reach`` px."""
    near, _ = depth_range(np.divide(1.0, disparity, out=np.zeros(disparity.shape), where=disparity > 0), reach)
    return np.where(np.isfinite(near), 1 / near, 0.0)
