"""Adapter: the 30 IRI runs (github Alados5/tfm_matlab, 2021): a rigid hanger swings one cloth of side 0.30 m.

    python -m torchcloth.training.validation.realdata.swings OUT_EPISODE --run range60_rep5 [--source DIR]
    torchcloth identify OUT_EPISODE --out DIR --fit air.normal --iterations 3

Motion: one gripper, "hanger", has the tool's measured pose, with rotations of up to 7 degrees. Samples of one burst are
averaged. The stamps themselves are right: against the 100 Hz command they leave 7.3 mm RMS, evenly spaced ones 8.0 mm.

Clock: the mesh's stamps are unchanged. `clock_offset` is minus the lag of the run, with which its upper edge follows
the tool best.

Frames: a frame is rejected unless the median arcs along the columns and along the rows are within 10 % of 0.30 m.
Markers are all frames and all 64 nodes as measured, NaN without depth, and without uv, because nodes are geometric.
`markers.extra["accepted"]` says which frames are accepted. Points are the nodes of the accepted frames that the motion
covers.

Cloth: a square sheet that is grasped along its whole upper edge, which does not sag between its corners. At the first
frame it hangs flat below the line through the upper nodes of the frames before the tool moves. Their corner nodes are
left out: the camera rounds them off and shows them 15 mm too low.

Bias: at rest the lower edge appears 11 mm (7 to 16 mm) in front of the vertical below the upper one. Either the
camera's pose is off by 2 degrees, or the hanger bends the cloth. As this is unknown, nothing is corrected.

Unknown are fabric, mass, thickness and stiffness. The density is the geometric mean of the authors' two guesses, 0.2
kg/m^2 and 0.1 kg per sheet, with an error that spans both. No two runs repeat one command, in spite of their names.
"""

from __future__ import annotations

import argparse
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchcloth import recordings
from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth.recordings import ClothInfo, GraspInfo, GripperMotion, Markers, PointClouds, Recording

from .source_folders import source_folder

SHEET_SIDE_M = 0.30
MAX_BURST_GAP_S = 0.02  # between stamps of one burst
STANDSTILL_TOLERANCE_M = 3e-3  # of the tool
ROBUST_SCALE_M = 5e-3  # larger residuals are down-weighted
MAX_ARC_DEVIATION = 0.1  # of SIDE
DENSITY_GUESSES_KG_PER_M2 = (0.2, 0.1 / SHEET_SIDE_M**2)  # of the authors' two models
IRI_BENDING_N_M, IRI_DAMPING_TIME_S = (
    5e-5,
    0.02,
)  # assumed: without damping wrinkles become chaotic, and a fit cannot converge


class Estimate(NamedTuple):
    """A value with its standard error.

    Attributes:
        value: number or array.
        std: standard error.
    """

    value: np.ndarray | float
    std: np.ndarray | float


Run = dict[str, np.ndarray]


@lru_cache(1)
def read_runs(path: Path) -> dict[str, Run]:
    """Read the fields of every run by its name."""
    with np.load(path / "swings.npz") as file:
        names = sorted({key.split("/")[0] for key in file.files if key.endswith("/t_mesh_s")})
        fields = ("t_mesh_s", "mesh_base_m", "t_tcp_s", "tcp_pos_m", "tcp_quat_xyzw", "cmd_t_pos_quatwxyz")
        return {name: {f: file[f"{name}/{f}"].astype(float) for f in fields} for name in names}


def arc_lengths(mesh: np.ndarray) -> np.ndarray:
    """Return the median arc lengths [F, 2] m along the rows and along the columns."""
    return np.stack(
        [np.nanmedian(np.linalg.norm(np.diff(mesh, axis=k), axis=-1).sum(k), axis=1) for k in (1, 2)], axis=-1
    )


def accepted_frames(run: Run) -> np.ndarray:
    """Return which frames [F] have arcs of the sheet's length."""
    is_close = np.abs(arc_lengths(run["mesh_base_m"]) / SHEET_SIDE_M - 1) < MAX_ARC_DEVIATION
    return np.asarray(is_close.all(1))


def motion_start(run: Run) -> float:
    """Return the time [s] at which the tool starts to move."""
    is_displaced = np.abs(run["tcp_pos_m"] - np.median(run["tcp_pos_m"][:6], axis=0)).max(1) > STANDSTILL_TOLERANCE_M
    return float(run["t_tcp_s"][np.flatnonzero(is_displaced)[0] - 1])


