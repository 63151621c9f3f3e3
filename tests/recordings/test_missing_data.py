"""Data that were recorded but do not lie here are named, and never read as "not recorded"."""

from __future__ import annotations

import pytest
from helpers import foreign_formats

from torchcloth import recordings as rec
from torchcloth.errors import RecordingError
from torchcloth.recordings import formats

EPISODE_PARTS = (
    "episode.json",
    "cloth.obj",
    "cloth_initial.npy",
    "motion.npz",
    "points.npz",
    "markers.npz",
    "truth.npz",
)
CAMERA_PARTS = ("cam0/depth", "cam0/timestamps.csv", "cam0/depth/000003.png")


@pytest.mark.parametrize("name", EPISODE_PARTS + CAMERA_PARTS)
def test_a_link_to_nothing_is_no_absent_stream(episode, name):
    path = episode / name
    path.rename(episode.parent / "elsewhere")
    path.symlink_to("../.annex/objects/SHA256E-s1--1")
    with pytest.raises(
        RecordingError, match=r"is a link to nothing; got a link to \.\./\.annex.*fetch the data"
    ) as caught:
        rec.read(episode, with_truth=True)
    assert str(path) in str(caught.value)


def test_an_episode_that_is_a_link_to_nothing(tmp_path):
    (tmp_path / "ep").symlink_to("gone")
    with pytest.raises(RecordingError, match="ep is a link to nothing"):
        rec.read(tmp_path / "ep")
    with pytest.raises(RecordingError, match="ep is a link to nothing"):
        formats.read(tmp_path / "ep")


def test_a_link_to_data_is_read(episode):
    (episode / "points.npz").rename(episode.parent / "store.npz")
    (episode / "points.npz").symlink_to(episode.parent / "store.npz")
    assert rec.read(episode).points is not None


@pytest.mark.parametrize(
    ("text", "command"),
    [
        ("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n", "git lfs pull"),
        ("/annex/objects/SHA256E-s9--0.npz\n", "git annex get"),
    ],
)
@pytest.mark.parametrize("name", ["points.npz", "cam0/depth/000003.png"])
def test_a_placeholder_of_a_file_says_how_to_fetch_it(episode, name, text, command):
    (episode / name).write_text(text)
    with pytest.raises(RecordingError, match=f"{name} was not fetched; got the placeholder of .*run {command}"):
        rec.read(episode).cameras["cam0"].depth.load(1)


@pytest.mark.parametrize(
    ("name", "part"),
    [
        ("tum", "groundtruth.txt"),
        ("tum", "depth.txt"),
        ("redwood", "trajectory.log"),
        ("redwood", "camera_intrinsic.json"),
        ("redwood", "depth"),
    ],
)
def test_a_link_to_nothing_in_another_format(tmp_path, name, part):
    truth = foreign_formats.WRITERS[name](tmp_path)
    path = truth.path / part
    path.rename(tmp_path / "elsewhere")
    path.symlink_to("gone")
    with pytest.raises(RecordingError, match=f"{part} is a link to nothing"):
        formats.read(truth.path, scene=truth.write_scene())
