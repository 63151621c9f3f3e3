"""A folder of simulated motions, one file for each, from which the pose network learns.

``python -m torchcloth.training.pose.motions --out DIR --motions N`` makes the folder, and goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from torchcloth._utils.durations import describe_time
from torchcloth._utils.files import check_output_folder, write_atomically, write_text
from torchcloth.errors import InvalidInput, RecordingError, TorchclothError
from torchcloth.pose.scene_frame import rest_coordinates

from ..resumable import check_jobs
from .clouds import gripper_poses, observe_scene
from .scenes import (
    MOTIONS_PER_CLOTH,
    POSE_FRAME_PERIOD_S,
    SPLIT_CODES,
    SPLITS,
    RejectedScene,
    Scene,
    SimulatedScene,
    Split,
    build_scene,
    simulate,
)

Array = np.ndarray
DATA_SCHEMA = "torchcloth.pose-data/1"
FOLDER_FILE = "data.json"
RUNS_PER_MOTION, FRAMES_PER_RUN = 5, 3
MOTION_KNOT_PERIOD_S = POSE_FRAME_PERIOD_S / 2
DATA_PROGRESS_PERIOD_S = 10.0


def make_motion(seed: int, split: Split, simulate: Callable[[Scene], SimulatedScene] = simulate) -> dict[str, Array]:
    """Simulate and observe the motion of a seed; return the arrays of its file.

    A scene that was rejected has no frames, and ``rejected`` says why.

    Args:
        seed: of the scene.
        split: "train" or "held-out".
        simulate: the engine; it may raise `RejectedScene`.
    """
    head = {"schema": np.array(DATA_SCHEMA), "seed": np.array(seed), "split": np.array(split)}
    scene = build_scene(seed, split)
    shape = scene.shape
    head |= {
        "novelty": np.array(scene.novelty),
        "kind": np.array(shape.kind),
        "grip_kind": np.array(shape.grip_kind),
        "motion_kind": np.array(scene.motion_kind),
    }
    try:
        simulated = simulate(scene)
    except RejectedScene as error:
        return {**head, "rejected": np.array(str(error))}
    rng = np.random.default_rng([SPLIT_CODES[split], 2, seed])
    frames = observe_scene(simulated, _draw_frames(len(simulated.times), rng), rng)
    mesh = shape.mesh
    grip = np.zeros(len(mesh.vertices), np.int8)
    for k, index in enumerate(shape.grips):
        grip[index] = k + 1
    motion_times = np.arange(0.0, simulated.times[-1] + 0.2, MOTION_KNOT_PERIOD_S)
    x, v = simulated.x[frames.index], simulated.v[frames.index]
    assert mesh.pattern is not None
    return {
        **head,
        "rejected": np.array(""),
        "has_table": np.array(scene.has_table),
        "fabric": np.array(scene.fabric),
        "vertices": mesh.vertices.astype(np.float32),
        "faces": mesh.faces.astype(np.int32),
        "pattern": mesh.pattern.astype(np.float32),
        "rest": rest_coordinates(mesh).numpy().astype(np.float32),
        "grip": grip,
        "frame": frames.index.astype(np.int32),
        "times": frames.times,
        "points": frames.points.astype(np.float32),
        "is_stray": frames.is_stray.astype(bool),
        "visible": frames.visible.astype(np.float32),
        "x": x.astype(np.float32),
        "v": v.astype(np.float32),
        "previous": (simulated.x[np.maximum(frames.index - 1, 0)] + frames.previous_error).astype(np.float32),
        "grip_position": frames.grip_position.astype(np.float32),
        "grip_velocity": frames.grip_velocity.astype(np.float32),
        "motion_times": motion_times,
        "motion_pose": gripper_poses(scene, motion_times).astype(np.float32),
    }


def _draw_frames(count: int, rng: np.random.Generator) -> list[int]:
    """Return the indices of runs of successive frames, spread over ``count`` frames; the first has one before it."""
    edges = np.linspace(1, count - FRAMES_PER_RUN + 1, RUNS_PER_MOTION + 1)
    starts = [
        int(rng.integers(int(low), max(int(low) + 1, int(high) - FRAMES_PER_RUN + 1))) for low, high in pairwise(edges)
    ]
    return [start + k for start in starts for k in range(FRAMES_PER_RUN)]


def motion_path(folder: Path, seed: int) -> Path:
    """Return the path of a motion's file."""
    return folder / f"motion_{seed:06d}.npz"


