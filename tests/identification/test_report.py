"""Statements: every warning can be reached, none comes without its reason, and numbers are never bare."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from helpers.twins import build_cloth_at

import torchcloth as tc
from torchcloth.episodes.observed import Episode
from torchcloth.episodes.unknowns import apply_priors, collect_unknowns
from torchcloth.identification.estimators import levenberg_marquardt, linearity
from torchcloth.identification.fit_warnings import fit_warnings
from torchcloth.identification.nuisances import NuisanceSlice
from torchcloth.identification.residuals.metrics import DistanceMetrics
from torchcloth.identification.residuals.rigid_carry import CARRIED_NULL
from torchcloth.identification.result import Identification
from torchcloth.identification.uncertainty.estimates import (
    Estimate,
    EstimateSet,
    make_estimates,
    make_nuisance_estimates,
    withdraw_estimates,
)

GOOD = Estimate(2.0, 0.1, (1.8, 2.2), "-", 1.0, True)
LOST = Estimate(2.0, 1.9, (0.1, 9.0), "-", 1.0, False)
FIT = {"chamfer_before": 5e-3, "chamfer_after": 0.8e-3, "chamfer_null": 10e-3, "rms_after": 1e-3}
EPISODE = Episode("shake", {}, torch.zeros(9), [], torch.zeros(0, 3), needs_settling=True, noise_std=1e-3)


def answer(a=GOOD, b=GOOD, correlation=0.0, density=True):
    parameters = {"a": a, "b": b}
    if density:
        parameters["areal_density"] = Estimate(0.3, 0.005, (0.29, 0.31), "kg/m^2", 0.3, True, "prior")
    matrix = {m: {n: float(m == n) for n in parameters} for m in parameters}
    matrix["a"]["b"] = matrix["b"]["a"] = correlation
    return EstimateSet(parameters, matrix)


def warn(model, what=None, fit=None, episodes=(EPISODE,), frames=None, null=""):
    flat = torch.as_tensor(model.mesh.vertices).expand(2, -1, -1)
    faces = torch.as_tensor(model.mesh.faces)
    frames = [flat] if frames is None else frames
    return fit_warnings(model, episodes, what or answer(), {**FIT, **(fit or {})}, frames, faces, null)


def folded(model):
    """The sheet doubled over itself, the halves 5 mm apart."""
    x = torch.as_tensor(model.mesh.vertices).clone()
    over = x[:, 0] > 0.15
    x[over, 2] = 5e-3
    x[over, 0] = 0.3 - x[over, 0]
    return x.expand(2, -1, -1)


def test_a_good_fit_has_no_warnings(model):
    assert warn(model) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"null": CARRIED_NULL}, "no better than cloth carried rigidly"),
        ({"fit": {"chamfer_before": 0.7e-3}}, "farther from the points than the start"),
        ({"what": answer(a=LOST)}, "a is not identifiable from these data"),
        ({"what": answer(correlation=-0.97)}, "b and a are confounded (correlation -0.97)"),
        ({"what": answer(density=False)}, "areal density was taken as exact"),
        ({"fit": {"rms_after": 2.1e-3}}, "the residual (2.1 mm rms) exceeds 1.3 times the sensor noise (1.0 mm)"),
        ({"episodes": (EPISODE, replace(EPISODE, needs_settling=False))}, "an episode has no initial_vertices"),
        ({"episodes": (replace(EPISODE, frames_after_motion=3),)}, "shake: 3 of 12 frames come after the motion's end"),
    ],
)
def test_every_warning_comes_alone_with_its_reason(model, change, said):
    (warning,) = warn(model, **change)
    assert said in warning


def test_layers_that_meet_are_noticed_where_contact_was_left_out(model, recording):
    (warning,) = warn(model, frames=[folded(model)])
    assert warning == "layers of the cloth come near each other, and contact was left out: fit with contact"
    with_contact = tc.Cloth(model.mesh, tc.materials.AEP(4e4, 0.3), 0.3, contact=tc.Contact())
    assert warn(with_contact, frames=[folded(model)]) == []


def test_unknown_noise_is_not_compared(model):
    assert warn(model, fit={"rms_after": 1.0}, episodes=(replace(EPISODE, noise_std=None),)) == []


def test_what_was_measured_or_absent_is_not_called_unidentifiable(model):
    absent = Estimate(1.0, 9.0, (0.1, 9.0), "-", 1.0, False, "not in the model")
    assert warn(model, answer(a=absent)) == []


def test_an_unstable_motion_is_said_and_differences_replace_tangents():
    """A residual that wobbles: its slope at a point is not its slope over a standard error."""
    rows, one = 60, torch.ones(60)
    frame, patch = torch.arange(rows) % 6 + 1, torch.arange(rows) % 4
    noise = 1e-3 * torch.randn(rows, generator=torch.Generator().manual_seed(0))
    spread = torch.linspace(-1, 1, rows)

    def linear(slope):
        return levenberg_marquardt.Linearised(noise, slope * 1e-2 * spread[:, None], one, frame, patch)

    class Fake(SimpleNamespace):
        def problem(self):
            one = torch.ones(1)
            return levenberg_marquardt.Problem(
                None, None, None, prior_mean=0 * one, prior_std=one, max_step=one, noise_floor=1e-3
            )

        def linearise_by_differences(self, raw, steps):
            assert 0.005 <= float(steps[0]) <= 0.1
            return linear(self.secant), None

    def at_slope(slope):
        size, of_part = torch.tensor([1e-3]), torch.ones(1)
        return levenberg_marquardt.Iterate(
            torch.zeros(1), linear(slope), True, size, of_part, torch.tensor([torch.inf])
        )

    def made(name, secant):
        cloth, blocks = SimpleNamespace(mesh=SimpleNamespace(extent=1.0)), [SimpleNamespace(unit="m")]
        return Fake(unknowns=[SimpleNamespace(name=name, measured=False)], blocks=blocks, cloth=cloth, secant=secant)

    at_start = at_slope(1.0)
    for secant, warned, bent in ((1.2, False, []), (1.4, False, ["youngs_modulus"]), (5.0, True, [])):
        fake = made("youngs_modulus", secant)
        checked = linearity.check_linearity(fake, at_start)
        assert bool(checked.warnings) == checked.is_withdrawn == warned
        assert checked.curved_parameters == bent
        assert (checked.final.linear is not at_start.linear) == warned
    assert "tangents of youngs_modulus differ from finite steps by up to 80 %" in checked.warnings[0]
    away = at_start._replace(linear=linear(1e4))
    assert linearity.has_runaway_tangents(fake, away)
    assert not linearity.has_runaway_tangents(fake, at_start)
    for slope, warned in ((1e-3, False), (1.0, True)):  # what no reading notices misleads none; runaway tangents do
        fake = made("density", 5e-3)
        assert bool(linearity.check_linearity(fake, at_slope(slope)).warnings) == warned


# -- estimates -------------------------------------------------------------------------------------------------------


def stated(model, deviation, names=("youngs_modulus", "air.normal")):
    unknowns = collect_unknowns(model, names, None)
    raw = torch.tensor([u.start for u in unknowns])
    return make_estimates(model, unknowns, raw, torch.diag(torch.tensor(deviation) ** 2)).parameters


def test_errors_of_logarithms_become_errors_of_values(model):
    p = stated(model, [0.1, 0.05])["youngs_modulus"]
    assert p.std == pytest.approx(0.1 * 8e4)
    assert p.ci95 == pytest.approx((8e4 * math.exp(-0.196), 8e4 * math.exp(0.196)), rel=1e-5)
    assert p.identifiable


def test_identifiable_is_an_error_below_a_quarter(model):
    assert stated(model, [0.24, 0.05])["youngs_modulus"].identifiable
    assert not stated(model, [0.26, 0.05])["youngs_modulus"].identifiable


def test_a_default_prior_is_no_knowledge(recording):
    """That of a Poisson's ratio near one half is narrow beside its value."""
    model = build_cloth_at(recording, poisson_ratio=0.4)
    assert not stated(model, [1.0], ["poisson_ratio"])["poisson_ratio"].identifiable
    assert stated(model, [0.3], ["poisson_ratio"])["poisson_ratio"].identifiable
    stiff = build_cloth_at(recording, **{"bending.stiffness": 1e-3})
    wide = collect_unknowns(stiff, ["bending.stiffness"], None)[0].prior_std
    assert not stated(stiff, [wide], ["bending.stiffness"])["bending.stiffness"].identifiable


