"""What a model file gives: a layer, a start for fits, a prediction, and a gain that can be confirmed."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import sheet_episodes

import torchcloth as tc
from torchcloth import diagnosis as dx
from torchcloth import recordings as rec
from torchcloth.cli import main
from torchcloth.cli.identify import describe_causes_outside_cloth
from torchcloth.errors import InvalidInput
from torchcloth.identification import build_cloth, identify, load_fitted_cloth, predict_episode
from torchcloth.recordings.fingerprints import fingerprint
from torchcloth.viewing import film_from_fit

TRUE = 1.5


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """(base and extended model files, an episode of another motion than they know)."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    folder, blank = tmp_path_factory.mktemp("models"), sheet_episodes.make_episode()
    by = {h.name: h for h in dx.list_hypotheses(dx.build_base_model(blank), [blank])}
    base = dx.build_base_model(blank)
    extended = base.with_hypothesis(by["air.drag_n"], TRUE).with_hypothesis(by["obs.clock"], 0.0)
    dx.save_model(folder / "base.tcm", base, blank)
    covariance = torch.diag(torch.tensor([0.02, 0.5, 0.05, 0.01, 1.2, 0.03, 1e-3]).double() ** 2)
    dx.save_model(folder / "extended.tcm", extended, blank, covariance, episodes=[fingerprint(blank)])
    seen = sheet_episodes.record_changed_world("fast", lambda world: by["air.drag_n"].apply(world, TRUE), 3)
    yield folder, rec.read(rec.write(seen, folder / "fast")), blank
    torch.set_default_dtype(before)


def test_a_model_file_is_a_layer(made):
    folder, _, blank = made
    cloth = tc.load(folder / "extended.tcm")
    assert isinstance(cloth, tc.Cloth)
    assert cloth.effects["air"].normal.value.item() == pytest.approx(TRUE)
    unlearned = {name for name, p in cloth.named_parameters() if not p.requires_grad}
    in_contact = {f"material.{name}.raw" for name in ("contact_stiffness", "shear_stiffness", "cone")}
    assert unlearned == {"effects.gravity.acceleration", "effects.gravity.tilt", "effects.air.wind"} | in_contact
    first = torch.as_tensor(blank.cloth.initial_vertices)
    pose = torch.eye(4).repeat(2, 1, 1)
    pose[1, 1, 3] = 0.01
    hold = tc.Trajectory(torch.tensor([0.0, 0.02]), pose, torch.ones(2, dtype=torch.bool))
    out = cloth(cloth.state(first), {"left": hold, "right": hold}, times=[0.0, 0.02])
    out.x[-1].sum().backward()
    assert float(cloth.effects["air"].normal.raw.grad.abs()) > 0


def test_what_is_not_in_the_cloth_is_beside_it(made, tmp_path):
    _, _, blank = made
    base = dx.build_base_model(blank)
    clock = next(h for h in dx.list_hypotheses(base, [blank]) if h.name == "obs.clock")
    dx.save_model(tmp_path / "late.tcm", base.with_hypothesis(clock, -0.03), blank)
    assert dx.list_causes_outside_cloth(dx.load_model(tmp_path / "late.tcm")) == {"obs.clock": -0.03}
    assert len(dx.load_world(tmp_path / "late.tcm").observation_transforms) == 1


def test_a_fit_that_began_with_a_model_brings_it_along(made, tmp_path):
    """Its effects stay, and its numbers are the fit's."""
    folder, seen, _ = made
    model = folder / "extended.tcm"
    begun = identify(dx.load_cloth_for(model, seen), seen, ["youngs_modulus"], iterations=1, exact_bench=True)
    path = begun.save(tmp_path / "fit", model)
    cloth, _ = load_fitted_cloth(path, seen, dx.make_start_builder(path))
    assert cloth.effects["air"].normal.value.item() == pytest.approx(TRUE)
    assert cloth.material.youngs_modulus.value.item() == begun.parameters["youngs_modulus"].value
    assert predict_episode(path, seen, dx.make_start_builder(path)).metrics["chamfer"] < 0.01
    assert "mm from the points" in film_from_fit(seen, tmp_path / "fit").title
    with pytest.raises(InvalidInput, match=r"a fit of another model.*give build_start=diagnosis.make_start_builder"):
        load_fitted_cloth(path, seen)
    plain = identify(build_cloth(seen), seen, ["youngs_modulus"], iterations=1, exact_bench=True)
    assert dx.make_start_builder(plain.save(tmp_path / "fit")) is None


