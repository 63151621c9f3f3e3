"""``torchcloth convert`` as a user meets it."""

from __future__ import annotations

import pytest
from helpers import foreign_formats

from torchcloth import recordings as rec
from torchcloth.cli import convert, main
from torchcloth.recordings import formats


def call(*arguments) -> int:
    return main(["convert", *map(str, arguments)])


def test_the_choices_are_the_formats():
    assert set(convert.FORMATS) == set(formats.FORMAT_NAMES)


def test_a_folder_becomes_an_episode_and_the_episode_mcap(tmp_path, capsys):
    truth = foreign_formats.write_tum(tmp_path)
    scene, episode, bag = truth.write_scene(), tmp_path / "ep", tmp_path / "ep.mcap"
    assert call(truth.path, episode, "--scene", scene, "--from", "tum") == 0
    message = capsys.readouterr().out
    assert "cam0/depth" in message
    assert "16 x 12 px" in message
    assert "30.0" in message
    assert "cam0/depth: 0.0002 m per unit, a median depth of 0." in message
    assert call(episode, bag) == 0
    assert call(bag, tmp_path / "back") == 0
    images = [rec.read(p).cameras["cam0"].color for p in (episode, tmp_path / "back")]
    assert [p.read_bytes() for p in images[0].paths] == [p.read_bytes() for p in images[1].paths]


def test_a_refusal_is_one_line_and_leaves_nothing(tmp_path, capsys):
    truth = foreign_formats.write_tum(tmp_path)
    out = tmp_path / "out" / "ep"
    scene = truth.write_scene()
    for arguments, match in (
        ([], "does not contain everything"),
        (["--scene", scene, "--from", "redwood"], "mislabelled; got content of tum; expected redwood"),
        (["--scene", tmp_path / "lost.json"], "lost.json is missing"),
        (["--scene", scene, "--episode", "3"], "holds one episode"),
    ):
        assert call(truth.path, out, *arguments) == 2
        message = capsys.readouterr().err
        assert message.startswith("torchcloth: ")
        assert message.count("\n") == 1
        assert match in message
    image = sorted((truth.path / "depth").iterdir())[2]
    image.write_bytes(image.read_bytes()[:-20])
    assert call(truth.path, out, "--scene", scene) == 2
    assert f"{image}: depth image 2 cannot be decoded" in capsys.readouterr().err
    assert not out.exists()
    assert not any(out.parent.glob("*"))


@pytest.mark.parametrize("suffix", ["", ".mcap"])
def test_nothing_is_overwritten_unasked(tmp_path, capsys, suffix):
    truth = foreign_formats.write_tum(tmp_path)
    scene, out = truth.write_scene(), tmp_path / f"ep{suffix}"
    assert call(truth.path, out, "--scene", scene) == 0
    capsys.readouterr()
    assert call(truth.path, out, "--scene", scene) == 2
    assert "DST exists" in capsys.readouterr().err
    assert call(truth.path, out, "--scene", scene, "--overwrite") == 0


def test_a_scene_is_not_overwritten_by_what_it_describes(tmp_path, capsys):
    truth, out = foreign_formats.write_tum(tmp_path), tmp_path / "ep"
    out.mkdir()
    scene = truth.write_scene().rename(out / "scene.json")
    assert call(truth.path, out, "--scene", scene, "--overwrite") == 2
    assert "--scene is in DST" in capsys.readouterr().err
    assert list(out.iterdir()) == [scene]


def test_the_target_must_be_what_is_written(tmp_path, capsys):
    """An episode folder that looks like a bag, and an episode written over itself."""
    truth = foreign_formats.write_tum(tmp_path)
    episode = tmp_path / "ep_0.15"  # a dot alone makes no file
    assert call(truth.path, episode, "--scene", truth.write_scene()) == 0
    before = sorted((p, p.stat().st_mtime_ns) for p in episode.rglob("*"))
    for target, match in (
        ("a.bag", "DST cannot be a .bag file"),
        ("a.db3", "DST cannot be a .db3 file"),
        ("ep_0.15/../ep_0.15", "DST is SRC or contains it"),
    ):
        assert call(episode, tmp_path / target, "--overwrite") == 2
        assert match in capsys.readouterr().err
    assert not (tmp_path / "a.bag").exists()
    assert sorted((p, p.stat().st_mtime_ns) for p in episode.rglob("*")) == before