def motion_stop(run: Run) -> float:
    """Return the time [s] at which the tool stops."""
    is_displaced = np.abs(run["tcp_pos_m"] - np.median(run["tcp_pos_m"][-10:], axis=0)).max(1) > STANDSTILL_TOLERANCE_M
    return float(run["t_tcp_s"][np.flatnonzero(is_displaced)[-1]])


def tool_motion(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times [K] s, positions [K, 3] m and quaternions wxyz [K, 4] of the tool, one sample per burst."""
    t, quat = run["t_tcp_s"], run["tcp_quat_xyzw"][:, [3, 0, 1, 2]]
    quat = quat * np.sign(quat @ quat[0])[:, None]
    burst = np.concatenate([[0], np.cumsum(np.diff(t) > MAX_BURST_GAP_S)])
    count = np.bincount(burst)
    t, position, quat = (
        np.stack([np.bincount(burst, column) / count for column in np.atleast_2d(a.T)], -1)
        for a in (t, run["tcp_pos_m"], quat)
    )
    return t[:, 0], position, quat / np.linalg.norm(quat, axis=1, keepdims=True)


def upper_edge_middles(run: Run) -> np.ndarray:
    """Return the middle of the upper edge [F, 3] m."""
    return np.nanmedian(run["mesh_base_m"][:, 1:-1, -1], axis=1)


def estimate_hanger_offset(run: Run) -> Estimate:
    """Estimate the offset [3] m from the tool to the middle of the upper edge, before the motion."""
    is_still = accepted_frames(run) & (run["t_mesh_s"] < motion_start(run))
    gap = upper_edge_middles(run)[is_still] - np.median(run["tcp_pos_m"][run["t_tcp_s"] < motion_start(run)], axis=0)
    middle = np.median(gap, axis=0)
    return Estimate(middle, 1.4826 * np.median(np.abs(gap - middle), axis=0))


def estimate_lag(run: Run) -> Estimate:
    """Estimate the lag [s] of the upper edge's stamps, by robust least squares on the axis of the stroke, y."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    t, position, quat = tool_motion(run)
    turn = Rotation.from_quat(quat[:, [1, 2, 3, 0]])
    edge = position + (turn * turn[0].inv()).apply(estimate_hanger_offset(run).value)
    is_accepted = accepted_frames(run)
    stamps, y = run["t_mesh_s"][is_accepted], upper_edge_middles(run)[is_accepted][:, 1]

    def residual(unknown: np.ndarray) -> np.ndarray:
        return (y - unknown[1] - np.interp(stamps - unknown[0], t, edge[:, 1])) / ROBUST_SCALE_M

    result: Any = least_squares(residual, [0.3, 0.0], loss="soft_l1", diff_step=1e-3)
    scale = 1.4826 * np.median(np.abs(result.fun))
    return Estimate(float(result.x[0]), float(scale * np.linalg.inv(result.jac.T @ result.jac)[0, 0] ** 0.5))


def estimate_noise(run: Run) -> np.ndarray:
    """Estimate the robust standard deviation [3] m of a node before the motion."""
    is_still = accepted_frames(run) & (run["t_mesh_s"] < motion_start(run))
    mesh = run["mesh_base_m"][is_still]
    return 1.4826 * np.nanmedian(np.abs(mesh - np.nanmedian(mesh, axis=0)), axis=(0, 1, 2))


def estimate_flat_sheet(run: Run) -> tuple[np.ndarray, float]:
    """Estimate the flat sheet before the motion.

    Returns:
        Its corners [2, 2, 3] m (width, height from below), and the RMS distance [m] of the nodes from it.
    """
    is_still = accepted_frames(run) & (run["t_mesh_s"] < motion_start(run))
    mesh = np.nanmedian(run["mesh_base_m"][is_still], axis=0)
    upper = mesh[1:-1, -1]
    middle = np.median(upper, axis=0)
    along = np.linalg.svd(upper - upper.mean(0))[2][0]
    along = along * np.sign(along @ (upper[-1] - upper[0]))
    down = np.array([0.0, 0.0, -1.0])
    down = down - (down @ along) * along
    down = down / np.linalg.norm(down)
    left, right = middle - SHEET_SIDE_M / 2 * along, middle + SHEET_SIDE_M / 2 * along
    corners = np.stack([[p + SHEET_SIDE_M * down, p] for p in (left, right)])
    distance = (mesh - middle) @ np.cross(along, down)
    return corners, float(np.sqrt(np.nanmean(distance**2)))


def measure_lean(run: Run) -> float:
    """Measure how far [m] the lowest nodes are from the vertical below the upper ones, along y, before the motion."""
    is_still = accepted_frames(run) & (run["t_mesh_s"] < motion_start(run))
    rows = np.nanmedian(run["mesh_base_m"][is_still][..., 1], axis=(0, 1))
    return float(rows[0] - rows[-1])


def read_episode(path: Path, run: str) -> Recording:
    """Read one run, e.g. "range60_rep5", as a recording; see the module's docstring.

    Args:
        path: the source's folder.
        run: a key of `read_runs`.
    """
    data = read_runs(Path(path))[run]
    (t, position, quat), lag, is_accepted = tool_motion(data), estimate_lag(data), accepted_frames(data)
    stamps, mesh = data["t_mesh_s"], data["mesh_base_m"].reshape(len(data["t_mesh_s"]), -1, 3)
    has_depth = np.asarray(np.isfinite(mesh).all(-1))
    mesh = np.where(has_depth[..., None], mesh, np.nan)
    use = is_accepted & (stamps - lag.value >= t[0]) & (stamps - lag.value <= t[-1])
    edge = np.linspace(0, SHEET_SIDE_M, 31)
    frames = {"all": len(stamps), "rejected by arc length": int((~is_accepted).sum()), "in points": int(use.sum())}
    return Recording(
        cloth=describe_cloth(data),
        grasps={"hanger": GraspInfo(np.stack([edge, np.full(31, SHEET_SIDE_M)], -1), 0.006)},
        grippers={"hanger": GripperMotion(t, position, quat, np.ones(len(t), dtype=bool))},
        points=PointClouds(stamps[use], mesh[use][has_depth[use]], has_depth[use].sum(1)),
        markers=Markers(stamps, mesh, extra={"accepted": is_accepted, "grid": np.array([8, 8])}),
        observation_noise_std=float(estimate_noise(data)[1]),
        clock_offset=-float(lag.value),
        air_density=STANDARD_AIR_DENSITY_KG_PER_M3,
        split={"motion": run.split("_")[0]},
        provenance="measured",
        licence="none stated by its authors (github Alados5/tfm_matlab): for tests here, not to be passed on",
        extra={"notes": {"run": run, "frames": frames, "nodes without depth": int((~has_depth).sum()), **_notes(data)}},
    )


def describe_cloth(run: Run) -> ClothInfo:
    """Describe the sheet and where it hangs at the first frame."""
    density = float(np.prod(DENSITY_GUESSES_KG_PER_M2) ** 0.5)
    return ClothInfo(
        areal_density=density,
        areal_density_std=density * np.log(DENSITY_GUESSES_KG_PER_M2[1] / DENSITY_GUESSES_KG_PER_M2[0]) / 2,
        sheet=(SHEET_SIDE_M, SHEET_SIDE_M),
        initial_vertices=estimate_flat_sheet(run)[0],
        nominal={
            "bending_stiffness": IRI_BENDING_N_M,
            "bending_damping_time": IRI_DAMPING_TIME_S,
            "units": {"bending_stiffness": "N m", "bending_damping_time": "s"},
        },
    )


def _notes(run: Run) -> dict[str, Any]:
    lag, offset, noise = estimate_lag(run), estimate_hanger_offset(run), estimate_noise(run)
    return {
        "source": "github Alados5/tfm_matlab, IRI (CSIC-UPC) 2021",
        "lag (s)": {"value": lag.value, "std": lag.std},
        "hanger from tool (m)": {"value": np.asarray(offset.value).tolist(), "std": np.asarray(offset.std).tolist()},
        "noise of a standing node (m)": {"x": noise[0], "y, normal to the cloth": noise[1], "z": noise[2]},
        "distance of standing nodes from the flat sheet (m, RMS)": estimate_flat_sheet(run)[1],
        "lean of the standing cloth along y (m)": measure_lean(run),
        "assumed": "areal density, bending and its damping, air density, the whole upper edge is held",
        "not known": "fabric, mass, thickness, stiffness",
        "repeats": "none: all 30 commands differ, also those of one range",
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="One IRI run as a torchcloth recording.")
    parser.add_argument("episode", type=Path, metavar="OUT_EPISODE", help="folder to write")
    parser.add_argument("--run", default="range60_rep5", help="range{30,60,90}_rep{1..10}")
    parser.add_argument("--source", type=Path, help="default: $TORCHCLOTH_REALDATA/iri_cloth_swings")
    options = parser.parse_args()
    recording = read_episode(source_folder(parser, options.source, "iri_cloth_swings"), options.run)
    recordings.write(recording, options.episode)
    print(f"{options.episode}: {len(recording.require('points'))} frames, {recording.extra['notes']['frames']}")


if __name__ == "__main__":
    main()
