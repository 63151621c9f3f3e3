"""``torchcloth inspect`` as a user meets it."""

import json
from dataclasses import replace

import numpy as np
import pytest
from helpers.command_line import write_twin
from helpers.swinging_cloth import make_episode, make_markers

from torchcloth import recordings
from torchcloth.cli import main
from torchcloth.cli.inspect import describe_verdict


@pytest.fixture
def folder(tmp_path):
    stream = make_markers(lag=0.1, extra={"grid": np.array([8, 8])})
    return recordings.write(make_episode(markers=stream), tmp_path / "episode")


def test_tables_a_result_and_a_picture(folder, tmp_path, capsys):
    out = tmp_path / "deep" / "out"
    assert main(["inspect", str(folder), "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "lag of the observations" in text
    assert "rejected frames, markers" in text
    assert sorted(path.name for path in out.iterdir()) == ["inspection.json", "inspection.png"]
    assert json.loads((out / "inspection.json").read_text())["lag"]["value"] == pytest.approx(0.1, abs=0.01)


def test_json_alone_on_standard_output(folder, capsys):
    assert main(["inspect", str(folder), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["streams"]["markers"]["frames"] == 84
    assert result["episode"] == str(folder)


@pytest.mark.parametrize("damage", ["absent", "not json", "times", "out is a file"])
def test_a_bad_episode_is_one_line_and_nothing_is_written(damage, folder, tmp_path, capsys):
    out = tmp_path / "out"
    if damage == "absent":
        folder = tmp_path / "nowhere"
    elif damage == "not json":
        (folder / "episode.json").write_text("{")
    elif damage == "times":
        with np.load(folder / "markers.npz") as file:
            arrays = dict(file)
        np.savez(folder / "markers.npz", **{**arrays, "t": arrays["t"][::-1]})
    else:
        out.write_text("taken")
    assert main(["inspect", str(folder), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert error.startswith("torchcloth: ")
    assert error.count("\n") == 1
    assert damage == "out is a file" or not out.exists()


def test_depth_images_are_summarised_and_a_damaged_one_is_one_line(tmp_path, capsys):
    image = pytest.importorskip("PIL.Image")
    from torchcloth.observe import DepthCamera, encode_depth

    camera = DepthCamera.azure_kinect_nfov(np.eye(4))
    source = tmp_path / "images"
    source.mkdir()
    depth = np.full((576, 640), 1.25, np.float32)
    depth[:144] = 0
    paths = []
    for k in range(3):
        paths.append(source / f"{k:06d}.png")
        image.fromarray(encode_depth(depth)).save(paths[-1])
    stream = recordings.ImageStream("depth", np.arange(3), np.arange(3) / 30, tuple(paths), (640, 576))
    recorded = recordings.Camera(**camera.to_calibration(), depth_scale=0.001, depth=stream)
    folder = recordings.write(make_episode(cameras={"cam0": recorded}), tmp_path / "episode")
    assert main(["inspect", str(folder), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["depth"]["cam0"]["invalid_fraction"] == pytest.approx(0.25)
    assert result["depth"]["cam0"]["median"] == pytest.approx(1.25)
    assert result["depth"]["cam0"]["has_distortion"]
    assert result["streams"]["cam0/depth"]["rate"] == pytest.approx(30)
    assert main(["inspect", str(folder), "--out", str(tmp_path / "out")]) == 0
    with image.open(tmp_path / "out" / "inspection.png") as drawn:
        pixels = np.asarray(drawn.convert("RGB"), int)
    lower = pixels[pixels.shape[0] // 2 :, : pixels.shape[1] // 2]
    assert (np.ptp(lower, axis=-1) > 40).mean() > 0.1  # the depth in colours, where points would be
    capsys.readouterr()
    (folder / "cam0" / "depth" / "000001.png").write_bytes(b"no image")
    assert main(["inspect", str(folder)]) == 2
    assert capsys.readouterr().err.count("\n") == 1


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    """Folder of an episode that can be fitted."""
    return write_twin(tmp_path_factory.mktemp("episodes") / "twin")


def test_the_last_line_says_that_identify_can_begin(twin, capsys):
    assert main(["inspect", str(twin)]) == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[-1] == "verdict: Ready for identify. The note above says what to mistrust."
    assert printed.index("Streams") < printed.index("note: no lag") < printed.index("Findings")


def test_the_last_line_says_what_must_be_mended_first(twin, tmp_path, capsys):
    """As identify says it: here the unit of the points, and grippers that never close."""
    good = recordings.read(twin)
    let_go = {name: replace(g, closed=np.zeros(len(g.t), bool)) for name, g in good.grippers.items()}
    small = replace(good.points, xyz=1e-3 * np.asarray(good.points.xyz))
    folder = recordings.write(replace(good, grippers=let_go, points=small, path=None), tmp_path / "spoiled")
    assert main(["inspect", str(folder)]) == 0
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("verdict: 2 problems must be mended first: (1) spoiled: the cloud is 0.00")
    assert "; (2) " in line
    assert "nothing holds the cloth; got grippers that are never closed" in line
    assert main(["identify", str(folder), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.strip().removeprefix("torchcloth: ") in line


def test_the_verdict_in_words():
    assert describe_verdict([], []) == "Ready for identify."
    assert describe_verdict([], ["a", "b"]) == "Ready for identify. The 2 notes above say what to mistrust."
    assert describe_verdict(["no motion"], ["a"]) == "1 problem must be mended first: no motion."
    assert describe_verdict(["a", "b"], []) == "2 problems must be mended first: (1) a; (2) b."
