"""When the frames of the IRI rig were taken, from the upper edge of the cloth, which the hanger holds.

Stamps: the mesh of a frame is stamped when it is finished. Its image was taken about 0.2 s before the computation
began, that is before the stamp of the frame before. In moving frames the delay behind a frame's own stamp scatters by
45 to 60 ms, and it grows with the time since the stamp before (correlation 0.77). The delay behind the stamp before
scatters by 30 ms.

Time of a frame: the maximum of the posterior of the place of the upper edge's middle and of a normal prior around the
stamp before, less the lag. Lag, width of the prior and the offset of the upper edge from the tool are estimated
together with the times, by expectation and maximisation. Nothing is used of the free cloth.

Camera: the same edge shows a turn of the camera's pose against the robot's base, of 1 to 3 degrees in the swings and 2
to 5 in the carries; with it the edge follows the tool within 2 to 3 mm across the cloth (before: 2 to 10 mm).

Rejected are frames whose arcs have not the sheet's length, and frames whose upper edge is not where the tool can have
it at any time near theirs: failures of the segmentation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .swings import Run, accepted_frames, motion_start, motion_stop, tool_motion

TYPICAL_IMAGE_LAG_S = 0.2  # behind the stamp of the frame before
TYPICAL_JITTER_STD_S = 0.03
EDGE_NOISE_STD_M = (0.010, 0.003, 0.006)  # of the upper edge's middle: along the edge, across the cloth, in height
MAX_SQUARED_EDGE_RESIDUAL = 9.0  # of one axis, in squared standard deviations: a wrong edge decides nothing
TIME_STEP_S, SEARCH_HALF_WIDTH_S = 0.002, 0.12  # of the times that are tried
CLOCK_ROUNDS, ALIGNMENT_ROUNDS = 4, 3
CAMERA_TURN_PRIOR_STD_RAD = 0.05  # 3 degrees, prior of each axis
EDGE_TOLERANCE_M = (np.inf, 0.012, 0.018)  # across the cloth and in height, above which an edge is a wrong one


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


class Alignment(NamedTuple):
    """A rigid correction of the camera's pose.

    Attributes:
        turn: [3] rad, rotation vector about ``centre``.
        turn_std: [3] rad.
        centre: [3] m.
        shift: [3] m.
    """

    turn: np.ndarray
    turn_std: np.ndarray
    centre: np.ndarray
    shift: np.ndarray

    def apply(self, run: Run) -> Run:
        """Return the run with corrected nodes."""
        from scipy.spatial.transform import Rotation

        nodes = run["mesh_base_m"] - self.centre
        turned = Rotation.from_rotvec(self.turn).apply(nodes.reshape(-1, 3)).reshape(nodes.shape)
        return {**run, "mesh_base_m": turned + self.centre + self.shift}


class TimedRun(NamedTuple):
    """The usable frames of a run, with their times and the camera's corrected pose.

    Attributes:
        name: of the run.
        path: of the tool.
        clock: lag, jitter and edge offset.
        alignment: correction of the camera's pose; None: not corrected.
        stamps: [F] s.
        t: [F] s, on the tool's clock.
        std: [F] s.
        nodes: [F, A, D, 3] m, along the upper edge and from bottom to top; NaN without depth.
        is_still: [F] bool, before the tool moves.
        stop: s, when the tool stops.
        frames: number of all frames.
        rejected_by_arc: number of frames whose arcs have not the sheet's length.
        rejected_by_edge: number of frames whose upper edge is not where the tool can have it.
    """

    name: str
    path: ToolPath
    clock: Clock
    alignment: Alignment | None
    stamps: np.ndarray
    t: np.ndarray
    std: np.ndarray
    nodes: np.ndarray
    is_still: np.ndarray
    stop: float
    frames: int
    rejected_by_arc: int
    rejected_by_edge: int

    def with_one_lag(self) -> TimedRun:
        """Return the run with times that lag the frames' own stamps by one constant."""
        return self._replace(t=self.stamps - np.median(self.stamps - self.t))


def estimate_alignment(run: Run, times: FrameTimes, edge_offset: np.ndarray) -> Alignment:
    """Estimate the correction with which the upper edge follows the tool best, by robust least squares."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    known = np.isfinite(times.t)
    edge, place = upper_edge(run)[known], ToolPath(run).carry(times.t[known], edge_offset)
    centre = place.mean(0)

    def residual(unknown: np.ndarray) -> np.ndarray:
        aligned = Rotation.from_rotvec(unknown[:3]).apply(edge - centre) + centre + unknown[3:]
        return np.concatenate([((aligned - place) / EDGE_NOISE_STD_M).ravel(), unknown[:3] / CAMERA_TURN_PRIOR_STD_RAD])

    result = least_squares(residual, np.zeros(6), loss="soft_l1")
    covariance = np.linalg.inv(result.jac.T @ result.jac)
    return Alignment(result.x[:3], covariance.diagonal()[:3] ** 0.5, centre, result.x[3:])


def time_frames(name: str, run: Run, align: bool = True) -> TimedRun:
    """Find the times of a run's frames and, if ``align``, the camera's pose, from the upper edge alone."""
    clock, alignment, aligned = estimate_clock(run), None, run
    for _ in range(ALIGNMENT_ROUNDS if align else 0):
        alignment = estimate_alignment(run, estimate_frame_times(aligned, clock), clock.edge_offset)
        aligned = alignment.apply(run)
    clock = estimate_clock(aligned)
    times, path = estimate_frame_times(aligned, clock), ToolPath(aligned)
    known = np.isfinite(times.t)
    fits = known & (np.abs(times.edge_residual) < EDGE_TOLERANCE_M).all(1)
    return TimedRun(
        name,
        path,
        clock,
        alignment,
        run["t_mesh_s"][fits],
        times.t[fits],
        times.std[fits],
        aligned["mesh_base_m"][fits],
        times.t[fits] < motion_start(run),
        motion_stop(run),
        len(known),
        int((~accepted_frames(run)).sum()),
        int((known & ~fits).sum()),
    )
