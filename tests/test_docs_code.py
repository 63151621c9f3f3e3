"""Every Python block of the README and the documentation runs as it stands.

The blocks of one page run in order, in one namespace, in an empty folder. ``PREPARE`` puts there what the page's text
assumes: files of a reader, or names that an earlier sentence describes. ``CHECK`` holds assertions on the results.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import foreign_formats
from helpers.arm_view import write_arm_view
from helpers.bench_files import write_bar

import torchcloth as tc
from torchcloth import recordings
from torchcloth.cli import main
from torchcloth.diagnosis.causes import hypotheses

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
PREPARE: dict[str, Callable[[Path], dict[str, Any]]] = {}  # page: files and names that its text assumes
CHECK: dict[str, Callable[[dict[str, Any]], None]] = {}  # page: what must hold after its blocks
SLOW_PAGES = {  # they take ten seconds and more
    "docs/how-to/new-episode.md",
    "docs/how-to/record.md",
    "docs/how-to/simulate-recordings.md",
    "docs/tutorials/from-depth-images-to-a-fabric.md",
    "docs/tutorials/plan-an-arm-motion.md",
    "docs/tutorials/write-your-own-effect.md",
}
CLOTH_HEIGHT_M = 0.3  # over the table of the depth images
HALF_SHEET_M = 0.1


def prepare_arm(folder: Path) -> dict[str, Any]:
    """Write a Rizon's URDF under another name, with another name of the tool."""
    urdf = Path(tc.robots.__file__).parent / "urdf" / "rizon4.urdf"
    (folder / "my.urdf").write_text(urdf.read_text().replace('"tcp_closed"', '"tip"'))
    return {}


def prepare_depth_images(folder: Path) -> dict[str, Any]:
    """Write the depth images of a camera 1 m over a table that looks down on a square of cloth."""
    pose = np.array([[0.0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]])
    depth = np.full((120, 160), 1000, np.uint16)
    depth[40:80, 60:100] = round(1000 * (1 - CLOTH_HEIGHT_M))
    images = folder / "my_episode" / "cam0" / "depth"
    images.mkdir(parents=True)
    for i in range(2):
        (images / f"{i:06d}.png").write_bytes(foreign_formats.encode_png(depth))
    (images.parent / "timestamps.csv").write_text("frame,t_color,t_depth\n0,,0.0\n1,,0.5\n")
    matrix = [[140.0, 0, 79.5], [0, 140.0, 59.5], [0, 0, 1]]
    size = {"width": 160, "height": 120, "depth_scale": 0.001}
    message = {**foreign_formats.SCENE_DESCRIPTION, "format": "torchcloth-recording", "version": 1}
    message["cloth"] = message["cloth"] | {"sheet": {"width": 2 * HALF_SHEET_M, "height": 2 * HALF_SHEET_M}}
    message["cameras"] = {"cam0": {**size, "K": matrix, "T_world_camera": pose.tolist()}}
    (folder / "my_episode" / "episode.json").write_text(json.dumps(message))
    return {}


def prepare_bench(folder: Path) -> dict[str, Any]:
    """Write joints in CSV and depth images in PNG, of a sheet on a bar."""
    write_bar(folder / "bench")
    return {}


def prepare_arm_view(folder: Path) -> dict[str, Any]:
    """Write an episode with an arm in the view of its camera."""
    return {"truth": write_arm_view(folder / "my_episode")[1]}


PREPARE |= {
    "docs/how-to/record.md": prepare_arm_view,
    "docs/how-to/own-arm.md": prepare_arm,
    "docs/how-to/import-recordings.md": prepare_depth_images,
    "docs/how-to/new-episode.md": prepare_bench,
}


def check_layer(namespace: dict[str, Any]) -> None:
    assert torch.isfinite(namespace["q"].grad).all()
    assert float(namespace["q"].grad.abs().max()) > 0
    assert namespace["cloth"].material.youngs_modulus.raw.grad.abs().item() > 0


def check_shirt(namespace: dict[str, Any]) -> None:
    """Check that the held shoulder follows the hand, and that no vertex falls through the table."""
    frames, shoulder = namespace["lifted"], namespace["mesh"].places["left shoulder"]
    assert torch.isfinite(frames).all()
    torch.testing.assert_close(frames[-1, shoulder, 2] - frames[0, shoulder, 2], torch.full((len(shoulder),), 0.04))
    assert float(frames[..., 2].min()) > -0.0061


