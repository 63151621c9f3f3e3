"""A fit on a coarse mesh, corrected by one simulation on a finer one."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import twins

import torchcloth as tc
from torchcloth.boundaries import Grasp
from torchcloth.episodes.unknowns import collect_unknowns
from torchcloth.errors import InvalidInput, SimulationDiverged
from torchcloth.identification import build_episode, identify
from torchcloth.identification.estimators import levenberg_marquardt
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.fit import default_parameters
from torchcloth.identification.uncertainty import richardson
from torchcloth.identification.uncertainty.model_error import MODEL_ERRORS
from torchcloth.identification.uncertainty.richardson import MeshCorrection, refine_cloth, refine_recording

PAIR = ["youngs_modulus", "air.normal"]


@pytest.fixture(scope="module")
def corrected(recording):
    """As the fit ``plain``, corrected for its mesh."""
    with twins.use_float64():
        return identify(twins.build_cloth_at(recording), recording, PAIR, refine=True, exact_bench=True)


def test_the_finer_mesh_is_the_same_cloth(model, recording):
    fine = refine_cloth(model)
    assert len(fine.mesh.faces) == 4 * len(model.mesh.faces)
    assert fine.mesh.area.sum() == pytest.approx(model.mesh.area.sum(), rel=1e-12)
    assert float(fine.material.youngs_modulus.value) == float(model.material.youngs_modulus.value)
    episode = refine_recording(recording, model.mesh, fine.mesh)
    first, coarse = episode.cloth.initial_vertices, recording.cloth.initial_vertices
    np.testing.assert_array_equal(first[: len(coarse)], coarse)
    assert np.abs(first).max() <= np.abs(coarse).max()


def test_a_finer_mesh_keeps_the_gap_between_layers(model):
    touching = tc.Cloth(model.mesh, tc.materials.AEP(1e5), 0.2, contact=tc.Contact())
    assert refine_cloth(touching).contact_grid().spacing == touching.contact_grid().spacing


def test_a_grip_holds_the_new_vertices_between_those_it_held():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(3, 3))
    sheet = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, boundaries={"bar": Grasp([0, 1, 2])}, contact=None)
    fine = refine_cloth(sheet)
    gripped = np.asarray(fine.mesh.uv)[fine.boundaries["bar"].index]
    assert sorted(gripped[:, 1].round(6).tolist()) == [0.0, 0.05, 0.1, 0.15, 0.2]
    assert (gripped[:, 0] == 0).all()


@pytest.mark.parametrize(
    "grip",
    [
        Grasp(uv=[[0.0, 0.05], [0.0, 0.1], [0.0, 0.15]], radius=0.06),
        Grasp(uv=[[0.0, 0.1]], radius=0.11),
        Grasp.corner("lower-left", 0.06),
        Grasp.at("lower-left", 0.06),
    ],
    ids=["bar", "patch", "corner", "place"],
)
def test_a_patch_that_ends_between_vertices_holds_no_more_of_a_finer_mesh(grip):
    """Its next row came within the radius, or was moved there: a bar held 12 of 300 mm more of the cloth, and the drag
    of 48 twins was corrected from 1.0 to 0."""
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(3, 3))
    mesh = tc.meshes.Mesh.build(mesh.vertices, mesh.faces, mesh.uv, {"lower-left": [0]})
    sheet = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, boundaries={"grip": grip}, contact=None)
    fine = refine_cloth(sheet)
    coarse, now = (np.asarray(c.mesh.uv)[c.boundaries["grip"].index.numpy()] for c in (sheet, fine))
    assert (now.min(0), now.max(0)) == (pytest.approx(coarse.min(0)), pytest.approx(coarse.max(0)))
    assert len(now) >= 2 * len(coarse) - 1  # those between
    assert fine.boundaries["grip"].bind(fine.mesh).index.tolist() == fine.boundaries["grip"].index.tolist()


def test_a_residual_force_is_no_parameter_and_no_obstacle(model):
    """As in the extended model of a diagnosis: its strengths are not fitted, and it stays on the finer mesh."""
    law = tc.effects.ResidualForce({"across": 0.1, "mass@edge": 0.01}, gripped_vertices=[0, 1])
    cloth = tc.Cloth(model.mesh, tc.materials.AEP(1e5), 0.2, {"residual": law}, contact=None)
    assert "residual.strength" not in default_parameters(cloth)
    fine = refine_cloth(cloth)
    assert fine.effects["residual"].gripped_vertices == (0, 1)
    assert len(fine.effects["residual"].vertex_area) == len(fine.mesh.vertices)


def test_fields_are_refused_before_anything_is_computed(model, recording):
    model.material.youngs_modulus.raw.data = model.material.youngs_modulus.raw.data.expand(
        len(model.mesh.faces)
    ).clone()
    with pytest.raises(InvalidInput, match=r"finer mesh: material.youngs_modulus.*one number for all triangles"):
        identify(model, recording, ["air.normal"], refine=True)


def test_a_profile_is_that_of_the_given_mesh(model, recording):
    with pytest.raises(InvalidInput, match="profile; got refine as well; expected one of them"):
        identify(model, recording, PAIR, refine=True, profile=PAIR[:1])


def test_a_finer_mesh_that_cannot_be_simulated_leaves_the_fit_and_says_so(model, brief, monkeypatch):
    def torn(*_):
        raise SimulationDiverged("the cloth is torn apart")

    monkeypatch.setattr(richardson, "mesh_correction", torn)
    result = identify(model, brief, ["youngs_modulus"], refine=True, exact_bench=True)
    assert result.parameters == identify(model, brief, ["youngs_modulus"], exact_bench=True).parameters
    assert "mesh_correction" not in result.fit
    assert any("not corrected for the coarseness of the mesh: on a finer one, the cloth" in w for w in result.warnings)


def test_it_moves_towards_what_a_finer_mesh_finds(recording, model, plain, corrected):
    """The truth has 11 x 11 vertices, the model 7 x 7; a fit on 13 x 13, which costs eight times as much, judges."""
    fine = refine_cloth(model)
    judge = identify(fine, refine_recording(recording, model.mesh, fine.mesh), PAIR, exact_bench=True)
    for name in PAIR:
        a, b, c = (fit.parameters[name].value for fit in (plain, corrected, judge))
        assert abs(b - c) < max(0.7 * abs(a - c), 0.3 * judge.parameters[name].std), name
    assert corrected.fit["mesh_correction"] > 0
    assert "mesh_correction" not in plain.fit
    assert torch.equal(plain.frames_before[0], corrected.frames_before[0])


def test_a_correction_adds_a_quarter_of_itself_to_the_standard_error(model, plain, corrected):
    """A third of the step, of which the correction is four thirds. Simulators differ by a share of the value, which the
    correction may lower: the standard error as a whole need not grow."""
    for unknown in collect_unknowns(model, PAIR, None):
        estimates = [fit.parameters[unknown.name] for fit in (plain, corrected)]
        raw, variance = zip(*(_unconstrained(unknown, estimate) for estimate in estimates), strict=True)
        added = (0.25 * (raw[1] - raw[0])) ** 2
        assert added > 0
        assert variance[1] == pytest.approx(variance[0] + added, rel=1e-9), unknown.name


def _unconstrained(unknown, estimate):
    """(solution, its variance without the differences between simulators), in the unconstrained coordinate."""
    unknown.parameter.set(estimate.value)
    raw = float(unknown.parameter.raw)
    slope = unknown.slope(raw)
    return raw, (estimate.std / slope) ** 2 - (MODEL_ERRORS.other * estimate.value / slope) ** 2


@pytest.mark.slow
def test_a_mesh_that_is_fine_already_is_hardly_corrected(recording):
    """With the truth's own spacing halved the step is below a standard error. What noise does to it stays."""
    fine = refine_cloth(twins.build_cloth_at(recording))
    episode = refine_recording(recording, twins.build_cloth_at(recording).mesh, fine.mesh)
    coarse, finer = (
        identify(c, r, PAIR, refine=True, exact_bench=True).fit["mesh_correction"]
        for c, r in ((twins.build_cloth_at(recording), recording), (fine, episode))
    )
    assert finer < 0.7 * coarse
    assert finer < 1.0


