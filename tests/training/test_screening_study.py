"""What is left out is, and nothing else; what the study of screening's parts counts, and that it runs (slow)."""

import json

import pytest
import torch
from helpers import linear_evidence as toys

from torchcloth.diagnosis import screen
from torchcloth.training.studies import screening, screening_ablations
from torchcloth.training.studies.command import main


def evidence(truth=(0.0, 0.3, 0.0, 0.7, 0.0), mesh=0.0):
    fitted = toys.draw_linearisation(toys.draw_jacobian(1, 6), 2, ["a", "b", "c"], torch.tensor(truth).double(), 0)
    return fitted.__class__(
        fitted.bins,
        fitted.n_coordinates,
        fitted.hypotheses,
        fitted.nuisance_stds,
        [mesh * c.jacobian[:, 3] for c in fitted.bins],
    )


def test_independent_errors_are_as_large_and_agree_with_nobody():
    fitted = toys.make_model_fit(evidence())
    other = screening_ablations.without_error_correlation(fitted)
    cells, nothing = fitted.linearisation.bins[0], torch.zeros(0).double()
    usual, alone = (f.noise.covariance(cells, cells.jacobian[:, :0], nothing) for f in (fitted, other))
    assert torch.equal(usual.diagonal(), alone.diagonal())
    assert float((alone - torch.diag(alone.diagonal())).abs().max()) == 0.0 < float((usual[0, 1:]).abs().max())
    assert other.linearisation is fitted.linearisation
    assert other.noise.smooth_fraction(cells).equal(fitted.noise.smooth_fraction(cells))


def test_exact_episodes_keep_all_but_their_nuisances():
    fitted = toys.make_model_fit(evidence())
    other = screening_ablations.without_nuisances(fitted)
    assert all(float(s.max()) < 1e-11 for s in other.linearisation.nuisance_stds)
    assert all(a is b for a, b in zip(fitted.linearisation.bins, other.linearisation.bins, strict=True))


def with_zero_threshold_only_what_matters_changes():
    rows = {
        r.hypothesis.name: r for r in screen(screening_ablations.with_zero_threshold(toys.make_model_fit(evidence())))
    }
    for r in screen(toys.make_model_fit(evidence())):
        assert rows[r.hypothesis.name].amplitude == r.amplitude
        assert rows[r.hypothesis.name].hypothesis.smallest_of_interest == 0.0 < r.hypothesis.smallest_of_interest


def test_on_one_mesh_residuals_are_those_of_the_given_one():
    fitted = toys.make_model_fit(evidence(mesh=-0.5))
    other = screening_ablations.without_mesh_error(fitted)
    for a, b, n in zip(
        fitted.linearisation.bins, other.linearisation.bins, fitted.linearisation.mesh_differences, strict=True
    ):
        assert torch.equal(b.value, a.value + n)
        assert torch.equal(b.jacobian, a.jacobian)
    assert not any(n.any() for n in other.linearisation.mesh_differences)


def test_a_rigid_fabric_leaves_all_to_the_causes():
    """What is asked for is then the plain regression on that cause alone."""
    fitted = screening_ablations.with_fixed_parameters(toys.make_model_fit(evidence()))
    slopes, value = fitted.whitened.jacobian[:, fitted.linearisation.n_coordinates :], fitted.whitened.value
    for r in screen(fitted):
        k = [h.name for h in fitted.linearisation.hypotheses].index(r.hypothesis.name)
        assert r.amplitude == pytest.approx(-float(slopes[:, k] @ value / slopes[:, k].square().sum()), rel=1e-5)


def row(effect, amplitude, decision="present"):
    return {"effect": effect, "amplitude": amplitude, "std": 0.1, "decision": decision}


def hidden(name, amplitude, is_enabling=False):
    name_without_axis = name.partition("[")[0]
    return {
        "names": [name_without_axis],
        "hypothesis": name,
        "amplitude": amplitude,
        "sign": 1.0,
        "is_enabling": is_enabling,
    }


def test_what_is_present_and_not_there_is_counted_is_enabling_the_size_of_what_is():
    ways = {"one": [row("air.wind[x]", 0.33), row("air.drag_n", 1.0), row("mass.hem", 0.1), row("obs.clock", 1, "no")]}
    case = {"hidden": [hidden("air.drag_n", 1.2, is_enabling=True), hidden("air.wind[x]", 0.3)], "ways": ways}
    assert screening.count_present(case, "one") == "1 (1.10)"
    assert screening.count_present({**case, "hidden": []}, "one") == "3"
    other_way = [hidden("air.drag_n", 1.2, is_enabling=True), hidden("air.wind[x]", 0.3) | {"sign": -1.0}]
    assert screening.count_present({**case, "hidden": other_way}, "one") == "1 (-1.10)"
    other_axis = [hidden("air.drag_n", 1.2, is_enabling=True), hidden("air.wind[y]", 0.3)]
    assert screening.count_present({**case, "hidden": other_axis}, "one") == "2 (–)"
    assert screening.count_present({**case, "ways": {"one": []}}, "one") == "0 (–)"


def test_a_wrong_number_of_jobs_is_refused(tmp_path, capsys):
    assert main(["screening", "--jobs", "0", "--out", str(tmp_path / "p")]) == 2
    assert "--jobs" in capsys.readouterr().err
    assert not (tmp_path / "p").exists()


@pytest.mark.slow
def test_a_null_and_a_drag_are_screened_in_all_ways(tmp_path, capsys):
    pytest.importorskip("mujoco", minversion="4.0")
    assert main(["screening", "--fast", "--out", str(tmp_path / "p")]) == 0
    null, drag = json.loads((tmp_path / "p" / "screening.json").read_text())["cases"]
    assert null["hidden"] == []
    assert [e["hypothesis"] for e in drag["hidden"]] == ["air.drag_n"]
    assert not [r for r in null["ways"][screening.ALL_PARTS] if r["decision"] == "present"]
    assert any(r["effect"] == "air.drag_n" and r["decision"] == "present" for r in drag["ways"][screening.ALL_PARTS])
    assert len(drag["ways"]) == 8
    assert "by tangents" in capsys.readouterr().out