def load_motion(path: Path) -> dict[str, Any]:
    """Read the file of a motion.

    Raises:
        RecordingError: the file is damaged, or of another schema.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            motion = {name: file[name] for name in file.files}
        schema, rejected = str(motion["schema"]), str(motion["rejected"])
        is_complete = rejected != "" or motion["points"].shape[0] == len(motion["times"]) == len(motion["x"])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        raise _damaged(path) from None
    if schema != DATA_SCHEMA:
        raise RecordingError(f"{path}: schema", got=schema, expected=DATA_SCHEMA, remedy="make the data again")
    if not is_complete:
        raise _damaged(path)
    return motion


def _damaged(path: Path) -> RecordingError:
    return RecordingError(f"{path}: damaged", expected="a motion as the command wrote it", remedy="delete it")


def make_data(folder: Path, motions: int, split: Split, jobs: int = 1) -> Counter[str]:
    """Make the motions 0 to ``motions`` - 1 of a split that are not in the folder yet; print the progress.

    Returns:
        Counts of "motions", "samples" and "rejected" among those that were made.

    Raises:
        InvalidInput: a folder of another split, or one that cannot be written.
        RecordingError: a damaged file is in the folder.
    """
    check_jobs(jobs)
    if motions < 1:
        raise InvalidInput("--motions", got=motions, expected="1 or more")
    _prepare_folder(folder, split)
    missing = [seed for seed in range(motions) if not _is_made(motion_path(folder, seed))]
    groups: dict[int, list[int]] = {}
    for seed in missing:
        groups.setdefault(seed // MOTIONS_PER_CLOTH, []).append(seed)
    counts: Counter[str] = Counter()
    started = last = time.monotonic()
    for part in _map(partial(_make_group, folder, split), list(groups.values()), jobs):
        counts.update(part)
        now = time.monotonic()
        if now - last > DATA_PROGRESS_PERIOD_S or counts["motions"] == len(missing):
            last = now
            ready, rate = motions - len(missing) + counts["motions"], counts["motions"] / (now - started)
            print(
                f"{ready}/{motions} motions ({ready / motions:.0%}), {counts['samples']} samples "
                f"({counts['samples'] / (now - started):.0f} a second), {counts['rejected']} rejected, "
                f"{describe_time((len(missing) - counts['motions']) / rate)} left",
                flush=True,
            )
    return counts


def _prepare_folder(folder: Path, split: str) -> None:
    check_output_folder(folder)
    wanted = {"schema": DATA_SCHEMA, "split": split}
    try:
        content = json.loads((folder / FOLDER_FILE).read_text())
    except FileNotFoundError:
        write_text(folder / FOLDER_FILE, json.dumps(wanted) + "\n")
        return
    except ValueError:
        content = None
    if content != wanted:
        raise InvalidInput("--out", got=f"{folder} with {content}", expected=f"a new folder, or one of {wanted}")


def _is_made(path: Path) -> bool:
    """Return whether a motion's file is there; a quick check refuses one that was cut."""
    if not path.exists():
        return False
    if not zipfile.is_zipfile(path):
        raise _damaged(path)
    return True


def _make_group(folder: Path, split: Split, seeds: Sequence[int]) -> Counter[str]:
    counts: Counter[str] = Counter()
    for seed in seeds:
        motion = make_motion(seed, split)
        with write_atomically(motion_path(folder, seed)) as part:
            np.savez(part, **cast("dict[str, Any]", motion))
        counts.update(motions=1, samples=len(motion.get("times", ())), rejected=int(str(motion["rejected"]) != ""))
    return counts


def _map(function: Any, items: Sequence[Any], jobs: int) -> Iterator[Any]:
    """Yield ``function`` of the items, each process with one thread."""
    if jobs == 1:
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            yield from map(function, items)
        finally:
            torch.set_num_threads(threads)
        return
    with ProcessPoolExecutor(jobs, get_context("spawn"), initializer=torch.set_num_threads, initargs=(1,)) as pool:
        yield from pool.map(function, items)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code (0 done, 2 wrong input, 130 interrupted)."""
    parser = argparse.ArgumentParser(
        prog="python -m torchcloth.training.pose.motions",
        description="Simulate motions of cloth and observe them; the same command continues where it was stopped.",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the motions")
    parser.add_argument("--motions", type=int, default=3000, metavar="N", help="how many in all (default: 3000)")
    parser.add_argument("--split", choices=SPLITS, default="train", help="default: train")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes (default: 1)")
    options = parser.parse_args(arguments)
    try:
        make_data(options.out, options.motions, options.split, options.jobs)
        return 0
    except (TorchclothError, OSError) as error:
        print(f"pose data: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("pose data: stopped; the same command continues, finished motions remain", file=sys.stderr)
        return 130


if __name__ == "__main__":
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the processes that are started
    sys.exit(main())
