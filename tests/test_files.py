"""Files are there whole or not at all."""

import os
import resource

import pytest
import torch

from torchcloth._utils.files import DISK_FULL_ERROR_NUMBERS, save_tensors, write_atomically, write_text


def test_an_interrupt_while_writing_leaves_the_old_text(tmp_path, monkeypatch):
    path = write_text(tmp_path / "progress.json", "old")
    monkeypatch.setattr(os, "replace", lambda a, b: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_text(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["progress.json"]


def test_a_block_that_fails_leaves_nothing(tmp_path):
    def half():
        with write_atomically(tmp_path / "new" / "a.npz") as part:
            part.write_bytes(b"half")
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        half()
    assert list((tmp_path / "new").iterdir()) == []


def test_the_systems_errors_name_the_file_that_was_asked_for(tmp_path):
    path = tmp_path / f"{'x' * 240}.txt"
    with pytest.raises(OSError, match="File name too long") as caught:
        write_text(path, "new")
    assert caught.value.filename == str(path)


def test_a_disk_that_is_full_is_an_error_of_the_system(tmp_path):
    """Reported under `ulimit -f 8`: torch.save raises "unexpected pos 1472 vs 1302"."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    save_tensors({"x": torch.zeros(3)}, tmp_path / "a.pt")
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, limits[1]))
    try:
        with pytest.raises(OSError, match="File too large") as caught:
            save_tensors({"x": torch.zeros(10_000)}, tmp_path / "a.pt")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert caught.value.filename == str(tmp_path / "a.pt")
    assert caught.value.errno in DISK_FULL_ERROR_NUMBERS
    assert [file.name for file in tmp_path.iterdir()] == ["a.pt"]
    assert torch.load(tmp_path / "a.pt", weights_only=True)["x"].shape == (3,)


def test_the_suffix_is_kept(tmp_path):
    """Libraries choose the format by it, and some add their own where there is none."""
    with write_atomically(tmp_path / "a.npz") as part:
        assert part.suffix == ".npz"
        part.write_bytes(b"whole")
    assert (tmp_path / "a.npz").read_bytes() == b"whole"