def test_a_sewn_mesh_keeps_its_pattern():
    """Warp and weft of the shirt's panels are those of the coarse mesh: so is the energy of a stretched one."""
    mesh = tc.meshes.shirt(triangles=300)
    law = tc.materials.OrthotropicAEP(2e6, 2e5, 1e4, thickness=1e-3)
    grip = {"left": tc.boundaries.Grasp.at("left shoulder")}
    coarse = tc.Cloth(mesh, law, 0.15, boundaries=grip, contact=None)
    fine = refine_cloth(coarse)
    for stretch in ([1.05, 1.0, 1.0], [1.0, 1.05, 1.0]):
        of_part, other = (
            sum(c.energy(c.state(torch.as_tensor(c.mesh.vertices * stretch))).values()).item() for c in (coarse, fine)
        )
        assert other == pytest.approx(of_part, rel=1e-6)


def test_a_late_clock_is_no_difference_between_meshes(recording):
    late = recording
    moved = {n: _later(g, 0.03) for n, g in late.grippers.items()}  # frames were taken 30 ms after they say
    late = replace(late, grippers=moved)
    names, clock = ["youngs_modulus", "air.normal"], {"clock": 0.03}
    fit = identify(
        twins.build_cloth_at(late),
        late,
        names,
        nuisances=clock,
        refine=True,
        model_errors=twins.SAME_SIMULATOR,
        exact_bench=True,
    )
    result = fit.parameters["air.normal"]
    assert result.value == pytest.approx(twins.TRUE_FABRIC.drag, abs=3 * result.std)
    assert result.std < 0.05


