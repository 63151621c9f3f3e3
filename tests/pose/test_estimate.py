"""The whole: against truth, with right and wrong models, as one continuous motion."""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from helpers import twins
from helpers.occluded_twins import WRONG_FABRIC, build_cloth

from torchcloth import recordings as rec
from torchcloth.effects import BodyForce
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.identification import build_episode, nuisances
from torchcloth.identification.residuals.metrics import distance_metrics
from torchcloth.pose import estimate_pose
from torchcloth.pose.estimate import find_gripped_vertices
from torchcloth.pose.fine_scale_uncertainty import estimate_fine_scale_std
from torchcloth.pose.modes import compute_modes
from torchcloth.types import ClothState


def rms(x, scene, where):
    return float((x - scene.truth).square().sum(-1)[where].mean().sqrt())


def coverage(estimate, scene):
    free = estimate.std.amax((0, 2)) > 1e-6  # held vertices are where the grippers are
    inside = (estimate.x - scene.truth).abs() < 1.96 * estimate.std
    return float(inside[:, free].double().mean()), float(inside[scene.hidden & free].double().mean())


def test_with_the_true_values_little_is_left_to_correct(scene, right):
    everywhere = torch.ones_like(scene.hidden)
    for where in (everywhere, scene.hidden):
        assert rms(right.x, scene, where) < 0.95 * rms(right.uncorrected, scene, where) < 1.5e-3
    assert right.fit["force_fraction"] < 0.06
    assert right.fit["converged"]
    assert right.warnings == []


def test_intervals_cover_the_truth(scene, right):
    everywhere, hidden = coverage(right, scene)
    assert 0.88 <= everywhere <= 1.0
    assert 0.88 <= hidden <= 1.0
    assert right.fit["std_rms"] < 2.5e-3  # a millimetre of each grip is in it, and not much more


def test_a_wrong_model_says_so_and_is_still_better_than_itself(scene, wrong):
    assert rms(wrong.x, scene, scene.hidden) < 0.7 * rms(wrong.uncorrected, scene, scene.hidden)
    assert wrong.fit["force_fraction"] > 0.2
    assert any("the model is wrong" in warning for warning in wrong.warnings)
    assert any("off the estimate" in warning for warning in wrong.warnings)
    assert coverage(wrong, scene)[0] > 0.88
    assert wrong.fit["std_rms"] > 5e-3


def test_stated_uncertainty_is_used(scene, right):
    """The same wrong values, known to within a factor of two: the fabric is corrected, not the force."""
    uncertain = {
        "youngs_modulus": (WRONG_FABRIC.membrane / twins.THICKNESS_M, 2.0),
        "air.normal": (WRONG_FABRIC.drag, 0.6),
    }
    result = estimate_pose(build_cloth(scene, WRONG_FABRIC), scene.recording, uncertain=uncertain, modes=4, window=0.18)
    assert rms(result.x, scene, scene.hidden) < 1.2 * rms(right.x, scene, scene.hidden)
    assert result.fit["force_fraction"] < 0.06
    assert result.parameters["youngs_modulus"].value == pytest.approx(
        twins.TRUE_FABRIC.membrane / twins.THICKNESS_M, rel=0.05
    )


def test_one_continuous_motion(scene, wrong):
    """Every window goes on from the state that the one before left: simulated in one piece it is the same motion."""
    cloth = build_cloth(scene, WRONG_FABRIC)
    cloth.effects["push"] = BodyForce(torch.zeros_like(wrong.x[0]))
    motion = build_episode(cloth, scene.recording).motion
    for w in range(1, len(wrong.windows)):
        first, last = ((wrong.times - t).abs().argmin() for t in wrong.windows[w])
        cloth.effects["push"].acceleration.set(wrong.acceleration[w])
        with torch.no_grad():
            out = cloth(cloth.state(wrong.x[first], wrong.v[first]), motion, wrong.times[first : last + 1])
        torch.testing.assert_close(out.x, wrong.x[first : last + 1], rtol=0, atol=1e-9)
        torch.testing.assert_close(out.v, wrong.v[first : last + 1], rtol=0, atol=1e-7)
    torch.testing.assert_close(wrong.last_state.x, wrong.x[-1])


