"""``torchcloth identify`` as a user meets it: one readable result, or one line that says what is wrong."""

import json
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from helpers.command_line import COMMAND, ENVIRONMENT, QUICK_FIT, call, one_line, refuse, write_twin

from torchcloth.cli import main
from torchcloth.errors import InvalidInput

MAX_LINE_LENGTH = 120
CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f\x9b]")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The twin episode on disk."""
    return write_twin(tmp_path_factory.mktemp("episodes") / "twin")


@pytest.fixture
def spoiled(folder, tmp_path):
    """A copy to break."""
    return Path(shutil.copytree(folder, tmp_path / "spoiled"))


WRONG = {
    "unstable step": (["--dt", "0.05"], "dt; got 0.05 s; expected at most 0.0"),
    "negative modulus": (["--start", "youngs_modulus=-1"], "Young's modulus|youngs_modulus; got -1 Pa; expected"),
    "infinite modulus": (["--start", "youngs_modulus=inf"], "got inf Pa"),
    "start without value": (["--start", "youngs_modulus"], "--start; got 'youngs_modulus'; expected NAME=NUMBER"),
    "start without number": (["--start", "youngs_modulus=stiff"], "--start; got 'youngs_modulus=stiff'"),
    "start of nothing": (["--start", "stiffness=3"], "--start; got 'stiffness'; expected one of .*youngs_modulus"),
    "fit of nothing": (["--fit", "stiffness"], "got 'stiffness'; expected one of .*youngs_modulus"),
    "no iterations": (["--iterations", "0"], "iterations; got 0; expected at least 1"),
    "resume of nothing": (["--resume"], "resume; got no .*progress; expected what an interrupted run left"),
    "negative contact": (["--contact", "-0.01"], "spacing"),
    "field of nothing": (["--fields", "stiffness"], "--fields; got 'stiffness'; expected one of .*youngs_modulus"),
    "fields and values": (["--fields", "youngs_modulus", "--fit", "air.normal"], "--fit; got a value, with --fields"),
    "endless step": (["--dt", "1e-12"], "dt; got 1e-12 s, that is .* substeps; expected at most 1e.07; raise dt"),
    "endless stiffness": (["--start", "youngs_modulus=1e30"], "the stable substep; got .* substeps; .*check the units"),
    "overflowing stiffness": (["--start", "youngs_modulus=1e300"], "stiffness; got .* N/m; expected a fabric's"),
    "contact of atoms": (["--contact", "1e-7"], "contact spacing; got 1e-07 m, for which .*; expected 0.000"),
    "contact of metres": (["--contact", "5"], "contact spacing; got 5 m; expected at most the length of the cloth, 0."),
    "starts without end": (["--starts", "1000000000"], "starts; got 1000000000; expected at most 1000"),
    "start twice": (["--start", "youngs_modulus=1e5", "youngs_modulus=2e5"], "--start; got 'youngs_modulus' twice"),
    "start in two options": (["--start", "air.normal=1", "--start", "air.normal=2"], "--start; got 'air.normal' twice"),
    "nuisance twice": (["--nuisance", "clock", "clock=0.1"], "--nuisance; got 'clock' twice; expected each name once"),
    "prior twice": (["--prior", "air.normal=1,2", "air.normal=3,2"], "--prior; got 'air.normal' twice"),
    "prior of a distance": (["--method", "adam", "--prior", "youngs_modulus=1e6,1.01"], "priors; got youngs_modulus w"),
    "contrast of nothing": (["--contrast", "2"], "--contrast; got 2.0; expected --fields as well"),
    "impossible contrast": (["--fields", "youngs_modulus", "--contrast", "-1"], "contrast; got -1.0; expected a num"),
    "fields without iterations": (["--fields", "youngs_modulus", "--iterations", "0"], "iterations; got 0; expected"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_options_are_one_line_and_exit_code_2(folder, tmp_path, capsys, case):
    options, said = WRONG[case]
    assert re.search(said, refuse(capsys, tmp_path / "deep" / "out", "identify", folder, *options))
    assert not (tmp_path / "deep").exists()


@pytest.mark.parametrize("more", [[], ["--fields", "youngs_modulus"]])
def test_one_episode_twice(folder, tmp_path, capsys, more):
    copy = shutil.copytree(folder, tmp_path / "copy")
    said = refuse(capsys, tmp_path / "out", "identify", folder, copy, *more)
    assert "episodes; got 'twin' and 'copy', which hold the same; expected each once" in said


def test_a_missing_folder(tmp_path, capsys):
    said = refuse(capsys, tmp_path / "out", "identify", tmp_path / "nowhere")
    assert f"{tmp_path / 'nowhere'} does not exist" in said


def test_a_truncated_file(spoiled, tmp_path, capsys):
    points = spoiled / "points.npz"
    points.write_bytes(points.read_bytes()[:-200])
    assert "points.npz" in refuse(capsys, tmp_path / "out", "identify", spoiled)


@pytest.mark.parametrize("stream", ["points", "motion"])
def test_millimetres_for_metres(spoiled, tmp_path, capsys, stream):
    path = spoiled / f"{stream}.npz"
    with np.load(path) as file:
        arrays = dict(file)
    scale = arrays.pop("scale", 1.0)
    for key in arrays:
        if key == "xyz" or key.endswith("/position"):
            arrays[key] = (arrays[key] * scale * 1000.0).astype(np.float32)
    np.savez(path, **arrays)
    said = refuse(capsys, tmp_path / "out", "identify", spoiled)
    assert "millimetres" in said
    assert path.name in said


@pytest.mark.parametrize(
    ("verb", "more"), [("identify", []), ("identify", ["--fields", "youngs_modulus"]), ("pose", [])]
)
def test_a_cloud_of_another_size(spoiled, tmp_path, capsys, verb, more):
    """A wrong scale makes no larger scene, and so passes the reader."""
    path = spoiled / "points.npz"
    with np.load(path) as file:
        np.savez(path, **{**file, "scale": file["scale"] * 1e-3})
    said = refuse(capsys, tmp_path / "out", verb, spoiled, *more)
    assert re.search(r"spoiled: the cloud is 0\.00\d+ times as long as the cloth.*check the unit of points", said)
    assert main(["inspect", str(spoiled), "--json"]) == 0  # which is to show it
    assert any("check the unit" in note for note in json.loads(capsys.readouterr().out)["notes"])


def test_progress_of_another_fit_is_not_taken_up(folder, tmp_path, capsys):
    (tmp_path / "progress").mkdir()
    (tmp_path / "progress" / "problem").write_text("another")
    assert main(["identify", str(folder), "--out", str(tmp_path), "--resume"]) == 2
    assert re.search(
        "progress of another fit, or of another version of torchcloth; expected the same episodes",
        one_line(capsys.readouterr().err),
    )


def test_a_folder_of_other_things_is_left_alone(folder, tmp_path, capsys):
    (tmp_path / "progress").mkdir()
    (tmp_path / "progress" / "thesis.tex").write_text("mine")
    assert main(["identify", str(folder), "--out", str(tmp_path)]) == 2
    assert "progress with other content" in one_line(capsys.readouterr().err)
    assert (tmp_path / "progress" / "thesis.tex").read_text() == "mine"


def test_out_that_is_a_file(folder, tmp_path, capsys):
    out = tmp_path / "out"
    out.write_text("mine")
    assert main(["identify", str(folder), "--out", str(out)]) == 2
    one_line(capsys.readouterr().err)
    assert out.read_text() == "mine"


def test_refusals_of_the_real_command(folder, tmp_path):
    """The same through a process of its own: the exit code and stderr are what a shell sees."""
    done = call("identify", tmp_path / "nowhere", "--out", tmp_path / "out")
    assert done.returncode == 2
    one_line(done.stderr)
    assert done.stdout == ""
    done = call("identify", folder, "--out", tmp_path / "out", "--start", "youngs_modulus=-1")
    assert done.returncode == 2
    one_line(done.stderr)
    assert not (tmp_path / "out").exists()


@pytest.fixture(scope="module")
def done(folder, tmp_path_factory):
    """(process, output folder) of a small fit whose output goes into a pipe."""
    out = tmp_path_factory.mktemp("fit") / "new"
    return call("identify", folder, "--out", out, *QUICK_FIT, "--start", "youngs_modulus=5e4"), out


def test_a_fit_leaves_its_files(done):
    process, out = done
    assert process.returncode == 0, process.stderr
    names = {path.name for path in out.iterdir()}
    assert names == {"identification.json", "fit.png", "distances.png", "parameters.png"}
    for picture in out.glob("*.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size > 5000  # an empty axis has some 3 kB
    content = json.loads((out / "identification.json").read_text())
    assert 36 < content["parameters"]["membrane_stiffness"]["value"] < 44  # N/m; the truth is 40


def test_the_table_names_distances_and_pictures(done):
    process, out = done
    content = json.loads((out / "identification.json").read_text())["fit"]
    for label, key in (("null", "chamfer_null"), ("start", "chamfer_before"), ("fitted", "chamfer_after")):
        assert re.search(rf"^ +{label}.* {1e3 * content[key]:.3f} ", process.stdout, re.MULTILINE), label
    for name in ("fit.png", "distances.png", "parameters.png", "identification.json"):
        assert str(out / name) in process.stdout


def test_notes_come_first_and_the_verdict_last(done):
    process, _ = done
    first, *_, last = process.stdout.splitlines()
    assert first.startswith("1 episode(s)")
    table = process.stdout.index("Parameters")
    assert all(note.start() < table for note in re.finditer("^note: ", process.stdout, re.MULTILINE))
    assert last == "verdict:  Identified: youngs_modulus, air.normal."


def test_output_in_a_pipe_is_plain_text(done):
    process, out = done
    assert process.stderr == ""
    assert not CONTROL.search(process.stdout)
    for line in process.stdout.splitlines():
        assert len(line) <= MAX_LINE_LENGTH or str(out.parent) in line  # paths are as long as they are


def test_no_name_and_no_number_of_the_table_is_cut(done):
    process, _ = done
    for name in ("membrane_stiffness", "youngs_modulus", "air.normal", "contact_stiffness", "std. error"):
        assert name in process.stdout
    table = process.stdout.split("Parameters")[1].split("Distance")[0]
    assert not re.search(r"\S…|…\S", table)  # "a … b" is an interval, "4.0…" a lost number


@pytest.mark.parametrize(
    ("arguments", "refines"),
    [
        ([], True),
        (["--no-refine"], False),
        (["--method", "lbfgs"], True),
        (["--method", "adam"], False),
        (["--stop", "paper"], False),
        (["--profile", "air.normal"], False),
        (["--method", "adam", "--refine"], True),
    ],
)
def test_a_fit_corrects_for_its_mesh_unless_that_makes_no_sense(monkeypatch, folder, tmp_path, arguments, refines):
    asked = {}

    def identify(*_, **options):
        asked.update(options)
        raise InvalidInput("enough", got="this", expected="nothing more")

    monkeypatch.setattr("torchcloth.identification.identify", identify)
    assert main(["identify", str(folder), "--out", str(tmp_path / "out"), *arguments]) == 2
    assert asked["refine"] is refines


def test_fields_have_a_value_for_each_triangle(folder, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["--fields", "youngs_modulus", "--iterations", "2", "--start", "youngs_modulus=5e4"]
    assert main(["identify", str(folder), "--out", str(out), *arguments]) == 0
    printed = capsys.readouterr().out
    content = json.loads((out / "fields.json").read_text())
    values = content["fields"]["youngs_modulus"]["values"]
    assert re.search(rf"{len(values)} triangles", printed)
    assert min(values) < max(values)
    assert content["fit"]["chamfer_after"] < content["fit"]["chamfer_before"]
    assert {path.name for path in out.iterdir()} == {"fields.json", "fields.png"}


def test_an_interrupted_fit_goes_on_as_if_nothing_had_happened(folder, tmp_path, done):
    """SIGINT after some work: the second run ends where an undisturbed one does, to the last bit."""
    out = tmp_path / "out"
    command = [*COMMAND, "identify", str(folder), "--out", str(out), "--start", "youngs_modulus=5e4", *QUICK_FIT]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a shell's background jobs ignore it
    )  # fmt: skip
    deadline = time.monotonic() + 120
    while len(list(out.glob("progress/*.pt"))) < 3 and time.monotonic() < deadline and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "--resume" in one_line(said)
    assert [path.name for path in out.iterdir()] == ["progress"]
    kept = sorted(path.name for path in out.glob("progress/*.pt"))
    unsaid = call("identify", folder, "--out", out, "--start", "youngs_modulus=5e4", *QUICK_FIT)
    assert unsaid.returncode == 2, "work is not thrown away unasked"
    assert "--resume, to go on from there" in one_line(unsaid.stderr)
    assert sorted(path.name for path in out.glob("progress/*.pt")) == kept

    resumed = call("identify", folder, "--out", out, "--start", "youngs_modulus=5e4", *QUICK_FIT, "--resume")
    assert resumed.returncode == 0, resumed.stderr
    assert not (out / "progress").exists()
    whole, parts = (json.loads((o / "identification.json").read_text()) for o in (done[1], out))
    assert parts["history"] == whole["history"]
    assert parts["parameters"] == whole["parameters"]
    assert {**parts["fit"], "seconds": 0} == {**whole["fit"], "seconds": 0}
