"""``make verify``: tolerances are applied, misses set the exit code, outcomes are stored."""

import os
import subprocess
import sys

import numpy as np
import pytest

from torchcloth.training.validation.verification import dynamics, run
from torchcloth.training.validation.verification.assessment import assess_outcome
from torchcloth.training.validation.verification.registry import (
    AT_LEAST_TRUTH,
    AT_MOST_TRUTH,
    CASES,
    Outcome,
    Row,
    Tolerance,
    absolute,
    register_case,
    relative,
)

CALLS: list[str] = []


def register_toy(function, **options):
    """Return a registry with this one case, called "toy"."""
    into = {}
    register_case("toy", "A toy", truth="arithmetic", into=into, **{"tolerance": relative(0.01), **options})(function)
    return into


def make_case_function(measured, truth=1.0, **options):
    return lambda fast: Outcome([Row("figure", measured, truth, "m", **options)])


def run_verification(folder, cases, *arguments):
    return run.main(["--out", str(folder / "out"), "--docs", str(folder / "docs"), *arguments], cases)


def test_a_true_simulation_passes_and_a_wrong_truth_does_not(tmp_path, monkeypatch):
    """The real free fall; then the same with gravity 1 % off in the closed form."""
    assert run_verification(tmp_path, None, "--fast", "--only", "free-fall") == 0
    monkeypatch.setattr(dynamics, "STANDARD_GRAVITY_M_PER_S2", 1.01 * dynamics.STANDARD_GRAVITY_M_PER_S2)
    assert run_verification(tmp_path, None, "--fast", "--fresh", "--only", "free-fall") == 1
    page = (tmp_path / "out/verification.md").read_text()
    assert "**missed**" in page
    assert "`free-fall`" in page


@pytest.mark.parametrize("measured", [1.02, float("nan"), float("inf")])
def test_a_miss_sets_the_exit_code(tmp_path, capsys, measured):
    assert run_verification(tmp_path, register_toy(make_case_function(1.005))) == 0
    assert run_verification(tmp_path, register_toy(make_case_function(measured)), "--fresh") == 1
    assert "missed: toy" in capsys.readouterr().out


def test_a_case_that_breaks_counts_as_missed_and_hides_no_other(tmp_path):
    def broken(fast):
        raise ValueError("boom")

    cases = {}
    for name, function in (("broken", broken), ("fine", make_case_function(1.0))):
        register_case(name, name, truth="arithmetic", tolerance=relative(0.01), into=cases)(function)
    assert run_verification(tmp_path, cases) == 1
    page = (tmp_path / "docs/verification.md").read_text()
    for words in ("**failed**", "ValueError: boom", "| pass |", "1 of 2 figures"):
        assert words in page


@pytest.mark.parametrize(
    ("tolerance", "inside", "outside", "truth"),
    [
        (relative(0.01), 0.991, 0.98, 1.0),
        (absolute(1e-9), -9e-10, 2e-9, 0.0),
        (AT_MOST_TRUTH, 4.9, 5.1, 5.0),
        (AT_LEAST_TRUTH, 0.1, -0.1, 0.0),
    ],
)
def test_tolerances(tolerance, inside, outside, truth):
    for value, verdict in ((inside, "pass"), (outside, "missed")):
        toy = register_toy(make_case_function(value, truth), tolerance=tolerance)["toy"]
        assert assess_outcome(toy, toy.function(False))[0].verdict == verdict


def test_a_finding_has_no_tolerance():
    toy = register_toy(make_case_function(7.0, finding=True))["toy"]
    assert assess_outcome(toy, toy.function(False))[0].verdict == "finding"


def test_rounding_is_printed_the_same_on_every_machine():
    """3e-15 on one machine and 8e-16 on another must not change the page."""
    toy = register_toy(make_case_function(0.0), tolerance=absolute(1e-9))["toy"]
    written = [assess_outcome(toy, Outcome([Row("", e, 0.0)]))[0] for e in (3e-15, 8e-16, 0.0)]
    assert written[0] == written[1] == written[2]
    assert assess_outcome(toy, Outcome([Row("", 2e-10, 0.0)]))[0].error == "< 1e-09"


def test_finished_cases_are_stored(tmp_path):
    def counted(fast):
        CALLS.append("run")
        row = Row("figure", 1.0, 1.0, tolerance=Tolerance(0.5, "absolute"))
        return Outcome([row], {"line": np.arange(3.0)}, "a note")

    cases = register_toy(counted, draw=lambda figure, data: figure.subplots().plot(data["line"]))
    CALLS.clear()
    pages, pictures = [], []
    for arguments in ((), (), ("--fresh",)):
        assert run_verification(tmp_path, cases, *arguments) == 0
        pages.append((tmp_path / "docs/verification.md").read_bytes())
        pictures.append((tmp_path / "docs/verification/toy.png").read_bytes())
    assert len(CALLS) == 2
    assert pages[0] == pages[1] == pages[2]
    assert pictures[0] == pictures[1] == pictures[2]
    assert len(pictures[0]) < 100_000


def test_a_stopped_run_leaves_its_finished_cases_usable(tmp_path):
    stored = tmp_path / "out/full"
    cases = register_toy(make_case_function(1.0))
    run_verification(tmp_path, cases)
    (stored / "toy.npz").write_bytes((stored / "toy.npz").read_bytes()[:40])  # killed while writing
    assert run_verification(tmp_path, cases) == 0


def test_a_partial_run_does_not_replace_the_page_in_the_docs(tmp_path):
    assert run_verification(tmp_path, register_toy(make_case_function(1.0)), "--fast") == 0
    assert run_verification(tmp_path, register_toy(make_case_function(1.0)), "--only", "toy") == 0
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
    """All tolerances hold there as well."""
    assert run_verification(tmp_path, None, "--fast") == 0


@pytest.mark.slow
def test_what_the_coarse_subset_leaves_out(tmp_path):
    """It takes minutes."""
    from torchcloth.training.validation.verification import all_cases  # noqa: F401

    left_out = [name for name, case in CASES.items() if not case.fast]
    assert len(left_out) > 3
    assert run_verification(tmp_path, None, "--only", *left_out) == 0