def test_shares_are_those_of_the_weight(wrong, scene):
    cloth = build_cloth(scene, WRONG_FABRIC)
    gripped = torch.cat([part.index for part in cloth.boundaries.values()])
    mass = cloth.build_model().mass.detach()[:, 0]
    mass[gripped] = 0
    expected = ((wrong.acceleration.square().sum(-1) * mass).sum(-1) / mass.sum()).sqrt() / 9.81
    torch.testing.assert_close(wrong.force_fractions, expected)


def test_distances_are_those_of_the_room_next_door(scene, right):
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    again = distance_metrics([right.x], [build_episode(cloth, scene.recording)], right.faces)
    assert right.fit["chamfer_after"] == pytest.approx(again.chamfer)


def test_the_last_state_goes_on(scene, right):
    assert isinstance(right.last_state, ClothState)
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    x = right.last_state.x.clone().requires_grad_()
    out = cloth(right.last_state._replace(x=x), build_episode(cloth, scene.recording).motion, [0.70, 0.71])
    out.x[-1, :, 2].mean().backward()
    assert float(x.grad.norm()) > 0


def test_another_effect_of_that_name_is_not_overwritten(scene):
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    cloth.effects["correction"] = BodyForce(torch.zeros(1, 3))
    with pytest.raises(InvalidInput, match="correction"):
        estimate_pose(cloth, scene.recording)


def test_markers_alone(scene):
    """The full mesh from a few material points that are seen now and then."""
    uv = np.array([[0.1, 0.1], [0.2, 0.05], [0.1, 0.2], [0.2, 0.25], [0.15, 0.15]])
    mesh = build_cloth(scene, twins.TRUE_FABRIC).mesh
    xyz = np.stack([twins.interpolate_bilinear(x, twins.FIT_RESOLUTION, uv) for x in scene.truth.numpy()])
    xyz[::3, :2] = np.nan
    times = scene.recording.points.t
    recording = replace(scene.recording, points=None, markers=rec.Markers(times, xyz, uv))
    result = estimate_pose(build_cloth(scene, WRONG_FABRIC), recording, modes=4, window=0.18)
    assert np.isfinite(result.std.numpy()).all()
    assert rms(result.x, scene, scene.hidden) < 0.6 * rms(result.uncorrected, scene, scene.hidden)
    assert any("no points" in warning for warning in result.warnings)
    assert math.isnan(result.fit["point_noise"])
    assert 0 < float(result.seen.double().mean()) < 1
    assert len(mesh.vertices) == result.x.shape[1]


