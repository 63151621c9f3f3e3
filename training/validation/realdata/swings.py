"""Adapter: the IRI runs (github Alados5/tfm_matlab, 2021): one cloth of side 0.30 m swung by a rigid hanger, 30 runs.

    python -m torchcloth.training.validation.realdata.swings OUT_EPISODE --run range60_rep5 [--source DIR]
    torchcloth identify OUT_EPISODE --out DIR --fit air.normal --iterations 3

Motion: one gripper, "hanger", the tool's measured pose (turns of up to 7 degrees included). Samples that came in one
burst (stamps closer than BURST) are averaged; the stamps themselves are right: against the 100 Hz command they leave
7.3 mm RMS, evenly spaced ones 8.0 mm.
Clock: the mesh's stamps are kept; `clock_offset` = -lag of this run, with which its upper edge follows the tool best.
Frames: a frame is refused unless the median arc along the columns and along the rows is within 10 % of 0.30 m.
Markers: all frames and all 64 nodes as measured, NaN where there was no depth, no uv because nodes are geometric;
`markers.extra["accepted"]` says which frames are. Points: the nodes of the accepted frames that the motion covers.
Cloth: a square sheet whose upper edge is held along its whole length (between its corners it does not sag). At the
first frame it hangs flat below the line through the upper nodes of the frames before the tool moves. Their corner
nodes are left out: seen 15 mm low, they are rounded off.
Bias: at rest the lower edge is seen 11 mm (7 to 16 mm) in front of the vertical below the upper one, as if the camera's
pose were off by 2 degrees, or the hanger bent the cloth. Which is not known, so nothing is corrected.
Not known: fabric, mass, thickness, stiffness. The density is the geometric mean of the authors' two guesses, 0.2 kg/m^2
and 0.1 kg per sheet, with an error that spans both. No two runs repeat one command, whatever their names say.
"""

from __future__ import annotations

import argparse
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchcloth import recordings
from torchcloth.recordings import ClothInfo, GraspInfo, GripperMotion, Markers, PointClouds, Recording

from .source_folders import source_folder

SIDE = 0.30  # m
BURST = 0.02  # s
STILL = 3e-3  # m, within which the tool stands
NOISE = 5e-3  # m, beyond which a residual counts less
ARC_TOLERANCE = 0.1  # of SIDE
GUESSES = (0.2, 0.1 / SIDE**2)  # kg/m^2, the authors' two models
AIR = 1.204  # kg/m^3, assumed
BENDING, DAMPING = 5e-5, 0.02  # N m, s, assumed: without damping wrinkles grow chaotic, and a fit cannot move


class Estimate(NamedTuple):
    """A number, or an array, and its standard error."""

    value: np.ndarray | float
    std: np.ndarray | float


Run = dict[str, np.ndarray]


@lru_cache(1)
def runs(path: Path) -> dict[str, Run]:
    """Fields by run."""
    with np.load(path / "swings.npz") as file:
        names = sorted({key.split("/")[0] for key in file.files if key.endswith("/t_mesh_s")})
        fields = ("t_mesh_s", "mesh_base_m", "t_tcp_s", "tcp_pos_m", "tcp_quat_xyzw", "cmd_t_pos_quatwxyz")
        return {name: {f: file[f"{name}/{f}"].astype(float) for f in fields} for name in names}


def arcs(mesh: np.ndarray) -> np.ndarray:
    """[F, 2] m, median arcs along the rows and along the columns."""
    return np.stack(
        [np.nanmedian(np.linalg.norm(np.diff(mesh, axis=k), axis=-1).sum(k), axis=1) for k in (1, 2)], axis=-1
    )


def accepted(run: Run) -> np.ndarray:
    """[F] bool, frames whose arcs are those of the sheet."""
    return (np.abs(arcs(run["mesh_base_m"]) / SIDE - 1) < ARC_TOLERANCE).all(1)


def start(run: Run) -> float:
    """s, when the tool began to move."""
    away = np.abs(run["tcp_pos_m"] - np.median(run["tcp_pos_m"][:6], axis=0)).max(1) > STILL
    return float(run["t_tcp_s"][np.flatnonzero(away)[0] - 1])


