"""The JSON examples in docs/reference/episode.md and docs/how-to/import-recordings.md can be read."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from helpers import foreign_formats

from torchcloth import recordings as rec
from torchcloth.recordings import formats
from torchcloth.recordings.formats import scene_file_keys

DOCS = Path(__file__).resolve().parents[3] / "docs"


def json_blocks(page: str) -> list[str]:
    return re.findall(r"```json\n(.*?)```", (DOCS / page).read_text(), flags=re.DOTALL)


def test_the_episode_can_be_read(tmp_path):
    (text,) = json_blocks("reference/episode.md")
    (tmp_path / "episode.json").write_text(text)
    pose = {"t": [0.0, 1.0], "position": np.zeros((2, 3)), "quat_wxyz": [[1.0, 0, 0, 0]] * 2, "closed": [True, True]}
    np.savez(tmp_path / "motion.npz", **{f"left/{key}": np.array(value) for key, value in pose.items()})
    recording = rec.read(tmp_path)
    assert not recording.extra
    assert recording.cloth.sheet == (0.3, 0.3)
    np.testing.assert_array_equal(recording.cameras["cam0"].distortion, [0.2624, -0.9531, -0.0054, 0.0026, 1.1633])
    scene_file_keys.check_keys(json.loads(text), "docs/reference/episode.md")


def test_the_scene_files_can_be_read(tmp_path):
    tum, ros2, pcd = json_blocks("how-to/import-recordings.md")
    scene_file_keys.check_keys(json.loads(ros2), "docs/how-to/import-recordings.md")
    truth = foreign_formats.write_tum(tmp_path)
    (truth.path / "groundtruth.txt").unlink()
    truth.scene = json.loads(tum)
    assert formats.read(truth.path, scene=truth.write_scene()).cameras["cam0"].K[0, 0] == 517.3
    truth = foreign_formats.write_pcd(tmp_path)
    truth.scene = json.loads(pcd)
    np.testing.assert_allclose(
        formats.read(truth.path, scene=truth.write_scene()).points.xyz[:, 0], truth.arrays["points/xyz"][:, 1] + 0.5
    )
