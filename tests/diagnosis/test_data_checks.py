"""Data checks name faults planted in another engine's episodes, and pass the effects that a diagnosis looks for."""

import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import sheet_episodes

from torchcloth import recordings as rec
from torchcloth.cli import main
from torchcloth.diagnosis import build_base_model, check_episodes, diagnose, prepare_data
from torchcloth.diagnosis.data.cloud_checks import CheckedEpisode
from torchcloth.diagnosis.data.data_checks import _check_stamps
from torchcloth.diagnosis.data.dataset import check_positions_observed
from torchcloth.errors import InvalidInput
from torchcloth.recordings.images import ImageStream

EXAMPLE = Path(__file__).parents[2] / "torchcloth" / "examples" / "bimanual_swing"
GENERATE = "torchcloth.training.validation.independent.generate"
AHEAD, DEEP = np.array([0.3, 0.0, 0.0]), np.array([0.0, 0.0, 0.6])
SMALL = ("--nodes", "9", "--fit-nodes", "7")


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    """A sheet that is turned by a quarter; MuJoCo's."""
    out = tmp_path_factory.mktemp("gate") / "turn"
    command = [sys.executable, "-m", GENERATE, "--motion", "turn", *SMALL, "--seed", "5", "--out", out]
    subprocess.run(command, check=True)
    return rec.read(out)


def seen(recording, change):
    """With other points."""
    points = recording.points
    return replace(recording, points=replace(points, xyz=change(points.xyz)))


def stamped(recording, change):
    return replace(recording, points=replace(recording.points, t=change(recording.points.t)))


def renamed(recording):
    left, right = recording.grippers["left"], recording.grippers["right"]
    return replace(recording, grippers={"left": right, "right": left})


def thinned(recording, every):
    points = recording.points
    kept = np.flatnonzero(np.arange(len(points)) % 20 < every)
    xyz = np.concatenate([points.frame(i) for i in kept])
    return replace(recording, points=rec.PointClouds(points.t[kept], xyz, points.counts[kept]))