def test_what_a_fit_leaves_out_of_a_model_is_said_with_what_allows_for_it(made):
    _, _, blank = made
    base = dx.build_base_model(blank)
    clock = next(h for h in dx.list_hypotheses(base, [blank]) if h.name == "obs.clock")
    own = dx.Hypothesis("my.view", "m", 0.01, lambda w, a: w.with_observation_transform(lambda frames, e: frames))
    late, mine = describe_causes_outside_cloth(base.with_hypothesis(clock, -0.03).with_hypothesis(own, 0.02))
    where = "of the model belongs to robot or camera, not to the cloth"
    assert late == f"obs.clock = -0.03 {where}: --nuisance clock allows for it"
    assert mine == f"my.view = 0.02 {where}: no option allows for it"


def test_what_was_confirmed_goes_with_its_models(tmp_path):
    gone = [tmp_path / name for name in ("confirmation/confirmation.json", "base.tcm", "extended.tcm")]
    gone[0].parent.mkdir()
    for path in gone:
        path.write_text("of a diagnosis before")
    dx.write_diagnosis(dx.refuse([dx.Fault("e1", "a clock that jumps", "record again")]), [], tmp_path)
    assert not any(path.exists() for path in gone)
    assert json.loads((tmp_path / "diagnosis.json").read_text())["verdict"] == "invalid_data"


def test_a_grip_that_is_wider_is_in_the_cloth(made):
    """By 30 mm, of which the pattern has room for once."""
    _, _, blank = made
    by = {h.name: h for h in dx.list_hypotheses(dx.build_base_model(blank), [blank])}
    wide = dx.build_base_model(blank).with_hypothesis(by["grip.width"], 0.03).with_hypothesis(by["obs.clock"], 0.01)
    assert dx.list_causes_outside_cloth(wide) == {"obs.clock": 0.01}


def test_a_model_knows_its_episodes(made):
    folder, fast, blank = made
    assert dx.was_fitted(folder / "extended.tcm", blank)
    assert not dx.was_fitted(folder / "extended.tcm", fast)


def test_numbers_of_any_precision_are_kept(made, tmp_path):
    _, _, blank = made
    own = replace(blank.cloth, areal_density=np.float32(0.2))
    path = dx.save_model(tmp_path / "m.tcm", dx.build_base_model(blank), replace(blank, cloth=own))
    assert dx.load(path).areal_density.value.item() == pytest.approx(0.2)


def test_another_scene_keeps_the_fabric_and_another_fabric_is_refused(made):
    folder, seen, _ = made
    elsewhere = replace(seen, grasps={"left": seen.grasps["left"]})
    cloth = dx.load_cloth_for(folder / "extended.tcm", elsewhere)
    assert list(cloth.boundaries) == ["left"]
    assert "air" in cloth.effects
    heavy = replace(seen, cloth=replace(seen.cloth, areal_density=0.4))
    with pytest.raises(InvalidInput, match=r"another fabric.*0\.4.*expected 0\.2"):
        dx.load_cloth_for(folder / "extended.tcm", heavy)


def test_a_model_makes_no_two_cloths_one(made):
    folder, seen, blank = made
    other = replace(seen.cloth, nominal=seen.cloth.nominal | {"membrane_stiffness": 1.0})
    with pytest.raises(InvalidInput, match="another data sheet"):
        dx.start_from_model(folder / "extended.tcm", [blank, replace(seen, cloth=other)])


def test_a_diagnosis_begins_with_a_models_fabric_in_the_scene_of_its_episodes(made):
    """And writes what it finds beside the data sheet that the numbers are relative to."""
    folder, seen, blank = made
    plane = rec.Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.4)
    other = replace(seen.cloth, nominal=seen.cloth.nominal | {"membrane_stiffness": 1.0})
    model, told = dx.start_from_model(folder / "extended.tcm", [replace(seen, colliders={"table": plane}, cloth=other)])
    assert "table" in model.build_world().cloth.boundaries
    assert dict(zip([h.name for h in model.accepted], model.amplitudes, strict=True))["air.drag_n"] == TRUE
    assert told[0].cloth.nominal == seen.cloth.nominal
    assert model.episode_fingerprints == (fingerprint(blank),), "episodes whose data it carries on"
    own, new = (
        m.build_world().cloth.material.youngs_modulus.value for m in (dx.load_model(folder / "extended.tcm"), model)
    )
    assert float(own) == pytest.approx(float(new))