def check_arm(namespace: dict[str, Any]) -> None:
    assert namespace["rig"]["hand"].frame == "tip"
    assert set(namespace["plan"].q) == {"hand"}


def check_imports(namespace: dict[str, Any]) -> None:
    """The cloud and the first shape lie where the cloth is, and the episode from arrays can be fitted."""
    points = recordings.read("my_episode_points").require("points")
    np.testing.assert_array_equal(points.t, [0, 0.5])
    assert points.counts.min() > 150
    np.testing.assert_allclose(points.xyz[:, 2], CLOTH_HEIGHT_M, atol=1e-4)
    half_side = 40 / 140 * (1 - CLOTH_HEIGHT_M) / 2
    assert 0.85 * half_side < np.abs(points.xyz[:, :2] - [0.5, 0]).max() <= half_side
    first = recordings.read("my_episode_ready").cloth.initial_vertices
    np.testing.assert_allclose(first[:, 2], CLOTH_HEIGHT_M, atol=2e-3)
    np.testing.assert_allclose(np.ptp(first[:, :2], axis=0), 2 * HALF_SHEET_M, atol=5e-3)
    assert main(["identify", "from_arrays", "--out", "fit", "--fit", "air.normal", "--iterations", "1"]) == 0
    assert json.loads(Path("fit/identification.json").read_text())["parameters"]["air.normal"]


def check_new_episode(namespace: dict[str, Any]) -> None:
    assert len(recordings.read("from_bench").require("points")) > 10
    assert Path("from_bench/new.png").is_file()


def check_tension(namespace: dict[str, Any]) -> None:
    assert namespace["fit"].parameters["shear_modulus"].identifiable
    assert main(["predict", "nylon", "--angle", "30", "--out", "thirty"]) == 0


def check_tutorial(namespace: dict[str, Any]) -> None:
    """The first shape is near the one of the shipped recording, and every frame shows most of the cloth."""
    episode = recordings.read("my_episode_ready")
    x, true_x = (one.cloth.initial_vertices for one in (episode, namespace["source"]))
    np.testing.assert_allclose(x.min(0), true_x.min(0), atol=0.01)
    np.testing.assert_allclose(x.max(0), true_x.max(0), atol=0.01)
    assert min(episode.require("points").counts) > 1500


def check_arm_view(namespace: dict[str, Any]) -> None:
    np.testing.assert_allclose(namespace["pose"].T_world_camera, namespace["truth"], atol=5e-3)


CHECK |= {
    "docs/how-to/record.md": check_arm_view,
    "docs/how-to/use-the-layer.md": check_shirt,
    "README.md": check_layer,
    "docs/how-to/own-arm.md": check_arm,
    "docs/how-to/import-recordings.md": check_imports,
    "docs/how-to/new-episode.md": check_new_episode,
    "docs/how-to/tension-machine.md": check_tension,
    "docs/tutorials/from-depth-images-to-a-fabric.md": check_tutorial,
}


def read_blocks(page: Path) -> list[str]:
    return BLOCK.findall(page.read_text(encoding="utf-8"))


def page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def list_pages() -> list[Any]:
    names = [page_name(page) for page in PAGES if read_blocks(page)]
    return [pytest.param(name, id=name, marks=[pytest.mark.slow] * (name in SLOW_PAGES)) for name in names]


@pytest.mark.filterwarnings("ignore:.*is under way where it ends")  # the shipped recording is cut within its motion
@pytest.mark.parametrize("page", list_pages())
def test_the_blocks_of_a_page_run(page, tmp_path, monkeypatch):
    torch.set_default_dtype(torch.float32)  # as in a reader's session
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(hypotheses, "_registered", [])  # a page may register a cause of its own
    namespace = PREPARE.get(page, lambda folder: {})(tmp_path)
    for number, block in enumerate(read_blocks(ROOT / page), start=1):
        exec(compile(block, f"{page}, block {number}", "exec"), namespace)
    CHECK.get(page, lambda namespace: None)(namespace)


def test_every_prepared_page_exists():
    assert {*PREPARE, *CHECK, *SLOW_PAGES} <= {page_name(page) for page in PAGES}
