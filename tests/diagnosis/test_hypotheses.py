"""Hypotheses change a world: by nothing at zero, continuously from there, with the stated sign and size."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import sheet_episodes

from torchcloth import materials
from torchcloth._utils.resume import digest
from torchcloth.diagnosis.causes import air, fabric, grip, observer
from torchcloth.diagnosis.causes.hypotheses import list_hypotheses, register, unregister
from torchcloth.diagnosis.data.binning import BLOCK_NAMES as NAMES_OF_DATA
from torchcloth.diagnosis.data.binning import FORCE_BLOCK, _average, _part_positions, bin_residuals
from torchcloth.diagnosis.data.dataset import (
    MAX_CLOCK_DELAY_S,
    MAX_POINTS_PER_FRAME,
    _check_informative,
    label_motions,
    prepare_data,
)
from torchcloth.diagnosis.data.fine_mesh import refine_model
from torchcloth.diagnosis.models.base_model import UNSTATED_PRIOR_STD, build_base_model
from torchcloth.diagnosis.models.model_file import load_model, save_model
from torchcloth.diagnosis.report.wording import warn_of_implied_amplitudes
from torchcloth.effects import AirDrag
from torchcloth.episodes.cloth_fingerprint import cloth_fingerprint_parts
from torchcloth.episodes.observed_surface import build_surface_of_mesh
from torchcloth.episodes.world import Hypothesis
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.identification.residuals.rows import ResidualRows
from torchcloth.meshes import rectangle
from torchcloth.recordings import Collider, Markers
from torchcloth.recordings.consistency import merge_scene

RECORDING = sheet_episodes.make_episode()


EVERY = [*air.HYPOTHESES, *fabric.HYPOTHESES, *grip.HYPOTHESES, *observer.HYPOTHESES]
NAMES = [h.name for h in EVERY if h.is_applicable(RECORDING)]
# of which a gentle swing shows nothing: tests of their own have scenes for them
HARDLY_VISIBLE = (
    "air.drag_t",
    "damp.kv",
    "plast.crease",
    "elas.stiffen",
    "env.gravity_tilt[x]",
    "grip.slip",
)


@pytest.mark.parametrize("name", NAMES)
def test_nothing_at_zero_and_twice_as_much_at_twice(made, name):
    """A thousandth of a typical amplitude moves the cloth by about a thousandth, and half of it by half."""
    model, setting = made
    h = next(h for h in list_hypotheses(model, [RECORDING]) if h.name == name)
    e = setting.episodes[0]
    base = model.build_world().simulate_observed(e)
    assert torch.equal(model.build_world([(h, 0.0)]).simulate_observed(e).x, base.x)
    assert not any(p.requires_grad for p in model.build_world([(h, h.typical)]).cloth.parameters())
    if h.effect == "air.wind":  # brings its drag along
        return
    share = (0.05, 0.1)
    moved = [(model.build_world([(h, s * h.typical)]).simulate_observed(e), s) for s in share]
    small, twice = ((f.x - base.x).norm() + (f.rim_offset - base.rim_offset).norm() for f, _ in moved)
    shows = float(twice) > 1e-4  # m, of all vertices and frames together: else the substep, chosen anew, does
    assert shows == (name not in HARDLY_VISIBLE), float(twice)
    if shows:
        assert float(twice / small) == pytest.approx(2.0, rel=0.15)


def test_air_and_hem_do_what_their_names_say(made):
    model, setting = made
    e, by = setting.episodes[0], {h.name: h for h in list_hypotheses(model, [RECORDING])}
    last = lambda name, a: model.build_world([(by[name], a)]).simulate_observed(e).x[-1]  # noqa: E731
    base = model.build_world().simulate_observed(e).x[-1]
    free = base[:, 2] < 1.1
    assert float((last("air.drag_n", 5.0) - base)[free, 1].mean()) < -1e-5  # it lags behind the grippers
    assert float((last("air.wind[y]", 1.0) - last("air.drag_n", 1.2))[free, 1].mean()) > 1e-5
    assert float((last("mass.hem", 0.1) - base)[free, 2].mean()) < -1e-5
    assert float((last("env.gravity_tilt[y]", 0.2) - base)[free, 1].mean()) > 1e-5
    assert float((last("env.gravity_tilt[x]", 0.2) - base)[free, 0].mean()) > 1e-5
    assert float((last("rest.shrink[weft]", 0.05) - base)[free, 2].mean()) > 1e-3
    torch.testing.assert_close(last("obs.extrinsic[x]", 0.004) - base, torch.tensor([0.004, 0.0, 0.0]).expand_as(base))
    depth = lambda x: (x - torch.as_tensor(sheet_episodes.CAMERA_POSITION_M)).norm(dim=-1)  # noqa: E731
    torch.testing.assert_close(depth(last("obs.depth_scale", 0.015)), 1.015 * depth(base))
    torch.testing.assert_close(depth(last("obs.depth_bias", 5e-3)), depth(base) + 5e-3)


def test_cells_know_what_a_longer_depth_does_to_them(made):
    model, setting = made
    e, by = setting.episodes[0], {h.name: h for h in list_hypotheses(model, [RECORDING])}
    cells = lambda world: bin_residuals(world.simulate_observed(e), None, e, setting.surface, setting.rest_positions)  # noqa: E731
    base, off = cells(model.build_world()), cells(model.build_world([(by["obs.depth_bias"], 1e-4)]))
    seen = base.block < FORCE_BLOCK
    assert torch.equal(base.key, off.key)
    assert float(base.depth_slope[seen].abs().max()) > 0.5
    assert not base.depth_slope[~seen].any()
    change = (off.value - base.value) / 1e-4
    assert float((change - base.depth_slope).square().mean().sqrt()) < 0.05 * float(
        base.depth_slope.square().mean().sqrt()
    )
    unplaced = bin_residuals(
        model.build_world().simulate_observed(e),
        None,
        replace(e, camera_position=None),
        setting.surface,
        setting.rest_positions,
    )
    assert not unplaced.depth_slope.any(), "no camera, or several"


@pytest.mark.parametrize("first", ["elas.ortho", "plast.crease", "air.drag_n", "rest.skew", "grip.width"])
def test_whatever_was_accepted_all_others_still_apply(made, first):
    model, _ = made
    by = {h.name: h for h in list_hypotheses(model, [RECORDING])}
    alone = model.build_world([(by[first], by[first].typical)])
    for h in by.values():
        both = model.build_world([(by[first], by[first].typical), (h, h.typical)])
        changed = digest(cloth_fingerprint_parts(both.cloth)) != digest(cloth_fingerprint_parts(alone.cloth))
        seen = (len(both.motion_transforms), len(both.observation_transforms)) != (
            len(alone.motion_transforms),
            len(alone.observation_transforms),
        )
        assert changed or seen, h.name


def test_a_table_may_rub_more_and_otherwise_along_x():
    table = replace(RECORDING, colliders={"table": Collider(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.4)})
    model = build_base_model(table)
    by = {h.name: h for h in list_hypotheses(model, [table])}
    law = model.build_world([(by["contact.aniso"], -0.5), (by["contact.mu"], 0.2)]).cloth.boundaries["table"].friction
    assert float(law.value) == pytest.approx(0.4)  # (0.4 / 2) + 0.2 along x
    assert float(law.ratio.value) == pytest.approx(2.0)


def test_a_table_may_hold_before_it_slips_and_pull():
    table = replace(RECORDING, colliders={"table": Collider(np.array([0.0, 0.0, 0.2]), np.array([0.0, 0.0, 1.0]), 0.4)})
    model = build_base_model(table)
    by = {h.name: h for h in list_hypotheses(model, [table])}
    cloth = model.build_world(
        [(by["contact.stick"], 0.3), (by["contact.mu"], 0.1), (by["contact.adhesion"], 2.0)]
    ).cloth
    law, pull = cloth.boundaries["table"].friction, cloth.effects["table_pull"]
    assert (float(law.value), float(law.excess.value)) == pytest.approx((0.5, 0.3))
    assert float(pull.stress.value) == pytest.approx(2.0)
    assert pull.point.tolist() == [0.0, 0.0, 0.2]
    both = (
        model.build_world([(by["contact.stick"], 0.3), (by["contact.aniso"], -0.5)]).cloth.boundaries["table"].friction
    )
    assert type(both) is type(law)  # no law has both: the later changes nothing


def test_what_a_recording_cannot_show_is_not_asked(made):
    model, _ = made
    asked = {h.name for h in list_hypotheses(model, [replace(RECORDING, cameras={})])}
    assert asked.isdisjoint({"obs.depth_scale", "obs.depth_bias", "contact.mu"})


def test_parts_of_the_fabric_that_have_no_vertex_are_where_the_nearest_is():
    mesh = rectangle(0.3, 0.3, resolution=(3, 3))
    rest = torch.as_tensor(mesh.vertices)
    places = _part_positions("points", build_surface_of_mesh(mesh), rest)
    assert places.shape == (16, 3)
    assert sorted(places[[0, 2, 8, 10]].tolist()) == sorted(rest[[0, 1, 3, 4]].tolist())
    assert places[5].tolist() in rest.tolist(), "between vertices on the coarse mesh"


def test_an_episode_that_names_no_motion_is_one_of_its_own():
    """Also where several come from folders of one name, or from none."""
    bare = replace(RECORDING, split={})
    assert label_motions([bare, replace(RECORDING, split={"motion": "swing"}), bare]) == [
        "episode 0",
        "swing",
        "episode 2",
    ]


def test_a_repetition_is_of_the_motion_that_it_repeats(tmp_path):
    own = lambda name, **split: replace(RECORDING, path=tmp_path / name, split=split)  # noqa: E731
    every = [own("a"), own("b", replicate_of="a"), own("c", motion="swing"), own("d", replicate_of="c"), own("e")]
    assert label_motions(every) == ["a", "a", "swing", "swing", "episode 4"]


def test_a_data_sheet_without_bending_is_asked_nothing_about_it():
    sheet = {k: v for k, v in RECORDING.cloth.nominal.items() if not k.startswith("bending")}
    bare = replace(RECORDING, cloth=replace(RECORDING.cloth, nominal=sheet))
    model = build_base_model(bare)
    asked = list_hypotheses(model, [bare])
    assert {h.effect for h in EVERY} - {h.effect for h in asked} >= set(fabric.BENDING_EFFECTS)
    for h in asked:
        model.build_world([(h, h.typical)])


def test_a_data_sheet_without_stiffness_is_believed_nothing(made):
    sheet = {k: v for k, v in RECORDING.cloth.nominal.items() if k != "membrane_stiffness"}
    bare = replace(RECORDING, cloth=replace(RECORDING.cloth, nominal=sheet))
    told, silent = (build_base_model(r).parameters[0] for r in (RECORDING, bare))
    assert (told.name, silent.name) == ("youngs_modulus", "youngs_modulus")
    assert told.value(2 * told.prior_std) == pytest.approx(2.5 * told.value(0.0))
    assert silent.value(2 * silent.prior_std) == pytest.approx(10 * silent.value(0.0))
    assert silent.prior_std > UNSTATED_PRIOR_STD > told.prior_std


def test_an_own_effect_does_not_take_the_name_of_one_of_the_catalogue(made):
    """Beside drag that was found, it would silently be all the air there is."""
    model, _ = made

    class Gust(AirDrag):
        pass

    own = lambda name: Hypothesis("my.gust", "-", 1.0, lambda w, a: w.with_cloth({name: Gust(a)}))  # noqa: E731
    try:
        register(own("air"))
        with pytest.raises(InvalidInput, match=r"my\.gust.*Gust named 'air'.*another name"):
            list_hypotheses(model, [RECORDING])
        register(own("gust"))
        assert "my.gust" in {h.name for h in list_hypotheses(model, [RECORDING])}
    finally:
        unregister("my.gust")


@pytest.mark.parametrize("rate", [5.0, 10.0, 12.5, 15.0, 30.0])
def test_slow_sensors_are_heard_in_every_window(rate):
    """Of two readings in a window none was kept, as if they were strays, but where rounding made it three."""
    times = torch.arange(int(3 * rate)) / rate
    rows = ResidualRows(
        torch.randn(len(times)), torch.zeros(len(times), 1), torch.arange(len(times)), torch.zeros(len(times)).long()
    )
    cells = _average(rows, NAMES_OF_DATA.index("force"), SimpleNamespace(times=times), None, torch.zeros(1, 3))
    windows = len(set((times / 0.2 + 1e-6).floor().tolist()))
    assert len(cells.value) >= windows - 1
    assert cells.count.sum() >= 0.9 * len(times)


def test_windows_do_not_run_into_the_next_part_of_the_fabric(made):
    """Known before anything is simulated, which then takes minutes."""
    (e,) = made[1].episodes
    with pytest.raises(InvalidInput, match="of 250 s; expected less than 200 s; cut it"):
        _check_informative(replace(e, times=torch.linspace(0.0, 250.0, len(e.times))))
    _check_informative(replace(e, times=torch.linspace(0.0, 199.0, len(e.times))))


def test_dense_clouds_are_thinned_alike_on_both_meshes(made):
    model, _ = made
    points = RECORDING.points
    xyz = np.concatenate([np.repeat(points.frame(0), 250, axis=0), *(points.frame(k) for k in range(1, len(points)))])
    counts = np.array([250 * points.counts[0], *points.counts[1:]])
    dense = replace(RECORDING, points=replace(points, xyz=xyz, counts=counts))
    setting = prepare_data(model, [dense])
    (coarse,), (fine,) = setting.episodes, setting.fine_mesh.episodes
    assert len(coarse.clouds[0]) == MAX_POINTS_PER_FRAME
    assert torch.equal(coarse.clouds[0], fine.clouds[0])
    assert torch.equal(coarse.clouds[1], torch.as_tensor(points.frame(1)))


def test_two_effects_in_one_part_keep_both(made):
    model, _ = made
    by = {h.name: h for h in list_hypotheses(model, [RECORDING])}
    world = model.build_world([(by["air.drag_n"], 0.8), (by["air.wind[x]"], 0.3), (by["air.drag_t"], 0.02)])
    air = world.cloth.effects["air"]
    assert (float(air.normal.value), float(air.tangential.value)) == pytest.approx((0.8, 0.02))
    assert air.wind.tolist() == pytest.approx([0.3, 0.0, 0.0])
    bending = model.build_world(
        [(by[name], by[name].typical) for name in ("rest.curl[weft]", "plast.crease", "damp.bend", "bend.aniso")]
    ).cloth.effects["bending"]
    found = [float(getattr(bending, name).value) for name in ("curl_weft", "mobility", "damping_time", "weft_ratio")]
    assert found == pytest.approx([3.0, 5.0, 0.06, 0.4])
    rest = model.build_world([(by["rest.shrink[warp]"], 0.02), (by["rest.skew"], 0.01)]).cloth.effects["rest_shape"]
    assert (float(rest.shrink_warp.value), float(rest.skew.value)) == pytest.approx((0.02, 0.01))
    woven = model.build_world([(by["elas.ortho"], 0.5), (by["elas.shear"], -0.4)]).cloth.material
    assert float(woven.weft_modulus.value / woven.youngs_modulus.value) == pytest.approx(0.5)
    assert float(woven.shear_modulus.value * 2 * 1.3 / woven.youngs_modulus.value) == pytest.approx(0.6)


def test_stiffening_of_the_base_leaves_one_modulus_and_adds_to_what_exceeds_it(made):
    model, _ = made
    by = {h.name: h for h in list_hypotheses(model, [RECORDING])}
    stiff = model.at_point(model.point + 1.2 * torch.eye(len(model.point)).double()[-1])
    assert type(model.build_world().cloth.material) is materials.AEP
    cloth = stiff.build_world([(by["elas.stiffen"], 8.0)]).cloth.material
    assert type(cloth) is materials.StiffeningAEP
    assert float(cloth.stiffening.value) == pytest.approx(9.2)
    woven = stiff.build_world([(by["elas.shear"], -0.4)]).cloth.material
    assert [float(c.value) for c in (woven.warp_stiffening, woven.weft_stiffening)] == pytest.approx([1.2, 1.2])


def test_the_base_is_in_vacuum_and_left_alone(made):
    model, _ = made
    assert set(model.base.cloth.effects) == {"gravity", "bending"}
    with_air = replace(RECORDING, air_density=1.2)
    assert set(build_base_model(with_air).base.cloth.effects) == {"gravity", "bending"}
    before = {name: value.clone() for name, value in model.base.cloth.state_dict().items()}
    model.at_point(model.point + 0.3).build_world([(h, h.typical) for h in list_hypotheses(model, [RECORDING])[:5]])
    for name, value in model.base.cloth.state_dict().items():
        assert torch.equal(value, before[name]), name


def test_a_finer_mesh_is_the_same_cloth(made):
    model, _ = made
    finer, (recording,) = refine_model(model, [RECORDING])
    a, b = model.base.cloth.mesh, finer.base.cloth.mesh
    assert len(b.faces) == 4 * len(a.faces)
    assert b.area.sum() == pytest.approx(a.area.sum(), rel=1e-12)
    first, unmoved = (
        recording.cloth.initial_vertices[: len(a.vertices)],
        (b.uv[: len(a.vertices)] == RECORDING.cloth.uv).all(1),
    )
    assert unmoved.sum() > 10
    np.testing.assert_allclose(first[unmoved], RECORDING.cloth.initial_vertices[unmoved], atol=1e-12)
    assert recording.cloth.initial_vertices[25:].mean(0) == pytest.approx(
        RECORDING.cloth.initial_vertices.mean(0), abs=0.01
    )


def test_a_hypothesis_of_ones_own_joins_the_search(made):
    model, _ = made
    own = register(Hypothesis("user.sag", "m", 0.01, lambda world, a: world.with_observation_transform(lambda f, _: f)))
    assert own in list_hypotheses(model, [RECORDING])
    assert own not in list_hypotheses(model.with_hypothesis(own, 0.01), [RECORDING])
    unregister("user.sag")
    assert own not in list_hypotheses(model, [RECORDING])


def test_a_model_file_gives_the_same_world(made, tmp_path):
    model, setting = made
    by = {h.name: h for h in list_hypotheses(model, [RECORDING])}
    extended = (
        model.at_point(model.point + 0.1)
        .with_hypothesis(by["air.drag_n"], 0.9)
        .with_hypothesis(by["rest.shrink[warp]"], -0.02)
    )
    again = load_model(save_model(tmp_path / "m.tcm", extended, RECORDING))
    assert torch.equal(
        again.build_world().simulate_observed(setting.episodes[0]).x,
        extended.build_world().simulate_observed(setting.episodes[0]).x,
    )
    assert [h.name for h in again.accepted] == ["air.drag_n", "rest.shrink[warp]"]


def test_model_files_that_cannot_be_read_are_refused(made, tmp_path):
    model, _ = made
    with pytest.raises(InvalidInput, match="no file"):
        load_model(tmp_path / "nothing.tcm")
    (tmp_path / "bad.tcm").write_text("no zip")
    with pytest.raises(RecordingError, match="unreadable"):
        load_model(tmp_path / "bad.tcm")
    stranger = Hypothesis("user.unknown", "-", 1.0, lambda world, _: world)
    path = save_model(tmp_path / "m.tcm", model.with_hypothesis(stranger, 1.0), RECORDING)
    with pytest.raises(InvalidInput, match=r"'user.unknown'.*register"):
        load_model(path)


def test_a_table_that_one_episode_names_is_there_in_all():
    plane = Collider(np.array([0.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.0]), 0.4)
    with_table = replace(RECORDING, colliders={"table": plane})
    assert list(merge_scene([RECORDING, with_table]).colliders) == ["table"]
    high = replace(RECORDING, colliders={"table": replace(plane, point=np.array([0.0, 0.0, 1.1]))})
    with pytest.raises(InvalidInput, match=r"inside 'table', which only other episodes have"):
        merge_scene([RECORDING, high])
    seen = RECORDING.points
    marked = Markers(seen.t, np.stack([seen.frame(k)[:9] for k in range(len(seen.t))]), np.full((9, 2), 0.01))
    with pytest.raises(InvalidInput, match=r"inside 'table', which only other episodes have"):
        merge_scene([replace(RECORDING, points=None, markers=marked), high])
    plain = replace(RECORDING, colliders={"table": replace(plane, friction=None)})
    assert merge_scene([with_table, plain]).colliders["table"] is plane  # 0.4 where none is said
    again = replace(RECORDING, colliders={"table": replace(plane, point=np.array([0.4, 0.0, 0.501]))})
    assert merge_scene([with_table, again]).colliders["table"] is plane  # measured twice
    for other in (replace(plane, point=np.array([0.0, 0.0, 0.3])), replace(plane, friction=0.9)):
        with pytest.raises(InvalidInput, match=r"table 'table'.*in one episode.*in another"):
            merge_scene([with_table, replace(RECORDING, colliders={"table": other})])


@pytest.mark.parametrize("normal", [(0.002, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
def test_a_table_that_leans_or_stands_rubs_otherwise_along_an_axis_of_its_own(normal):
    plane = Collider(np.zeros(3), np.array(normal) / np.linalg.norm(normal), 0.4)
    model = build_base_model(replace(RECORDING, colliders={"table": plane}))
    law = grip._change_friction(model.build_world(), along=-0.5).cloth.boundaries["table"].friction
    assert abs(float(law.axis @ torch.as_tensor(plane.normal).to(law.axis))) < 1e-5
    assert law.ratio.value.item() == pytest.approx(2.0)
    again = (
        grip._change_friction(grip._change_friction(model.build_world(), along=-0.5), more=0.1)
        .cloth.boundaries["table"]
        .friction
    )
    assert torch.allclose(again.axis, law.axis)


def test_a_late_clock_sees_only_frames_that_were_simulated():
    """Of the last ones, which it would see beyond the motion's end, no points are used."""
    recording = sheet_episodes.record_changed_world("fast", lambda world: world, 4)
    model = build_base_model(recording)
    (e,) = prepare_data(model, [recording]).episodes
    used = torch.tensor([len(c) > 0 for c in e.clouds])
    assert used.sum() == len(recording.points) - 1
    assert float(e.times[used][-1]) <= float(e.motion["left"].t[-1]) - MAX_CLOCK_DELAY_S
    clock = next(h for h in list_hypotheses(model, [recording]) if h.name == "obs.clock")
    late = clock.apply(model.build_world(), 0.03).simulate_observed(e).x
    then = torch.cat([e.times[:1], e.times[used][1:] + 0.03])
    truth = model.build_world().simulate_observed(replace(e, times=then)).x
    off = lambda x: (x - truth).square().mean((-2, -1)).sqrt()[1:]  # noqa: E731
    assert float(off(late[used]).max()) < 6e-4  # of cubics through frames 50 ms apart
    assert float(off(model.build_world().simulate_observed(e).x[used]).max()) > 4e-3
    assert (
        float((late[-1] - model.build_world().simulate_observed(e).x[-1]).norm(dim=-1).max()) < 1e-9
    )  # stands still there