def _later(g, by):
    """A gripper's motion, begun so much later."""
    parts = "position", "quat_wxyz", "closed"
    ahead = {name: np.concatenate([getattr(g, name)[:1], getattr(g, name)]) for name in parts}
    return replace(g, t=np.concatenate([g.t[:1], g.t + by]), **ahead)


def test_a_correction_that_cannot_be_simulated_is_none(model, brief, monkeypatch):
    plain = identify(model, brief, ["youngs_modulus"], exact_bench=True)
    seen, longest = Objective.observe, collect_unknowns(model, ["youngs_modulus"], None)[0].max_step

    def torn_elsewhere(self, raw):
        if float(raw[0] - ended[0]) > 0.05 * longest:
            raise SimulationDiverged("the cloth is torn apart")
        return seen(self, raw)

    def step(objective, final, *_):
        ended.append(float(final.raw[0]))
        moved = torch.zeros_like(final.raw)
        moved[0] = 0.1 * longest
        monkeypatch.setattr(Objective, "observe", torn_elsewhere)
        return MeshCorrection(moved, math.nan)

    ended = []
    monkeypatch.setattr(richardson, "mesh_correction", step)
    result = identify(model, brief, ["youngs_modulus"], refine=True, exact_bench=True)
    assert result.parameters == plain.parameters
    assert any("not corrected for the coarseness of the mesh: on a finer one, the cloth" in w for w in result.warnings)


@pytest.mark.parametrize(("gain_ratio", "is_applied"), [(0.6, True), (-0.3, False)])
def test_a_correction_that_a_finer_mesh_does_not_confirm_withdraws_what_it_moves(
    model, brief, monkeypatch, gain_ratio, is_applied
):
    def correct(objective, final, *_):
        step = torch.zeros_like(final.raw)
        step[0] = 5 * levenberg_marquardt.covariance(objective.problem(), final).diagonal().sqrt()[0]
        return MeshCorrection(step, gain_ratio)

    monkeypatch.setattr(richardson, "mesh_correction", correct)
    result = identify(model, brief, PAIR, refine=True, exact_bench=True)
    plain = identify(model, brief, PAIR, exact_bench=True)
    assert plain.parameters["youngs_modulus"].identifiable
    assert result.parameters["youngs_modulus"].identifiable is is_applied
    assert result.parameters["air.normal"].identifiable is plain.parameters["air.normal"].identifiable
    assert ("mesh_correction" in result.fit) is is_applied
    assert any("no estimate of youngs_modulus" in w for w in result.warnings) is not is_applied


def test_the_finer_mesh_confirms_what_it_asks_for(recording, model):
    """Along its own step its cost falls about as far as the slopes of the given mesh promise."""
    unknowns = collect_unknowns(model, PAIR, None)
    objective = Objective(model, unknowns, [build_episode(model, recording)])
    final = levenberg_marquardt.minimise(objective.problem(), objective.start, 20, lambda at: False)
    scene = richardson.FineScene(refine_cloth(model), [recording])
    correction = richardson.mesh_correction(objective, final, scene)
    assert correction.gain_ratio == pytest.approx(1.0, abs=0.5)
