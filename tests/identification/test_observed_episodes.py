"""From recordings to what the solver takes: clocks, frames, refusals; what ``identify`` refuses before it begins."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import twins
from helpers.twins import build_cloth_at, shift_clock

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.diagnosis.data.dataset import prepare_data
from torchcloth.diagnosis.models.base_model import build_base_model
from torchcloth.episodes import streams
from torchcloth.episodes.observed import check_recordings, find_depth_camera
from torchcloth.episodes.recorded_cloth import build_mesh, compute_initial_vertices
from torchcloth.episodes.unknowns import collect_unknowns, find_scalar_parameters
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.identification import build_cloth, build_episode, fit_fields, identify
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.uncertainty.richardson import refine_cloth, refine_recording


def with_cloth(recording, **changes):
    return replace(recording, cloth=replace(recording.cloth, **changes))


# -- episode() -------------------------------------------------------------------------------------------------------


def test_an_episode_holds_what_was_recorded(recording, model):
    seen = build_episode(model, recording)
    assert set(seen.motion) == {"left", "right"}
    assert [len(cloud) for cloud in seen.clouds] == recording.points.counts.tolist()
    np.testing.assert_array_equal(torch.cat(seen.clouds).numpy(), recording.points.xyz)
    np.testing.assert_array_equal(seen.initial.numpy(), recording.cloth.initial_vertices)
    assert seen.needs_settling
    assert seen.noise_std == recording.observation_noise_std
    assert seen.clouds[0].dtype == seen.initial.dtype == torch.float64


def test_a_cloud_takes_the_cloths_dtype(recording):
    torch.set_default_dtype(torch.float32)
    seen = build_episode(build_cloth(recording), recording)
    assert seen.clouds[0].dtype == seen.initial.dtype == seen.motion["left"].pose.dtype == torch.float32
    assert seen.times.dtype == torch.float64  # seconds since an epoch do not fit into float32


def test_without_initial_vertices_the_mesh_is_the_first_frame(recording):
    placed = with_cloth(recording, vertices=recording.cloth.initial_vertices, initial_vertices=None)
    model = build_cloth(placed)
    seen = build_episode(model, placed)
    assert not seen.needs_settling
    np.testing.assert_array_equal(seen.initial.numpy(), model.mesh.vertices)


def test_a_shape_that_is_to_be_estimated_may_be_far_from_the_grippers(recording, model):
    far = with_cloth(recording, initial_vertices=None)  # the mesh lies flat about the origin
    with pytest.raises(InvalidInput, match=r"the held patch 1\.05 m from its gripper"):
        build_episode(model, far)
    assert build_episode(model, far, has_first_shape=False).motion.keys() == recording.grippers.keys()


def test_patches_end_where_they_are_said_to_and_the_first_shape_is_carried_there(recording):
    """Whole vertices would hold 33 mm of them: edges are as long."""
    corner = np.array([[0.0, 0.0]])
    bent = lambda uv: np.column_stack([uv, 0.2 + uv[:, 0] ** 2 - 2 * uv[:, 0] * uv[:, 1]])  # noqa: E731
    given = with_cloth(recording, initial_vertices=bent(recording.cloth.uv))
    for radius in (0.036, 0.045):
        gripped = replace(given, grasps={**given.grasps, "left": rec.GraspInfo(corner, radius)})
        cloth = build_cloth(gripped)
        fine = refine_cloth(cloth)
        for model, episode_ in ((cloth, gripped), (fine, refine_recording(gripped, cloth.mesh, fine.mesh))):
            uv = model.mesh.uv
            mine = uv[model.boundaries["left"].index.numpy()]
            assert mine[mine[:, 1] == 0, 0].max() == pytest.approx(radius, rel=1e-9)
            assert mine[mine[:, 0] == 0, 1].max() == pytest.approx(radius, rel=1e-9)
            assert model.mesh.area.sum() == pytest.approx(twins.SIDE_M**2)
            reached = compute_initial_vertices("", model, episode_).numpy()
            np.testing.assert_allclose(reached[:, :2], uv, atol=1e-9)
            if model is cloth:  # of the finer mesh, vertices lie on the coarse one's chords
                np.testing.assert_allclose(reached, bent(uv), atol=1e-9)


def test_a_cloth_far_from_its_grippers_is_refused(recording, model):
    """Without initial vertices the flat rest mesh lies at the origin, a metre below the hands."""
    with pytest.raises(InvalidInput, match=r"grasp 'left'; got the held patch 1\.\d+ m .*initial_vertices in world"):
        build_episode(model, with_cloth(recording, initial_vertices=None))


def test_parameters_of_contact_need_contact(recording, model):
    with pytest.raises(InvalidInput, match=r"'cone'; .*needs contact"):
        identify(model, recording, ["cone"])


@pytest.mark.parametrize("key", ["youngs_modulus", "poisson_ratio", "bending_stiffness"])
def test_a_nominal_value_that_is_no_number_is_refused(recording, key):
    with pytest.raises(RecordingError, match=f"nominal.{key}; got 'soft'"):
        build_cloth(with_cloth(recording, nominal={key: "soft"}))


def test_initial_vertices_of_another_mesh_are_refused(recording, model):
    bad = with_cloth(recording, initial_vertices=recording.cloth.initial_vertices[:-3])
    with pytest.raises(InvalidInput, match=r"initial_vertices; got 46 rows; expected 49"):
        build_episode(model, bad)


def test_a_grasp_without_motion_is_refused(recording, model):
    bad = replace(recording, grippers={"left": recording.grippers["left"]})
    with pytest.raises(RecordingError, match=r"no motion for grasp 'right'; got motion of \['left'\]"):
        build_episode(model, bad)


def test_motion_that_no_grasp_needs_is_left_aside(recording, model):
    more = replace(recording, grippers={**recording.grippers, "third": recording.grippers["left"]})
    assert set(build_episode(model, more).motion) == {"left", "right"}


def test_an_episode_without_points_is_refused(recording, model):
    with pytest.raises(RecordingError, match="has no points, which a fit needs"):
        build_episode(model, replace(recording, points=None))


def test_a_single_frame_is_refused(recording, model):
    p = recording.points
    one = rec.PointClouds(p.t[:1], p.xyz[: p.counts[0]], p.counts[:1])
    with pytest.raises(RecordingError, match=r"1 frame.*at least two"):
        build_episode(model, replace(recording, points=one))


@pytest.mark.parametrize("offset", [12.5, -0.3])
def test_the_clock_offset_is_added_to_the_observations(recording, model, offset):
    """t_motion = t_observation + clock_offset, as the format says; the wrong sign would be off by twice it."""
    moved = shift_clock(recording, offset)
    np.testing.assert_allclose(moved.points.t, recording.points.t - offset)
    seen = build_episode(model, moved)
    np.testing.assert_allclose(seen.times.numpy(), recording.points.t, atol=1e-9)
    assert len(seen.clouds) == len(recording.points)


def test_a_clock_that_is_off_is_refused_with_the_remedy(recording, model):
    for offset in (-0.1, 5.0):
        with pytest.raises(RecordingError, match=r"covers the first frame; check clock_offset"):
            build_episode(model, replace(recording, clock_offset=offset))


def test_frames_after_the_motion_are_left_out(recording, model):
    late = replace(recording, clock_offset=0.12)  # two and a half frames beyond 0.72 s
    seen = build_episode(model, late)
    assert len(seen.times) == len(seen.clouds) == twins.FRAME_COUNT - 2
    assert float(seen.times[-1]) <= 0.72
    (doubt,) = seen.data_warnings()
    assert f"2 of {twins.FRAME_COUNT} frames come after the motion's end" in doubt
    assert build_episode(model, recording).data_warnings() == []


def test_an_episode_in_which_nothing_is_held_says_so(recording, model):
    open_ = {name: replace(g, closed=np.zeros_like(g.closed)) for name, g in recording.grippers.items()}
    (doubt,) = build_episode(model, replace(recording, grippers=open_)).data_warnings()
    assert "no gripper is ever closed" in doubt


def test_a_fit_needs_something_that_holds_the_cloth(recording, model):
    """Reported: with a gripper that is never closed, falling cloth was fitted for minutes."""
    open_ = {name: replace(g, closed=np.zeros_like(g.closed)) for name, g in recording.grippers.items()}
    falling = replace(recording, grippers=open_)
    words = r"nothing holds the cloth; got grippers that are never closed \(.*\), and no collider; .* write closed"
    for fit in (
        lambda: identify(model, falling, ["youngs_modulus"]),
        lambda: fit_fields(model, falling, ["youngs_modulus"]),
        lambda: prepare_data(build_base_model(falling), [falling]),
    ):
        with pytest.raises(RecordingError, match=words):
            fit()
    table = rec.Collider(point=np.zeros(3), normal=np.array([0.0, 0.0, 1.0]))
    assert check_recordings(replace(falling, colliders={"table": table}))
    assert check_recordings(recording)


def test_a_cloud_beside_the_cloth_says_so(recording, model):
    """Of half of the cloth, that is not missed; of a camera that is said to stand elsewhere, it is told where."""
    points = recording.points
    shifted = replace(recording, points=replace(points, xyz=points.xyz + np.array([0.3, 0.0, 0.0])))
    (doubt,) = build_episode(model, shifted).data_warnings()
    assert re.search(r"lie \(\+(29|30|31)\d, [+-]\d+, [+-]\d+\) mm from the cloth: check T_world_camera", doubt)
    x = build_episode(model, recording).initial
    half = replace(build_episode(model, recording), clouds=[x[x[:, 0] > x[:, 0].median()]])
    assert half.data_warnings() == []


def test_a_gripper_without_a_grasp_says_so(recording, model):
    hand = next(iter(recording.grippers.values()))
    (doubt,) = build_episode(model, replace(recording, grippers={**recording.grippers, "third": hand})).data_warnings()
    assert "no grasp is called third" in doubt
    away = replace(hand, closed=np.zeros_like(hand.closed))
    assert (
        build_episode(model, replace(recording, grippers={**recording.grippers, "third": away})).data_warnings() == []
    )


def test_until_keeps_the_early_frames(recording, model):
    seen = build_episode(model, recording)
    assert len(seen.first_fraction(0.5).clouds) == len(seen.first_fraction(0.5).times) == round(0.5 * twins.FRAME_COUNT)
    assert len(seen.first_fraction(0.0).clouds) == 4  # fewer would not be a motion


# -- build_cloth() ----------------------------------------------------------------------------------------------------


def test_the_cloth_starts_at_the_data_sheet(recording):
    cloth = build_cloth(recording)
    assert cloth.material.youngs_modulus.value.item() == pytest.approx(8e4)
    assert cloth.material.poisson_ratio.value.item() == pytest.approx(0.15)
    assert cloth.effects["bending"].stiffness.value.item() == pytest.approx(3e-5)
    assert cloth.effects["bending"].damping_time.value.item() == 5e-3
    assert cloth.effects["air"].density == 1.204
    assert cloth.areal_density.value.item() == pytest.approx(0.3)
    assert cloth.contact is None
    assert [len(cloth.boundaries[name].index) for name in ("left", "right")] == [7, 7]


def test_without_a_data_sheet_and_air_the_base_model_is_bare(recording):
    bare = replace(with_cloth(recording, nominal={}), air_density=None)
    cloth = build_cloth(bare)
    assert set(cloth.effects) == {"gravity"}
    assert cloth.material.youngs_modulus.value.item() * cloth.material.thickness == pytest.approx(300.0)  # N/m


def test_a_sheet_needs_no_mesh_and_something_is_needed(recording):
    nothing = with_cloth(recording, vertices=None, faces=None, uv=None, initial_vertices=None)
    with pytest.raises(RecordingError, match="neither mesh nor sheet"):
        build_mesh(nothing)
    sheet = with_cloth(nothing, sheet=(0.3, 0.2))
    np.testing.assert_allclose(np.ptp(build_mesh(sheet).vertices, axis=0)[:2], [0.3, 0.2])


def test_of_several_cameras_the_one_with_depth_sees_how_far_things_are(recording):
    """A Kinect is two: colour has no say in depth."""
    camera = rec.Camera(width=640, height=480, K=np.eye(3), T_world_camera=np.eye(4))
    deep = replace(camera, depth_scale=1e-3)
    seen = lambda **cameras: find_depth_camera(replace(recording, cameras=cameras))  # noqa: E731
    assert seen(depth=deep, color=camera) is deep
    assert seen(only=camera) is camera
    assert seen(one=camera, two=camera) is None
    assert seen(one=deep, two=deep, color=camera) is None


def test_a_gripper_that_comes_for_the_cloth_later_may_be_far_away(recording):
    model = build_cloth(recording)
    away = {
        name: replace(g, position=g.position + np.array([0.0, 0.0, 0.5]), closed=np.arange(len(g.t)) > 2)
        for name, g in recording.grippers.items()
    }
    build_episode(model, replace(recording, grippers=away))
    with pytest.raises(InvalidInput, match=r"the held patch 0\.5\d m from its gripper"):
        build_episode(
            model, replace(recording, grippers={n: replace(g, closed=g.closed | True) for n, g in away.items()})
        )


def test_a_collider_becomes_a_plane(recording):
    table = rec.Collider(np.array([0.0, 0.0, 0.2]), np.array([0.0, 0.0, 1.0]), 0.3)
    assert set(build_cloth(replace(recording, colliders={"table": table})).boundaries) == {"table", "left", "right"}


# -- unknowns --------------------------------------------------------------------------------------------------------


def test_a_step_is_half_of_what_is_typical_with_a_sign_and_without():
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(3, 3))
    effects = {"rest": tc.effects.RestShape(shrink_warp=0.0), "air": tc.effects.AirDrag(1.0)}
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), 0.2, effects, contact=None)
    result = collect_unknowns(cloth, ["rest.shrink_warp", "air.normal", "youngs_modulus"], None)
    assert [u.max_step / u.typical_change for u in result] == [0.5, 0.5, 1.0]
    assert result[0].max_step == pytest.approx(0.01)


def test_unknowns_by_public_name(model):
    names = set(find_scalar_parameters(model))
    assert names >= {"youngs_modulus", "poisson_ratio", "air.normal", "bending.stiffness", "areal_density"}
    one = collect_unknowns(model, ["air.normal", "youngs_modulus", "air.normal"], (0.3, 0.005))
    assert [u.name for u in one] == ["air.normal", "youngs_modulus", "areal_density"]
    assert [u.measured for u in one] == [False, False, True]
    assert one[2].prior_std == pytest.approx(0.005 / 0.3)  # of the logarithm
    assert one[0].clip(-0.1) == 0.0
    assert one[1].clip(-0.1) == -0.1


def test_slopes_are_those_of_the_values(model):
    for unknown in collect_unknowns(model, ["youngs_modulus", "poisson_ratio", "air.normal"], None):
        h = 1e-5
        finite = (unknown.value(unknown.start + h) - unknown.value(unknown.start - h)) / (2 * h)
        assert unknown.slope(unknown.start) == pytest.approx(finite, rel=1e-6)


def test_values_and_raw_are_inverse(model, recording):
    problem = Objective(
        model, collect_unknowns(model, ["youngs_modulus", "poisson_ratio"], None), [build_episode(model, recording)]
    )
    values = {"youngs_modulus": 3.3e4, "poisson_ratio": 0.31}
    assert problem.physical_values(problem.start_with(values)) == pytest.approx(values)


# -- what identify() refuses before it simulates ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"parameters": ["stiffness"]}, r"parameter to fit; got 'stiffness'; expected one of .*youngs_modulus"),
        ({"parameters": ["gravity"]}, r"parameter to fit; got 'gravity'"),
        ({"method": "newton"}, r"method.*'newton'"),
        ({"stop": "never"}, r"stop.*'never'"),
        ({"iterations": 0}, r"iterations; got 0; expected at least 1"),
        ({"iterations": -3}, r"iterations; got -3"),
        ({"guess": {"stiffness": 1.0}}, r"guess; got 'stiffness'; expected one of youngs_modulus"),
        ({"guess": {"youngs_modulus": -1.0}}, r"youngs_modulus; got -1 Pa; expected a value > 0"),
        ({"dt": -1.0}, r"dt; got -1"),
        ({"dt": 0.05}, r"dt; got 0.05 s; expected at most 0\.00\d+ s"),
    ],
)
def test_wrong_arguments_are_named(model, recording, arguments, said):
    with pytest.raises(ValueError, match=said) as caught:
        identify(model, recording, **{"parameters": ["youngs_modulus"], **arguments})
    assert "\n" not in str(caught.value)


def test_episodes_of_another_cloth_or_grasp_are_refused(model, recording):
    other = with_cloth(shift_clock(recording, 1.0), areal_density=2 * recording.cloth.areal_density)
    with pytest.raises(InvalidInput, match=r"another areal density \(kg/m\^2\) than in"):
        identify(model, [recording, other])
    one = replace(shift_clock(recording, 1.0), grasps=dict(list(recording.grasps.items())[:1]))
    with pytest.raises(InvalidInput, match="another set of grasps than in"):
        identify(model, [recording, one])
    numbered = with_cloth(shift_clock(recording, 1.0), faces=recording.cloth.faces[::-1])
    with pytest.raises(InvalidInput, match="another numbering of the mesh"):
        identify(model, [recording, numbered])


def test_a_first_shape_of_another_mesh_is_refused(recording, model):
    elsewhere = with_cloth(recording, uv=0.001 + recording.cloth.uv, faces=recording.cloth.faces[:, ::-1][5:])
    with pytest.raises(InvalidInput, match="those of a mesh with other triangles"):
        build_episode(model, elsewhere)
    turned = with_cloth(recording, faces=recording.cloth.faces[:, ::-1])  # the same triangles
    assert torch.equal(build_episode(model, turned).initial, build_episode(model, recording).initial)


def test_no_recordings_are_refused(model):
    with pytest.raises(InvalidInput, match="recordings; got none"):
        identify(model, [])


def test_one_episode_twice_is_no_evidence_more(model, recording):
    """The stranger's: error bars fell by sqrt 2 for every copy."""
    with pytest.raises(InvalidInput, match="episodes; got 'recording' twice; expected each once"):
        identify(model, [recording, replace(recording, clock_offset=0.01)])


