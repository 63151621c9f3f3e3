"""Damage of any kind gives one clear error, or the recording that is there: never a wrong or a half-written one.

What a format cannot notice (a changed number or pixel in bytes that no checksum covers) is counted apart; for each
format it is said what that may be, and streams always keep their lengths and names.
"""

from __future__ import annotations

import copy
import random
import re
import shutil
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from helpers import foreign_formats

from torchcloth import recordings as rec
from torchcloth.errors import MissingDependency, TorchclothError
from torchcloth.recordings import atomic_write, formats

DEFAULT_MUTANTS, SLOW_MUTANTS = 60, 500  # damaged files of each case
HEAD = 3000  # bytes at either end, where the structure is
KINDS = ("depth", "color", "mask")


@dataclass
class Content:
    """All that a recording says, decoded."""

    numbers: dict[str, np.ndarray]
    images: dict[str, list[np.ndarray]]


def content(recording: rec.Recording) -> Content:
    motions = [*recording.grippers.items(), *recording.joints.items()]
    numbers = {f"{name}/{key}": value for name, m in motions for key, value in vars(m).items()}
    if recording.points is not None:
        numbers |= {f"points/{key}": value for key, value in vars(recording.points).items()}
    images = {}
    for name, camera in recording.cameras.items():
        numbers |= {f"{name}/{key}": value for key, value in vars(camera).items()}
        for kind in KINDS:
            stream = getattr(camera, kind)
            if stream is not None:
                numbers |= {f"{name}/{kind}/t": stream.t, f"{name}/{kind}/frames": stream.frames}
                images[f"{name}/{kind}"] = [stream.load(i) for i in range(len(stream))]
    numbers |= {"scale": np.array([c.depth_scale or 0 for c in recording.cameras.values()])}
    return Content({k: v for k, v in numbers.items() if isinstance(v, np.ndarray)}, images)


def wrong_parts(result: Content, truth: Content) -> list[str]:
    """The names of what differs; a part that is there in one only, or of another length, is "structure"."""
    if result.numbers.keys() != truth.numbers.keys() or result.images.keys() != truth.images.keys():
        return ["structure"]
    wrong = []
    for key, expected in truth.numbers.items():
        if result.numbers[key].shape != expected.shape:
            return ["structure"]
        if not np.array_equal(result.numbers[key], expected):
            wrong.append(key)
    for key, images in truth.images.items():
        if len(result.images[key]) != len(images):
            return ["structure"]
        wrong += [
            f"{key}[{i}]"
            for i, (a, b) in enumerate(zip(result.images[key], images, strict=True))
            if not np.array_equal(a, b)
        ]
    return wrong


def files_below(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]


def mutate(rng: random.Random, files: list[Path]) -> tuple[str, set[Path]]:
    """Damage one file as disks, networks and people do; says how, and which files it touched."""
    file, other = rng.choice(files), rng.choice(files)
    data = bytearray(file.read_bytes())
    how = rng.choice(
        ["flip", "flip", "flip", "flips", "cut", "zeros", "twice", "swap", "rename", "lose", "empty", "text"]
    )
    n = len(data)

    def anywhere() -> int:
        """Half of all places are near the ends, or pixels would take nearly all."""
        near = rng.randrange(min(n, HEAD))
        return rng.choice([rng.randrange(n), rng.randrange(n), near, n - 1 - near])

    if how == "flip":
        data[anywhere()] ^= 1 << rng.randrange(8)
    elif how == "flips":
        for _ in range(20):
            data[anywhere()] ^= 1 << rng.randrange(8)
    elif how == "cut":
        del data[anywhere() :]
    elif how == "zeros":
        i = anywhere()
        length = min(rng.choice([4, 64, 512]), n - i)
        data[i : i + length] = bytes(length)
    elif how == "twice":
        i, j = sorted(rng.sample(range(n + 1), 2))
        data[i:j] = data[i:j] * 2
    elif how == "text":
        data = bytearray(rng.choice([b"{}", b"[]", b"1 2 3\n", b"\x00" * 50, b"null"]))
    touched = {file}
    if how == "swap" and other != file:
        remaining = other.read_bytes()
        other.write_bytes(bytes(data))
        file.write_bytes(remaining)
        touched.add(other)
    elif how == "rename":
        suffix = rng.choice([file.suffix, ".txt", ".png", ".mkv"])
        name = file.with_name(file.stem + rng.choice(["0", "_", ""]) + suffix)
        touched.add(file.rename(name))
    elif how == "lose":
        file.unlink()
    else:
        file.write_bytes(b"" if how == "empty" else bytes(data))
    return f"{how} {file.name}", touched


