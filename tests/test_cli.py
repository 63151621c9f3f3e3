"""The command line as a whole: usage, places to write to, and streams. Each verb has a test_command.py of its own."""

import errno
import re
import subprocess
import sys
import warnings
from importlib import metadata, util
from pathlib import Path

import pytest
from helpers.command_line import COMMAND, ENVIRONMENT, QUICK_FIT, one_line, refuse, write_twin

from torchcloth import cli, recordings
from torchcloth.cli import doctor, main
from torchcloth.cli.output_paths import check_output_file, check_output_folder
from torchcloth.errors import InvalidInput
from torchcloth.observe import render


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The twin episode on disk."""
    return write_twin(tmp_path_factory.mktemp("episodes") / "twin")


def test_help_lists_the_verbs(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--help"])
    assert stopped.value.code == 0
    said = capsys.readouterr().out
    for verb in ("identify", "demo", "doctor"):
        assert re.search(rf"^ +{verb} ", said, re.MULTILINE)


@pytest.mark.parametrize(
    "arguments",
    [[], ["identify"], ["conquer"], ["identify", "x", "--iterations", "few"], ["identify", "x", "--out", ""]],
)
def test_wrong_usage_is_exit_code_2(capsys, arguments):
    with pytest.raises(SystemExit) as stopped:
        main(arguments)
    assert stopped.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("torchcloth")
    assert line.endswith("--help")


@pytest.mark.parametrize("verb", ["identify", "diagnose"])
def test_an_option_that_a_verb_has_not_is_the_verbs_matter(capsys, verb):
    with pytest.raises(SystemExit) as stopped:
        main([verb, "x", "--out", "y", "--mispelt"])
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said == f"torchcloth {verb}: unrecognized arguments: --mispelt; to do: see torchcloth {verb} --help\n"


def test_a_diagnosis_does_not_replace_the_model_that_it_starts_from(capsys, tmp_path):
    (tmp_path / "base.tcm").write_text("mine")
    assert main(["diagnose", "a", "b", "--model", str(tmp_path / "base.tcm"), "--out", str(tmp_path)]) == 2
    assert "another folder" in capsys.readouterr().err
    assert (tmp_path / "base.tcm").read_text() == "mine"


def test_version(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--version"])
    assert stopped.value.code == 0
    assert capsys.readouterr().out.strip() == metadata.version("torchcloth")


def test_doctor_says_what_is_installed(capsys):
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert f"torchcloth {metadata.version('torchcloth')}" in said
    assert re.search(r"^engine +(built|will be built|not available)", said, re.MULTILINE)
    assert re.search(r"^trimesh +installed$", said, re.MULTILINE)


def test_doctor_tells_a_package_that_cannot_be_imported_from_one_that_works(capsys, monkeypatch):
    """As open3d without the system's libusb: it is there, and of no use."""
    loading = {"open3d": ImportError("libusb-1.0.so.0: cannot open shared object file")}
    monkeypatch.setattr(util, "find_spec", lambda name: object())

    def load(name):
        raise loading[name]

    monkeypatch.setattr(render, "import_module", load)
    assert main(["doctor"]) == 0
    said = capsys.readouterr().out
    assert re.search(
        r"^open3d +cannot be imported: libusb-1.0.so.0: .*; pip install .*libusb-1.0-0", said, re.MULTILINE
    )
    assert re.search(r"^trimesh +installed$", said, re.MULTILINE)


@pytest.mark.parametrize("verb", ["identify", "pose", "diagnose", "inspect"])
def test_a_folder_below_a_file_is_refused_at_once(verb, folder, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main([verb, str(folder), "--out", str(tmp_path / "file" / "sub")]) == 2
    assert "file, a file; expected a folder" in one_line(capsys.readouterr().err)


FIT = ("base.tcm", "extended.tcm")  # need not be there: where to write is asked first
PLACED = {
    "identify": [],
    "pose": [],
    "diagnose": [],
    "inspect": [],
    "simulate": ["--garment", "sheet", "--motion", "swing"],
    "confirm": FIT,
    "bench": ["--fast"],
    "demo": [],
    "predict": FIT[:1],
    "view": [],
}


@pytest.mark.parametrize("verb", PLACED)
def test_a_place_that_cannot_be_written_is_refused_at_once(verb, folder, tmp_path, capsys):
    """Before anything is simulated or measured; and nothing of the trial is left."""
    episode = [] if verb in ("simulate", "bench", "demo") else [str(folder)]
    places = {tmp_path / "new" / ("x" * 300): "File name too long"}
    if Path("/proc/self").exists():
        places[Path("/proc/x")] = "No such file or directory"
    for place, why in places.items():
        out = place / "a.rrd" if verb == "view" else place
        assert main([verb, *PLACED[verb], *episode, "--out", str(out)]) == 2
        said = one_line(capsys.readouterr().err)
        assert f"--out; got {place}, which cannot be written ({why}); expected a folder" in said
    assert list(tmp_path.iterdir()) == []


def test_an_episode_is_not_converted_to_where_it_cannot_be_written(folder, tmp_path, capsys):
    assert main(["convert", str(folder), str(tmp_path / ("x" * 300) / "copy")]) == 2
    assert "DST; got" in one_line(capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_can_be_written_is_left_as_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old").mkdir()
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    for path in (Path("old"), Path("new/a/b"), tmp_path / "new" / ".." / "b", Path(".."), Path("old/../c")):
        check_output_folder(path)
    check_output_file(Path("new/a.gif"))
    for path in (Path("dangling"), Path("dangling/a")):
        with pytest.raises(InvalidInput, match="dangling, a file"):
            check_output_folder(path)
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["dangling", "old"]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            PermissionError(13, "Permission denied", "/data/a.npz"),
            "/data/a.npz; got Permission denied; expected a path th",
        ),
        (OSError(28, "No space left on device"), "the system refuses; got No space left on device"),
        (OSError("broken picture"), "the system refuses; got broken picture"),
    ],
)
def test_what_the_system_says_is_said_like_everything_else(folder, tmp_path, capsys, monkeypatch, error, said):
    monkeypatch.setattr(recordings, "read", lambda *_, **__: (_ for _ in ()).throw(error))
    assert f"torchcloth: {said}" in refuse(capsys, tmp_path / "out", "identify", folder)