def paused(recording):
    """The robot's clock stands still for a while that is not seen."""
    t = recording.grippers["left"].t
    late = np.where(np.arange(len(t)) > len(t) // 3, t + 0.7, t)
    own = {name: replace(g, t=late) for name, g in recording.grippers.items()}
    return replace(recording, grippers=own)


FAULTS = {
    "the stamps of left jump by 0.7": paused,
    "the stamps of points does not increase": lambda r: stamped(r, lambda t: np.where(np.arange(len(t)) == 9, t[8], t)),
    "the stamps of points jump by 0.4": lambda r: stamped(r, lambda t: t + 0.4 * (np.arange(len(t)) > 30)),
    "the stamps of points jump by 0.18": lambda r: stamped(r, lambda t: t + 0.15 * (np.arange(len(t)) > 30)),
    "points come every": lambda r: stamped(r, lambda t: 1e3 * t),
    "camera and robot do not overlap": lambda r: stamped(r, lambda t: t + 100.0),
    "jump by 0.53": lambda r: thinned(r, 5),
    "the grippers are swapped": renamed,
    "times as long as the cloth, as if in inches": lambda r: seen(r, lambda x: x / 0.0254),
    r"0\.02\d+ times as long": lambda r: seen(r, lambda x: x * 0.0254),
    "the cloud is mirrored along y": lambda r: seen(r, lambda x: x * [1, -1, 1]),
    "the cloud is mirrored along x": lambda r: seen(r, lambda x: x * [-1, 1, 1]),
    "the cloud is mirrored with y and z exchanged": lambda r: seen(r, lambda x: x[:, [0, 2, 1]]),
    "points lie 0.[2-5]. m off": lambda r: seen(r, lambda x: x + AHEAD),
    "of the points lie farther from a gripper": lambda r: seen(
        r, lambda x: np.where(np.arange(len(x))[:, None] % 4 == 0, x - DEEP, x)
    ),
}


@pytest.mark.parametrize("said", FAULTS)
def test_a_planted_fault_is_named(turned, said):
    found = check_episodes([FAULTS[said](turned)])
    assert found, "nothing"
    assert re.search(said, str(found[0])), found[0]
    assert found[0].episode == "turn"
    assert found[0].remedy


def test_a_mirrored_cloud_is_told_though_some_frames_are_empty(turned):
    """A camera drops a frame now and then."""
    points = seen(turned, lambda x: x * [1, -1, 1]).points
    full = np.arange(len(points)) % 7 != 3
    xyz = np.concatenate([points.frame(i) for i in np.flatnonzero(full)])
    points = rec.PointClouds(points.t, xyz, np.where(full, points.counts, 0))
    assert "mirrored along y" in str(check_episodes([replace(turned, points=points)])[0])


GOOD = {
    "as it is": lambda r: r,
    "clock 30 ms": lambda r: stamped(r, lambda t: t + 0.03),
    "camera 4 mm": lambda r: seen(r, lambda x: x + 0.004),
    "camera 0.02 rad": lambda r: seen(r, lambda x: x @ np.array([[1, -0.02, 0], [0.02, 1, 0], [0, 0, 1]])),
    "depth 2 %": lambda r: seen(r, lambda x: [-0.7, 0.0, 0.3] + 1.02 * (x - [-0.7, 0.0, 0.3])),
    "half is hidden": lambda r: seen_where(r, lambda x: x[:, 2] > np.median(x[:, 2])),
    "stamps that scatter by 3 ms": lambda r: stamped(
        r, lambda t: t + 3e-3 * np.random.default_rng(0).standard_normal(len(t))
    ),
    "every fifth frame lost": lambda r: thinned(r, 16),
    "three stray points of a hundred": lambda r: seen(
        r, lambda x: np.where(np.arange(len(x))[:, None] % 33 == 0, x - DEEP, x)
    ),
}


def seen_where(recording, keep):
    points = recording.points
    frames = [f[keep(f)] for f in (points.frame(i) for i in range(len(points)))]
    counts = np.array([len(f) for f in frames])
    return replace(recording, points=rec.PointClouds(points.t, np.concatenate(frames), counts))


def with_markers(recording, count):
    """Instead of the cloud: single places, near each other."""
    points = recording.points
    middle = np.array([np.median(points.frame(i), axis=0) for i in range(len(points))])
    xyz = middle[:, None] + 0.01 * np.arange(count)[:, None] * [1.0, 0.0, 0.0]
    uv = np.full((count, 2), 0.15)
    return replace(recording, points=None, markers=rec.Markers(points.t, xyz, uv))


def with_bystander(recording):
    """A gripper that holds nothing, where it is not in the way."""
    own = recording.grippers["left"]
    idle = replace(own, position=own.position + np.array([0.0, 1.5, 0.0]), closed=np.zeros_like(own.closed))
    return replace(recording, grippers={**recording.grippers, "idle": idle})


def letting_go(recording):
    """The left gripper opens after a third and goes away; clouds as they were."""
    own = recording.grippers["left"]
    open_ = np.arange(len(own.t)) >= len(own.t) // 3
    away = own.position + np.array([0.0, 0.0, 0.6]) * open_[:, None]
    left = replace(own, position=away, closed=~open_)
    return replace(recording, grippers={**recording.grippers, "left": left})


def with_images(recording):
    """Of a camera whose pictures stop for half a second: nothing is compared with them."""
    t = np.array([0.0, 0.02, 0.04, 0.06, 0.6, 0.62, 0.64])
    (name, own), *_ = recording.cameras.items()
    camera = replace(own, color=ImageStream("color", np.arange(len(t)), t, (), (640, 480)))
    return replace(recording, cameras={name: camera})


def with_rests(recording):
    """Grippers of whose first rest, a second, there is one knot, and a path at 100 Hz."""
    moved = {}
    for name, g in recording.grippers.items():
        t = np.concatenate([g.t[:1], g.t[1:] + 1.0])
        position = np.concatenate([g.position[1:2], g.position[1:] + 1e-9 * np.arange(1, len(t))[:, None]])
        position[1] = position[0]
        quat = np.concatenate([g.quat_wxyz[1:2], g.quat_wxyz[1:]])
        moved[name] = replace(g, t=t, position=position, quat_wxyz=quat)
    return stamped(replace(recording, grippers=moved), lambda t: t + 1.0)


GOOD |= {
    "grippers that rest first": with_rests,
    "a gripper that lets go": letting_go,
    "pictures with a gap": with_images,
    "one marker": lambda r: with_markers(r, 1),
    "three markers": lambda r: with_markers(r, 3),
    "a gripper that stands by": with_bystander,
}


@pytest.mark.parametrize("what", GOOD)
def test_what_a_diagnosis_looks_for_passes(turned, what):
    assert check_episodes([GOOD[what](turned)]) == []


def test_two_knots_are_enough_of_a_gripper_that_rests(turned):
    still = {
        name: rec.GripperMotion(
            g.t[0] + np.array([0.0, 9.0]), *(v[[0, 0]] for v in (g.position, g.quat_wxyz, g.closed))
        )
        for name, g in turned.grippers.items()
    }
    assert list(_check_stamps(replace(turned, grippers=still))) == []


def test_an_arm_that_was_recorded_with_its_fingers_width_holds_while_they_are_near():
    """Width instead of closed: as ``replay`` reads it."""
    whole = rec.read(EXAMPLE)
    width = np.where(np.arange(len(whole.joints["left"].t)) < 5, 0.08, 0.0)
    joints = {"left": replace(whole.joints["left"], closed=None, width=width), "right": whole.joints["right"]}
    seen = CheckedEpisode(replace(whole, joints=joints))
    free = seen.t < whole.joints["left"].t[5]
    assert np.isnan(seen.holding_positions[free, list(seen.paths).index("left")]).all()
    assert np.isfinite(seen.holding_positions[~free]).all()


def test_episodes_of_two_cloths_are_refused(turned):
    light = replace(turned, cloth=replace(turned.cloth, areal_density=0.1))
    with pytest.raises(InvalidInput, match=r"another areal density.*got 0\.1.*expected 0\.25.*separately"):
        check_episodes([turned, light])
    uv = turned.cloth.uv * 1.5
    with pytest.raises(InvalidInput, match=r"another cloth.*got 0\.45 x 0\.45.*expected 0\.3 x 0\.3"):
        check_episodes([turned, replace(turned, cloth=replace(turned.cloth, uv=uv))])
    for other in (
        replace(turned, gravity=np.array([9.81, 0.0, 0.0])),
        replace(turned, cloth=replace(turned.cloth, nominal={**turned.cloth.nominal, "membrane_stiffness": 1e4})),
    ):
        with pytest.raises(InvalidInput, match=r"another (gravity|data sheet)"):
            check_episodes([turned, other])
    held = {name: rec.GraspInfo(vertices=np.array([0, 1]), uv=None) for name in turned.grasps}
    others = {name: replace(g, vertices=np.array([40, 41])) for name, g in held.items()}
    beside = [{n: replace(g, vertices=np.array([k])) for n, g in held.items()} for k in (1500, 1501)]  # of a fine mesh
    wider = {name: replace(g, radius=2 * g.radius) for name, g in turned.grasps.items()}
    for one, two, what in (
        (replace(turned, grasps=held), replace(turned, grasps=others), "vertices of a grasp"),
        (*(replace(turned, grasps=grasps) for grasps in beside), "vertices of a grasp"),
        (turned, replace(turned, grasps=wider), "radius of a grasp"),
        (replace(turned, air_density=None), replace(turned, air_density=1.2), "air"),
    ):
        with pytest.raises(InvalidInput, match=f"another {what}"):
            check_episodes([one, two])
    elsewhere = {name: rec.GraspInfo(g.uv * 0.5, g.radius) for name, g in turned.grasps.items()}
    with pytest.raises(InvalidInput, match="another place of a grasp"):
        check_episodes([turned, replace(turned, grasps=elsewhere)])


def test_the_verdict_is_written_and_the_command_is_done(turned, tmp_path, capsys):
    swapped = rec.write(renamed(turned), tmp_path / "swapped")
    other = rec.write(replace(turned, split={"motion": "other"}), tmp_path / "good")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "extended.tcm").touch()  # of an earlier diagnosis
    assert main(["diagnose", str(swapped), str(other), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    assert "verdict: invalid_data" in said
    assert "swapped: the grippers are swapped" in said
    content = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert content["verdict"] == "invalid_data"
    assert [f["episode"] for f in content["faults"]] == ["swapped"]
    assert {"causes", "gain", "next_experiment", "unresolvable", "model", "warnings"} <= set(content)
    assert "the grippers are swapped" in (tmp_path / "out" / "report.html").read_text()
    assert not (tmp_path / "out" / "extended.tcm").exists()


def test_a_stream_that_cannot_be_read_is_invalid_data_and_a_missing_folder_is_not(tmp_path, capsys):
    folders = [str(rec.write(sheet_episodes.make_episode(motion), tmp_path / motion)) for motion in ("slow", "fast")]
    with np.load(tmp_path / "slow" / "points.npz") as file:
        arrays = dict(file)
    arrays["t"] = arrays["t"][::-1].copy()
    np.savez(tmp_path / "slow" / "points.npz", **arrays)
    assert main(["diagnose", *folders, "--out", str(tmp_path / "out")]) == 0
    assert "does not increase" in capsys.readouterr().out
    kept = tmp_path / "out" / "progress" / "problem"  # of a diagnosis that was stopped
    kept.parent.mkdir()
    kept.touch()
    assert main(["diagnose", *folders, "--out", str(tmp_path / "out"), "--resume"]) == 0
    assert kept.exists()
    assert main(["diagnose", *folders, str(tmp_path / "none"), "--out", str(tmp_path / "other")]) == 2
    assert not (tmp_path / "other").exists()


def test_what_was_not_searched_has_no_model(turned):
    answer = diagnose([renamed(turned), replace(turned, split={"motion": "b"})])
    assert answer.verdict == "invalid_data"
    with pytest.raises(InvalidInput, match="invalid data"):
        _ = answer.model


def test_forces_alone_do_not_say_where_the_cloth_goes(turned):
    """Nor do points in the frame where the simulation starts, and in the last ones, of which a late clock sees none."""
    model = build_base_model(turned)
    ends = np.isin(np.arange(len(turned.points)), (0, len(turned.points) - 1))
    blind = [replace(turned, points=None, markers=None, split={"motion": m}) for m in "ab"]
    with pytest.raises(InvalidInput, match="none with points or markers"):
        check_positions_observed(prepare_data(model, blind))
    check_positions_observed(prepare_data(model, [turned, *blind]))
    with pytest.raises(InvalidInput, match="after its first frame"):
        check_positions_observed(prepare_data(model, [replace(turned, points=turned.points.select(ends))]))


def test_small_episodes_of_the_same_engine_pass():
    torch.set_default_dtype(torch.float64)
    assert (
        check_episodes([sheet_episodes.make_episode(motion, duration=0.6) for motion in sheet_episodes.MOTIONS]) == []
    )


@pytest.mark.parametrize("seed", [2, 3])
def test_a_bar_in_view_is_no_mirror(tmp_path, seed):
    """It hides the cloth near a gripper now and then, and a mirrored cloud would hide that."""
    out, barred = tmp_path / "shake", ("--effect", "obs.occlusion=0.2")
    made = [sys.executable, "-m", GENERATE, "--motion", "shake", *SMALL, *barred, "--seed", str(seed), "--out", out]
    subprocess.run(made, check=True)
    assert check_episodes([rec.read(out)]) == []


def test_an_episode_that_says_nothing_is_refused_by_name(tmp_path, capsys):
    """Two frames, of which the first begins the simulation and the last is what a late clock would see."""
    good = [sheet_episodes.make_episode(motion) for motion in ("slow", "fast")]
    points = good[1].points
    short = rec.PointClouds(points.t[:2], points.xyz[: points.counts[:2].sum()], points.counts[:2])
    cut = {name: _until(g, points.t[1] + 0.01) for name, g in good[1].grippers.items()}
    episodes = [good[0], replace(good[1], points=short, grippers=cut, split={"motion": "fast"})]
    folders = [str(rec.write(r, tmp_path / r.split["motion"])) for r in episodes]
    assert main(["diagnose", *folders, "--out", str(tmp_path / "out")]) == 2
    assert "fast, without points, markers or forces" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out" / "progress").exists()


def _until(motion, end):
    kept = motion.t <= end + 1e-9
    t, place, turn, closed = (c[kept] for c in (motion.t, motion.position, motion.quat_wxyz, motion.closed))
    return rec.GripperMotion(t, place, turn, closed)
