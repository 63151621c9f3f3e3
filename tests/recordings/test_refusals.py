"""Every refusal, with its message: file and key, what was got, one line."""

from __future__ import annotations

import json
import re
import shutil
import time

import numpy as np
import pytest

from torchcloth import recordings as rec
from torchcloth.errors import RecordingError

DROP = object()


def edit_json(episode, keys, value):
    """Set or drop one value of episode.json."""
    path = episode / "episode.json"
    root = node = json.loads(path.read_text())
    for key in keys[:-1]:
        node = node[key]
    if value is DROP:
        del node[keys[-1]]
    else:
        node[keys[-1]] = value
    path.write_text(json.dumps(root))


def edit_npz(episode, file, key, change):
    """Change, drop or add one array of an NPZ file."""
    with np.load(episode / file) as stored:
        arrays = dict(stored)
    if change is DROP:
        del arrays[key]
    else:
        arrays[key] = change(arrays.get(key)) if callable(change) else change
    np.savez(episode / file, **arrays)


def put(index, value):
    def change(array):
        array = array.copy()
        array[index] = value
        return array

    return change


def refused(episode, message):
    with pytest.raises(RecordingError) as caught:
        rec.read(episode, with_truth=True)
    text = str(caught.value)
    assert re.search(message, text), text
    assert "\n" not in text
    assert text.startswith(str(episode))


def test_texture_coordinates_are_no_pattern(episode):
    """From 0 to 1 on a sheet of 0.3 m x 0.2 m: where episode.json gives no sheet, nothing else tells their unit."""
    edit_json(episode, ["cloth", "sheet"], DROP)
    mesh = episode / "cloth.obj"

    def unit(row):
        return f"vt {float(row[1]) / 0.3!r} {float(row[2]) / 0.2!r}"

    mesh.write_text(re.sub(r"vt (\S+) (\S+)", unit, mesh.read_text()))
    refused(episode, r"cloth.obj: vt; got edges .* 3.33 to 5 times .*; expected about the same; vt must be in metres")


@pytest.mark.parametrize(("path", "wrong"), [(["grasps"], "grasp"), (["cloth", "areal_density"], "area_density")])
def test_a_misspelt_key_is_not_ignored(episode, path, wrong):
    """The cloth would fall, of nothing but a lacking letter."""
    content = json.loads((episode / "episode.json").read_text())
    value = content[path[0]] if len(path) == 1 else content[path[0]][path[1]]
    edit_json(episode, path, DROP)
    edit_json(episode, [*path[:-1], wrong], value)
    refused(episode, f"{wrong} is unknown; got '{wrong}'; expected '{path[-1]}'|{path[-1]} is missing")


MISSPELT = [
    ("grasps.left", "radius", "radios"),
    ("robots.right", "tool_frame", "tool_frme"),
    ("cameras.cam0", "distortion", "distorsion"),
    ("colliders.table", "friction", "fricton"),
    ("colliders.table.plane", "normal", "normals"),
    ("observation_noise", "std", "stdd"),
    ("air", "density", "densty"),
    ("split", "replicate_of", "replica_of"),
]


@pytest.mark.parametrize(("place", "right", "wrong"), MISSPELT)
def test_a_misspelt_key_is_not_ignored_wherever_it_stands(episode, place, right, wrong):
    content = json.loads((episode / "episode.json").read_text())
    keys, node = place.split("."), content
    for key in keys:
        node = node.setdefault(key, {})
    node.pop(right, None)
    node[wrong] = 1.0
    (episode / "episode.json").write_text(json.dumps(content))
    refused(episode, rf"{place}.{wrong} is unknown; got '{wrong}'; expected '{right}'|{place}.{right} is missing")


@pytest.mark.parametrize(
    ("file", "right", "wrong"),
    [
        ("motion.npz", "left/force", "left/forces"),
        ("motion.npz", "spare/width", "spare/widht"),
        ("markers.npz", "uv", "u_v"),
    ],
)
def test_a_misspelt_array_is_not_ignored(episode, file, right, wrong):
    with np.load(episode / file) as stored:
        there = right in stored
    if there:
        edit_npz(episode, file, right, DROP)
    edit_npz(episode, file, wrong, np.zeros(3))
    refused(episode, rf"{wrong} is unknown; got '{wrong.split('/')[-1]}'; expected '{right.split('/')[-1]}'; rename it")


