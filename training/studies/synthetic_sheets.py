"""Functions for synthetic recordings of sheets: material points on a grid of vertices, and force readings."""

from __future__ import annotations

import numpy as np

from torchcloth.types import Rollout


def interpolate_on_grid(x: np.ndarray, resolution: tuple[int, int], share: np.ndarray) -> np.ndarray:
    """Interpolate positions [N, 3] m of material points bilinearly between the vertices of ``meshes.rectangle``.

    Args:
        x: [V, 3] m.
        resolution: number of vertices along width and height.
        share: [N, 2], fractions of width and height, 0 to 1.
    """
    columns, rows = resolution
    place = np.clip(share, 0, 1) * [columns - 1, rows - 1]
    cell = np.minimum(place.astype(int), [columns - 2, rows - 2])
    a, b = (place - cell).T[:, :, None]
    first = cell[:, 0] * rows + cell[:, 1]
    low, high = ((1 - b) * x[first + skip] + b * x[first + skip + 1] for skip in (0, rows))
    return (1 - a) * low + a * high


def simulate_readings(
    out: Rollout, name: str, knots: np.ndarray, noise: float, rng: np.random.Generator, axes: int = 3
) -> np.ndarray:
    """Simulate readings [K, axes] N (and N m) of a gripper's sensor at its knots [s], with white noise.

    A rollout gives means over intervals, so readings are interpolated between the middles of intervals.
    """
    times, mean = out.t.numpy(), out.wrench[name][1:, :axes].numpy()
    middle = 0.5 * (times[1:] + times[:-1])
    at_knots = np.stack([np.interp(knots, middle, column) for column in mean.T], axis=1)
    return at_knots + noise * rng.standard_normal(at_knots.shape)