def stop(run: Run) -> float:
    """s, when the tool came to stand."""
    away = np.abs(run["tcp_pos_m"] - np.median(run["tcp_pos_m"][-10:], axis=0)).max(1) > STILL
    return float(run["t_tcp_s"][np.flatnonzero(away)[-1]])


def tool(run: Run) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [K] s, positions [K, 3] m and quaternions wxyz [K, 4] of the tool, one sample a burst."""
    t, quat = run["t_tcp_s"], run["tcp_quat_xyzw"][:, [3, 0, 1, 2]]
    quat = quat * np.sign(quat @ quat[0])[:, None]
    burst = np.concatenate([[0], np.cumsum(np.diff(t) > BURST)])
    count = np.bincount(burst)
    t, position, quat = (
        np.stack([np.bincount(burst, column) / count for column in np.atleast_2d(a.T)], -1)
        for a in (t, run["tcp_pos_m"], quat)
    )
    return t[:, 0], position, quat / np.linalg.norm(quat, axis=1, keepdims=True)


def edges(run: Run) -> np.ndarray:
    """[F, 3] m, middle of the upper edge."""
    return np.nanmedian(run["mesh_base_m"][:, 1:-1, -1], axis=1)


def hanger(run: Run) -> Estimate:
    """[3] m, the upper edge's middle from the tool while both stand, before the motion."""
    still = accepted(run) & (run["t_mesh_s"] < start(run))
    gap = edges(run)[still] - np.median(run["tcp_pos_m"][run["t_tcp_s"] < start(run)], axis=0)
    middle = np.median(gap, axis=0)
    return Estimate(middle, 1.4826 * np.median(np.abs(gap - middle), axis=0))