def test_nothing_need_be_seen_at_the_beginning(scene):
    """Early stages without data were refused as if the whole had none."""
    uv = np.array([[0.1, 0.1], [0.2, 0.05], [0.1, 0.2], [0.2, 0.25]])
    xyz = np.stack([twins.interpolate_bilinear(x, twins.FIT_RESOLUTION, uv) for x in scene.truth.numpy()])
    xyz[: len(xyz) // 2] = np.nan
    markers = rec.Markers(scene.recording.points.t, xyz, uv)
    result = estimate_pose(
        build_cloth(scene, WRONG_FABRIC), replace(scene.recording, points=None, markers=markers), modes=4, window=0.18
    )
    late = scene.hidden.clone()
    late[: len(late) // 2] = False
    assert rms(result.x, scene, late) < 0.8 * rms(result.uncorrected, scene, late)


def test_nothing_seen_at_all_is_said(scene):
    hands = {name: replace(m, force=None, torque=None) for name, m in scene.recording.grippers.items()}
    blind = rec.Markers(scene.recording.points.t, np.full((len(scene.truth), 1, 3), np.nan), np.array([[0.1, 0.1]]))
    recording = replace(scene.recording, points=None, grippers=hands, markers=blind)
    with pytest.raises(RecordingError, match="nothing to estimate from"):
        estimate_pose(build_cloth(scene, twins.TRUE_FABRIC), recording)


def test_a_search_that_can_make_no_step_has_not_converged(scene):
    """Stiffer cloth has no such step; that no step was made passed for a small one."""
    cloth = build_cloth(scene, replace(twins.TRUE_FABRIC, membrane=0.2 * twins.TRUE_FABRIC.membrane))
    soft = 0.2 * twins.TRUE_FABRIC.membrane / twins.THICKNESS_M
    stuck = {"uncertain": {"youngs_modulus": (soft, 4.0)}, "dt": 0.999 * cloth.stable_step()}
    result = estimate_pose(cloth, scene.recording, modes=2, window=0.35, **stuck)
    assert not result.fit["converged"]
    assert any("did not converge" in warning for warning in result.warnings)


def test_stated_noise_is_what_points_are_compared_with(scene):
    result = estimate_pose(
        build_cloth(scene, twins.TRUE_FABRIC), scene.recording, modes=4, window=0.18, noise={"points": 3e-3}
    )
    assert result.fit["point_noise"] == 3e-3
    assert result.warnings == []


def test_what_a_gripper_has_let_go_is_as_uncertain_as_the_rest(scene, right):
    """Its patch was taken for held to the end, and known to the last digit."""
    hands = scene.recording.grippers
    left = replace(hands["left"], closed=hands["left"].t < 0.53)  # until the knot at 0.54 s
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    data = build_episode(cloth, replace(scene.recording, grippers={**hands, "left": left}))
    gripped, patch = find_gripped_vertices(cloth, data), cloth.boundaries["left"].index
    assert torch.equal(gripped[:, patch].all(1), data.times < 0.54)
    assert bool(gripped[:, cloth.boundaries["right"].index].all())
    finer = estimate_fine_scale_std(right.x, data, right.faces, compute_modes(cloth.mesh), 4, gripped, 1e-3, 1e-3)
    assert float(finer[gripped].max()) < 1e-9
    assert float(finer[data.times > 0.54][:, patch].min()) > 0.2 * float(finer[~gripped].median())


def test_forces_are_no_blindness(scene):
    pull = np.random.default_rng(0).normal(0, 0.05, (len(scene.recording.grippers["left"].t), 3))
    hands = {name: replace(motion, force=pull) for name, motion in scene.recording.grippers.items()}
    felt = replace(scene.recording, grippers=hands)
    result = estimate_pose(build_cloth(scene, twins.TRUE_FABRIC), felt, modes=4, window=0.18, use=["force"])
    assert not any("seen or felt" in warning for warning in result.warnings)


def few(recording, count):
    """With at most so many points a frame."""
    rng, points = np.random.default_rng(0), recording.points
    clouds = [rng.permutation(points.frame(i))[:count] for i in range(len(points))]
    counts = np.array([len(cloud) for cloud in clouds])
    return replace(recording, points=rec.PointClouds(points.t, np.concatenate(clouds), counts))


def test_few_points_of_unknown_noise_are_not_taken_for_exact(scene):
    """Too few to tell noise from shape: taken as exact, they made every error three times as large.

    Depth of a camera that nobody knows may be off by twice its scatter.
    """
    sparse, cloth = few(scene.recording, 60), build_cloth(scene, twins.TRUE_FABRIC)
    stated = estimate_pose(cloth, sparse, modes=4, window=0.18)
    unknown = estimate_pose(cloth, replace(sparse, observation_noise_std=None), modes=4, window=0.18)
    assert stated.fit["std_rms"] < unknown.fit["std_rms"] < 2 * stated.fit["std_rms"]
    assert coverage(unknown, scene)[0] > 0.88


@pytest.mark.parametrize(("use", "noise"), [("markers", 1e-3), ("force", None)])
def test_what_is_not_used_was_not_seen(scene, use, noise):
    """The points are there, and tell of distances only: all else is as if they were not."""
    uv = np.array([[0.1, 0.1], [0.2, 0.2]])
    xyz = np.stack([twins.interpolate_bilinear(x, twins.FIT_RESOLUTION, uv) for x in scene.truth.numpy()])
    pull = np.random.default_rng(0).normal(0, 0.05, (len(scene.recording.grippers["left"].t), 3))
    grippers = {name: replace(motion, force=pull) for name, motion in scene.recording.grippers.items()}
    markers = rec.Markers(scene.recording.points.t, xyz, uv)
    whole = replace(scene.recording, grippers=grippers, markers=markers, observation_noise_std=noise)
    ask = partial(estimate_pose, build_cloth(scene, WRONG_FABRIC), modes=4, window=0.18, use=[use])
    result, alone = ask(whole), ask(replace(whole, points=None))
    torch.testing.assert_close(result.x, alone.x)
    torch.testing.assert_close(result.std, alone.std)
    assert torch.equal(result.seen, alone.seen)
    assert bool(result.seen.any()) == (use == "markers")
    said = [[w for w in e.warnings if "rigidly" not in w] for e in (result, alone)]  # that is of distances
    assert said[0] == said[1]
    assert math.isfinite(result.fit["chamfer_after"])
    assert math.isnan(result.fit["point_noise"])


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"window": 0.0}, "window"),
        ({"modes": 0}, "modes"),
        ({"uncertain": {"colour": (1.0, 2.0)}}, "colour"),
        ({"uncertain": {"air.normal": (1.0, -1.0)}}, "air.normal"),
        ({"nuisances": ["weather"]}, "nuisance"),
        ({"nuisances": ["grip", "jitter"]}, "nuisances; got grip, jitter; expected none of these"),
        ({"use": ["sound"]}, "use"),
        ({"noise": {"colour": 1.0}}, "noise; got 'colour'; expected some of points"),
        ({"noise": {"points": -1.0}}, "noise of points"),
        ({"noise": {"points": math.nan}}, "noise of points"),
    ],
)
def test_bad_options(scene, options, match):
    with pytest.raises(InvalidInput, match=match):
        estimate_pose(build_cloth(scene, twins.TRUE_FABRIC), scene.recording, **options)