def test_priors_come_from_what_data_told(made):
    folder, seen, _ = made
    spread = dx.derive_priors(dx.read_model(folder / "extended.tcm", seen))
    assert set(spread) == {"youngs_modulus", "bending.stiffness"}  # the others are no better than their data sheet
    assert spread["youngs_modulus"] == pytest.approx((6e4, 1.0202), rel=1e-4)


def test_a_prediction_has_errors_and_meets_the_truth(made, tmp_path):
    folder, seen, _ = made
    found = dx.predict_episode(folder / "extended.tcm", seen)
    assert found.metrics["rms"] < 0.5 * dx.predict_episode(folder / "base.tcm", seen).metrics["rms"]
    assert 0 < float(found.vertex_std.max()) < 0.01
    assert main(["predict", str(folder / "extended.tcm"), str(folder / "fast"), "--out", str(tmp_path / "p")]) == 0
    assert json.loads((tmp_path / "p" / "prediction.json").read_text())["measured"]["rms"] == found.metrics["rms"]


def test_a_motion_that_is_only_planned_is_predicted_and_drawn(made, tmp_path):
    folder, seen, _ = made
    rec.write(replace(seen, points=None), tmp_path / "e")
    model = folder / "extended.tcm"
    assert main(["predict", str(model), str(tmp_path / "e"), "--out", str(tmp_path / "p")]) == 0
    found, known = (dx.predict_episode(model, e) for e in (rec.read(tmp_path / "e"), seen))
    torch.testing.assert_close(found.episode.times.diff(), torch.full((len(found.vertex_std) - 1,), 0.05))
    k = [int((known.episode.times - t).abs().argmin()) for t in found.episode.times]
    near = (known.episode.times[k] - found.episode.times).abs() < 1e-9
    assert near.sum() > 3
    torch.testing.assert_close(found.frames.x[near], known.frames.x[k][near], atol=1e-5, rtol=0)
    film = film_from_fit(rec.read(tmp_path / "e"), model)
    assert film.sheets["cloth"].vertices.shape == tuple(found.frames.x.shape)


def test_a_model_is_looked_at_beside_the_points(made):
    folder, seen, _ = made
    base, extended = (film_from_fit(seen, folder / name) for name in ("base.tcm", "extended.tcm"))
    far = [film.curves["distance"].values.mean() for film in (base, extended)]  # mm
    assert far[1] < 0.5 * far[0]
    assert f"extended model, {far[1]:.2f} mm from the points" in extended.title
    found = dx.predict_episode(folder / "extended.tcm", seen).frames.x.numpy()
    np.testing.assert_allclose(extended.sheets["cloth"].vertices, found, atol=1e-6)


def test_a_late_clock_is_looked_at_beyond_the_last_frame(made, tmp_path):
    folder, seen, blank = made
    model = dx.load_model(folder / "extended.tcm")
    late = model.at_point(torch.cat([model.point[:-1], model.point.new_tensor([0.03])]))
    dx.save_model(tmp_path / "late.tcm", late, blank)
    early = replace(seen, points=seen.points.select(seen.points.t < 0.6 * seen.points.t[-1]))  # the motion goes on
    x = film_from_fit(early, tmp_path / "late.tcm").sheets["cloth"].vertices
    np.testing.assert_allclose(x, dx.predict_episode(tmp_path / "late.tcm", early).frames.x.numpy(), atol=1e-6)
    punctual = film_from_fit(early, folder / "extended.tcm").sheets["cloth"].vertices
    assert np.abs(x[-1] - punctual[-1]).max() > 1e-3  # the clock matters there