def test_a_key_of_ones_own_beside_one_like_it_is_kept(episode):
    edit_json(episode, ["grasp"], {"by": "Ada"})
    assert rec.read(episode).extra["grasp"] == {"by": "Ada"}


MIRROR = np.diag([-1.0, 1, 1, 1]).tolist()
MILLI = [[1, 0, 0, 500.0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
SHEAR = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
COLUMNS = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0.5, 0, 0, 1]]

JSON = [
    (("format",), "rosbag", r"episode.json: format is unknown; got 'rosbag'; expected 'torchcloth-recording'"),
    (("version",), 2, r"version is unknown; got 2; expected 1; update torchcloth"),
    (("version",), DROP, "version is missing"),
    (("version",), True, "version is not a finite number; got True"),
    (("cloth",), DROP, "cloth is missing"),
    (("cloth",), [1], r"cloth is not an object of named values; got \[1\]"),
    (("cloth", "areal_density"), 0.0, "cloth.areal_density is too small; got 0.0; expected more than 0"),
    (("cloth", "areal_density"), "0.15", "cloth.areal_density is not a finite number; got '0.15'"),
    (("cloth", "areal_density"), 150, "cloth.areal_density looks like grams per square metre; got 150"),
    (("cloth", "areal_density"), 10**400, "cloth.areal_density is not a finite number"),
    (("cloth", "areal_density_std"), -1, "cloth.areal_density_std is too small"),
    (("cloth", "thickness"), 0.5, "cloth.thickness looks like millimetres"),
    (("cloth", "layer_gap"), 10, "cloth.layer_gap looks like millimetres; got 10"),
    (("cloth", "layer_gap"), 0.0, "cloth.layer_gap is too small; got 0.0; expected more than 0"),
    (("cloth", "sheet"), {"width": 300, "height": 200}, "cloth.sheet.width looks like millimetres; got 300"),
    (("cloth", "sheet"), {"width": 0.3, "height": 0.3}, "cloth.sheet is not the mesh; got a mesh of"),
    (("cloth", "sheet", "height"), DROP, "cloth.sheet.height is missing"),
    (("cloth", "mesh"), "lost.obj", "lost.obj is missing; expected a file"),
    (("cloth", "mesh"), "../../etc/passwd", "is not a plain name"),
    (("cloth", "mesh"), "a\0b", "is not a plain name"),
    (("cloth", "mesh"), "x" * 5000, "is missing"),
    (("cloth", "mesh"), None, r"cloth_initial.npy belongs to no mesh; got \[12, 3\]; expected \[M, N, 3\]"),
    (("cloth", "nominal"), {"youngs_modulos": 1e6}, r"nominal.youngs_modulos is unknown; expected .*youngs_modulus, "),
    (
        ("cloth", "nominal"),
        {"membrane_stiffness": 300, "youngs_modulus": 1e7},
        "nominal.membrane_stiffness is not youngs_modulus times thickness; got 300 N/m; expected .* N/m",
    ),
    (("cloth", "nominal", "membrane_stiffness"), "soft", "membrane_stiffness is not a finite number; got 'soft'"),
    (("cloth", "nominal", "membrane_stiffness"), True, "membrane_stiffness is not a finite number; got True"),
    (("cloth", "nominal", "membrane_stiffness"), -50, "membrane_stiffness is too small; got -50; expected more than 0"),
    (("cloth", "nominal", "membrane_stiffness"), 1e25, "membrane_stiffness looks like another unit; got 1e.25"),
    (
        ("cloth", "nominal", "poisson_ratio"),
        0.9,
        "poisson_ratio looks like another measure; got 0.9; expected at most 0.",
    ),
    (("cloth", "nominal", "bending_stiffness"), 30, "bending_stiffness looks like micronewton metres; got 30"),
    (("cloth", "nominal", "bending_damping_time"), -1, "bending_damping_time is too small"),
    (("cloth", "initial_vertices"), "lost.npy", "lost.npy is missing"),
    (("cloth", "initial_vertices"), "points.npz", "points.npz is not an NPY array"),
    (
        ("grasps", "middle"),
        {"uv": [[0, 0]], "radius": 0.01},
        r"grasps.middle has no motion; got \['left', 'right', 'spare'\]",
    ),
    (("grasps", "left", "uv"), [[0.35, 0.0]], r"grasps.left holds nothing; got uv \[0.35, 0.0\], 0.05 m outside"),
    (("grasps", "left", "uv"), [[0.05, 0.05]], "grasps.left holds no vertex; got radius 0.012"),
    (("grasps", "left", "uv"), [], r"grasps.left.uv has the wrong shape; got \[0\]; expected \[G, 2\]"),
    (("grasps", "left", "uv"), [[0, 0], [1]], "grasps.left.uv is not a rectangular array"),
    (("grasps", "left", "vertices"), [0], "grasps.left holds twice; got uv and vertices; expected one of them"),
    (("grasps", "left"), {"vertices": [12]}, r"grasps.left holds nothing; got vertices \[12\]; .* 0 to 11"),
    (("grasps", "left"), {"vertices": []}, "grasps.left.vertices has the wrong dtype"),
    (("grasps", "left"), {"vertices": [0.5]}, "grasps.left.vertices has the wrong dtype"),
    (("grasps", "left"), {"radius": 0.01}, "grasps.left.uv is missing"),
    (("grasps", "left", "radius"), 0, "grasps.left.radius is too small"),
    (("grasps", "left", "radius"), 12, "grasps.left.radius looks like millimetres"),
    (("robots", "ghost"), {"model": "rizon4", "T_world_base": np.eye(4).tolist()}, "robots.ghost is an unknown arm"),
    (
        ("robots", "spare", "model"),
        "rizon4s",
        r"motion.npz: spare/q is not a rizon4s's; got \[3, 6\]; expected \[K, 7\]",
    ),
    (("robots", "right", "model"), "", "robots.right.model is not text"),
    (("robots", "right", "T_world_base"), MIRROR, "robots.right.T_world_base is not a rotation; got .* det -1"),
    (("robots", "right", "T_world_base"), SHEAR, "robots.right.T_world_base is not a rotation"),
    (("robots", "right", "T_world_base"), MILLI, "robots.right.T_world_base looks like millimetres"),
    (("robots", "right", "T_world_base"), COLUMNS, "robots.right.T_world_base has a wrong last row"),
    (("cameras", "cam0", "T_world_camera"), MIRROR, "cameras.cam0.T_world_camera is not a rotation"),
    (("cameras", "cam0", "K"), np.zeros((3, 3)).tolist(), "cameras.cam0.K is no camera matrix"),
    (
        ("cameras", "cam0", "distortion"),
        [0.1, -0.2, 0.01],
        "cameras.cam0.distortion is cut off; got 3 numbers; expected 0, 4, 5, 8, 12 or 14",
    ),
    (("cameras", "cam0", "width"), 8.5, "cameras.cam0.width is not whole"),
    (("cameras", "cam0", "depth_scale"), DROP, "cameras.cam0.depth_scale is missing"),
    (("cameras", "cam0", "depth_scale"), 1000, "cameras.cam0.depth_scale looks like units per metre"),
    (("cameras", "../up"), {}, r"cameras name is not a plain name; got '../up'"),
    (
        ("colliders", "table"),
        {"sphere": 1},
        r"colliders.table is of an unknown shape; got \['sphere'\]; expected plane",
    ),
    (("colliders", "table", "box"), {"size": 1}, r"of an unknown shape; got \['plane', .*'box'.*\]; expected plane"),
    (("colliders", "table", "plane", "normal"), [0, 0, 2], "colliders.table.plane.normal is not unit; got length 2"),
    (("colliders", "table", "friction"), -0.1, "colliders.table.friction is too small"),
    (("observation_noise", "std"), 2.0, "observation_noise.std looks like millimetres"),
    (("gravity",), [0, -9.81], r"gravity has the wrong shape; got \[2\]; expected \[3\]"),
    (("gravity",), ["0", "0", "1"], "gravity has the wrong dtype"),
    (
        ("gravity",),
        [0, 0, -9810],
        r"gravity looks like mm/s\^2; got \[0.0, 0.0, -9810.0\]; expected at most 100 m/s\^2",
    ),
    (("air", "density"), -1, "air.density is too small"),
    (("air", "density"), 1204, r"air.density looks like g/m\^3; got 1204; expected at most 100"),
    (("clock_offset",), 1e3, r"points.npz: t does not overlap the motion; got 1000.1 to .*; set clock_offset"),
    (("split", "motion"), 3, "split.motion is not text"),
    (("provenance",), DROP, "provenance is missing"),
    (("provenance",), "a friend", "provenance is unclear; got 'a friend'"),
    (("provenance",), "measured", "truth.npz is in a measured episode"),
]