def lag(run: Run) -> Estimate:
    """s, by which the upper edge follows the tool in the stamps: robust least squares on the stroke's axis, y."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    t, position, quat = tool(run)
    turn = Rotation.from_quat(quat[:, [1, 2, 3, 0]])
    held = position + (turn * turn[0].inv()).apply(hanger(run).value)
    good = accepted(run)
    seen, y = run["t_mesh_s"][good], edges(run)[good][:, 1]

    def residual(unknown: np.ndarray) -> np.ndarray:
        return (y - unknown[1] - np.interp(seen - unknown[0], t, held[:, 1])) / NOISE

    found = least_squares(residual, [0.3, 0.0], loss="soft_l1", diff_step=1e-3)
    scale = 1.4826 * np.median(np.abs(found.fun))
    return Estimate(float(found.x[0]), float(scale * np.linalg.inv(found.jac.T @ found.jac)[0, 0] ** 0.5))


def noise(run: Run) -> np.ndarray:
    """[3] m, robust standard deviation of a node while all stands."""
    still = accepted(run) & (run["t_mesh_s"] < start(run))
    mesh = run["mesh_base_m"][still]
    return 1.4826 * np.nanmedian(np.abs(mesh - np.nanmedian(mesh, axis=0)), axis=(0, 1, 2))


def hanging(run: Run) -> tuple[np.ndarray, float]:
    """Corners [2, 2, 3] m (width, height from below) of the flat sheet before the motion; RMS m of nodes off it."""
    still = accepted(run) & (run["t_mesh_s"] < start(run))
    mesh = np.nanmedian(run["mesh_base_m"][still], axis=0)
    upper = mesh[1:-1, -1]
    middle = np.median(upper, axis=0)
    along = np.linalg.svd(upper - upper.mean(0))[2][0]
    along = along * np.sign(along @ (upper[-1] - upper[0]))
    down = np.array([0.0, 0.0, -1.0])
    down = down - (down @ along) * along
    down = down / np.linalg.norm(down)
    left, right = middle - SIDE / 2 * along, middle + SIDE / 2 * along
    corners = np.stack([[p + SIDE * down, p] for p in (left, right)])
    off = (mesh - middle) @ np.cross(along, down)
    return corners, float(np.sqrt(np.nanmean(off**2)))


def lean(run: Run) -> float:
    """m, of the lowest nodes off the vertical below the upper ones, along y, before the motion."""
    still = accepted(run) & (run["t_mesh_s"] < start(run))
    rows = np.nanmedian(run["mesh_base_m"][still][..., 1], axis=(0, 1))
    return float(rows[0] - rows[-1])


def episode(path: Path, run: str) -> Recording:
    """One run, e.g. "range60_rep5"; see the module's docstring.

    Args:
        path: the source's folder.
        run: a key of `runs`.
    """
    data = runs(Path(path))[run]
    (t, position, quat), late, good = tool(data), lag(data), accepted(data)
    seen, mesh = data["t_mesh_s"], data["mesh_base_m"].reshape(len(data["t_mesh_s"]), -1, 3)
    nodes = np.isfinite(mesh).all(-1)
    mesh = np.where(nodes[..., None], mesh, np.nan)
    use = good & (seen - late.value >= t[0]) & (seen - late.value <= t[-1])
    edge = np.linspace(0, SIDE, 31)
    frames = {"all": len(seen), "rejected by arc length": int((~good).sum()), "in points": int(use.sum())}
    return Recording(
        cloth=_cloth(data),
        grasps={"hanger": GraspInfo(np.stack([edge, np.full(31, SIDE)], -1), 0.006)},
        grippers={"hanger": GripperMotion(t, position, quat, np.ones(len(t), dtype=bool))},
        points=PointClouds(seen[use], mesh[use][nodes[use]], nodes[use].sum(1)),
        markers=Markers(seen, mesh, extra={"accepted": good, "grid": np.array([8, 8])}),
        observation_noise_std=float(noise(data)[1]),
        clock_offset=-float(late.value),
        air_density=AIR,
        split={"motion": run.split("_")[0]},
        provenance="measured",
        licence="none stated by its authors (github Alados5/tfm_matlab): for tests here, not to be passed on",
        extra={"notes": {"run": run, "frames": frames, "nodes without depth": int((~nodes).sum()), **_notes(data)}},
    )


def _cloth(run: Run) -> ClothInfo:
    density = float(np.prod(GUESSES) ** 0.5)
    return ClothInfo(
        areal_density=density,
        areal_density_std=density * np.log(GUESSES[1] / GUESSES[0]) / 2,
        sheet=(SIDE, SIDE),
        initial_vertices=hanging(run)[0],
        nominal={
            "bending_stiffness": BENDING,
            "bending_damping_time": DAMPING,
            "units": {"bending_stiffness": "N m", "bending_damping_time": "s"},
        },
    )


def _notes(run: Run) -> dict[str, Any]:
    late, offset, spread = lag(run), hanger(run), noise(run)
    return {
        "source": "github Alados5/tfm_matlab, IRI (CSIC-UPC) 2021",
        "lag (s)": {"value": late.value, "std": late.std},
        "hanger from tool (m)": {"value": offset.value.tolist(), "std": offset.std.tolist()},
        "noise of a standing node (m)": {"x": spread[0], "y, normal to the cloth": spread[1], "z": spread[2]},
        "standing nodes off the flat sheet (m, RMS)": hanging(run)[1],
        "lean of the standing cloth along y (m)": lean(run),
        "assumed": "areal density, bending and its damping, air density, the whole upper edge is held",
        "not known": "fabric, mass, thickness, stiffness",
        "repeats": "none: all 30 commands differ, also those of one range",
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="One IRI run as a torchcloth recording.")
    parser.add_argument("episode", type=Path, metavar="OUT_EPISODE", help="folder to write")
    parser.add_argument("--run", default="range60_rep5", help="range{30,60,90}_rep{1..10}")
    parser.add_argument("--source", type=Path, help="default: $TORCHCLOTH_REALDATA/iri_cloth_swings")
    options = parser.parse_args()
    recording = episode(source_folder(parser, options.source, "iri_cloth_swings"), options.run)
    recordings.write(recording, options.episode)
    print(f"{options.episode}: {len(recording.points)} frames, {recording.extra['notes']['frames']}")


if __name__ == "__main__":
    main()
