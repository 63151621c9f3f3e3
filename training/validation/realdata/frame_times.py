"""When the frames of the IRI rig were taken, from the upper edge of the cloth, which the hanger holds.

Stamps: the mesh of a frame is stamped when it is finished. Its image was taken about 0.2 s before the computation
began, that is before the stamp of the frame before. In moving frames the delay behind a frame's own stamp scatters by
45 to 60 ms, and it grows with the time since the stamp before (correlation 0.77). The delay behind the stamp before
scatters by 30 ms.

Time of a frame: the maximum of the posterior of the place of the upper edge's middle and of a normal prior around the
stamp before, less the lag. Lag, width of the prior and the offset of the upper edge from the tool are estimated
together with the times, by expectation and maximisation. Nothing is used of the free cloth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .swings import Run, accepted_frames, motion_start, tool_motion

TYPICAL_IMAGE_LAG_S = 0.2  # behind the stamp of the frame before
TYPICAL_JITTER_STD_S = 0.03
EDGE_NOISE_STD_M = (0.010, 0.003, 0.006)  # of the upper edge's middle: along the edge, across the cloth, in height
MAX_SQUARED_EDGE_RESIDUAL = 9.0  # of one axis, in squared standard deviations: a wrong edge decides nothing
TIME_STEP_S, SEARCH_HALF_WIDTH_S = 0.002, 0.12  # of the times that are tried
CLOCK_ROUNDS = 4


class Clock(NamedTuple):
    """What is common to the frames of a run.

    Attributes:
        lag: s, mean delay of an image behind the stamp of the frame before it.
        jitter_std: s, standard deviation of the delay.
        edge_offset: [3] m, middle of the upper edge as the camera sees it, from the tool, in the tool's axes.
    """

    lag: float
    jitter_std: float
    edge_offset: np.ndarray


class FrameTimes(NamedTuple):
    """Times of frames on the tool's clock.

    Attributes:
        t: [F] s; NaN where there is no time: rejected frames, the first one, and frames outside of the motion.
        std: [F] s, standard deviation of the posterior.
        edge_residual: [F, 3] m, upper edge as seen less where the tool has it at that time.
    """

    t: np.ndarray
    std: np.ndarray
    edge_residual: np.ndarray


class ToolPath:
    """The tool's smooth path: cubic splines through its samples.

    Between samples at 10 Hz a straight line is up to 6 mm off where the tool stops; the spline is 0.3 mm off.

    Args:
        run: fields of a run.
    """

    def __init__(self, run: Run) -> None:
        from scipy.interpolate import CubicSpline
        from scipy.spatial.transform import Rotation, RotationSpline

        self.t, position, quat = tool_motion(run)
        self._position = CubicSpline(self.t, position)
        self._rotation = RotationSpline(self.t, Rotation.from_quat(quat[:, [1, 2, 3, 0]]))

    def position(self, t: np.ndarray) -> np.ndarray:
        """Return the tool's position [..., 3] m."""
        return self._position(t)

    def rotation_matrix(self, t: np.ndarray) -> np.ndarray:
        """Return the tool's axes [..., 3, 3]."""
        return self._rotation(t).as_matrix()

    def carry(self, t: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """Return a point that is fixed to the tool, [..., 3] m, from its offset [3] m in the tool's axes."""
        return self.position(t) + self.rotation_matrix(t) @ offset


def image_stamps(run: Run) -> np.ndarray:
    """Return the stamp of the frame before each frame, [F] s; NaN for the first."""
    return np.concatenate([[np.nan], run["t_mesh_s"][:-1]])


def upper_edge(run: Run) -> np.ndarray:
    """Return the middle of the upper edge [F, 3] m, without its corners, which the camera rounds off."""
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # frames without an edge
        return np.nanmedian(run["mesh_base_m"][:, 1:-1, -1], axis=1)


def estimate_clock(run: Run) -> Clock:
    """Estimate lag, jitter and edge offset of a run, from its upper edge alone."""
    path, edge = ToolPath(run), upper_edge(run)
    still = accepted_frames(run) & (run["t_mesh_s"] < motion_start(run)) & np.isfinite(edge).all(1)
    offset = path.rotation_matrix(path.t[0]).T @ (np.median(edge[still], axis=0) - path.position(path.t[0]))
    clock = Clock(TYPICAL_IMAGE_LAG_S, TYPICAL_JITTER_STD_S, offset)
    for _ in range(CLOCK_ROUNDS):
        times = estimate_frame_times(run, clock)
        known = np.isfinite(times.t)
        delay = image_stamps(run)[known] - times.t[known]
        informed = 1 - (times.std[known] / clock.jitter_std) ** 2  # what a frame tells of the prior
        lag = float(informed @ delay / informed.sum())
        spread = float((informed @ ((delay - lag) ** 2 + times.std[known] ** 2) / informed.sum()) ** 0.5)
        turned = np.einsum("fba,fb->fa", path.rotation_matrix(times.t[known]), times.edge_residual[known])
        clock = Clock(lag, spread, clock.edge_offset + np.median(turned, axis=0))
    return clock


def estimate_frame_times(run: Run, clock: Clock) -> FrameTimes:
    """Estimate the time of each accepted frame, from its upper edge and the prior."""
    path, edge, expected = ToolPath(run), upper_edge(run), image_stamps(run) - clock.lag
    grid = np.arange(path.t[0], path.t[-1], TIME_STEP_S)
    places = path.carry(grid, clock.edge_offset)
    speeds = np.gradient(places, TIME_STEP_S, axis=0)
    t, std, residuals = np.full(len(edge), np.nan), np.full(len(edge), np.nan), np.full((len(edge), 3), np.nan)
    usable = accepted_frames(run) & np.isfinite(edge).all(1) & (expected > grid[0]) & (expected < grid[-1])
    for k in np.flatnonzero(usable):
        first, last = np.searchsorted(grid, expected[k] + np.array([-1, 1]) * SEARCH_HALF_WIDTH_S)
        residual = (edge[k] - places[first:last]) / EDGE_NOISE_STD_M
        cost = np.minimum(residual**2, MAX_SQUARED_EDGE_RESIDUAL).sum(1)
        best = first + int((cost + ((grid[first:last] - expected[k]) / clock.jitter_std) ** 2).argmin())
        t[k], residuals[k] = grid[best], edge[k] - places[best]
        std[k] = (clock.jitter_std**-2 + ((speeds[best] / EDGE_NOISE_STD_M) ** 2).sum()) ** -0.5
    return FrameTimes(t, std, residuals)


def pool_clocks(clocks: Sequence[Clock]) -> tuple[float, float]:
    """Return the median lag [s] and jitter [s] of runs of one rig, which a run with little motion can use."""
    return float(np.median([c.lag for c in clocks])), float(np.median([c.jitter_std for c in clocks]))