@pytest.mark.parametrize(
    ("keys", "value", "message"), JSON, ids=[f"{'.'.join(k)}-{i}" for i, (k, *_) in enumerate(JSON)]
)
def test_episode_json(episode, keys, value, message):
    edit_json(episode, keys, value)
    refused(episode, message)


def test_a_pose_with_few_digits_is_the_nearest_rotation(episode):
    """Cameras and arms ask for exact ones."""
    c, s = np.round([np.cos(0.3), np.sin(0.3)], 4)
    typed = [[c, -s, 0.0, 0.1], [s, c, 0.0, 0.2], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    edit_json(episode, ("robots", "right", "T_world_base"), typed)
    pose = rec.read(episode).robots["right"].T_world_base
    assert np.abs(pose - typed).max() < 1e-4
    assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-14


M, P, K, T = "motion.npz", "points.npz", "markers.npz", "truth.npz"
NPZ = [
    (M, "left/t", DROP, "motion.npz: left/t is missing"),
    (M, "left/t", put(3, 0.1), "left/t does not increase; got 0.4 then 0.1 at sample 3"),
    (M, "left/t", put(3, 0.4), "left/t does not increase"),
    (M, "left/t", np.zeros(0), "left/t is empty"),
    (M, "left/t", lambda t: t * 1e9, "left/t looks like milli- or nanoseconds"),
    (
        M,
        "left/t",
        lambda t: t * 1e3,
        r"left/t looks like milliseconds; got steps of 200, while .*spans 1; expected s",
    ),
    (M, "left/t", lambda t: t[:-1], r"left/closed has the wrong shape; got \[6\]; expected \[5\]"),
    (M, "left/t", lambda t: t[:, None], r"left/t has the wrong shape; got \[6, 1\]; expected \[T\]"),
    (M, "left/t", lambda t: t.astype(str), "left/t has the wrong dtype"),
    (M, "left/position", DROP, "left/position is missing"),
    (M, "left/position", put((2, 1), np.nan), r"left/position is not finite; got nan at \[2, 1\]"),
    (M, "left/position", put((2, 1), np.inf), r"left/position is not finite; got inf at \[2, 1\]"),
    (M, "left/position", lambda x: x * 1000, "left/position looks like millimetres; got a span of"),
    (M, "left/position", lambda x: x.astype(complex), "left/position has the wrong dtype; got complex128"),
    (M, "left/quat_wxyz", DROP, "left/quat_wxyz is missing"),
    (M, "left/quat_wxyz", lambda q: q * 1.01, "left/quat_wxyz is not unit; got length 1.01 at sample"),
    (M, "left/quat_wxyz", lambda q: q[:, :3], "left/quat_wxyz has the wrong shape"),
    (M, "left/closed", DROP, r"left/closed is missing; expected \[6\] bool"),
    (M, "left/closed", lambda c: c.astype(float), "left/closed has the wrong dtype; got float64; expected bool"),
    (M, "left/force", put((0, 0), np.nan), "left/force is not finite"),
    (M, "left/force", lambda f: f[:3], "left/force has the wrong shape"),
    (M, "right/q", lambda q: q * 100, "right/q looks like degrees"),
    (M, "right/q", lambda q: q[:, :0], "right/q has no columns"),
    (M, "right/q", lambda q: q[:, :6], r"right/q is not a rizon4's; got \[6, 6\]"),
    (M, "right/width", lambda w: w + 80, "right/width looks like millimetres"),
    (M, "right/width", lambda w: w - 1, "right/width is negative"),
    (M, "spare/q", DROP, r"spare has no motion; got \['t', 'width'\]"),
    (M, "stray", np.zeros(3), "stray belongs to no gripper; expected keys like left/t"),
    (M, "a/b/t", np.zeros(3), "motion.npz: a has no motion"),
    (P, "t", DROP, "points.npz: t is missing"),
    (P, "t", lambda t: t[::-1], "points.npz: t does not increase"),
    (P, "t", lambda t: t + 10, r"points.npz: t does not overlap the motion"),
    (P, "counts", lambda c: c + 1, "counts does not match xyz; got counts for 51 points, 48 in xyz"),
    (P, "counts", put(0, 2**62), "counts does not match xyz"),
    (P, "counts", lambda c: c[:2], "counts has the wrong shape"),
    (P, "counts", lambda c: c.astype(float), "counts has the wrong dtype"),
    (P, "counts", np.array([31, 0, 17]), "counts has an empty cloud; got 0 points in frame 1"),
    (P, "xyz", DROP, "points.npz: xyz is missing"),
    (P, "xyz", lambda x: x[:0], "counts does not match xyz"),
    (P, "xyz", lambda x: x.astype(np.int32), "xyz has the wrong dtype; got int32"),
    (P, "xyz", lambda x: x.astype(np.float32), "scale does not fit xyz; got float32 with scale"),
    (P, "xyz", lambda x: x[:, :2], "xyz has the wrong shape"),
    (P, "xyz", np.array([[{}, 1, 2]], dtype=object), "points.npz is truncated, corrupt or holds pickled objects"),
    (P, "scale", DROP, "scale does not fit xyz; got int16 without scale"),
    (P, "scale", np.float64(0.1), "xyz looks like millimetres"),
    (P, "scale", np.float64(-1e-4), "scale is not positive"),
    (K, "t", lambda t: t + 10, "markers.npz: t does not overlap the motion"),
    (K, "xyz", put((0, 0, 0), np.nan), "markers.npz: xyz is half seen"),
    (K, "xyz", put((0, 0, 0), np.inf), "markers.npz: xyz is not finite"),
    (K, "xyz", lambda x: x * np.nan, "markers.npz: xyz is empty"),
    (K, "xyz", lambda x: x * 1000, "markers.npz: xyz looks like millimetres"),
    (K, "uv", lambda uv: uv[:1], "markers.npz: uv has the wrong shape"),
    (K, "uv", lambda uv: uv + 0.1, "markers.npz: uv is not on the cloth"),
    (T, "t", lambda t: t - 10, "truth.npz: t does not overlap the motion"),
    (T, "vertices", lambda v: v[:-1], "truth.npz: vertices has the wrong shape"),
    (T, "vertices", lambda v: v * 1000, "truth.npz: vertices looks like millimetres"),
    (T, "faces", lambda f: f + 5, "truth.npz: faces does not fit vertices"),
]


@pytest.mark.parametrize(
    ("file", "key", "change", "message"), NPZ, ids=[f"{f}-{k}-{i}" for i, (f, k, *_) in enumerate(NPZ)]
)
def test_streams(episode, file, key, change, message):
    edit_npz(episode, file, key, change)
    refused(episode, message)


def test_an_episode_all_in_milliseconds(episode):
    """Nothing is longer than anything else, but no camera is so slow."""
    with np.load(episode / M) as stored:
        slow = {key: 1e3 * value if key.endswith("/t") else value for key, value in stored.items()}
    np.savez(episode / M, **slow)
    for file in (K, T):
        edit_npz(episode, file, "t", lambda t: 1e3 * t)
    with np.load(episode / P) as stored:
        np.savez(
            episode / P, t=33.3 * np.arange(6), counts=np.full(6, 8), xyz=stored["xyz"][:48], scale=stored["scale"]
        )
    refused(episode, "points.npz: t looks like milliseconds; got steps of 33.3; expected seconds")


def test_points_in_float_millimetres(episode):
    with np.load(episode / P) as stored:
        np.savez(episode / P, t=stored["t"], counts=stored["counts"], xyz=stored["xyz"] * np.float32(0.1))
    refused(episode, "points.npz: xyz looks like millimetres")


FILES = [
    ("episode.json", None, "episode.json is missing"),
    ("episode.json", b"", "episode.json is not valid JSON"),
    ("episode.json", b"[1]", "episode.json is not an object of named values"),
    ("episode.json", b"\xff\xfe", "episode.json is not UTF-8 text"),
    ("episode.json", b'{"format": NaN}', "NaN is no JSON number"),
    ("episode.json", b'{"clock_offset": 0.1, "cloth": {}, "clock_offset": 0}', "'clock_offset' twice in an object"),
    ("episode.json", b"[" * 100_000, "episode.json is not valid JSON"),
    ("motion.npz", None, r"grasps.left has no motion; got \[\]"),
    ("motion.npz", b"", "motion.npz is truncated, corrupt"),
    ("motion.npz", b"PK\x03\x04 and then nothing", "motion.npz is truncated, corrupt"),
    ("motion.npz", b"\x80\x04K\x01.", "motion.npz is truncated, corrupt or holds pickled objects"),
    ("cloth_initial.npy", None, "cloth_initial.npy is missing"),
    ("cloth_initial.npy", b"\x93NUMPY", "cloth_initial.npy is truncated"),
    ("cloth.obj", None, "cloth.obj is missing"),
    ("cloth.obj", b"", "cloth.obj: v has the wrong shape"),
    ("cloth.obj", b"v 0 0 zero", "cloth.obj is damaged at line 1; got 'v 0 0 zero'"),
    ("cloth.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4", "cloth.obj is damaged at line 4"),
    ("cloth.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3", "cloth.obj has a vertex in no face; got vertex 4"),
    ("cloth.obj", b"v 0 0 0\nv 300 0 0\nv 0 300 0\nf 1 2 3", "cloth.obj: v looks like millimetres"),
    ("cloth.obj", b"v 0 0 0\nv 1e999 0 0\nv 0 300 0\nf 1 2 3", "cloth.obj: v is not finite"),
    ("cam0/timestamps.csv", None, "timestamps.csv is missing"),
    ("cam0/timestamps.csv", b"frame,t\n0,1\n", "timestamps.csv is damaged"),
    ("cam0/timestamps.csv", b"frame,t_color,t_depth\n0,0.1,nan\n", "timestamps.csv is damaged"),
    ("cam0/timestamps.csv", b"frame,t_color,t_depth\n0,1,1\n0,2,2\n", "a frame listed twice"),
    ("cam0/timestamps.csv", b"frame,t_color,t_depth\n0,1,1\n3,1,1\n", "t of depth does not increase"),
    ("cam0/depth/000003.png", None, "cam0/depth and timestamps.csv do not match; got frame 3 in only one of them"),
    ("cam0/depth/extra.png", b"", "cam0/depth is no image stream; got names that are not distinct frame numbers"),
]


@pytest.mark.parametrize(("file", "content", "message"), FILES, ids=[f"{f}-{i}" for i, (f, *_) in enumerate(FILES)])
def test_files(episode, file, content, message):
    if content is None:
        (episode / file).unlink()
    else:
        (episode / file).write_bytes(content)
    refused(episode, message)


def test_paths(episode, tmp_path):
    refused(tmp_path / "nowhere", "nowhere does not exist; expected an episode folder")
    refused(episode / "motion.npz", "motion.npz is a file; expected an episode folder; pass the folder around it")
    (episode / "points.npz").unlink()
    (episode / "points.npz").mkdir()
    refused(episode, "points.npz cannot be read; got Is a directory")


def test_a_key_that_is_repeated_among_many_is_named_at_once(episode):
    """The search for it once took the square of their number: hours for a file of 10 MB."""
    keys = ", ".join(f'"key{i}": 0' for i in range(200_000))
    (episode / "episode.json").write_text(f'{{{keys}, "key199999": 1}}')
    started = time.monotonic()
    with pytest.raises(RecordingError, match="'key199999' twice in an object"):
        rec.read(episode)
    assert time.monotonic() - started < 10


def test_initial_vertices_of_another_mesh(episode):
    np.save(episode / "cloth_initial.npy", np.zeros((5, 3)))
    refused(episode, r"cloth_initial.npy has the wrong shape; got \[5, 3\]; expected \[12, 3\]")


def test_initial_vertices_in_another_order(episode):
    """As of a loader that sorts or merges vertices: every edge would be stretched, and the cloth would explode."""
    initial = np.load(episode / "cloth_initial.npy")
    np.save(episode / "cloth_initial.npy", initial[np.random.default_rng(0).permutation(len(initial))])
    refused(
        episode,
        r"cloth_initial.npy is not a shape of this mesh; got edges up to 3\.\d times their rest length; .*reord",
    )


def test_an_initial_grid_in_another_order(episode):
    edit_json(episode, ("cloth", "mesh"), DROP)
    grid = np.load(episode / "cloth_initial.npy").reshape(4, 3, 3)
    np.save(episode / "cloth_initial.npy", grid)
    rec.read(episode)
    np.save(episode / "cloth_initial.npy", np.random.default_rng(0).permutation(grid.reshape(12, 3)).reshape(4, 3, 3))
    refused(episode, "is not a shape of this mesh; got edges up to")


@pytest.mark.parametrize(
    ("shape", "speed", "message"),
    [
        ((5, 3), 1.0, r"v.npy has the wrong shape; got \[5, 3\]; expected \[12, 3\]"),
        ((12, 3), 300.0, "v.npy is too fast; got 300 m/s; .*millimetres per second"),
    ],
)
def test_velocities_of_another_mesh_or_unit(episode, shape, speed, message):
    np.save(episode / "v.npy", np.full(shape, speed))
    edit_json(episode, ("cloth", "initial_velocities"), "v.npy")
    refused(episode, message)


def test_velocities_without_a_first_shape(episode):
    np.save(episode / "v.npy", np.zeros((12, 3)))
    edit_json(episode, ("cloth", "initial_velocities"), "v.npy")
    edit_json(episode, ("cloth", "initial_vertices"), None)
    refused(episode, "v.npy belongs to no first shape")


def test_a_cloth_that_is_stretched_and_measured_with_noise_is_read(episode):
    initial = np.load(episode / "cloth_initial.npy") * [1.5, 1.0, 1.0]
    np.save(episode / "cloth_initial.npy", initial + np.random.default_rng(0).normal(0, 5e-3, initial.shape))
    rec.read(episode)


def test_grasps_need_pattern_coordinates(episode):
    edit_json(episode, ("cloth", "sheet"), None)
    (episode / "markers.npz").unlink()
    text = (episode / "cloth.obj").read_text()
    (episode / "cloth.obj").write_text(re.sub(r"/\d+|vt .*\n", "", text))
    refused(episode, "grasps.left cannot be found on the mesh; expected vt")


def test_a_held_arm_says_when_it_holds(episode):
    edit_json(episode, ("grasps", "spare"), {"uv": [[0, 0]], "radius": 0.01})
    rec.read(episode)
    edit_npz(episode, "motion.npz", "spare/width", DROP)
    refused(episode, "spare/closed is missing; expected closed or width")


@pytest.mark.parametrize("missing", ["points.npz", "markers.npz", "truth.npz", "cam0"])
def test_a_missing_stream_is_none(episode, missing):
    path = episode / missing
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    back = rec.read(episode, with_truth=True)
    assert [back.points, back.markers, back.truth, back.cameras["cam0"].depth].count(None) == 1