def attempt(truth: foreign_formats.ForeignRecording, scene: Path, out: Path) -> Content | None:
    """Import and write; None when it was refused, by one line and without a trace."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            recording = formats.read(truth.path, scene=scene, **truth.options)
            rec.write(recording, out, compact=False)
    except MissingDependency:
        raise
    except TorchclothError as error:
        assert "\n" not in str(error)  # noqa: PT017
        assert not out.exists()
        assert not list(out.parent.glob(".*.partial"))
        return None
    result = content(rec.read(out))
    shutil.rmtree(out)
    return result


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    """Tiny files are not brought to the disk 20 000 times."""
    monkeypatch.setattr(atomic_write, "sync_to_disk", lambda path: None)


def fuzz(case: str, tmp_path: Path, count: int) -> Counter:
    """Mutations of one format by what became of them."""
    (name, options), rng, outcome = CASES[case], random.Random(case), Counter()
    truth = foreign_formats.WRITERS[name](tmp_path / "whole", **options)
    scene, out = truth.write_scene(), tmp_path / "out"
    expected = attempt(truth, scene, out)
    assert expected is not None
    whole = {file: file.read_bytes() for file in files_below(truth.path)}
    for i in range(count):
        how, touched = mutate(rng, list(whole))
        result = attempt(truth, scene, out)
        if result is None:
            outcome["refused"] += 1
        elif not (wrong := wrong_parts(result, expected)):
            outcome["right"] += 1
        else:
            outcome["unnoticed"] += 1
            unnoticed(case, wrong, f"{case} {i}: {how}: {wrong}")
        for file in touched - whole.keys():
            file.unlink()
        for file in touched & whole.keys():
            file.write_bytes(whole[file])
    print(case, dict(outcome))
    return outcome


def unnoticed(case: str, wrong: list[str], message: str) -> None:
    """What no checksum covers, and nothing else, may differ."""
    print(message)
    assert wrong != ["structure"] or case in TABLE_CASES, message
    assert all(re.fullmatch(UNNOTICEABLE[case], part) for part in wrong), message


PIXELS = r"\w+/(depth|color)\[\d\]"
TIMES = r"\w+/((depth|color)/)?(t|frames)"
LENS = r"\w+/(K|distortion|T_world_camera)"
MOTION = r"\w+/(position|quat_wxyz|force|torque|q|width|closed|xyz)"
CASES = {
    "redwood": ("redwood", {}),
    "tum": ("tum", {}),
    "rosbag2 of MCAP": ("ros2", {}),
    "rosbag2 of sqlite": ("ros2", {"storage": "sqlite3"}),
    "MCAP with checksums": ("ros2", {"checksums": True}),
    "lerobot": ("lerobot", {}),
    "kinect": ("kinect", {}),
    "pcd": ("pcd", {}),
    "rgbench": ("rgbench", {}),
}
TABLE_CASES = ("pcd", "rgbench")  # rows of a CSV table, whole clouds and points may be missing
UNNOTICEABLE = {  # pixels of PNG only when two whole files change places
    "redwood": f"{PIXELS}|{TIMES}|{LENS}",
    "tum": f"{PIXELS}|{TIMES}|{LENS}",
    "rosbag2 of MCAP": f"{PIXELS}|{TIMES}|{LENS}|{MOTION}",
    "rosbag2 of sqlite": f"{PIXELS}|{TIMES}|{LENS}|{MOTION}",
    "MCAP with checksums": "",
    "lerobot": PIXELS,
    "kinect": f"{PIXELS}|{TIMES}|{LENS}",
    "pcd": f"structure|{TIMES}|{MOTION}|points/counts",
    "rgbench": f"structure|{TIMES}|{MOTION}|points/counts",
}
SHARE = {
    "rosbag2 of MCAP": 0.34,
    "rosbag2 of sqlite": 0.33,
    "MCAP with checksums": 0.33,
}  # three ways to write one format


def places(node, path=()):
    """Every key path of a JSON tree."""
    for key in node.keys() if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
        yield (*path, key)
        yield from places(node[key], (*path, key))


VALUES = [None, True, 0, -1, 1e400, 10**400, "", "x", "/", "\0", [], {}, [[]], [None], [["a"]], [[1, 2], 3], {"": {}}]


def wrong_scenes(name: str, tmp_path: Path, count: int) -> Counter:
    """Side files with faults of people: read, or refused by one line; whatever is read can be written."""
    rng, outcome = random.Random(name), Counter()
    truth = foreign_formats.WRITERS[name](tmp_path)
    table = {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}}
    whole = {"cameras": {}, **truth.scene, "grasps": {}, "colliders": {"table": table}}
    camera = whole["cameras"].setdefault("depth" if name == "kinect" else "cam0", {})
    camera["depth_scale"] = 0.0002 if name == "tum" else 0.001
    if name == "ros2":
        whole["source"]["motion"]["left"]["frame"] = "arm"
    paths = list(places(whole))
    for _ in range(count):
        truth.scene = copy.deepcopy(whole)
        *outer, last = rng.choice(paths)
        node = truth.scene
        for key in outer:
            node = node[key]
        how = rng.randrange(4)
        if how == 0:
            del node[last]
        elif how == 1 and isinstance(node, dict):
            node[f"{last}s"] = node.pop(last)
        else:
            node[last] = rng.choice(VALUES)
        outcome[attempt(truth, truth.write_scene(), tmp_path / "out") is not None] += 1
    return outcome


@pytest.mark.parametrize("name", foreign_formats.WRITERS)
def test_wrong_scenes(name, tmp_path):
    assert wrong_scenes(name, tmp_path, DEFAULT_MUTANTS // 4)[False] > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", foreign_formats.WRITERS)
def test_many_wrong_scenes(name, tmp_path):
    outcome = wrong_scenes(name, tmp_path, SLOW_MUTANTS)
    print(name, dict(outcome))
    assert outcome[False] > SLOW_MUTANTS / 4


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_much_damage(case, tmp_path):
    outcome = fuzz(case, tmp_path, SLOW_MUTANTS)
    assert outcome["refused"] > SLOW_MUTANTS / 4


@pytest.mark.parametrize("case", CASES)
def test_damage(case, tmp_path):
    count = round(SHARE.get(case, 1) * DEFAULT_MUTANTS)
    assert fuzz(case, tmp_path, count)["refused"] > count / 4
