"""The machinery of ``make verify``: marks are applied, misses set the exit code, finished cases are kept."""

import os
import subprocess
import sys

import numpy as np
import pytest

from torchcloth.training.validation.verification import closed_forms, dynamics, run
from torchcloth.training.validation.verification.assessment import lines
from torchcloth.training.validation.verification.registry import (
    AT_LEAST,
    AT_MOST,
    CASES,
    Mark,
    NotThere,
    Outcome,
    Row,
    absolute,
    case,
    relative,
)

CALLS: list[str] = []


def made(function, **options):
    """A registry with this one case, called "toy"."""
    into = {}
    case("toy", "A toy", truth="arithmetic", into=into, **{"mark": relative(0.01), **options})(function)
    return into


def figure(measured, truth=1.0, **more):
    return lambda fast: Outcome([Row("figure", measured, truth, "m", **more)])


def execute(folder, cases, *arguments):
    return run.main(["--out", str(folder / "out"), "--docs", str(folder / "docs"), *arguments], cases)


def test_a_true_simulation_passes_and_a_wrong_truth_does_not(tmp_path, monkeypatch):
    """The real free fall; then the same with gravity 1 % off in the closed form."""
    assert execute(tmp_path, None, "--fast", "--only", "free-fall") == 0
    monkeypatch.setattr(dynamics.closed_forms, "GRAVITY", 1.01 * closed_forms.GRAVITY)
    assert execute(tmp_path, None, "--fast", "--fresh", "--only", "free-fall") == 1
    page = (tmp_path / "out/verification.md").read_text()
    assert "**missed**" in page
    assert "`free-fall`" in page


@pytest.mark.parametrize("measured", [1.02, float("nan"), float("inf")])
def test_a_miss_sets_the_exit_code(tmp_path, capsys, measured):
    assert execute(tmp_path, made(figure(1.005))) == 0
    assert execute(tmp_path, made(figure(measured)), "--fresh") == 1
    assert "missed: toy" in capsys.readouterr().out


def test_what_is_absent_or_breaks_counts_as_missed_and_hides_nothing(tmp_path):
    def absent(fast):
        raise NotThere("no such law")

    def broken(fast):
        raise ValueError("boom")

    cases = {}
    for name, function in (("absent", absent), ("broken", broken), ("fine", figure(1.0))):
        case(name, name, truth="arithmetic", mark=relative(0.01), into=cases)(function)
    assert execute(tmp_path, cases) == 1
    page = (tmp_path / "docs/verification.md").read_text()
    for words in ("**absent**", "no such law", "**failed**", "ValueError: boom", "| pass |", "1 of 3 figures"):
        assert words in page


@pytest.mark.parametrize(
    ("mark", "inside", "outside", "truth"),
    [
        (relative(0.01), 0.991, 0.98, 1.0),
        (absolute(1e-9), -9e-10, 2e-9, 0.0),
        (AT_MOST, 4.9, 5.1, 5.0),
        (AT_LEAST, 0.1, -0.1, 0.0),
    ],
)
def test_marks(mark, inside, outside, truth):
    for value, verdict in ((inside, "pass"), (outside, "missed")):
        toy = made(figure(value, truth), mark=mark)["toy"]
        assert lines(toy, toy.function(False))[0].verdict == verdict


def test_a_finding_is_not_judged():
    toy = made(figure(7.0, finding=True))["toy"]
    assert lines(toy, toy.function(False))[0].verdict == "finding"


def test_rounding_is_written_alike_everywhere():
    """3e-15 on one machine and 8e-16 on another must not change the page."""
    toy = made(figure(0.0), mark=absolute(1e-9))["toy"]
    written = [lines(toy, Outcome([Row("", e, 0.0)]))[0] for e in (3e-15, 8e-16, 0.0)]
    assert written[0] == written[1] == written[2]
    assert lines(toy, Outcome([Row("", 2e-10, 0.0)]))[0].error == "< 1e-09"


def test_finished_cases_are_kept(tmp_path):
    def counted(fast):
        CALLS.append("run")
        row = Row("figure", 1.0, 1.0, mark=Mark(0.5, "absolute"))
        return Outcome([row], {"line": np.arange(3.0)}, "a note")

    cases = made(counted, draw=lambda figure, data: figure.subplots().plot(data["line"]))
    CALLS.clear()
    pages, pictures = [], []
    for arguments in ((), (), ("--fresh",)):
        assert execute(tmp_path, cases, *arguments) == 0
        pages.append((tmp_path / "docs/verification.md").read_bytes())
        pictures.append((tmp_path / "docs/verification/toy.png").read_bytes())
    assert len(CALLS) == 2
    assert pages[0] == pages[1] == pages[2]
    assert pictures[0] == pictures[1] == pictures[2]
    assert len(pictures[0]) < 100_000


def test_a_stopped_run_leaves_its_finished_cases_usable(tmp_path):
    stored = tmp_path / "out/full"
    cases = made(figure(1.0))
    execute(tmp_path, cases)
    (stored / "toy.npz").write_bytes((stored / "toy.npz").read_bytes()[:40])  # killed while writing
    assert execute(tmp_path, cases) == 0


def test_parts_do_not_replace_the_page_in_the_docs(tmp_path):
    assert execute(tmp_path, made(figure(1.0)), "--fast") == 0
    assert execute(tmp_path, made(figure(1.0)), "--only", "toy") == 0
    assert not (tmp_path / "docs").exists()


def test_bad_usage_and_list(tmp_path):
    command = [sys.executable, "-m", "torchcloth.training.validation.verification.run"]
    bad = subprocess.run([*command, "--only", "no-such-case"], capture_output=True, text=True, cwd=tmp_path)
    assert bad.returncode == 2
    assert "unknown case no-such-case" in bad.stderr
    listed = subprocess.run([*command, "--list"], capture_output=True, text=True, cwd=tmp_path)
    assert listed.returncode == 0
    assert "small-swing" in listed.stdout
    assert not os.listdir(tmp_path)


def test_every_line_of_the_design_has_a_case():
    from torchcloth.training.validation.verification import all_cases  # noqa: F401

    needed = {
        "force-is-minus-gradient", "rollout-gradient", "frame-indifference", "momentum", "spinning-sheet",
        "drop-on-sheet", "fold-half-a-metre", "friction-of-layers", "energy", "uniaxial-strip", "bias-strip",
        "hanging-strip", "small-swing", "incline", "free-fall", "drag", "cantilever", "biaxial-plastic-set",
        "convergence", "convergence-grid", "fold-and-unfold",
    }  # fmt: skip
    assert needed <= set(CASES)


@pytest.mark.slow
def test_the_coarse_subset(tmp_path):
    """All marks hold there, too."""
    assert execute(tmp_path, None, "--fast") == 0


@pytest.mark.slow
def test_what_the_coarse_subset_leaves_out(tmp_path):
    """Minutes; `make verify` alone had run these."""
    from torchcloth.training.validation.verification import all_cases  # noqa: F401

    left_out = [name for name, case in CASES.items() if not case.fast]
    assert len(left_out) > 3
    assert execute(tmp_path, None, "--only", *left_out) == 0