def test_no_parameters_are_refused(model, recording):
    exact = with_cloth(recording, areal_density_std=None)
    with pytest.raises(InvalidInput, match="parameters"):
        identify(model, exact, [])


def test_a_field_is_not_a_scalar(recording):
    cloth = build_cloth_at(recording)
    from torchcloth import PhysicalParameter

    field = torch.full((len(cloth.mesh.faces),), 0.3)
    cloth.areal_density = PhysicalParameter(field, "kg/m^2", name="areal_density")
    with pytest.raises(InvalidInput, match="areal_density"):
        identify(cloth, recording, ["areal_density"])


def test_force_readings_after_the_last_cloud_are_told():
    """Frames are those of what is seen: readings of a second were dropped without a word."""
    whole = twins.make_twin()
    t = whole.grippers["left"].t
    hands = {name: replace(m, force=np.zeros((len(t), 3))) for name, m in whole.grippers.items()}
    short = replace(twins.take_first_frames(whole, 4), grippers=hands)
    data = build_episode(twins.build_cloth_at(short), short)
    assert data.readings_after_last_frame > 10
    assert any("force readings come after the last frame with points" in doubt for doubt in data.data_warnings())
    assert build_episode(twins.build_cloth_at(whole), replace(whole, grippers=hands)).readings_after_last_frame == 0


def test_the_frame_of_a_time_is_the_nearest_one_that_is_the_same():
    frames = np.array([0.0, 0.1, 0.25, 0.4])
    times = np.array([0.4, 0.1 + 1e-9, -1.0, 0.0, 0.17, 9.0, 0.25 - 1e-9])
    assert streams.match_frames(times, frames).tolist() == [3, 1, -1, 0, -1, -1, 2]
    assert streams.match_frames(times[:2], frames[3:]).tolist() == [0, -1]
    many = np.arange(200_000) / 30  # two hours: a table of all pairs would have 320 GB
    assert np.array_equal(streams.match_frames(many, many), np.arange(200_000))


def test_an_arm_that_stands_by_need_not_be_known(recording, model):
    aside = replace(recording, joints={"spare": rec.JointMotion(np.arange(5) / 10, np.zeros((5, 6)))})
    seen, alone = (build_episode(model, r) for r in (aside, recording))
    assert set(seen.motion) == {"left", "right"}
    assert torch.equal(seen.motion["left"].pose, alone.motion["left"].pose)