@pytest.mark.slow
def test_the_gain_is_confirmed_on_what_was_not_seen(made, tmp_path, capsys):
    folder, seen, blank = made
    models = [str(folder / name) for name in ("base.tcm", "extended.tcm")]
    assert main(["confirm", *models, str(folder / "fast"), "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "The gain is confirmed" in printed
    assert "replaced" not in printed
    assert main(["confirm", *models, str(folder / "fast"), "--out", str(tmp_path)]) == 0
    assert "(the earlier one was replaced)" in " ".join(capsys.readouterr().out.split())
    found = json.loads((tmp_path / "confirmation.json").read_text())
    assert found["is_confirmed"]
    assert found["models"] == models
    assert found["episodes"] == [str(folder / "fast")]
    assert found["gain"]["rms_after"] < 0.4 * found["gain"]["rms_before"]
    assert found["motions"]["fast"]["explained_fraction"] > 0.8
    assert main(["confirm", *models[::-1], str(folder / "fast"), "--out", str(tmp_path / "b")]) == 2
    assert "a base model, then one with all its causes and more" in capsys.readouterr().err
    assert main(["confirm", models[0], models[0], str(folder / "fast"), "--out", str(tmp_path / "b")]) == 2
    assert "a diagnosis that added no cause has no gain to confirm" in capsys.readouterr().err
    assert not (tmp_path / "b").exists()
    with pytest.raises(InvalidInput, match="'fast' twice"):
        dx.confirm(*models, 2 * [rec.read(folder / "fast")])
    with pytest.raises(InvalidInput, match="that the model was fitted to"):
        dx.confirm(*models, [seen, blank])


@pytest.mark.parametrize("other", ["data sheet", "set of grasps"])
def test_another_cloth_confirms_nothing(made, other):
    folder, _, _ = made
    unseen = sheet_episodes.make_episode("lift", duration=0.4)
    if other == "data sheet":
        nominal = {**unseen.cloth.nominal, "membrane_stiffness": 77.0}
        unseen = replace(unseen, cloth=replace(unseen.cloth, nominal=nominal))
    else:
        unseen = replace(unseen, grasps=dict(list(unseen.grasps.items())[:1]))
    with pytest.raises(InvalidInput, match=f"another {other} than in base.tcm"):
        dx.confirm(folder / "base.tcm", folder / "extended.tcm", [unseen])


@pytest.mark.slow
def test_a_table_that_one_episode_has_is_in_the_scene_of_all(made):
    folder, _, _ = made
    plane = rec.Collider(np.array([0.0, 0.0, 1.004]), np.array([0.0, 0.0, 1.0]), 0.4)
    over = replace(sheet_episodes.make_episode("lift", duration=0.4), colliders={"table": plane})
    free = sheet_episodes.make_episode("fast", duration=0.5)
    models = [folder / name for name in ("base.tcm", "extended.tcm")]
    one, other = (dx.confirm(*models, order).gain_by_motion["lift"] for order in ([free, over], [over, free]))
    assert one.rms_after == pytest.approx(other.rms_after, rel=1e-9)


@pytest.mark.slow
def test_the_bases_metres_hardly_depend_on_what_it_is_compared_with(made, tmp_path):
    """Beside the true cause, a third of it, and a wrong one, which fits no better and is not confirmed.

    All are compared on what both models meet, which differs a little.
    """
    folder, seen, blank = made
    base = dx.build_base_model(blank)
    by = {h.name: h for h in dx.list_hypotheses(base, [blank])}
    found = []
    for name, amplitude in (("air.drag_n", TRUE), ("air.drag_n", 0.3 * TRUE), ("obs.clock", 0.02)):
        path = dx.save_model(tmp_path / f"{name}-{amplitude}.tcm", base.with_hypothesis(by[name], amplitude), blank)
        found.append(dx.confirm(folder / "base.tcm", path, [seen]))
    for f in found:
        assert f.total_gain.rms_before == pytest.approx(found[0].total_gain.rms_before, rel=0.03)
        assert f.gain_by_motion["fast"].rms_before == pytest.approx(
            found[0].gain_by_motion["fast"].rms_before, rel=0.03
        )
    assert found[0].total_gain.rms_after < found[1].total_gain.rms_after < 0.9 * found[1].total_gain.rms_before
    assert (found[0].is_confirmed, found[2].is_confirmed) == (True, False)
    assert found[1].total_gain.log_density > 0, "a third of it: by one short episode not beyond doubt"
    assert all(f.noise_floor < 1e-3 for f in found), "half a millimetre a point, of which a cell has several"


def test_friction_stays_above_none_and_a_table_tells_how_high_a_camera_stands(made):
    _, _, blank = made
    table = rec.Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.4)
    for scene, low, kin in ((blank, None, ("robot.base",)), (replace(blank, colliders={"table": table}), -0.399, ())):
        by = {h.name: h for h in dx.list_hypotheses(dx.build_base_model(scene), [scene])}
        assert by["obs.extrinsic[z]"].structurally_equivalent == kin
        assert by["obs.extrinsic[y]"].structurally_equivalent == ("robot.base",)
        if low is not None:
            assert by["contact.mu"].min_amplitude == pytest.approx(low)
            model = dx.build_base_model(scene).with_hypothesis(by["contact.mu"])
            model = model.at_point(torch.cat([model.point[:-1], model.point.new_tensor([-0.6])]))
            assert model.amplitudes[-1] == pytest.approx(low)