@pytest.mark.parametrize("columns", [7, 8])
def test_a_seam_is_the_same_on_every_mesh(columns):
    """Where no line of vertices lies in the middle, too."""
    seam = next(h for h in fabric.HYPOTHESES if h.name == "mass.seam")
    model = build_base_model(sheet_episodes.make_episode(resolution=(columns, 7)))
    for world in (model.build_world(), refine_model(model, [])[0].build_world()):
        mass = (
            (seam.apply(world, 0.02).cloth.build_model().mass - world.cloth.build_model().mass)[:, 0].detach().numpy()
        )
        assert mass.sum() == pytest.approx(0.02 * sheet_episodes.SIDE_M, rel=1e-6)
        assert mass @ world.cloth.mesh.uv[:, 0] / mass.sum() == pytest.approx(sheet_episodes.SIDE_M / 2, abs=1e-6)
        assert np.abs(
            world.cloth.mesh.uv[mass > 1e-9, 0] - sheet_episodes.SIDE_M / 2
        ).max() < 0.7 * sheet_episodes.SIDE_M / (columns - 1)


def test_drag_beside_wind_says_what_it_counts_from(made):
    model, _ = made
    by = {h.name: h for h in EVERY}
    both = model.with_hypothesis(by["air.wind[x]"], 0.3).with_hypothesis(by["air.drag_n"], 0.4)
    assert both.build_world().cloth.effects["air"].normal.value.item() == pytest.approx(1.6)
    assert warn_of_implied_amplitudes(both) == ["air.drag_n = 0.4 comes on top of the 1.2 that air.wind[x] implies"]
    assert (
        warn_of_implied_amplitudes(model.with_hypothesis(by["air.drag_n"], 0.4).with_hypothesis(by["air.wind[x]"], 0.3))
        == []
    )


def test_an_episode_without_a_motion_has_a_name_that_no_other_has():
    named = replace(RECORDING, split={"motion": "episode 1"})
    assert len(set(label_motions([named, replace(RECORDING, split={})]))) == 2


def test_drag_that_was_found_and_is_none_does_not_come_along_with_wind(made):
    model, _ = made
    by = {h.name: h for h in EVERY}
    blown = lambda of: float(of.with_hypothesis(by["air.wind[x]"], 0.5).build_world().cloth.effects["air"].normal.value)  # noqa: E731
    assert blown(model.with_hypothesis(by["air.drag_n"], 0.0)) == 0.0
    assert blown(model.with_hypothesis(by["air.drag_n"], 1e-3)) == pytest.approx(1e-3)
    assert blown(model) == pytest.approx(1.2)
