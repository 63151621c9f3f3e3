"""Benches of the study of strangers on disk: their files, the episodes that ``torchcloth new`` writes, and the truth.

A bench is a folder:

    files/      what the stranger has; ``command.txt`` has the arguments of ``torchcloth new``
    episode/    what ``torchcloth new`` wrote
    truth.npz   vertices, times and camera
    truth.json  what is hidden, what the commands said, and how far the episode is from the truth; written last
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from torchcloth import recordings
from torchcloth._utils.files import to_json, write_atomically, write_text
from torchcloth.errors import InvalidInput

from ..validation.independent.bench_files import write_bench
from ..validation.independent.flex_sheet import SheetSpec, interpolate_bilinear
from ..validation.independent.stranger_bench import BenchSize, StrangerBench, draw_bench, draw_towel, make_bench
from .honesty import run_command

Array = np.ndarray
FAST_SIZE = BenchSize(spacing=0.03, rate=10.0, shrink=4)
DENSE_NODES = 101  # along each side of the dense surface from which points are measured
FOREIGN_DISTANCE_M = 0.03  # from the true surface, beyond which a point is none of the cloth
CHECKED_CLOUDS = 10
FILE_OPTIONS = ("--joints", "--base", "--depth", "--intrinsics", "--camera-pose")


def find_or_make_episode(folder: Path, seed: int, fast: bool, is_towel: bool = False) -> dict[str, Any]:
    """Return what is hidden in a seed's bench; make its files and its episode where they are missing.

    Raises:
        InvalidInput: the folder holds a bench of another size.
    """
    size = FAST_SIZE if fast else BenchSize()
    try:
        truth = json.loads((folder / "truth.json").read_text())
    except FileNotFoundError:
        pass
    else:
        if truth["size"] != asdict(size):
            got, remedy = f"{folder}, a bench of size {truth['size']}", "choose another folder"
            raise InvalidInput("--episodes", got=got, expected=f"{asdict(size)}", remedy=remedy)
        return truth
    shutil.rmtree(folder, ignore_errors=True)
    bench = make_bench(seed, size, draw_towel if is_towel else draw_bench)
    write_bench(bench, folder / "files")
    _write_arrays(bench, folder / "truth.npz")
    return remake_episode(folder, _describe(bench))


def remake_episode(folder: Path, truth: Mapping[str, Any]) -> dict[str, Any]:
    """Write the episode of a bench whose files are there, and return what is hidden with what the commands said."""
    shutil.rmtree(folder / "episode", ignore_errors=True)
    words = (folder / "files" / "command.txt").read_text().split()
    options = [
        str((folder / "files" / word).resolve()) if before in FILE_OPTIONS else word
        for before, word in zip(["", *words], words, strict=False)
    ]
    episode = folder.resolve() / "episode"
    seconds_new, message = run_command(sys.executable, ["new", str(episode), *options])
    out = {**truth, "seconds_new": seconds_new, "refused": "", "notes": [], "quality": None}
    if episode.is_dir():
        seconds_inspect, inspect_message = run_command(sys.executable, ["inspect", str(episode)])
        recording = recordings.read(episode)
        notes = recording.extra.get("source", {}).get("notes", [])
        quality = measure_quality(recording, folder / "truth.npz", has_two_sides=truth["holding"] == "bar")
        out |= {"seconds_inspect": seconds_inspect, "inspect": inspect_message, "notes": notes, "quality": quality}
    else:
        out["refused"] = f"new: {message}"
    write_text(folder / "truth.json", to_json(out))
    return json.loads((folder / "truth.json").read_text())


def measure_quality(recording: recordings.Recording, truth: Path, has_two_sides: bool) -> dict[str, float]:
    """Measure how far an episode is from the truth, as the stated camera sees it.

    Args:
        recording: the episode.
        truth: the arrays of its bench.
        has_two_sides: the sheet may be on it with its left and right exchanged, which no camera tells.

    Returns:
        Median distance of the points from the true surface ("points_m"), share of the points that are far from it
        ("foreign"), root mean square distance of the first shape's vertices ("first_shape_m"), and by how much the
        images are taken too late ("clock_s").
    """
    with np.load(truth) as arrays:
        lines_u, lines_v, x, T, light, stamps = (
            arrays[key] for key in ("lines_u", "lines_v", "x", "believed_from_true", "light_times", "stamps")
        )
    width, height = float(lines_u[-1]), float(lines_v[-1])
    sheet = SheetSpec(width, height, (len(lines_u), len(lines_v)), lines_u=tuple(lines_u), lines_v=tuple(lines_v))
    x = x @ T[:3, :3].T + T[:3, 3]
    clouds, since_first = recording.require("points"), stamps - stamps[0]
    grid = np.meshgrid(np.linspace(0, width, DENSE_NODES), np.linspace(0, height, DENSE_NODES))
    dense = np.stack([axis.ravel() for axis in grid], 1)
    distances = []
    for i in np.unique(np.linspace(0, len(clouds) - 1, CHECKED_CLOUDS).astype(int)):
        image = int(np.abs(since_first - clouds.t[i]).argmin())
        distances.append(KDTree(interpolate_bilinear(sheet, x[image], dense)[0]).query(clouds.frame(i))[0])
    distance = np.concatenate(distances)
    cloth = recording.cloth
    uv = np.asarray(cloth.uv)
    sides = [uv, uv * [-1, 1] + [width, 0]] if has_two_sides else [uv]
    errors = [cloth.initial_vertices - interpolate_bilinear(sheet, x[0], side)[0] for side in sides]
    return {
        "points_m": float(np.median(distance)),
        "foreign": float((distance > FOREIGN_DISTANCE_M).mean()),
        "first_shape_m": min(float(np.sqrt((error**2).sum(-1).mean())) for error in errors),
        "clock_s": float(np.median(stamps + recording.clock_offset - light)),
    }


def _write_arrays(bench: StrangerBench, path: Path) -> None:
    lines_u, lines_v = bench.sheet.grid_lines
    with write_atomically(path) as part, part.open("wb") as file:
        np.savez_compressed(
            file,
            lines_u=lines_u,
            lines_v=lines_v,
            x=bench.x.astype(np.float32),
            light_times=bench.light_times,
            stamps=bench.stamps,
            believed_from_true=bench.believed_from_true,
        )


def _describe(bench: StrangerBench) -> dict[str, Any]:
    return {
        "seed": bench.seed,
        "holding": bench.holding,
        "camera": bench.camera,
        "motion": bench.motion,
        "faults": bench.faults,
        "truth": bench.truth,
        "iterations": None,  # of the fit: as many as it takes
        "size": asdict(bench.size),
    }