def test_an_amplitude_of_zero_can_be_known(recording):
    """No drag, known to 0.1 where 1.2 is typical, is a finding; its interval ends at zero."""
    p = stated(build_cloth_at(recording, **{"air.normal": 0.0}), [0.1, 0.1])["air.normal"]
    assert p.identifiable
    assert p.ci95[0] == 0.0
    assert p.ci95[1] == pytest.approx(0.196, rel=1e-4)


def test_what_is_withdrawn_is_not_identified_by_its_prior_either(model):
    """The fit took it to elsewhere, with the error of slopes that mean nothing: its prior's is what is known."""
    unknowns = apply_priors(
        collect_unknowns(model, ["youngs_modulus", "poisson_ratio"], (0.3, 0.005)), {"youngs_modulus": (1e6, 1.01)}
    )
    raw = torch.tensor([u.start for u in unknowns])
    fitted = make_estimates(model, unknowns, raw, torch.diag(torch.full((3,), 1e-12)))
    assert fitted.parameters["youngs_modulus"].source == fitted.parameters["areal_density"].source == "prior"
    p = withdraw_estimates(fitted, unknowns, raw).parameters
    assert not any(e.identifiable for e in p.values())
    assert p["youngs_modulus"].std == pytest.approx(8e4 * math.hypot(math.log(1.01), math.log(12.5)))
    assert p["youngs_modulus"].ci95 == pytest.approx((8e4, 1.0197e6), rel=1e-3)
    assert p["areal_density"].std == pytest.approx(0.005)