@pytest.mark.filterwarnings("default:settle")
def test_what_the_library_warns_of_is_one_line(monkeypatch, capsys):
    def run(options):
        warnings.warn("settle: the cloth still moves", stacklevel=1)
        return 0

    monkeypatch.setattr(doctor, "_doctor", run)
    before = warnings.showwarning
    assert main(["doctor"]) == 0
    assert capsys.readouterr().err == "torchcloth: warning: settle: the cloth still moves\n"
    assert warnings.showwarning is before


def test_a_full_disk_is_one_line_that_says_how_to_resume(monkeypatch, capsys):
    def run(options):
        raise OSError(errno.ENOSPC, "No space left on device", "out/progress/a.pt")

    monkeypatch.setattr(doctor, "_doctor", run)
    monkeypatch.setattr(cli, "_how_to_resume", lambda _: "; `--resume` goes on from there")
    assert main(["doctor"]) == 2
    line = "out/progress/a.pt; got No space left on device; expected space to write it; free some space"
    assert capsys.readouterr().err == f"torchcloth: {line}; `--resume` goes on from there\n"


def test_a_reader_that_closes_the_pipe_is_no_failure(monkeypatch, capsys):
    """`inspect | head -1` gave exit code 1, which is rich's: see its Console.on_broken_pipe."""

    def run(options):
        try:
            raise BrokenPipeError
        except BrokenPipeError:
            raise SystemExit(1)  # noqa: B904 - as rich does

    monkeypatch.setattr(doctor, "_doctor", run)
    assert main(["doctor"]) == 141


def test_a_stream_that_is_closed_is_no_failure(monkeypatch):
    """`torchcloth doctor >&-`: sys.stdout is None."""
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(doctor, "_doctor", lambda _: 0 if sys.stdout.isatty() is False else 1)
    assert main(["doctor"]) == 0
    sys.stdout.close()


@pytest.mark.slow
def test_what_is_written_is_there_before_it_is_shown(folder, tmp_path):
    """`| head -1`: nobody reads on, and the files are whole; a folder's name may look like markup, or lead back."""
    for verb in (["inspect", folder], ["identify", folder, *QUICK_FIT, "--iterations", "1", "--no-refine"]):
        out = tmp_path / verb[0] / "new" / ".." / "a[b]"
        command = [*COMMAND, *map(str, verb), "--out", str(out)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT) as p:
            p.stdout.readline()
            p.stdout.close()
            said = p.stderr.read()
        assert p.returncode in (0, 141), said
        assert "Traceback" not in said
        assert [*(tmp_path / verb[0] / "a[b]").glob("*.json")]


@pytest.mark.parametrize(
    "verb", ["view", "inspect", "identify", "diagnose", "pose --fit a.tcm", "predict a.tcm", "confirm a.tcm b.tcm"]
)
def test_nothing_is_written_into_an_episode(verb, folder, capsys):
    before = sorted(folder.rglob("*"))
    out = folder / "cam0" / "000000.png"
    name, *more = verb.split()
    order = [str(folder), *more] if name == "pose" else [*more, str(folder)]
    assert main([name, *order, "--out", str(out)]) == 2
    assert f"within {folder}, which is read" in one_line(capsys.readouterr().err)
    assert sorted(folder.rglob("*")) == before


@pytest.mark.slow
def test_letters_that_a_terminal_does_not_have_end_no_work(folder, tmp_path):
    done = subprocess.run(
        [*COMMAND, "inspect", str(folder), "--out", str(tmp_path / "ν")],
        capture_output=True, text=True, timeout=300, env={**ENVIRONMENT, "PYTHONIOENCODING": "ascii"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
