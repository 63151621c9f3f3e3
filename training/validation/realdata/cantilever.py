"""Adapter: a heavy glass-fabric strip as a cantilever (github phbroberg/bendstiff, MIT), as an episode of one frame.

The strip lies level in a clamp at x < 0 and hangs over its edge at x = 0: arc 0.251 m, 13.6 N/m^2, 0.05 m wide. Its
midline's 50 measured points are markers without uv, and points. x is along the strip, z up. Clamped are the CLAMPED
metres of strip before the edge (assumed; the clamp does not bend). Known is also the authors' own table of moment over
curvature, see `moments`. Not known: membrane stiffness, noise, the time (none).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from torchcloth import recordings
from torchcloth.recordings import ClothInfo, GraspInfo, GripperMotion, Markers, PointClouds, Recording

from .source_folders import source_folder

LOAD, LENGTH, WIDTH = 13.6, 0.251, 0.05  # N/m^2, m, m
CLAMPED = 0.05  # m
GRAVITY = 9.81  # m/s^2


def moments(path: Path) -> np.ndarray:
    """The authors' table, rows (curvature 1/m, moment per width N), rising from 0, 0."""
    rows = np.loadtxt(path / "authors_moment_curvature.csv", delimiter=",", skiprows=1)
    return rows[np.argsort(rows[:, 0])]


def episode(path: Path) -> Recording:
    """The profile at rest."""
    x, z = np.loadtxt(path / "midline_profile.csv", delimiter=",", skiprows=1).T
    line = np.stack([x, np.full(len(x), WIDTH / 2), z], -1)
    flat = np.array([[[u, v, 0.0] for v in (0.0, WIDTH)] for u in (-CLAMPED, LENGTH)])
    held = np.stack(np.meshgrid(np.linspace(0, CLAMPED, 11), np.linspace(0, WIDTH, 11)), -1).reshape(-1, 2)
    return Recording(
        cloth=ClothInfo(areal_density=LOAD / GRAVITY, sheet=(CLAMPED + LENGTH, WIDTH), initial_vertices=flat),
        grasps={"clamp": GraspInfo(held, 0.004)},
        grippers={
            "clamp": GripperMotion(
                np.array([0.0, 1.0]),
                np.tile([0.0, WIDTH / 2, 0.0], (2, 1)),
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
                "assumed": "length in the clamp; the strip is at rest at the one frame, which is called 1 s",
                "not known": "membrane stiffness, noise",
            }
        },
    )


def profile(recording: Recording) -> np.ndarray:
    """[50, 2] m, along and up, of the midline."""
    return recording.require("markers").xyz[0][:, [0, 2]]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="The cantilever as a torchcloth recording.")
    parser.add_argument("episode", type=Path, metavar="OUT_EPISODE", help="folder to write")
    parser.add_argument("--source", type=Path, help="default: $TORCHCLOTH_REALDATA/cantilever")
    options = parser.parse_args()
    recordings.write(episode(source_folder(parser, options.source, "cantilever")), options.episode)
    print(f"{options.episode}: one frame")


if __name__ == "__main__":
    main()
