"""Damage of any kind gives one clear error, or the recording that is there: never a wrong one, never a half-written one.

What no format can notice (a changed number or pixel in bytes that no checksum covers) is counted apart and shown; it must
stay where the damage was: streams keep their lengths and times their order.
"""

from __future__ import annotations

import random
import shutil
import sys
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))

import foreign

from torchcloth import recordings as rec
from torchcloth.errors import MissingDependency, TorchclothError
from torchcloth.recordings import formats

FEW, MANY = 40, 520
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


def wrong_parts(found: Content, truth: Content) -> list[str]:
    """The names of what differs; a part that is there in one only, or of another length, is "structure"."""
    if found.numbers.keys() != truth.numbers.keys() or found.images.keys() != truth.images.keys():
        return ["structure"]
    wrong = []
    for key, expected in truth.numbers.items():
        if found.numbers[key].shape != expected.shape:
            return ["structure"]
        if not np.array_equal(found.numbers[key], expected):
            wrong.append(key)
    for key, images in truth.images.items():
        if len(found.images[key]) != len(images):
            return ["structure"]
        wrong += [
            f"{key}[{i}]"
            for i, (a, b) in enumerate(zip(found.images[key], images, strict=True))
            if not np.array_equal(a, b)
        ]
    return wrong


def files_below(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]


def mutate(rng: random.Random, files: list[Path]) -> str:
    """Damage one file as disks, networks and people do; says how."""
    file, other = rng.choice(files), rng.choice(files)
    data = bytearray(file.read_bytes())
    how = rng.choice(
        ["flip", "flip", "flip", "flips", "cut", "zeros", "twice", "swap", "rename", "lose", "empty", "text"]
    )
    n = len(data)
    if how == "flip":
        data[rng.randrange(n)] ^= 1 << rng.randrange(8)
    elif how == "flips":
        for _ in range(20):
            data[rng.randrange(n)] ^= 1 << rng.randrange(8)
    elif how == "cut":
        del data[rng.randrange(n) :]
    elif how == "zeros":
        i = rng.randrange(n)
        length = min(rng.choice([4, 64, 512]), n - i)
        data[i : i + length] = bytes(length)
    elif how == "twice":
        i, j = sorted(rng.sample(range(n + 1), 2))
        data[i:j] = data[i:j] * 2
    elif how == "text":
        data = bytearray(rng.choice([b"{}", b"[]", b"1 2 3\n", b"\x00" * 50, b"null"]))
    if how == "swap" and other != file:
        kept = other.read_bytes()
        other.write_bytes(bytes(data))
        file.write_bytes(kept)
    elif how == "rename":
        file.rename(
            file.with_name(file.stem + rng.choice(["0", "_", ""]) + rng.choice([file.suffix, ".txt", ".png", ".mkv"]))
        )
    elif how == "lose":
        file.unlink()
    else:
        file.write_bytes(b"" if how == "empty" else bytes(data))
    return f"{how} {file.name}"


def attempt(truth: foreign.Foreign, scene: Path, out: Path) -> Content | None:
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
    found = content(rec.read(out))
    shutil.rmtree(out)
    return found


def fuzz(name: str, tmp_path: Path, count: int, **options) -> Counter:
    """Mutations of one format by what became of them."""
    rng, outcome = random.Random(name), Counter()
    truth = foreign.WRITERS[name](tmp_path / "whole", **options)
    scene, out = truth.write_scene(), tmp_path / "out"
    expected = attempt(truth, scene, out)
    assert expected is not None
    spare = tmp_path / "spare"
    (shutil.copytree if truth.path.is_dir() else shutil.copy)(truth.path, spare)
    for i in range(count):
        how = mutate(rng, files_below(truth.path))
        found = attempt(truth, scene, out)
        if found is None:
            outcome["refused"] += 1
        elif not (wrong := wrong_parts(found, expected)):
            outcome["right"] += 1
        else:
            outcome["unnoticed"] += 1
            unnoticed(name, how, wrong, f"{name} {i}: {how}: {wrong}")
        if truth.path.is_dir():
            shutil.rmtree(truth.path)
            shutil.copytree(spare, truth.path)
        else:
            shutil.copy(spare, truth.path)
    print(name, options, dict(outcome))
    return outcome


def unnoticed(name: str, how: str, wrong: list[str], message: str) -> None:
    """What may differ where no checksum is: never the structure."""
    print(message)
    assert wrong != ["structure"], message


CASES = [
    ("redwood", {}),
    ("tum", {}),
    ("ros2", {}),
    ("ros2", {"storage": "sqlite3"}),
    ("ros2", {"seal": True}),
    ("lerobot", {}),
    ("kinect", {}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "options"), CASES)
def test_much_damage(name, options, tmp_path):
    assert fuzz(name, tmp_path, MANY, **options)["refused"] > MANY / 4


@pytest.mark.parametrize(("name", "options"), CASES)
def test_damage(name, options, tmp_path):
    outcome = fuzz(name, tmp_path, FEW, **options)
    assert outcome["refused"] > FEW / 4
