"""Markers and forces beside points: where they come from, and what they say."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import stretched_sheets, twins

from torchcloth import recordings as rec
from torchcloth.episodes import streams
from torchcloth.episodes.unknowns import collect_unknowns
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.identification import build_episode, identify
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.nuisances import select_nuisances
from torchcloth.identification.residuals.blocks import select_blocks
from torchcloth.identification.uncertainty import consider_covariance

GRASP = {"grasp": 1e-3}


@pytest.fixture(scope="module")
def pulled():
    with twins.use_float64():
        return stretched_sheets.record_episode(markers=5)


@pytest.fixture
def model(pulled):
    return stretched_sheets.build_start_cloth(pulled, youngs_modulus=7e4, poisson_ratio=0.3)


def test_streams_share_one_list_of_times(pulled, model):
    """Markers seen between the clouds: frames without a cloud, clouds without markers."""
    late = replace(pulled, markers=replace(pulled.markers, t=pulled.markers.t + 0.02))
    seen = build_episode(model, late)
    assert len(seen.times) == 2 * len(pulled.points)
    assert [len(c) > 0 for c in seen.clouds[:4]] == [True, False, True, False]
    assert bool(seen.markers[0].isnan().all())
    np.testing.assert_array_equal(seen.markers[1].numpy(), pulled.markers.xyz[0])
    assert seen.clouds[0].shape == seen.observed_points(0).shape


def test_markers_lie_on_their_material_points(pulled, model):
    seen = build_episode(model, pulled)
    flat = torch.nn.functional.pad(torch.as_tensor(model.mesh.uv), (0, 1))
    np.testing.assert_allclose(seen.marker_places.interpolate(flat)[:, :2].numpy(), pulled.markers.uv, atol=1e-12)
    uv = pulled.markers.uv.copy()
    uv[3] = [-0.1, 0.1]
    off = replace(pulled, markers=replace(pulled.markers, uv=uv))
    with pytest.raises(InvalidInput, match=r"markers.uv\[3\]; got 0.1"):
        build_episode(model, off)


def test_markers_without_uv_are_points(pulled, model):
    """Where there are points already, they would be the same cloth seen twice."""
    plain = replace(pulled, markers=replace(pulled.markers, uv=None))
    known = np.isfinite(pulled.markers.xyz[1]).all(-1)
    for recording, count in ((replace(plain, points=None), known.sum()), (plain, pulled.points.counts[1])):
        seen = build_episode(model, recording)
        assert seen.markers is None
        assert len(seen.clouds[1]) == count


def test_markers_alone_will_do(pulled, model):
    fit = identify(
        model, replace(pulled, points=None), ["youngs_modulus"], nuisances=GRASP, iterations=3, exact_bench=True
    )
    assert fit.parameters["membrane_stiffness"].value == pytest.approx(60.0, rel=0.03)
    assert "points_residual" not in fit.fit
    assert fit.fit["chamfer_after"] < fit.fit["chamfer_before"]


@pytest.mark.parametrize("use", ["points", "markers", "force"])
def test_the_distance_is_from_what_is_in_use(pulled, model, use):
    """By it steps through chaotic motion are judged."""
    grip = {name: replace(m, force=m.force + 1.0) for name, m in pulled.grippers.items()}
    off = {
        "points": replace(pulled, points=replace(pulled.points, xyz=pulled.points.xyz + 0.05)),
        "markers": replace(pulled, markers=replace(pulled.markers, xyz=pulled.markers.xyz + 0.05)),
        "force": replace(pulled, grippers=grip),
    }
    unknowns = collect_unknowns(model, ["youngs_modulus"], None)
    asked = {
        kind: Objective(model, unknowns, [build_episode(model, recording)], blocks=select_blocks(use))
        for kind, recording in {"as it is": pulled, **off}.items()
    }
    result = {kind: objective.mean_distance(objective.start) for kind, objective in asked.items()}
    assert [kind for kind in off if result[kind] > 2 * result["as it is"]] == [use]
    assert [kind for kind in off if result[kind] == result["as it is"]] == [kind for kind in off if kind != use]


def test_neither_points_nor_markers_nor_forces_is_refused(pulled, model):
    mute = {name: replace(motion, force=None, torque=None) for name, motion in pulled.grippers.items()}
    with pytest.raises(RecordingError, match="has no points"):
        build_episode(model, replace(pulled, points=None, markers=None, grippers=mute))


def test_means_of_a_signal_between_frames():
    """Of a parabola through its knots: the trapezoidal rule is exact for what lies linearly between them."""
    t = np.array([0.0, 0.1, 0.3, 0.4])
    value = np.stack([t, np.full(4, 2.0), [0.0, 1.0, 1.0, 0.0]], axis=1)
    mean = streams._interval_means(t, value, np.array([0.0, 0.2, 0.4]))
    assert np.isnan(mean[0]).all()
    np.testing.assert_allclose(mean[1:, 0], [0.1, 0.3])
    np.testing.assert_allclose(mean[1:, 1], 2.0)
    np.testing.assert_allclose(mean[1:, 2], [0.75, 0.75])


def test_a_lost_reading_takes_its_interval_and_no_other():
    t = np.arange(6) / 10
    value = np.stack([t, np.where(t == 0.2, np.nan, t)], axis=1)
    mean = streams._interval_means(t, value, np.array([0.0, 0.1, 0.25, 0.4, 0.45]))
    np.testing.assert_allclose(mean[1:, 0], [0.05, 0.175, 0.325, 0.425])
    np.testing.assert_allclose(mean[1:, 1], [0.05, np.nan, np.nan, 0.425])


def test_forces_are_those_of_the_rollout(pulled, model):
    """At the truth, on the truth's mesh: what is left is the sensor's noise, averaged over some three knots."""
    exact = stretched_sheets.make_cloth(stretched_sheets.Fabric(), stretched_sheets.TRUTH_RESOLUTION)
    seen = build_episode(model, pulled)
    start = torch.as_tensor(stretched_sheets.flat_positions(exact.mesh))
    with torch.no_grad():
        state = exact.settle(exact.state(start), seen.motion, duration=0.6)
        out = exact(state, seen.motion, seen.times)
    for name in ("left", "right"):
        error = (out.wrench[name] - seen.wrenches[name])[1:, :3]
        noise = stretched_sheets.FORCE_NOISE_N / 3**0.5
        assert float(error.square().mean(0).sqrt().max()) < 2 * noise
        assert float(error.mean(0).abs().max()) < 4 * noise / len(error) ** 0.5
        assert float(seen.wrenches[name][1:, 0].abs().max()) > 0.4  # N: the noise is small beside it
        assert bool(seen.wrenches[name][:, 3:].isnan().all())  # moments were not measured


def test_each_kind_has_a_scale_of_its_own(pulled, model):
    problem = Objective(model, collect_unknowns(model, ["youngs_modulus"], None), [build_episode(model, pulled)])
    linear = problem.linearise(problem.start)
    assert [b.name for b in problem.blocks] == ["points", "edges", "markers", "force", "torque"]
    assert sorted(set(linear.block.tolist())) == [0, 1, 2, 3]
    for block, unit in ((2, 1e-2), (3, 1.0)):  # metres and newtons, from a start that is off
        assert 0.01 * unit < float(linear.residual[linear.block == block].abs().median()) < unit


def test_force_gives_stiffness_without_a_density(pulled, model):
    """Positions of a shaken sheet give stiffness over density only; its own weight is not in question here."""
    options = {"nuisances": GRASP, "model_errors": twins.SAME_SIMULATOR, "exact_bench": True}
    blind = identify(model, pulled, ["youngs_modulus"], use=["points"], **options)
    felt = identify(model, pulled, ["youngs_modulus"], use=["points", "force"], **options)
    assert felt.parameters["youngs_modulus"].std < 0.5 * blind.parameters["youngs_modulus"].std
    assert felt.parameters["membrane_stiffness"].value == pytest.approx(60.0, rel=0.03)


def test_an_offset_that_is_not_fitted_widens_the_error(pulled, model, monkeypatch):
    """The first shape is off by half a millimetre at each jaw: unsaid, the error would be some 0.7 %."""
    plain = identify(model, pulled, ["youngs_modulus"], exact_bench=True).parameters["youngs_modulus"]
    monkeypatch.setattr(consider_covariance, "CONSIDERED_GRIP_STD_M", 0.0)
    exact = replace(pulled, observation_noise_std=None)
    sure = identify(model, exact, ["youngs_modulus"], exact_bench=True).parameters["youngs_modulus"]
    assert plain.std > 1.5 * sure.std
    assert abs(plain.value - 6e4) < 2 * plain.std


def test_use_is_checked(pulled, model):
    with pytest.raises(InvalidInput, match=r"use; got 'forces'; expected some of points, markers, force"):
        select_blocks(["forces"])
    still = replace(pulled, grippers={n: replace(m, force=None) for n, m in pulled.grippers.items()})
    with pytest.raises(InvalidInput, match="which no episode has"):
        identify(model, still, ["youngs_modulus"], use=["force"])


@pytest.mark.slow
def test_a_point_far_from_everything_does_not_count(pulled, model):
    """A hand in the picture, half a metre off: as if it were not there."""
    p = pulled.points
    hand = np.tile([0.0, 0.0, 1.6], (20, 1))
    xyz = np.concatenate([np.concatenate([p.frame(i), hand]) for i in range(len(p))])
    spoilt = replace(pulled, points=rec.PointClouds(p.t, xyz, p.counts + 20))
    clean, dirty = (
        identify(model, r, ["youngs_modulus"], use=["points"], iterations=2, exact_bench=True) for r in (pulled, spoilt)
    )
    a, b = (fit.parameters["youngs_modulus"] for fit in (clean, dirty))
    assert abs(a.value - b.value) < 0.3 * a.std


def test_one_name_may_stand_for_a_list_and_numbers_for_nothing(pulled, model):
    """Letter by letter, "points" was "got 'p'"."""
    assert select_blocks("markers") == select_blocks(["markers"])
    assert [type(n) for n in select_nuisances("clock")] == [type(n) for n in select_nuisances(["clock"])]
    with pytest.raises(InvalidInput, match="got 'youngs_modulu'; expected one of"):
        identify(model, pulled, "youngs_modulu")
    with pytest.raises(InvalidInput, match=r"prior of youngs_modulus; got 2.0; expected \(value, factor > 1\)"):
        identify(model, pulled, "youngs_modulus", priors={"youngs_modulus": 2.0})
    with pytest.raises(InvalidInput, match=r"iterations; got 1\.5; expected at least 1, and whole"):
        identify(model, pulled, iterations=1.5)
