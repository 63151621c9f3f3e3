"""Messages are one line of bounded length that no file can use to steer a terminal."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from helpers.rich_recording import make_recording

from torchcloth import cli
from torchcloth import recordings as rec
from torchcloth.errors import InvalidInput, RecordingError, to_message_part

CLEAR_SCREEN, REVERSED = "left\x1b[2J\x07", "left\u202etxt"


def test_a_message_holds_no_control_characters():
    error = InvalidInput("grasp\n'a\x1b[31m'", got="\x9b2J \u202eevil", expected="tab\there")
    assert str(error) == r"grasp 'a\x1b[31m'; got \x9b2J \u202eevil; expected tab here"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_a_message_has_a_bounded_length():
    text = str(InvalidInput("x" * 10**6, got="y" * 10**6, expected="z" * 10**6, remedy="w" * 10**6))
    assert len(text) < 4100
    assert to_message_part("a" * 1000) == "a" * 1000
    long = to_message_part("begin " + "a" * 2000 + " end")
    assert long.startswith("begin")
    assert long.endswith("end")


def test_letters_of_all_languages_stay():
    assert to_message_part("Ärmel 左 рука ±0.1 µm") == "Ärmel 左 рука ±0.1 µm"


@pytest.mark.parametrize("name", [CLEAR_SCREEN, REVERSED])
@pytest.mark.parametrize("group", ["grasps", "robots", "cameras", "colliders"])
def test_names_that_steer_a_terminal_are_refused(tmp_path, capsys, name, group):
    episode = rec.write(make_recording(tmp_path), tmp_path / "ep")
    content = json.loads((episode / "episode.json").read_text())
    entries = content[group]
    entries[name] = entries.pop(next(iter(entries)))
    (episode / "episode.json").write_text(json.dumps(content))
    assert cli.main(["inspect", str(episode)]) == 2
    message = capsys.readouterr().err
    assert f"{group} name is not a plain name or text; got 'left\\" in message
    assert not any(mark in message for mark in "\x1b\x07\u202e")


def test_grippers_texts_and_folders_that_steer_a_terminal_are_refused(tmp_path):
    episode = rec.write(make_recording(tmp_path), tmp_path / "ep")
    (tmp_path / "more").mkdir()
    with np.load(episode / "motion.npz") as stored:
        np.savez(episode / "motion.npz", **stored, **{f"{CLEAR_SCREEN}/t": np.zeros(1)})
    with pytest.raises(RecordingError, match="no control characters"):
        rec.read(episode)
    with pytest.raises(RecordingError, match="provenance is not a plain name or text"):
        rec.write(replace(make_recording(tmp_path / "more"), provenance=f"synthetic: {CLEAR_SCREEN}"), tmp_path / "new")
    with pytest.raises(RecordingError, match="name of the episode's folder is not a plain name"):
        rec.read((tmp_path / "ep").rename(tmp_path / CLEAR_SCREEN))
