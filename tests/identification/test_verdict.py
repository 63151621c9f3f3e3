"""What is printed of a fit: notes, tables in millimetres, no interval that means nothing, a verdict in one line."""

import pytest

from torchcloth.identification import describe_verdict, print_fit
from torchcloth.identification.display_units import in_display_unit
from torchcloth.identification.result import Identification
from torchcloth.identification.uncertainty.estimates import Estimate, InfluenceStatement

KNOWN = Estimate(2.0e5, 1.0e4, (1.8e5, 2.2e5), "Pa", 1.0e5, True)
UNKNOWN = Estimate(2.0e-5, 1.9e-5, (1.1e-6, 9.0e-5), "N m", 1.0e-5, False)
FIT = {f"{what}_{key}": 0.0123 for what in ("chamfer", "rms") for key in ("null", "before", "after")}
COUNTS = {"iterations": 3, "simulations": 9, "seconds": 1.0, "points": 0, "effective_observations": 5}


def make_fit(parameters, withdrawn=False, experiment="", **more):
    influences = {n: InfluenceStatement(e.identifiable, "", 1, 1, 1, 1, experiment) for n, e in parameters.items()}
    fit = FIT | COUNTS | {"converged": True, "withdrawn": withdrawn}
    return Identification(parameters, fit, {}, ["a note"], [], [], [], [], influences=influences, **more)


def test_a_fit_that_identifies_everything_says_so():
    assert describe_verdict(make_fit({"youngs_modulus": KNOWN})) == "Identified: youngs_modulus."


def test_what_was_not_fitted_is_not_in_the_verdict():
    others = {name: Estimate(1.0, 0.1, (0.9, 1.1), "-", 1.0, True, name) for name in ("derived", "held fixed", "prior")}
    assert describe_verdict(make_fit({"youngs_modulus": KNOWN, **others})) == "Identified: youngs_modulus."


def test_what_is_not_identifiable_is_named_with_where_to_look():
    fit = make_fit({"youngs_modulus": KNOWN, "bending.stiffness": UNKNOWN}, experiment="a slow lift")
    line = "Identified: youngs_modulus. Not identifiable: bending.stiffness. The column 'to determine it' says which"
    assert describe_verdict(fit).startswith(line)


@pytest.mark.parametrize(
    ("reasons", "sentence"),
    [
        ({"clock": 0.4, "camera": 0.2}, "Most likely reason of the misfit: a lag of the stamps, or a grip"),
        ({"clock": 0.1, "jitter": -0.1}, "No error of the recording explains the misfit: `torchcloth diagnose` looks"),
        ({}, "The notes above the tables say why."),
    ],
)
def test_a_withdrawn_fit_names_the_most_likely_reason(reasons, sentence):
    fit = make_fit({"youngs_modulus": UNKNOWN}, withdrawn=True, likely_reasons=reasons)
    assert describe_verdict(fit).startswith(f"Identified: nothing. Not identifiable: youngs_modulus. {sentence}")


@pytest.mark.parametrize("withdrawn", [True, False])
def test_numbers_that_were_withdrawn_have_no_interval(capsys, withdrawn):
    parameters = {"youngs_modulus": UNKNOWN, "cone": Estimate(0.3, 0.1, (0.1, 0.5), "-", 0.3, False, "held fixed")}
    print_fit(make_fit(parameters, withdrawn=withdrawn))
    table = capsys.readouterr().out.partition("Parameters")[2]
    assert ("1.1e-06 … 9e-05" in table) == (not withdrawn)
    assert "0.1 … 0.5" in table


def test_notes_stand_above_the_tables_and_distances_are_millimetres(capsys):
    clock, camera = (Estimate(0.0021, 0.0004, (0.001, 0.003), unit, 0.0, True, "nuisance") for unit in ("s", "m"))
    print_fit(make_fit({"youngs_modulus": KNOWN}, nuisances={"swing": {"clock": clock, "camera.x": camera}}))
    printed = capsys.readouterr().out
    assert printed.startswith("note: a note\n")
    assert "swing: clock 0.0021 ± 0.0004 s, camera.x 2.1 ± 0.4 mm" in printed
    assert [line.split()[-2:] for line in printed.splitlines() if "fitted values" in line] == [["12.300", "12.300"]]
    assert "Chamfer [mm]" in printed


def test_errors_are_shown_in_millimetres():
    assert in_display_unit("m", 0.1234) == "123 mm"
    assert in_display_unit("m/s", 0.0123, 0.001) == "12.3 ± 1 mm/s"
    assert in_display_unit("rad", 0.02) == "0.02 rad"
