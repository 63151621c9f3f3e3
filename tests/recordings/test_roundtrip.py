"""What is written is what is read, and writes are all or nothing."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.schema_checks import check_written
from PIL import Image

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.recordings import atomic_write, formats, writing
from torchcloth.recordings.robot_files import locate_mesh_file

FLOAT32 = 1e-7  # relative precision of float32 times the 1 m size of the scene
HALF_STEP = 0.5e-4 + 1e-12  # points are stored in tenths of a millimetre


@pytest.mark.parametrize(("compact", "dtype", "atol"), [(True, np.int16, HALF_STEP), (False, np.float32, FLOAT32)])
def test_round_trip(recording, tmp_path, assert_same, compact, dtype, atol):
    path = rec.write(recording, tmp_path / "new" / "ep", compact=compact)
    back = rec.read(path, with_truth=True)
    assert_same(recording, back, atol=atol)
    assert back.path == path
    with np.load(path / "points.npz") as stored:
        assert stored["xyz"].dtype == dtype


def test_second_write_is_byte_identical(episode, tmp_path):
    again = rec.write(rec.read(episode, with_truth=True), tmp_path / "again")
    files = sorted(p.relative_to(episode) for p in episode.rglob("*") if p.is_file())
    assert files == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    for file in files:
        assert (episode / file).read_bytes() == (again / file).read_bytes(), file


def test_points_too_far_for_int16_become_float32(recording, tmp_path):
    points = replace(recording.points, xyz=recording.points.xyz + 4.0)
    path = rec.write(replace(recording, points=points), tmp_path / "ep")
    with np.load(path / "points.npz") as stored:
        assert stored["xyz"].dtype == np.float32
        assert "scale" not in stored
    np.testing.assert_allclose(rec.read(path).points.xyz, points.xyz, rtol=1e-7)  # float32 has 24 bits


def test_a_bare_sheet_is_an_episode(assert_same, tmp_path):
    bare = rec.Recording(cloth=rec.ClothInfo(areal_density=0.2, sheet=(0.3, 0.4)), provenance="measured")
    back = rec.read(rec.write(bare, tmp_path / "ep"))
    assert_same(bare, back)
    assert back.cloth.pattern_box()[1].tolist() == [0.3, 0.4]


def test_a_sheet_carries_its_first_frame_as_a_grid(assert_same, tmp_path):
    u, v = np.meshgrid(np.linspace(0, 0.3, 5), np.linspace(0, 0.4, 3), indexing="ij")
    first = np.stack([u + 1.0, u * v, 2.0 - v], axis=-1)  # bilinear, so that interpolation is exact
    bare = rec.Recording(
        cloth=rec.ClothInfo(areal_density=0.2, sheet=(0.3, 0.4), initial_vertices=first), provenance="measured"
    )
    back = rec.read(rec.write(bare, tmp_path / "ep"))
    assert_same(bare, back)
    uv = np.random.default_rng(0).uniform(0, [0.3, 0.4], (50, 2))
    uv[:2] = [[0.0, 0.0], [0.3, 0.4]]
    expected = np.stack([uv[:, 0] + 1.0, uv[:, 0] * uv[:, 1], 2.0 - uv[:, 1]], axis=1)
    np.testing.assert_allclose(back.cloth.interpolate_initial_positions(uv), expected, atol=1e-14)
    with pytest.raises(RecordingError, match="uv is not on the sheet"):
        back.cloth.interpolate_initial_positions(uv + 0.2)
    with pytest.raises(RecordingError, match="no initial grid"):
        replace(back.cloth, initial_vertices=None).interpolate_initial_positions(uv)


def test_a_sewn_garment_is_an_episode(assert_same, tmp_path):
    """Pattern coordinates per corner, a grasp that names vertices: read back exactly, and the mesh is the same."""
    mesh = tc.meshes.shirt(triangles=300)
    cloth = rec.ClothInfo(
        areal_density=0.15,
        vertices=mesh.vertices,
        faces=mesh.faces,
        uv=mesh.pattern,
        initial_vertices=mesh.vertices + np.array([0.0, 0.0, 1.0]),
    )
    t, holding = np.array([0.0, 1.0]), mesh.places["left shoulder"]
    quat = np.array([[1.0, 0, 0, 0]] * 2)
    gripper = rec.GripperMotion(t, np.zeros((2, 3)), quat, np.array([True, True]))
    whole = rec.Recording(
        cloth=cloth,
        provenance="synthetic: test",
        grasps={"g": rec.GraspInfo(vertices=holding)},
        grippers={"g": gripper},
    )
    back = rec.read(rec.write(whole, tmp_path / "ep"))
    assert_same(whole, back)
    stored = json.loads((tmp_path / "ep" / "episode.json").read_text())
    check_written(stored, "episode")
    assert stored["grasps"] == {"g": {"vertices": holding.tolist()}}
    again = tc.meshes.Mesh.build(back.cloth.vertices, back.cloth.faces, back.cloth.uv)
    np.testing.assert_array_equal(again.rest, mesh.rest)
    np.testing.assert_array_equal(again.seams, mesh.seams)
    np.testing.assert_array_equal(tc.meshes.load(tmp_path / "ep" / "cloth.obj").rest, mesh.rest)


@pytest.mark.parametrize(("write", "read"), [(rec.write, rec.read), (formats.write_mcap, formats.read)])
def test_velocities_of_the_first_frame_are_read_as_they_were_written(recording, tmp_path, write, read):
    velocities = np.random.default_rng(0).normal(size=recording.cloth.vertices.shape)
    moving = replace(recording, cloth=replace(recording.cloth, initial_velocities=velocities))
    back = read(write(moving, tmp_path / "ep.mcap"))
    np.testing.assert_array_equal(back.cloth.initial_velocities, velocities)


def test_the_format_texts_example_is_read(tmp_path):
    """The example of the format, word for word where it is valid JSON, written without this package."""
    eye = np.eye(4).tolist()
    episode = {
        "format": "torchcloth-recording",
        "version": 1,
        "cloth": {
            "mesh": None,
            "sheet": {"width": 0.30, "height": 0.30},
            "areal_density": 0.15,
            "thickness": 0.0005,
            "areal_density_std": 0.005,
            "layer_gap": 0.01,
            "initial_vertices": None,
            "nominal": {"membrane_stiffness": 600, "units": {}},
        },
        "grasps": {"left": {"uv": [[0.0, 0.30]], "radius": 0.012}},
        "colliders": {"table": {"plane": {"point": [0, 0, 0], "normal": [0, 0, 1]}, "friction": 0.4}},
        "robots": {"left": {"model": "rizon4", "T_world_base": eye, "tool_frame": "tcp_closed"}},
        "cameras": {},
        "observation_noise": {"std": 0.002},
        "clock_offset": 0.0,
        "gravity": [0, 0, -9.81],
        "air": {"density": 1.204},
        "split": {"motion": "slow_swing", "replicate_of": None},
        "provenance": "measured",
        "licence": "CC-BY-4.0",
    }
    (tmp_path / "episode.json").write_text(json.dumps(episode))
    t = np.linspace(0, 1, 5)
    np.savez(tmp_path / "motion.npz", **{"left/t": t, "left/q": np.zeros((5, 7)), "left/width": np.zeros(5)})
    got = rec.read(tmp_path)
    assert got.joints["left"].q.shape == (5, 7)
    assert got.cloth.sheet == (0.3, 0.3)
    assert rec.read(rec.write(got, tmp_path / "again")).cloth.layer_gap == 0.01
    assert got.split == {"motion": "slow_swing"}


def test_truth_is_read_only_on_request(episode):
    (episode / "truth.npz").write_bytes(b"even a damaged one is not looked at")
    blind = rec.read(episode)
    assert blind.truth is None
    with pytest.raises(RecordingError, match="with_truth=True"):
        blind.require("truth")
    with pytest.raises(RecordingError, match=r"truth\.npz"):
        rec.read(episode, with_truth=True)


def test_frames_and_images(episode, recording):
    back = rec.read(episode)
    assert len(back.points) == 3
    assert [len(back.points.frame(i)) for i in range(3)] == [30, 1, 17]
    np.testing.assert_array_equal(back.points.frame(-1), back.points.xyz[31:])
    ends = back.points.select(np.array([True, False, True]))
    assert ends.counts.tolist() == [30, 17]
    np.testing.assert_array_equal(ends.frame(1), back.points.frame(2))
    np.testing.assert_array_equal(ends.t, back.points.t[[0, 2]])
    camera = back.cameras["cam0"]
    for kind, dtype, shape in (
        ("depth", np.uint16, (6, 8)),
        ("color", np.uint8, (6, 8, 3)),
        ("mask", np.bool_, (6, 8)),
    ):
        stream = getattr(camera, kind)
        image = stream.load(1)
        assert (image.dtype, image.shape) == (dtype, shape)
        np.testing.assert_array_equal(image, getattr(recording.cameras["cam0"], kind).load(1))
        assert stream.frames.tolist() == [0, 3]
    camera.depth.paths[0].write_bytes(b"no image")
    with pytest.raises(RecordingError, match="cannot be decoded"):
        camera.depth.load(0)
    with pytest.raises(RecordingError, match="cannot be decoded"):
        list(camera.depth.iterate_files())  # nor handed on
    with pytest.raises(RecordingError, match="wrong size"):
        replace(camera.depth, size=(6, 8)).load(1)


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA"])
def test_a_mask_is_what_is_painted(tmp_path, mode):
    """An alpha channel paints nothing, be the background opaque or cut out."""
    painted = np.zeros((6, 8), bool)
    painted[1:3, 2:5] = True
    image = Image.fromarray(painted.astype(np.uint8) * np.uint8(255)).convert(mode)
    image.save(tmp_path / "opaque.png")
    paths = [tmp_path / "opaque.png"]
    if mode in ("LA", "RGBA"):
        cut = Image.new(mode, (8, 6), "white")
        cut.putalpha(Image.fromarray(painted.astype(np.uint8) * np.uint8(255)))
        cut.save(tmp_path / "cut.png")
        paths.append(tmp_path / "cut.png")
    stream = rec.ImageStream("mask", np.arange(len(paths)), np.arange(len(paths)) / 10, tuple(paths), (8, 6))
    for i in range(len(stream)):
        np.testing.assert_array_equal(stream.load(i), painted)


def test_quaternions_of_few_digits_are_made_unit(episode):
    """Others stay as they are, to the bit."""
    exact = rec.read(episode).grippers["left"].quat_wxyz
    with np.load(episode / "motion.npz") as stored:
        arrays = dict(stored)
    arrays["left/quat_wxyz"][1] *= 1.0009
    np.savez(episode / "motion.npz", **arrays)
    read = rec.read(episode).grippers["left"].quat_wxyz
    np.testing.assert_array_equal(read[[0, *range(2, len(read))]], exact[[0, *range(2, len(read))]])
    np.testing.assert_allclose(read[1], exact[1], rtol=0, atol=1e-12)


def test_require(recording):
    assert recording.require("points") is recording.points
    assert set(recording.require("force")) == {"left", "right"}
    assert set(recording.require("torque")) == {"right"}
    assert set(recording.require("depth")) == {"cam0"}
    for stream in ("points", "markers", "observation_noise_std"):
        with pytest.raises(RecordingError, match=f"has no {stream}, which tc.identify needs; "):
            replace(recording, **{stream: None}).require(stream, by="tc.identify")
    with pytest.raises(RecordingError, match=r"has no force, which this call needs; write NAME/force"):
        replace(recording, grippers={}, joints={}).require("force")
    with pytest.raises(InvalidInput, match="expected one of points"):
        recording.require("smell")


def test_an_existing_target_is_refused(episode, recording, tmp_path):
    with pytest.raises(RecordingError, match="exists; expected a new name; pass overwrite=True"):
        rec.write(recording, episode)
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.tex").write_text("years of work")
    with pytest.raises(RecordingError, match=r"holds no episode\.json"):
        rec.write(recording, home, overwrite=True)
    assert (home / "thesis.tex").exists()


def test_a_target_that_appears_meanwhile_is_kept(recording, tmp_path, monkeypatch):
    def appear(_):
        rec.write(replace(recording, licence="first"), tmp_path / "ep")

    with monkeypatch.context() as patch:
        patch.setattr(atomic_write, "_sync_all", lambda part: (patch.undo(), appear(part)))
        with pytest.raises(RecordingError, match="cannot be written"):
            rec.write(recording, tmp_path / "ep")
    assert rec.read(tmp_path / "ep").licence == "first"


def test_overwrite_replaces(episode, recording, tmp_path):
    rec.write(replace(rec.read(episode), licence="MIT", truth=None), episode, overwrite=True)  # images come from itself
    back = rec.read(episode, with_truth=True)
    assert (back.licence, back.truth, len(back.cameras["cam0"].depth)) == ("MIT", None, 2)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ep", "images"]


def bad_recordings(recording):
    points = replace(recording.points, xyz=recording.points.xyz * np.nan)
    moved = replace(recording.grippers["right"], t=recording.grippers["right"].t + 1)
    camera = recording.cameras["cam0"]
    missing = replace(camera.depth, paths=(camera.depth.paths[0], camera.depth.paths[0].with_name("lost.png")))
    yield replace(recording, points=points), r"ep/points.npz: xyz is not finite; got nan at \[0, 0\]"
    yield replace(recording, extra={"what": object()}), "object cannot be stored as JSON"
    yield replace(recording, extra={"what": float("nan")}), "cannot be written"
    yield replace(recording, grippers={**recording.grippers, "right": moved}), r"grippers\['right'\].t differs"
    yield replace(recording, cameras={"cam0": replace(camera, depth=missing)}), "lost.png"
    yield (
        replace(recording, cameras={"../up": replace(camera, depth=None)}),
        "cameras.*is not a plain name",
    )
    yield replace(recording, provenance="a friend"), "provenance is unclear"
    yield replace(recording, cloth=replace(recording.cloth, faces=None)), "cloth.faces is missing"
    objects = replace(recording.points, extra={"o": np.array([{}], dtype=object)})
    yield replace(recording, points=objects), "Object arrays"
    graph = replace(recording.points, xyz=torch.tensor(recording.points.xyz, requires_grad=True))
    yield replace(recording, points=graph), "requires grad"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_refused_write_leaves_nothing(assert_same, recording, tmp_path, overwrite):
    folder = tmp_path / "out"
    folder.mkdir()
    if overwrite:
        rec.write(recording, folder / "ep")
    for bad, message in bad_recordings(recording):
        with pytest.raises(RecordingError, match=message):
            rec.write(bad, folder / "ep", overwrite=overwrite)
        assert [p.name for p in folder.iterdir()] == ["ep"] * overwrite
        assert sorted(p.name for p in tmp_path.iterdir()) == ["images", "out"]
    if overwrite:
        assert_same(recording, rec.read(folder / "ep", with_truth=True), atol=HALF_STEP)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
@pytest.mark.parametrize("step", ["_fill", "_sync_all", "_put", "rename"])
def test_a_crash_at_any_step_keeps_the_old_episode(recording, episode, tmp_path, monkeypatch, step, error):
    def crash(*_):
        raise error

    def crash_into_place(source, target):
        if source.suffix == ".partial":
            raise error
        os.rename(source, target)

    if step == "rename":
        monkeypatch.setattr("pathlib.Path.rename", crash_into_place)
    else:
        monkeypatch.setattr(writing if step == "_fill" else atomic_write, step, crash)
    expected = RecordingError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected):
        rec.write(replace(recording, licence="new"), episode, overwrite=True)
    assert rec.read(episode).licence == "CC0"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ep", "images"]


def test_errors_pickle(tmp_path):
    with pytest.raises(RecordingError) as caught:
        rec.read(tmp_path / "nowhere")
    copy = pickle.loads(pickle.dumps(caught.value))
    assert (type(copy), str(copy)) == (RecordingError, str(caught.value))
    assert "\n" not in str(copy)


def test_recordings_pickle(assert_same, recording):
    assert_same(recording, pickle.loads(pickle.dumps(recording)))


def test_the_room_needs_only_numpy():
    code = "import sys, torchcloth.recordings.reading as r; print(*[m for m in sys.modules if m in {'PIL', 'trimesh'}])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_frames_are_chosen_by_mask_number_or_slice(recording):
    points = recording.points
    mask = np.arange(len(points.t)) < 2
    for frames in (mask, [0, 1], slice(0, 2), np.array([1, 0])):
        assert points.select(frames).t.tolist() == points.t[:2].tolist()
        assert np.array_equal(points.select(frames).xyz, points.xyz[: points.counts[:2].sum()])


def test_a_mask_of_indexed_colours_is_what_is_painted(tmp_path):
    """Whatever their numbers are: a palette may begin with white."""
    painted = np.zeros((6, 8), bool)
    painted[1:3, 2:5] = True
    for first, numbers in (("white", ~painted), ("black", painted)):
        image = Image.fromarray(numbers.astype(np.uint8), "P")
        image.putpalette([255] * 3 + [0] * 3 if first == "white" else [0] * 3 + [255] * 3)
        path = tmp_path / f"{first}.png"
        image.save(path)
        stream = rec.ImageStream("mask", np.arange(1), np.zeros(1), (path,), (8, 6))
        np.testing.assert_array_equal(stream.load(0), painted)


def test_a_users_file_may_have_any_name(episode):
    """Only the arms that are shipped are known to have seven joints."""
    path = episode / "episode.json"
    content = json.loads(path.read_text())
    content["robots"]["spare"]["model"] = "rizon4_on_rail.urdf"
    path.write_text(json.dumps(content))
    assert rec.read(episode).joints["spare"].q.shape == (3, 6)


def test_files_with_a_byte_order_mark_are_read(episode, assert_same):
    """As editors and spreadsheets on Windows write UTF-8."""
    before = rec.read(episode)
    for name in ("episode.json", "cloth.obj", "cam0/timestamps.csv"):
        path = episode / name
        path.write_text(path.read_text(encoding="utf-8"), encoding="utf-8-sig")
    assert_same(rec.read(episode), before)


URDF = '<robot name="a"><link name="tip"><visual><geometry><mesh filename="{}"/></geometry></visual></link></robot>'


@pytest.fixture
def with_urdf(recording, tmp_path) -> rec.Recording:
    """An episode whose arm is described by a file beside it, with one mesh beside that and one elsewhere."""
    folder = tmp_path / "lab" / "arms"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "tip.stl").write_bytes(b"solid")
    (tmp_path / "lab" / "secret").write_text("secret")
    text = URDF.format("meshes/tip.stl") + URDF.format("../secret") + URDF.format("package://arms/tip.stl")
    (folder / "arm.urdf").write_text(text)
    robots = {**recording.robots, "right": replace(recording.robots["right"], model="arms/arm.urdf")}
    return replace(recording, robots=robots, path=tmp_path / "lab")


def test_a_urdf_beside_the_episode_is_copied_with_it(with_urdf, tmp_path):
    episode = rec.write(with_urdf, tmp_path / "ep")
    back = rec.read(episode)
    assert back.robots["right"].model == "robots/right/arm.urdf"
    assert back.robots["spare"].model == "homemade"
    assert (episode / back.robots["right"].model).read_text() == (tmp_path / "lab" / "arms" / "arm.urdf").read_text()
    assert (episode / "robots" / "right" / "meshes" / "tip.stl").read_bytes() == b"solid"
    assert sorted(p.name for p in (episode / "robots").rglob("*") if p.is_file()) == ["arm.urdf", "tip.stl"]
    again = rec.write(back, tmp_path / "again")
    assert (again / "robots" / "right" / "arm.urdf").is_file()
    assert rec.write(rec.read(again), again, overwrite=True) == again
    assert (again / "robots" / "right" / "arm.urdf").is_file()


def test_meshes_of_packages_are_copied_with_their_urdf(with_urdf, tmp_path):
    """Each to where its name leads from the copy; files that are no meshes stay where they are."""
    lab = tmp_path / "lab"
    (lab / "a.stl").write_bytes(b"above")
    (lab / "parts").mkdir()
    (lab / "parts" / "b.STL").write_bytes(b"package")
    names = ("../a.stl", "package://parts/b.STL", "../secret", "package://lab/secret")
    (lab / "arms" / "arm.urdf").write_text("".join(map(URDF.format, names)))
    folder = (rec.write(with_urdf, tmp_path / "ep") / "robots" / "right").resolve()
    assert sorted(p.name for p in folder.rglob("*") if p.is_file()) == ["a.stl", "arm.urdf", "b.STL"]
    for name, content in zip(names[:2], ("above", "package"), strict=True):
        file = locate_mesh_file(name, folder)
        assert file.read_text() == content
        assert file.is_relative_to(folder)


def test_a_model_that_is_no_urdf_is_not_copied(with_urdf, tmp_path):
    (tmp_path / "lab" / "arms" / "arm.urdf").write_text("root:x:0:0")
    with pytest.raises(RecordingError, match="is no URDF"):
        rec.write(with_urdf, tmp_path / "ep")
    assert not (tmp_path / "ep").exists()


def test_a_camera_may_be_called_robots(with_urdf, tmp_path):
    cameras = {"robots": with_urdf.cameras["cam0"]}
    back = rec.read(rec.write(replace(with_urdf, cameras=cameras), tmp_path / "ep"))
    assert back.robots["right"].model == "robots_/right/arm.urdf"
    assert back.cameras["robots"].depth is not None