def test_nuisances_of_what_is_withdrawn_are_not_known_either():
    """Their tiny errors are those of slopes that mean nothing, as the parameters' are."""
    unbounded = [(-math.inf, math.inf)]
    clock = NuisanceSlice(None, slice(0, 1), ["clock"], ["s"], [0.02], unbounded)
    episode = SimpleNamespace(name="swing")
    raw, covariance = torch.tensor([0.012]), torch.tensor([[3e-4**2]])
    answer = make_nuisance_estimates([episode], [[clock]], raw, covariance)["swing"]["clock"]
    assert (answer.identifiable, answer.std) == (True, pytest.approx(3e-4))
    answer = make_nuisance_estimates([episode], [[clock]], raw, covariance, withdrawn=True)["swing"]["clock"]
    assert not answer.identifiable
    assert answer.std == pytest.approx(math.hypot(0.02, 0.012))
    assert answer.ci95 == pytest.approx((-0.0392, 0.0392), rel=1e-3)


def test_what_is_withdrawn_far_from_its_start_is_uncertain_by_the_way(model):
    """Predictions read std over value as the error of a logarithm."""
    unknowns = collect_unknowns(model, ["youngs_modulus"], None)
    for factor in (1e-3, 1e3):
        raw = torch.tensor([unknowns[0].start + math.log(factor)])
        e = withdraw_estimates(make_estimates(model, unknowns, raw, torch.eye(1)), unknowns, raw).parameters[
            "youngs_modulus"
        ]
        assert e.std / e.value == pytest.approx(math.hypot(math.log(10), math.log(factor)))


def test_friction_is_judged_against_a_friction_s_size():
    mesh = tc.meshes.rectangle(0.2, 0.2, triangles=18)
    table = {"table": tc.boundaries.Plane(friction=0.1)}
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), 0.2, {"gravity": tc.effects.Gravity()}, table, tc.Contact(0.05))
    unknowns = collect_unknowns(cloth, ["table.friction", "cone"], None)
    answer = make_estimates(cloth, unknowns, torch.tensor([0.05, 0.05]), torch.eye(2) * 0.2**2).parameters
    assert not answer["table.friction"].identifiable
    assert not answer["cone"].identifiable
    known = make_estimates(cloth, unknowns, torch.tensor([0.05, 0.05]), torch.eye(2) * 0.05**2).parameters
    assert known["cone"].identifiable


# -- result ----------------------------------------------------------------------------------------------------------


def outcome(**changes):
    filled = {f"{k}_{w}": 1e-3 for k in ("chamfer", "rms") for w in ("before", "after", "null")}
    parts = {"parameters": {"a": GOOD}, "fit": filled, "correlation": {}, "warnings": [], "history": []}
    return Identification(**{**parts, "frames_before": [], "frames_after": [], "frames_null": [], **changes})


def test_saving_is_atomic(tmp_path, monkeypatch):
    """A failure in the middle leaves the old file, and no part of the new one beside it."""
    path = outcome().save(tmp_path)
    old = path.read_text()
    monkeypatch.setattr("os.fsync", lambda handle: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        outcome(warnings=["new"]).save(tmp_path)
    assert path.read_text() == old
    assert [p.name for p in tmp_path.iterdir()] == ["identification.json"]


def test_what_is_not_json_is_not_written(tmp_path):
    broken = outcome(parameters={"a": Estimate(math.nan, math.inf, (0.0, math.inf), "-", 1.0, False)})
    with pytest.raises(ValueError, match="JSON"):
        broken.save(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_figures_of_a_fit_name_what_they_count():
    """``fit`` is one flat object of numbers."""
    assert set(DistanceMetrics._fields) == {"chamfer", "rms", "per_frame"}
    assert all(isinstance(value, float) for value in outcome().as_dict()["fit"].values())


def test_errors_that_add_up_to_more_than_the_prior_end_at_its_width(model):
    """A considered grip once made a deviation of thousands in the logarithm, and an infinite interval."""
    unknowns = collect_unknowns(model, ("youngs_modulus",), None)
    raw = torch.tensor([unknowns[0].start])
    estimate = make_estimates(model, unknowns, raw, torch.tensor([[4e6]])).parameters["youngs_modulus"]
    assert estimate.std == pytest.approx(estimate.value * unknowns[0].prior_std)
    assert estimate.ci95[1] / estimate.value == pytest.approx(math.exp(1.96 * unknowns[0].prior_std), rel=1e-3)
    assert not estimate.identifiable
