"""The examples in docs/reference/episode.md and docs/how-to/import-recordings.md run as they stand."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from helpers import foreign_formats

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.recordings import formats
from torchcloth.recordings.formats import sidecar_schema

DOCS = Path(__file__).resolve().parents[3] / "docs"
HEIGHT = 0.3  # m, of the cloth over the table


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", (DOCS / page).read_text(), flags=re.DOTALL)


def test_the_episode_can_be_read(tmp_path):
    (text,) = blocks("reference/episode.md", "json")
    (tmp_path / "episode.json").write_text(text)
    pose = {"t": [0.0, 1.0], "position": np.zeros((2, 3)), "quat_wxyz": [[1.0, 0, 0, 0]] * 2, "closed": [True, True]}
    np.savez(tmp_path / "motion.npz", **{f"left/{key}": np.array(value) for key, value in pose.items()})
    recording = rec.read(tmp_path)
    assert not recording.extra
    assert recording.cloth.sheet == (0.3, 0.3)
    np.testing.assert_array_equal(recording.cameras["cam0"].distortion, [0.2624, -0.9531, -0.0054, 0.0026, 1.1633])
    sidecar_schema.check_keys(json.loads(text), "docs/reference/episode.md")


def test_an_arm_of_ones_own(tmp_path, monkeypatch):
    """A Rizon's URDF under another name; the plan itself is tested elsewhere."""
    monkeypatch.chdir(tmp_path)
    urdf = Path(tc.robots.__file__).parent / "urdf" / "rizon4.urdf"
    (tmp_path / "my.urdf").write_text(urdf.read_text().replace('"tcp_closed"', '"tip"'))
    monkeypatch.setattr(tc.robots, "plan", lambda rig, action: (rig, action))
    (text,) = blocks("how-to/own-arm.md", "python")
    custom = {}
    exec(compile(text, "docs/how-to/own-arm.md", "exec"), custom)
    rig, action = custom["plan"]
    assert rig["hand"].frame == "tip"
    assert set(action.motion) == {"hand"}


def test_every_word_is_explained():
    page = (DOCS / "reference" / "episode.md").read_text()
    every = [
        sidecar_schema.SIDECAR_KEYS,
        *sidecar_schema.OBJECT_KEYS.values(),
        *sidecar_schema.NAMED_GROUP_KEYS.values(),
        sidecar_schema.PLANE_KEYS,
    ]
    assert not [word for group in every for word in group if word != "source" and word not in page]


def test_the_scenes(tmp_path):
    tum, ros2 = blocks("how-to/import-recordings.md", "json")
    sidecar_schema.check_keys(json.loads(ros2), "docs/how-to/import-recordings.md")
    truth = foreign_formats.tum(tmp_path)
    (truth.path / "groundtruth.txt").unlink()
    truth.scene = json.loads(tum)
    assert formats.read(truth.path, scene=truth.write_scene()).cameras["cam0"].K[0, 0] == 517.3


def test_depth_images_become_points(tmp_path, monkeypatch):
    """A camera 1 m over a table looks down on a square of cloth, 0.3 m above it."""
    monkeypatch.chdir(tmp_path)
    pose = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
    depth = np.full((120, 160), 1000, np.uint16)
    depth[40:80, 60:100] = round(1000 * (1 - HEIGHT))
    images = tmp_path / "my_episode" / "cam0" / "depth"
    images.mkdir(parents=True)
    for i in range(2):
        (images / f"{i:06d}.png").write_bytes(foreign_formats.png(depth))
    (images.parent / "timestamps.csv").write_text("frame,t_color,t_depth\n0,,0.0\n1,,0.5\n")
    matrix = [[140.0, 0, 79.5], [0, 140.0, 59.5], [0, 0, 1]]
    size = {"width": 160, "height": 120, "depth_scale": 0.001}
    message = {**foreign_formats.KNOWN, "format": "torchcloth-recording", "version": 1}
    message["cloth"] = message["cloth"] | {"sheet": {"width": 0.2, "height": 0.2}}
    message["cameras"] = {"cam0": {**size, "K": matrix, "T_world_camera": pose.tolist()}}
    (tmp_path / "my_episode" / "episode.json").write_text(json.dumps(message))
    cut_out, laid_on = blocks("how-to/import-recordings.md", "python")
    exec(compile(cut_out, "docs/how-to/import-recordings.md", "exec"), {})
    points = rec.read("my_episode_points").require("points")
    np.testing.assert_array_equal(points.t, [0, 0.5])
    assert points.counts.min() > 150
    np.testing.assert_allclose(points.xyz[:, 2], HEIGHT, atol=1e-4)
    side = 40 / 140 * (1 - HEIGHT) / 2
    assert 0.85 * side < np.abs(points.xyz[:, :2] - [0.5, 0]).max() <= side
    exec(compile(laid_on, "docs/how-to/import-recordings.md", "exec"), {})
    first = rec.read("my_episode_ready").cloth.initial_vertices
    np.testing.assert_allclose(first[:, 2], HEIGHT, atol=2e-3)
    np.testing.assert_allclose(np.ptp(first[:, :2], axis=0), 0.2, atol=5e-3)
