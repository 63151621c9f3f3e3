"""Faults put into an episode: the inspection finds their size and number."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.swinging_cloth import gripper_path, make_clouds, make_episode, make_markers, make_motion, node_pattern
from PIL import Image

from torchcloth import meshes
from torchcloth import recordings as rec
from torchcloth.errors import RecordingError
from torchcloth.inspection import draw, inspect, show
from torchcloth.inspection.crop_planes import find_crop_planes
from torchcloth.inspection.lag import estimate_lag
from torchcloth.recordings.timing import summarise_timing
from torchcloth.robots.paths import holding_paths

GRID = {"extra": {"grid": np.array([8, 8])}}


@pytest.mark.parametrize(
    ("observed", "lag"), [("markers", 0.32), ("markers", -0.15), ("points", 0.0), ("points", 0.32)]
)
def test_the_lag_is_found_within_its_error(lag, observed, needs_open3d):
    stream = {"markers": make_markers(lag=lag, **GRID)} if observed == "markers" else {"points": make_clouds(lag=lag)}
    result = inspect(make_episode(**stream)).lag
    assert result.is_determined
    assert result.std < 0.02
    assert abs(result.value - lag) < max(3 * result.std, 0.01)
    assert result.recorded == 0.0


def test_a_lag_that_the_recording_states_is_no_news():
    recording = replace(make_episode(markers=make_markers(lag=0.2, **GRID)), clock_offset=-0.2)
    report = inspect(recording)
    assert report.lag.value == pytest.approx(0.2, abs=0.01)
    assert report.lag.recorded == 0.2
    assert not any("clocks differ" in note for note in report.notes)
    assert any("set clock_offset to -0.2" in n for n in inspect(replace(recording, clock_offset=0.0)).notes)


def test_a_shake_that_looks_the_same_a_period_later_keeps_the_recorded_lag():
    """Its misfit is as small one period of 0.5 s off; noise alone decides which of the two is the smallest."""
    hand = make_motion()
    shaken = np.stack([0 * hand.t, 0.03 * np.sin(4 * np.pi * hand.t), 0.5 + 0 * hand.t], -1)
    times, rng, chosen = np.arange(1.5, 6.5, 1 / 12), np.random.default_rng(0), []
    for _ in range(4):
        seen = np.stack([np.interp(times, hand.t, shaken[:, k]) for k in range(3)], -1)[:, None]
        markers = rec.Markers(times, seen + 0.02 * rng.standard_normal((len(times), 6, 3)))
        recording = make_episode(markers=markers)
        recording = replace(recording, grippers={"hand": replace(hand, position=shaken)})
        lag = estimate_lag(recording, holding_paths(recording))
        assert lag.is_determined
        assert not lag.differs_from_recorded
        assert sorted(abs(rival) for rival in lag.rivals)[:2] == pytest.approx([0.5, 0.5], abs=0.03)
        free = estimate_lag(recording, holding_paths(recording), is_one_clock=False)
        chosen.append(round(2 * free.value))
    assert set(chosen) - {0}  # without the recorded lag, another period wins in some of them


def test_an_arm_that_holds_nothing_is_drawn_and_not_followed():
    """It moves on its own, also while the cloth stands: neither lag nor noise are its business."""
    recording = make_episode(markers=make_markers(lag=0.1, **GRID))
    alone, hand = inspect(recording), recording.grippers["hand"]
    idle = np.stack([0.8 + 0.1 * np.sin(3.1 * hand.t), 0.1 * np.cos(2.3 * hand.t), 0.4 + 0 * hand.t], -1)
    grasp = rec.GraspInfo(uv=np.array([[0.15, 0.3]]), radius=0.02)
    both = {**recording.grippers, "idle": replace(hand, position=idle)}
    result = inspect(replace(recording, grippers=both, grasps={"hand": grasp}))
    assert set(result.paths) == {"hand", "idle"}
    assert result.lag.is_determined
    assert (result.lag.value, result.lag.std) == (alone.lag.value, alone.lag.std)
    assert result.noise["markers"] == alone.noise["markers"]
    assert not inspect(replace(recording, grippers=both)).lag.std < 2 * alone.lag.std  # where nothing says who holds


def test_its_standard_error_is_not_too_small_and_not_worlds_too_large():
    """It allows for errors that last, of which white noise has none."""
    values = [inspect(make_episode(markers=make_markers(noise=0.01, seed=seed, **GRID))).lag for seed in range(8)]
    scatter, stated = np.std([v.value for v in values]), np.median([v.std for v in values])
    assert 0.7 * scatter < stated < 6 * scatter + 0.003  # a spread of eight is known to a quarter


def test_a_motion_at_constant_speed_determines_no_lag():
    t = np.arange(0, 8, 0.02)
    straight = np.stack([0 * t, 0.1 * t, 0 * t + 0.5], -1)
    recording = make_episode(markers=make_markers(**GRID))
    stream = recording.markers
    xyz = (
        stream.xyz
        - gripper_path(stream.t)[:, None]
        + np.array([0, 0.1, 0]) * stream.t[:, None, None]
        + np.array([0, 0, 0.5])
    )
    quat, closed = np.tile([1.0, 0, 0, 0], (400, 1)), np.ones(400, bool)
    steady = rec.GripperMotion(t, straight, quat, closed)
    report = inspect(replace(recording, grippers={"hand": steady}, markers=replace(stream, xyz=xyz)))
    assert not report.lag.is_determined
    assert any("does not determine a lag" in note for note in report.notes)


@pytest.mark.parametrize("noise", [0.001, 0.004])
def test_static_noise_is_what_was_added(noise, needs_open3d):
    report = inspect(make_episode(markers=make_markers(noise=noise, **GRID), points=make_clouds(noise=noise)))
    assert report.noise["markers"].std == pytest.approx(noise, rel=0.15)
    assert report.noise["markers"].std_xyz == pytest.approx((noise,) * 3, rel=0.15)
    assert "at rest" in report.noise["markers"].method
    assert report.noise["points"].std == pytest.approx(noise, rel=0.15)
    assert "still frames" in report.noise["points"].method


def test_noise_in_one_direction_is_measured_along_it():
    stream = make_markers(noise=0.0, **GRID)
    ray = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    scatter = np.random.default_rng(0).standard_normal((*stream.xyz.shape[:2], 1))
    result = inspect(make_episode(markers=replace(stream, xyz=stream.xyz + 0.003 * scatter * ray))).noise["markers"]
    assert result.std == pytest.approx(0.003, rel=0.1)
    assert result.std_xyz[2] < 1e-4


@pytest.mark.parametrize("known", ["grid", "uv", "neither"])
def test_frames_of_another_size_are_rejected_and_no_others(known):
    extra = {"grid": GRID, "uv": {"uv": node_pattern()}, "neither": {}}[known]
    stream = make_markers(noise=0.001, **extra)
    spoiled = stream.xyz.copy()
    middle = spoiled.mean(1, keepdims=True)
    spoiled[10:15] = (middle + 1.15 * (spoiled - middle))[10:15]
    spoiled[40] = (middle + 0.8 * (spoiled - middle))[40]
    spoiled[60] = np.nan
    spoiled[5:9, ::7] = np.nan  # unseen, not wrong
    result = inspect(make_episode(markers=replace(stream, xyz=spoiled))).frames["markers"]
    np.testing.assert_array_equal(np.flatnonzero(result.rejected), [10, 11, 12, 13, 14, 40, 60])
    assert result.coverage[60] == 0
    assert result.coverage[5] == pytest.approx(54 / 64)
    assert ("unknown" in result.criterion) == (known == "neither")


@pytest.mark.parametrize(
    "grid", [np.array([8, 9]), np.array(64), np.array([-8, -8]), np.array([1, 64]), np.array(["u", "v"])]
)
def test_a_grid_that_does_not_fit_is_refused(grid):
    with pytest.raises(RecordingError, match="grid"):
        inspect(make_episode(markers=make_markers(extra={"grid": grid})))


def test_material_points_go_before_a_grid():
    """Markers set in from the edge are no grid over the whole sheet."""
    stream = make_markers(noise=0.001, uv=node_pattern())
    inner = np.abs(node_pattern() - node_pattern().mean(0)).max(1) < 0.8 * np.ptp(node_pattern(), axis=0).max() / 2
    side = int(inner.sum() ** 0.5)
    assert side**2 == inner.sum() < 64
    inner_markers = rec.Markers(stream.t, stream.xyz[:, inner], stream.uv[inner], {"grid": np.array([side, side])})
    assert not inspect(make_episode(markers=inner_markers)).frames["markers"].rejected.any()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("frames", [1, 3, 12, 84])
def test_sparse_streams_are_inspected_without_warnings(frames, needs_open3d, tmp_path):
    stream = make_markers(extra={})
    xyz = stream.xyz[:frames].copy()
    xyz[np.random.default_rng(0).random(xyz.shape[:2]) < 0.7] = np.nan
    sparse = rec.Markers(stream.t[:frames], xyz)
    single = rec.PointClouds(stream.t[:frames], np.zeros((frames, 3)), np.ones(frames, int))
    for paths in (make_episode().grippers, {}, {"hand": make_motion(length=0.5)}):
        report = inspect(replace(make_episode(markers=sparse, points=single), grippers=paths))
        json.dumps(report.as_dict(), allow_nan=False)
        assert draw(report, tmp_path).is_file()


def test_an_arm_that_is_not_known_is_a_note():
    t = np.arange(5) / 10
    arm = {"left": rec.JointMotion(t, np.zeros((5, 7)))}
    report = inspect(replace(make_episode(markers=make_markers(**GRID)), grippers={}, joints=arm))
    assert any("left" in note and "no lag" in note for note in report.notes)


def test_a_wrong_size_throughout_is_seen_where_the_size_is_known():
    stream = make_markers(**GRID)
    large = replace(stream, xyz=1.2 * stream.xyz)
    assert inspect(make_episode(markers=large)).frames["markers"].rejected.all()


def test_a_cloth_whose_mesh_lies_folded_may_be_seen_open(needs_open3d):
    mesh = meshes.rectangle(0.3, 0.3, resolution=(5, 5))
    folded = mesh.vertices * 1.0
    folded[:, 0] = np.abs(folded[:, 0] - 0.15)
    cloth = rec.ClothInfo(areal_density=0.2, vertices=folded, faces=mesh.faces, uv=mesh.uv)
    assert not inspect(replace(make_episode(points=make_clouds()), cloth=cloth)).frames["points"].rejected.any()


def test_clouds_outliers_crop_area_and_strangers(needs_open3d):
    stream = make_clouds(noise=0.001, count=800)
    rng = np.random.default_rng(1)
    frames = [stream.frame(i) for i in range(len(stream))]
    for i, frame in enumerate(frames):
        frames[i] = np.concatenate([frame[frame[:, 2] > 0.3], frame.mean(0) + rng.uniform(0.3, 0.6, (5, 3))])
    frames[20] = frames[20] * 2.0
    spoiled = rec.PointClouds(stream.t, np.concatenate(frames), np.array([len(f) for f in frames]))
    result = inspect(make_episode(points=spoiled)).frames["points"]
    assert np.flatnonzero(result.rejected).tolist() == [20]
    assert sum(result.removed.values()) == pytest.approx(5 * len(frames), rel=0.2)
    assert result.crop_planes == {"z >": pytest.approx(0.3, abs=2e-3)}
    uncropped = inspect(make_episode(points=stream)).frames["points"]
    assert uncropped.crop_planes == {}
    assert np.median(uncropped.coverage) == pytest.approx(1.0, abs=0.1)
    assert np.median(result.coverage) < 0.85 * np.median(uncropped.coverage)  # 0.5 m - 0.3 m of the 0.3 m are left


def test_frames_that_lose_most_of_the_cloth_are_rejected(needs_open3d):
    """23 of 2700 points, as where a hand hides the cloth or a threshold failed."""
    stream = make_clouds(count=800)
    frames = [stream.frame(i) for i in range(len(stream))]
    frames[7], frames[30], frames[31] = frames[7][:23], frames[30][:79], frames[31][:100]
    torn = rec.PointClouds(stream.t, np.concatenate(frames), np.array([len(f) for f in frames]))
    result = inspect(make_episode(points=torn)).frames["points"]
    assert np.flatnonzero(result.rejected).tolist() == [7, 30]
    assert "a tenth of the usual points" in result.criterion


def test_points_without_a_reading_are_named(needs_open3d):
    """(0, 0, 0) of a stereo camera, moved to the world with the others: all lie at its lens."""
    stream = make_clouds(count=200)
    xyz = stream.xyz.copy()
    xyz[::10] = 0.4, -1.2, 1.1
    notes = inspect(make_episode(points=replace(stream, xyz=xyz))).notes
    assert any(
        "10 % of the points repeat another of their frame, most of them at (0.4, -1.2, 1.1) m" in n for n in notes
    )
    assert not any("repeat another" in note for note in inspect(make_episode(points=stream)).notes)


LINK = '<link name="tip">{}</link>'
SOLID = "<collision><geometry>{}</geometry></collision>"


@pytest.mark.parametrize(
    ("solid", "camera_x", "match"),
    [
        ("", 0.0, "cam0 sees the arm 'hand', whose URDF has no solids: segmentation takes the arm for cloth"),
        (SOLID.format('<mesh filename="a.stl"/>'), 0.0, "whose URDF has no solids of tip: "),
        (SOLID.format('<sphere radius="0.1"/>'), 0.0, None),
        ("", 9.0, None),
    ],
)
def test_an_arm_without_solids_in_view_is_a_note(tmp_path, solid, camera_x, match):
    pytest.importorskip("pytorch_kinematics")
    joint = '<joint name="j" type="continuous"><parent link="base"/><child link="tip"/></joint>'
    (tmp_path / "arm.urdf").write_text(f'<robot name="a"><link name="base"/>{LINK.format(solid)}{joint}</robot>')
    pose = np.diag([1.0, -1.0, -1.0, 1.0])  # looks down from 2 m
    pose[:3, 3] = camera_x, 0.0, 2.0
    Image.fromarray(np.full((24, 32), 2000, np.uint16)).save(tmp_path / "0.png")
    depth = rec.ImageStream("depth", np.arange(1), np.zeros(1), (tmp_path / "0.png",), (32, 24))
    lens = {"width": 32, "height": 24, "K": np.array([[30.0, 0, 15.5], [0, 30, 11.5], [0, 0, 1]]), "depth_scale": 0.001}
    recording = replace(
        make_episode(),
        joints={"hand": rec.JointMotion(np.arange(5) / 10, np.zeros((5, 1)), closed=np.ones(5, bool))},
        robots={"hand": rec.RobotInfo(str(tmp_path / "arm.urdf"), np.eye(4), "tip")},
        cameras={"cam0": rec.Camera(**lens, T_world_camera=pose, depth=depth)},
    )
    notes = [note for note in inspect(recording).notes if "sees the arm" in note]
    assert len(notes) == (match is not None)
    assert match is None or match in notes[0]


def fold(*, cut=-np.inf, frames=60):
    """A sheet of 0.5 m lying at z = 0.1 m, whose half y > 0 a gripper at its far edge lifts and lays on the other.

    The edge y = -0.25 m never moves; points with y < ``cut`` are left out.
    """
    rng = np.random.default_rng(0)
    t = np.arange(frames) / 10
    turn = np.pi * 0.95 * np.clip((t - 0.5) / 5, 0, 1)
    clouds = []
    for angle in turn:
        u, v = rng.uniform(-0.25, 0.25, (2, 2000))
        up = np.maximum(v, 0)
        cloud = np.stack([u, np.minimum(v, 0) + up * np.cos(angle), 0.1 + up * np.sin(angle)], -1)
        clouds.append(cloud[cloud[:, 1] > cut])
    hand = np.stack([0 * t, 0.25 * np.cos(turn), 0.1 + 0.25 * np.sin(turn)], -1)
    grip = rec.GripperMotion(t, hand, np.tile([1.0, 0, 0, 0], (frames, 1)), np.ones(frames, bool))
    points = rec.PointClouds(t, np.concatenate(clouds), np.array([len(c) for c in clouds]))
    cloth = rec.ClothInfo(areal_density=0.2, sheet=(0.5, 0.5))
    return rec.Recording(cloth=cloth, grippers={"hand": grip}, provenance="synthetic: tests", points=points)


@pytest.mark.slow
def test_a_cloth_that_ends_is_not_cut_off(needs_open3d):
    assert inspect(fold()).frames["points"].crop_planes == {}
    result = inspect(fold(cut=-0.1)).frames["points"].crop_planes
    assert result["y >"] == pytest.approx(-0.1, abs=1e-3)


@pytest.mark.parametrize("excuse", ["gripped", "side seen", "complete", "none"])
def test_a_bound_is_no_crop_plane_with_an_excuse(excuse):
    """A cloud of 0.2 m that swings up from y = 0; a cloth of 0.4 m, unless it is told to be small."""
    rng = np.random.default_rng(0)
    heights = np.linspace(0.1, 0.25 if excuse != "side seen" else 0.19, 20)
    clouds = [np.append(rng.uniform(0, [0.1, h, 0.1], (3000, 3)), [[0, 0, 0]], axis=0) for h in heights]
    side = 0.15 if excuse == "side seen" else 0.4
    grippers = np.full((20, 1, 3), 0.02 if excuse == "gripped" else 0.5)
    seen = np.full(20, 1.1 if excuse == "complete" else 0.6)
    result = find_crop_planes(clouds, clouds, rec.ClothInfo(areal_density=0.2, sheet=(side, side)), seen, grippers)
    assert result == ({"y >": 0.0} if excuse == "none" else {})


def test_ticks_gaps_and_jitter():
    t = np.arange(50) / 10
    even = summarise_timing("points", t)
    assert (even.frames, even.span, even.gaps) == (50, pytest.approx(4.9), 0)
    assert even.rate == pytest.approx(10)
    assert even.jitter < 1e-12
    with_gaps = summarise_timing("points", np.delete(t, [20, 21, 22, 40]))
    assert (with_gaps.gaps, with_gaps.largest_gap) == (2, pytest.approx(0.4))
    assert with_gaps.rate == pytest.approx(45 / 4.9)
    noise = 0.01 * np.random.default_rng(0).standard_normal(2000)
    assert summarise_timing("points", np.arange(2000) / 10 + noise).jitter == pytest.approx(0.01 * np.sqrt(2), rel=0.1)
    assert summarise_timing("points", t[:1]).rate == 0.0


def test_an_episode_without_observations_says_so(capsys, tmp_path):
    report = inspect(make_episode())
    assert report.lag is None
    assert report.noise == report.frames == {}
    assert any("nothing to compare" in note for note in report.notes)
    show(report)
    assert "hand" in capsys.readouterr().out
    assert draw(report, tmp_path).is_file()


def test_without_motion_there_is_no_lag():
    report = inspect(replace(make_episode(markers=make_markers(**GRID)), grippers={}))
    assert report.lag is None
    assert "markers" in report.frames
    assert report.noise == {}


def test_without_motion_nobody_knows_which_frames_are_still(needs_open3d):
    seen = make_clouds()
    none, some = (inspect(replace(make_episode(points=seen), **change)) for change in ({"grippers": {}}, {}))
    assert none.noise["points"].method.endswith("in all frames, because without grippers still frames are unknown")
    assert "without grippers" not in some.noise["points"].method


def test_names_are_no_formulas(tmp_path, needs_open3d):
    recording = make_episode(points=make_clouds())
    odd = replace(
        recording, grippers={"a $x_{$ b": recording.grippers["hand"]}, cloth=replace(recording.cloth), grasps={}
    )
    assert draw(inspect(odd), tmp_path).is_file()


def test_the_report_is_json_and_a_picture(tmp_path, capsys, needs_open3d):
    report = inspect(make_episode(markers=make_markers(lag=0.1, **GRID), points=make_clouds(lag=0.1)))
    stored = json.loads(json.dumps(report.as_dict(), allow_nan=False))
    assert stored["lag"]["value"] == pytest.approx(0.1, abs=0.01)
    assert "constant speed" in stored["lag"]["caveat"]
    assert set(stored["streams"]) == {"hand", "points", "markers"}
    assert len(stored["frames"]["points"]["coverage"]) == len(report.recording.points)
    assert draw(report, tmp_path).read_bytes().startswith(b"\x89PNG")
    assert [p.name for p in tmp_path.iterdir()] == ["inspection.png"]
    show(report)
    text = capsys.readouterr().out
    assert "rate [Hz]" in text
    assert "0.1" in text
    assert max(map(len, text.splitlines())) <= 120


@pytest.mark.parametrize(("stamped", "recorded", "moved"), [(0.2, 0.0, -0.2), (0.2, 0.2, -0.2), (0.01, 0.0, 0.0)])
def test_observations_are_moved_by_a_lag_that_is_clear_only(stamped, recorded, moved):
    recording = replace(make_episode(markers=make_markers(lag=stamped, **GRID)), clock_offset=-recorded)
    lag = inspect(recording).lag
    assert lag.is_determined
    assert lag.differs_from_recorded == (stamped == 0.2 and recorded == 0.0)
    assert -lag.effective == pytest.approx(moved, abs=0.01 if lag.differs_from_recorded else 1e-12)


def test_coverage_and_what_was_removed_are_explained(capsys, monkeypatch, needs_open3d):
    recording = make_episode(points=make_clouds())
    show(inspect(recording))
    text = " ".join(capsys.readouterr().out.split())
    assert "apart from the cloth" in text
    assert "outliers not removed" not in text
    monkeypatch.setitem(sys.modules, "open3d", None)
    show(inspect(recording))
    assert "outliers not removed" in " ".join(capsys.readouterr().out.split())


def test_an_unknown_arm_that_stands_by_takes_nothing_away():
    recording = make_episode(markers=make_markers(lag=0.1, **GRID))
    grasp = rec.GraspInfo(uv=np.array([[0.15, 0.3]]), radius=0.02)
    gripped = replace(recording, grasps={"hand": grasp})
    with_idle_arm = replace(gripped, joints={"spare": rec.JointMotion(np.arange(5) / 10, np.zeros((5, 6)))})
    alone, result = inspect(gripped), inspect(with_idle_arm)
    assert set(result.paths) == {"hand"}
    assert (result.lag.value, result.noise["markers"]) == (alone.lag.value, alone.noise["markers"])
    assert [note for note in result.notes if note not in alone.notes] == [
        note for note in result.notes if "'spare' does not hold the cloth and has no path: " in note
    ]
    assert len(result.notes) == len(alone.notes) + 1