def test_a_late_clock_sees_beyond_the_last_stamp(scene, monkeypatch):
    """Frames taken later than they say: the last is where the cloth was then, which takes simulating on."""
    late, stored = 0.6 / twins.FRAME_RATE_HZ, slice(0, -4)
    points = scene.recording.points
    counts = points.counts[stored]
    stamps = np.concatenate([points.t[:1], points.t[stored][1:] - late])
    seen = replace(scene.recording, points=replace(points, t=stamps, counts=counts, xyz=points.xyz[: counts.sum()]))

    def last(result):
        assert (
            len(result.times)
            == len(result.x)
            == len(result.v)
            == len(result.seen)
            == len(result.rigid_carry)
            == len(counts)
        )
        assert float(result.windows[-1, 1]) == pytest.approx(float(result.times[-1]))
        return float((result.x[-1] - scene.truth[len(counts) - 1]).norm(dim=-1).square().mean().sqrt())

    ask = partial(
        estimate_pose,
        build_cloth(scene, twins.TRUE_FABRIC),
        seen,
        nuisances={"clock": 0.03},
        modes=4,
        window=0.18,
        checks=False,  # they would correct the clock
    )
    result = ask()
    assert result.nuisances["clock"].value == pytest.approx(late, rel=0.1)
    monkeypatch.setattr(nuisances, "MAX_CLOCK_OFFSET_STDS", 0.0)
    assert last(result) < 0.5 * last(ask())


def test_few_points_of_each_frame_tell_together(scene):
    """12 points a frame tell no field from noise, 12 of each of two frames do: the errors are not zero."""
    cloth = build_cloth(scene, WRONG_FABRIC)
    data = build_episode(cloth, scene.recording)
    few = replace(data, clouds=[cloud[:12] for cloud in data.clouds])
    gripped, modes, x = (
        find_gripped_vertices(cloth, data),
        compute_modes(cloth.mesh),
        scene.truth + 5e-3 * torch.sin(40 * scene.truth),
    )
    std = [
        estimate_fine_scale_std(x, subset, torch.as_tensor(cloth.mesh.faces), modes, 4, gripped, 1e-3, 1e-3)
        for subset in (data, few)
    ]
    sizes = [float(s.square().mean().sqrt()) for s in std]
    assert sizes[0] > 1e-3
    assert 0.3 < sizes[1] / sizes[0] < 3


def test_the_values_that_it_moved_with_can_be_set(scene):
    uncertain = {"youngs_modulus": (WRONG_FABRIC.membrane / twins.THICKNESS_M, 2.0)}
    cloth = build_cloth(scene, WRONG_FABRIC)
    result = estimate_pose(cloth, scene.recording, uncertain=uncertain, modes=2, window=0.3)
    value = result.parameters["youngs_modulus"].value
    assert value > 1.2 * uncertain["youngs_modulus"][0]
    assert float(result.apply(cloth).material.youngs_modulus.value.detach()) == pytest.approx(value)
