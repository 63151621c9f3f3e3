"""``torchcloth view`` as a user meets it."""

import sys
import urllib.request

import pytest
from PIL import Image

from torchcloth.cli import main


def say(capsys, *arguments):
    """(exit code, stdout, stderr)"""
    code = main(["view", *map(str, arguments)])
    message = capsys.readouterr()
    return code, message.out, message.err


WRONG = {
    "unknown suffix": (["--out", "a.mp4"], r"--out; got 'a.mp4'; expected a name with .gif, .png, .rrd"),
    "no suffix": (["--out", "a"], "--out; got 'a'"),
    "size without picture": (["--out", "a.rrd", "--size", "300x200"], "--size; got '300x200'"),
    "size without x": (["--out", "a.gif", "--size", "300"], "--size; got '300'; expected WIDTHxHEIGHT"),
    "tiny size": (["--out", "a.gif", "--size", "50x50"], "size; got 50x50; expected at least 120"),
    "huge size": (
        ["--out", "a.png", "--size", "9999x9999"],
        "size; got 9999x9999; expected at least 120 and at most 40",
    ),
    "no folder for it": (
        ["--out", "x" * 300 + "/a.gif"],
        "which cannot be written (File name too long); expected a fo",
    ),
    "fps of nothing": (["--out", "a.gif", "--fps", "0"], "--fps; got 0.0; expected a number > 0"),
    "fps that no GIF has, before a fit is simulated": (
        ["--out", "a.gif", "--fps", "90", "--fit", "nowhere"],
        "rate; got 90.0; expected up to 50",
    ),
    "before without a fit": (["--out", "a.gif", "--before"], "--before; got no --fit, or no .gif; expected --fit"),
    "port and file": (["--out", "a.gif", "--port", "9000"], "--port; got 9000; expected 1 to 65535, without --out"),
    "impossible port": (["--port", "70000"], "--port; got 70000"),
    "no fit": (["--out", "a.gif", "--fit", "nowhere"], "fit; got no nowhere"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_options_are_one_line_and_exit_code_2(short, tmp_path, capsys, monkeypatch, case):
    monkeypatch.chdir(tmp_path)
    options, message = WRONG[case]
    code, out, error = say(capsys, short[0], *options)
    assert (code, out, error.count("\n")) == (2, "", 1)
    assert message in error.replace("\\", "")
    assert list(tmp_path.iterdir()) == []


def test_an_episode_that_is_not_there(tmp_path, capsys):
    code, _, error = say(capsys, tmp_path / "nowhere", "--out", tmp_path / "a.gif")
    assert code == 2
    assert "does not exist" in error


def test_a_folder_is_no_file(short, tmp_path, capsys):
    (tmp_path / "a.gif").mkdir()
    assert say(capsys, short[0], "--out", tmp_path / "a.gif")[0] == 2


@pytest.mark.parametrize("name", ["a.gif", "a.PNG", "a.rrd", "a.viser", "a.html"])
def test_an_episode_becomes_a_file(short, tmp_path, capsys, name):
    code, message, error = say(capsys, short[0], "--truth", "--out", tmp_path / "new" / name)
    assert (code, error) == (0, "")
    assert message.startswith(f"{tmp_path / 'new' / name}: ")
    assert (tmp_path / "new" / name).stat().st_size > 5000


def test_options_of_a_gif(short, tmp_path, capsys):
    folder, fit = short
    out = tmp_path / "a.gif"
    assert say(capsys, folder, "--fit", fit, "--fps", 10, "--size", "300x240", "--out", out)[0] == 0
    with Image.open(out) as gif:
        assert (gif.size, gif.n_frames) == ((300, 240), 3)  # 0.2 s


@pytest.mark.filterwarnings("error::UserWarning")  # it is a single frame, too
def test_a_fit_in_the_smallest_pictures(short, tmp_path, capsys):
    folder, fit = short
    arguments = ["--fit", fit, "--truth", "--fps", 3, "--size", "200x160", "--out", tmp_path / "a.gif"]
    assert say(capsys, folder, *arguments)[0] == 0
    with Image.open(tmp_path / "a.gif") as gif:
        assert gif.size == (200, 160)


def test_no_second_file_when_the_extra_is_missing(short, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    code, _, error = say(capsys, short[0])
    assert code == 2
    assert 'pip install "torchcloth[viz]"' in error


def test_control_c_ends_the_server(short, capsys, monkeypatch):
    """It answers until then, says nothing more, and is gone."""
    asked = []

    def interrupted(viewer):
        with urllib.request.urlopen(f"http://127.0.0.1:{viewer.port}", timeout=10) as answer:
            asked.append((viewer.port, answer.status))
        raise KeyboardInterrupt

    monkeypatch.setattr("torchcloth.viewing.Viewer.run", interrupted)
    code, message, error = say(capsys, short[0], "--port", 18480)
    ((port, status),) = asked
    assert (code, status, error) == (0, 200, "")
    assert message == f"swing: http://localhost:{port} (Ctrl-C ends)\n"
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10)
