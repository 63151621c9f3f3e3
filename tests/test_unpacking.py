"""Files that would fill the memory are refused by the sizes that they declare, before anything is unpacked."""

from __future__ import annotations

import io
import tracemalloc
import zipfile

import numpy as np
import pytest

import torchcloth as tc
from torchcloth import planning
from torchcloth import recordings as rec
from torchcloth._utils import unpacking
from torchcloth.diagnosis.models.model_content import ARRAYS_FILE, CONTENT_FILE, FORMAT_VERSION
from torchcloth.errors import RecordingError

DECLARED_BYTES = 80 << 20


@pytest.fixture(scope="module")
def bomb() -> bytes:
    """An NPZ of 0.1 MB with one array of 80 MB."""
    header, file = io.BytesIO(), io.BytesIO()
    declared = {"descr": "<f8", "fortran_order": False, "shape": (DECLARED_BYTES // 8,)}
    np.lib.format.write_array_header_1_0(header, declared)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("xyz.npy", "w") as member:
        member.write(header.getvalue())
        for _ in range(DECLARED_BYTES >> 20):
            member.write(bytes(1 << 20))
    return file.getvalue()


def refuse(call, path, match="unpacks to too much; got 0.0781 GiB .*set TORCHCLOTH_MAX_UNPACKED_GIB"):
    tracemalloc.start()
    with pytest.raises(RecordingError, match=match) as caught:
        call(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < DECLARED_BYTES / 10
    assert str(path) in str(caught.value)


def test_an_episode(bomb, tmp_path):
    (tmp_path / "points.npz").write_bytes(bomb)
    (tmp_path / "episode.json").write_text('{"format": "torchcloth-recording", "version": 1}')
    refuse(rec.read, tmp_path)


def test_a_goal(bomb, tmp_path):
    (tmp_path / "goal.npz").write_bytes(bomb)
    refuse(planning.read_goal, tmp_path / "goal.npz")


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_a_model_file(bomb, tmp_path, method):
    """Its arrays are an archive within the archive; either may be the one that grows."""
    with zipfile.ZipFile(tmp_path / "cloth.tcm", "w", method) as file:
        content = f'{{"format": {FORMAT_VERSION}}}' if method == zipfile.ZIP_STORED else " " * DECLARED_BYTES
        file.writestr(CONTENT_FILE, content)
        file.writestr(ARRAYS_FILE, bomb)
    with pytest.raises(RecordingError, match="unpacks to too much"):
        tc.load(tmp_path / "cloth.tcm")


def test_an_array_that_declares_more_than_there_is(tmp_path):
    header = io.BytesIO()
    declared = {"descr": "<f8", "fortran_order": False, "shape": (1 << 33, 3)}
    np.lib.format.write_array_header_1_0(header, declared)
    (tmp_path / "goal.npy").write_bytes(header.getvalue() + bytes(100))
    refuse(planning.read_goal, tmp_path / "goal.npy", match="is cut off; got .* bytes; expected 206158430208 bytes")


def test_the_limit_can_be_set(bomb, monkeypatch):
    monkeypatch.setenv(unpacking.UNPACKED_LIMIT_VARIABLE, "0.2")
    unpacking.check_unpacked_size(DECLARED_BYTES, len(bomb), "points.npz")
    monkeypatch.setenv(unpacking.UNPACKED_LIMIT_VARIABLE, "0.05")
    with pytest.raises(RecordingError, match=r"expected at most 0\.05 GiB;"):
        unpacking.check_unpacked_size(DECLARED_BYTES, DECLARED_BYTES, "points.npz")
    monkeypatch.setenv(unpacking.UNPACKED_LIMIT_VARIABLE, "much")
    with pytest.raises(tc.errors.InvalidInput, match="TORCHCLOTH_MAX_UNPACKED_GIB; got 'much'"):
        unpacking.check_unpacked_size(1, 1, "points.npz")


def test_more_than_the_absolute_limit():
    with pytest.raises(RecordingError, match="got 9 GiB in a file of 5 GiB; expected at most 8 GiB"):
        unpacking.check_unpacked_size(9 << 30, 5 << 30, "points.npz")
