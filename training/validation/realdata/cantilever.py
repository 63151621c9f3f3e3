"""Adapter: a heavy glass-fabric strip as a cantilever (github phbroberg/bendstiff, MIT), as an episode of one frame.

The strip lies level in a clamp at x < 0 and hangs over its edge at x = 0: arc 0.251 m, 13.6 N/m^2, 0.05 m wide. The 50
measured points of its midline are markers without uv, and points. x is along the strip, z up. The clamped length is
assumed; the clamp does not bend. The authors also give a table of moment over curvature (`read_moment_table`). Unknown
are the membrane stiffness and the noise. There is no time.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from torchcloth import recordings
from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2
from torchcloth.recordings import ClothInfo, GraspInfo, GripperMotion, Markers, PointClouds, Recording

from .source_folders import source_folder

STRIP_LOAD_N_PER_M2, FREE_STRIP_LENGTH_M, GLASS_STRIP_WIDTH_M = 13.6, 0.251, 0.05  # N/m^2, m, m
CLAMPED_STRIP_LENGTH_M = 0.05  # m


def read_moment_table(path: Path) -> np.ndarray:
    """Read the authors' table: rows of curvature [1/m] and moment per width [N], rising from 0, 0."""
    rows = np.loadtxt(path / "authors_moment_curvature.csv", delimiter=",", skiprows=1)
    return rows[np.argsort(rows[:, 0])]


def read_episode(path: Path) -> Recording:
    """Read the profile at rest as a recording."""
    x, z = np.loadtxt(path / "midline_profile.csv", delimiter=",", skiprows=1).T
    line = np.stack([x, np.full(len(x), GLASS_STRIP_WIDTH_M / 2), z], -1)
    flat = np.array(
        [[[u, v, 0.0] for v in (0.0, GLASS_STRIP_WIDTH_M)] for u in (-CLAMPED_STRIP_LENGTH_M, FREE_STRIP_LENGTH_M)]
    )
    clamped = np.stack(
        np.meshgrid(np.linspace(0, CLAMPED_STRIP_LENGTH_M, 11), np.linspace(0, GLASS_STRIP_WIDTH_M, 11)), -1
    ).reshape(-1, 2)
    return Recording(
        cloth=ClothInfo(
            areal_density=STRIP_LOAD_N_PER_M2 / STANDARD_GRAVITY_M_PER_S2,
            sheet=(CLAMPED_STRIP_LENGTH_M + FREE_STRIP_LENGTH_M, GLASS_STRIP_WIDTH_M),
            initial_vertices=flat,
        ),
        grasps={"clamp": GraspInfo(clamped, 0.004)},
        grippers={
            "clamp": GripperMotion(
                np.array([0.0, 1.0]),
                np.tile([0.0, GLASS_STRIP_WIDTH_M / 2, 0.0], (2, 1)),
                np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
                np.ones(2, dtype=bool),
            )
        },
        points=PointClouds(np.array([1.0]), line, np.array([len(line)])),
        markers=Markers(np.array([1.0]), line[None]),
        provenance="measured",
        licence="MIT",
        split={"motion": "cantilever"},
        extra={
            "notes": {
                "source": "github phbroberg/bendstiff",
                "assumed": "length in the clamp; the strip is at rest in the one frame, at 1 s",
                "not known": "membrane stiffness, noise",
            }
        },
    )


def midline_profile(recording: Recording) -> np.ndarray:
    """Return the midline [50, 2] m, along and up."""
    return recording.require("markers").xyz[0][:, [0, 2]]


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="The cantilever as a torchcloth recording.")
    parser.add_argument("episode", type=Path, metavar="OUT_EPISODE", help="folder to write")
    parser.add_argument("--source", type=Path, help="default: $TORCHCLOTH_REALDATA/cantilever")
    options = parser.parse_args()
    recordings.write(read_episode(source_folder(parser, options.source, "cantilever")), options.episode)
    print(f"{options.episode}: one frame")


if __name__ == "__main__":
    main()
