"""Fuzzing of the readers: seeds are judged, targets notice planted faults, and a short search shows none."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path
from random import Random

import numpy as np
import pytest
import torch

pytest.importorskip("lightning")
pytest.importorskip("rosbags")
pytest.importorskip("yourdfpy")

from torchcloth.meshes import Mesh, obj, shapes
from torchcloth.recordings import checks, formats, streams
from torchcloth.recordings.formats import mcap_checksums
from torchcloth.training.validation.fuzz import command, mutations
from torchcloth.training.validation.fuzz.formats import FORMATS, is_accepted, strict_arithmetic
from torchcloth.training.validation.fuzz.invariants import BrokenPromise

ROOT = Path(__file__).resolve().parents[3]
SEEDS = sorted((Path(__file__).parent / "seeds").glob("*/*"))
SEED_OF = {path.parent.name: path.read_bytes() for path in reversed(SEEDS) if not path.name.startswith("found")}
MAX_SEEDS_BYTES = 200_000
SEARCH_SECONDS = 8


def test_every_format_has_a_small_seed():
    assert SEED_OF.keys() == FORMATS.keys()
    assert sum(path.stat().st_size for path in SEEDS) < MAX_SEEDS_BYTES


@pytest.mark.parametrize("path", SEEDS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_a_seed_is_refused_by_one_line_or_keeps_the_promises(path):
    """Seeds whose names begin with "found" once showed a fault."""
    with strict_arithmetic():
        accepted = is_accepted(FORMATS[path.parent.name], path.read_bytes())
    assert accepted or path.name.startswith("found")


def double(values, place):
    return 2 * values


def turned_over(vertices, faces, uv=None, places=None):
    """A mesh whose rest shape has negative areas."""
    faces = np.asarray(faces)
    return Mesh(np.asarray(vertices, float), faces, -np.asarray(vertices)[faces][..., :2][:, [0, 2, 1]], None)


def with_json(data: bytes, *path, value) -> bytes:
    tree = node = json.loads(data)
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    return json.dumps(tree).encode()


def with_reversed_times(data: bytes) -> bytes:
    arrays = dict(np.load(io.BytesIO(data)))
    file = io.BytesIO()
    np.savez(file, **{key: value[::-1] if key == "t" else value for key, value in arrays.items()})
    return file.getvalue()


def with_infinite_values(data: bytes) -> bytes:
    content, file = torch.load(io.BytesIO(data), weights_only=True), io.BytesIO()
    key = next(iter(content["state_dict"]))
    content["state_dict"][key] = torch.full_like(content["state_dict"][key], float("inf"))
    torch.save(content, file)
    return file.getvalue()


def same(data: bytes) -> bytes:
    return data


PLANTED = {  # format: (what is broken: owner, name, replacement; the input that shows it)
    "obj": (shapes.Mesh, "build", staticmethod(turned_over), same),
    "ply": (shapes.Mesh, "build", staticmethod(turned_over), same),
    "npz": (checks, "check_increasing", lambda t, place: None, with_reversed_times),
    "episode": (
        checks,
        "check_transform",
        lambda matrix, place: matrix,
        lambda data: with_json(data, "robots", "right", "T_world_base", 0, 0, value=2.0),
    ),
    "urdf": ("torchcloth.robots.description", "_axis", lambda joint: torch.tensor([0.0, 0.0, 2.0]).double(), same),
    "tcm": (
        "torchcloth.diagnosis.models.model_content.ModelContent",
        "covariance",
        lambda content: -torch.eye(len(content.matrix)),
        same,
    ),
    "mcap": (checks, "normalise_unit", double, same),
    "sqlite": (checks, "normalise_unit", double, same),
    "rosbag1": (checks, "normalise_unit", double, same),
    "tum": (checks, "check_transform", lambda matrix, place: 2 * matrix, same),
    "pcd": (checks, "normalise_unit", double, same),
    "bench": (checks, "check_transform", lambda matrix, place: 2 * matrix, same),
    "tension": (
        "torchcloth.recordings.tension.ForceDisplacement",
        "strain",
        property(lambda table: np.full(3, np.nan)),
        same,
    ),
    "checkpoint": ("torchcloth.training.fit.checkpoints", "_is_finite", lambda node: True, with_infinite_values),
}
READERS = {  # the function that reads the bytes of a format
    "obj": (obj, "parse"),
    "ply": (shapes, "_check_polygons"),
    "npz": (streams, "parse_points"),
    "episode": ("torchcloth.recordings.scene", "read_cloth"),
    "urdf": ("torchcloth.robots.description", "parse_urdf"),
    "tcm": ("torchcloth.diagnosis.models.model_file", "build_base_model"),
    "mcap": (formats.ROS2_IMPORTER.read.__globals__["embedded"], "restore_files"),
    "sqlite": (formats.ROS2_IMPORTER.read.__globals__["embedded"], "restore_files"),
    "rosbag1": (formats.ROS2_IMPORTER.read.__globals__["embedded"], "restore_files"),
    "tum": ("torchcloth.recordings.formats.tum", "_list"),
    "pcd": ("torchcloth.recordings.formats.pcd_file", "_read_entries"),
    "bench": ("torchcloth.recordings.formats.tables", "_split"),
    "tension": ("torchcloth.recordings.tension", "_columns"),
    "checkpoint": ("torchcloth.training.fit.module", "read_checkpoint"),
}


def patch(monkeypatch, owner, name, value):
    if isinstance(owner, str):
        monkeypatch.setattr(f"{owner}.{name}", value)
    else:
        monkeypatch.setattr(owner, name, value)


@pytest.mark.parametrize("name", FORMATS)
def test_a_target_notices_what_is_silently_wrong(name, monkeypatch):
    owner, attribute, replacement, spoil = PLANTED[name]
    data = spoil(SEED_OF[name])
    assert is_accepted(FORMATS[name], data) is (spoil is same)
    patch(monkeypatch, owner, attribute, replacement)
    with pytest.raises(BrokenPromise):
        is_accepted(FORMATS[name], data)


@pytest.mark.parametrize("name", FORMATS)
def test_a_target_lets_other_errors_through(name, monkeypatch):
    def fail(*args, **kwargs):
        raise ZeroDivisionError("planted")

    patch(monkeypatch, *READERS[name], fail)
    with pytest.raises(ZeroDivisionError, match="planted"):
        is_accepted(FORMATS[name], SEED_OF[name])


def test_an_overflow_is_a_fault():
    with strict_arithmetic(), pytest.raises(RuntimeWarning):
        np.float64(1e300) * np.float64(1e300)


def reversed_bytes(data: bytes, limit: int) -> bytes:
    return data[::-1][:limit]


@pytest.mark.parametrize("name", FORMATS)
def test_mutations_repeat_and_change_the_file(name):
    fuzzed, data = FORMATS[name], SEED_OF[name]
    changed = [fuzzed.mutate(Random(i), data, 2 * len(data), reversed_bytes) for i in range(30)]
    assert changed == [fuzzed.mutate(Random(i), data, 2 * len(data), reversed_bytes) for i in range(30)]
    assert all(len(c) <= 2 * len(data) for c in changed)
    assert sum(c != data for c in changed) > 20


def test_a_changed_archive_is_sound_outside_of_its_members():
    sound = 0
    for i in range(40):
        data = mutations.mutate_zip(Random(i), SEED_OF["npz"], 10_000, reversed_bytes)
        if zipfile.is_zipfile(io.BytesIO(data)):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                sound += archive.testzip() is None
    assert sound > 30


def test_changes_inside_of_mcap_chunks_have_right_checksums(tmp_path):
    """Else a reader would refuse every input for its checksum, and nothing behind it would be tried."""
    path, accepted, data = tmp_path / "bag.mcap", 0, (Path(__file__).parent / "seeds/mcap/checksums").read_bytes()
    path.write_bytes(data)
    assert mcap_checksums.verify_checksums(path) == "all bytes"
    for i in range(40):
        path.write_bytes(mutations.mutate_mcap(Random(i), data, len(data), reversed_bytes))
        try:
            accepted += mcap_checksums.verify_checksums(path) == "all bytes"
        except Exception:
            continue
    assert accepted > 20


def test_without_atheris_the_command_says_so_in_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "atheris", None)
    monkeypatch.chdir(ROOT)
    assert command.main(["obj", "--inputs", "10"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert 'pip install "torchcloth[fuzz]"' in error


def test_without_seeds_the_command_says_where_they_are(tmp_path, capsys):
    assert command.main(["obj", "--seeds", str(tmp_path)]) == 2
    assert "root of the repository" in capsys.readouterr().err


@pytest.mark.parametrize("option", [["--inputs", "0"], ["--seconds", "-1"], ["--seconds", "nan"]])
def test_a_search_without_an_end_or_a_beginning_is_refused(monkeypatch, capsys, option):
    monkeypatch.chdir(ROOT)
    assert command.main(["obj", *option]) == 2
    assert "expected above 0" in capsys.readouterr().err


def search(*lines: str, format_name: str, corpus: Path) -> subprocess.CompletedProcess:
    """Run the command in a process of its own, after these lines of Python."""
    pytest.importorskip("atheris")
    options = [format_name, "--seconds", str(SEARCH_SECONDS), "--corpus", str(corpus)]
    code = "\n".join([*lines, "from torchcloth.training.validation.fuzz.command import main", f"main({options!r})"])
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=environment, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_a_short_search_shows_no_fault(name, tmp_path):
    done = search(format_name=name, corpus=tmp_path)
    print(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert ", 0 faults" in done.stdout
    assert len(list(tmp_path.iterdir())) > 1


@pytest.mark.slow
def test_a_search_shows_a_planted_fault(tmp_path):
    """A branch that no seed enters: texture coordinates that count from the end."""
    plant = ["from torchcloth.meshes import obj", "corner = obj._corner"]
    plant += [
        "def planted(item, *counts):",
        "    if '/-' in item: raise KeyError('planted')",
        "    return corner(item, *counts)",
    ]
    done = search(*plant, "obj._corner = planted", format_name="obj", corpus=tmp_path)
    assert done.returncode == 1
    (line,) = [line for line in done.stdout.splitlines() if "KeyError" in line]
    assert b"/-" in Path(line.rpartition(": ")[2]).read_bytes()
