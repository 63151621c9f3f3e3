"""The file for rerun, read back with rerun's own reader."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from torchcloth.errors import MissingDependency
from torchcloth.observe import DepthCamera
from torchcloth.recordings import Camera, ImageStream
from torchcloth.viewing import CameraView, add_cloth, write_rrd
from torchcloth.viewing.colours import map_colours
from torchcloth.viewing.rerun_export import TIMELINE


def test_a_file_that_cannot_be_made_is_named(film, tmp_path):
    """Also where the name beside it, which nobody gave, is the one that the system refuses."""
    path = tmp_path / f"{'x' * 240}.rrd"
    with pytest.raises(OSError, match="File name too long") as caught:
        write_rrd(film, path)
    assert caught.value.filename == str(path)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def full_film(film, tmp_path):
    """The film with a measured cloth, its truth, and a camera that saw two depth images."""
    from PIL import Image

    paths = tuple(tmp_path / f"{i}.png" for i in range(2))
    for i, path in enumerate(paths):
        Image.fromarray(np.full((6, 8), 700 + i, np.uint16)).save(path)
    stream = ImageStream("depth", np.arange(2), np.array([1.0, 1.3]), paths, (8, 6))
    pose = np.array([[0.0, 0, -1, 1], [1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, 0, 1]])
    K = np.array([[9.0, 0, 3.5], [0, 9, 2.5], [0, 0, 1]])
    camera = Camera(width=8, height=6, K=K, T_world_camera=pose, depth_scale=0.001, depth=stream)
    view = CameraView(camera, np.array([0, -1, -1, 1, -1, -1]))
    cloth = film.sheets["cloth"]
    film = replace(film, sheets={"truth": cloth}, views={"cameras/cam0": view})
    return add_cloth(film, cloth.vertices, cloth.faces)


@pytest.fixture
def read(full_film, tmp_path):
    return read_back(full_film, tmp_path)


def read_back(film, folder):
    """Entity path -> columns -> values of all its chunks; times in seconds."""
    from rerun.chunk import RrdReader

    result = {}
    for chunk in RrdReader(write_rrd(film, folder / "film.rrd")).stream():
        batch = chunk.to_record_batch()
        columns = result.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            values, column = batch.column(name), columns.setdefault(name, [])
            if name == TIMELINE:
                column += (values.cast("int64").to_numpy() / 1e9).tolist()
            elif ":" in name and not name.startswith("RecordingInfo"):
                column += values.to_pylist()
    return result


def test_every_part_has_its_entity(read):
    parts = {"cloth", "truth", "points", "arms/one/ball", "colliders/table", "grippers/one", "cameras/cam0"}
    assert {f"/world/{part}" for part in parts} <= read.keys()
    assert {"/curves/distance", "/curves/force/one"} <= read.keys()


def test_the_world_is_z_up(read):
    (coordinates,) = read["/world"]["ViewCoordinates:xyz"]
    assert coordinates == [[3, 5, 1]]  # right, forward, up: right-handed with z up


def test_meshes_move_over_time(read, full_film):
    for name in ("cloth", "truth"):
        entity = read[f"/world/{name}"]
        assert entity[TIMELINE] == pytest.approx(full_film.times - full_film.times[0])
        np.testing.assert_allclose(np.array(entity["Mesh3D:vertex_positions"]), full_film.sheets[name].vertices)
        assert np.array_equal(entity["Mesh3D:triangle_indices"][0], full_film.sheets[name].faces)
    drawn = np.array(read["/world/cloth"]["Mesh3D:vertex_colors"], np.uint32)
    expected = map_colours(full_film.sheets["cloth"].values, full_film.colour_limit).astype(np.uint32)
    np.testing.assert_array_equal(drawn, (expected * [1 << 24, 1 << 16, 1 << 8]).sum(-1) + 255)


def test_points_may_be_another_number_in_each_frame(film, tmp_path):
    from rerun.chunk import RrdReader

    frames = tuple(points[: 7 * i] for i, points in enumerate(film.clouds["points"].frames))
    film = replace(film, clouds={"points": replace(film.clouds["points"], frames=frames)})
    chunks = [c for c in RrdReader(write_rrd(film, tmp_path / "a.rrd")).stream() if c.entity_path == "/world/points"]
    (rows,) = [c.to_record_batch().column("Points3D:positions").to_pylist() for c in chunks if not c.is_static]
    assert [len(row) for row in rows] == [0, 7, 14, 21, 28, 35]
    np.testing.assert_allclose(rows[2], frames[2])


def test_solids_and_grippers_follow_their_poses(read, full_film):
    for name, poses in (
        ("arms/one/ball", full_film.solids["arms/one/ball"].poses),
        ("grippers/one/now", full_film.traces["grippers/one"].poses),
    ):
        entity = read[f"/world/{name}"]
        np.testing.assert_allclose(np.array(entity["Transform3D:translation"])[:, 0], poses[:, :3, 3], atol=1e-6)


def test_cameras_look_where_they_did(read):
    """Quaternions are xyzw; the pinhole's matrix is stored by columns."""
    from scipy.spatial.transform import Rotation

    entity = read["/world/cameras/cam0"]
    (((x, y, z, w),),) = entity["Transform3D:quaternion"]
    assert Rotation.from_quat([x, y, z, w]).as_matrix() == pytest.approx(
        np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]]), abs=1e-6
    )
    ((matrix,),) = entity["Pinhole:image_from_camera"]
    assert pytest.approx(np.array([[9.0, 0, 3.5], [0, 9, 2.5], [0, 0, 1]])) == np.reshape(matrix, (3, 3)).T


def test_depth_images_come_at_their_frames(read, full_film):
    entity = read["/world/cameras/cam0/depth"]
    assert entity[TIMELINE] == pytest.approx(full_film.times[[0, 3]] - full_film.times[0])
    pixels = [np.frombuffer(bytes(buffer[0]), np.uint16) for buffer in entity["DepthImage:buffer"]]
    assert [set(p.tolist()) for p in pixels] == [{700}, {701}]
    assert entity["DepthImage:meter"][0] == pytest.approx([1000.0])


SLOPE = np.array([0.3, -0.2, 1.0])  # of a wall that stands 0.8 m before the camera


def wall(rays):
    """Depth [...] m of the wall along rays [..., 2] (x / z, y / z)."""
    return 0.8 / (rays @ SLOPE[:2] + SLOPE[2])


@pytest.fixture
def bent(film, tmp_path):
    """(The film with a camera whose lens is strongly distorted, before a wall; that camera)."""
    from PIL import Image

    K, distortion = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]), np.array([-0.2, 0.05, 0, 0])
    lens = DepthCamera(64, 48, K, np.eye(4), distortion=distortion)
    Image.fromarray(np.rint(1e4 * wall(lens.pixel_rays)).astype(np.uint16)).save(tmp_path / "wall.png")
    stream = ImageStream("depth", np.arange(1), np.array([1.0]), (tmp_path / "wall.png",), (64, 48))
    camera = Camera(**lens.to_calibration(), depth_scale=1e-4, depth=stream)
    return replace(film, views={"cam": CameraView(camera, np.array([0, *[-1] * 5]))}), lens


def test_a_lens_is_taken_out_for_the_pinhole(bent, tmp_path, needs_open3d):
    film, lens = bent
    result = read_back(film, tmp_path)
    assert "Pinhole:image_from_camera" in result["/world/cam"]
    buffer = result["/world/cam/depth"]["DepthImage:buffer"][0][0]
    depth = 1e-4 * np.frombuffer(bytes(buffer), np.uint16).reshape(48, 64)
    expected = wall(lens.without_distortion().pixel_rays)
    assert np.abs(expected - wall(lens.pixel_rays)).max() > 0.02  # what came of it under the pinhole as it was
    seen = depth > 0
    assert seen.mean() > 0.9
    np.testing.assert_allclose(depth[seen], expected[seen], rtol=0, atol=1e-3)


def test_without_open3d_a_distorted_image_is_placed_nowhere(bent, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    result = read_back(bent[0], tmp_path)
    assert "DepthImage:buffer" in result["/world/cam/depth"]
    assert "Pinhole:image_from_camera" not in result["/world/cam"]


def test_curves_are_scalars_at_their_own_times(read, full_film):
    for name in ("distance", "force/one"):
        entity, curve = read[f"/curves/{name}"], full_film.curves[name]
        assert entity[TIMELINE] == pytest.approx(curve.t - full_film.times[0])
        assert np.ravel(entity["Scalars:scalars"]) == pytest.approx(curve.values)


def test_reruns_own_check_accepts_the_file(film, tmp_path):
    path = write_rrd(film, tmp_path / "film.rrd")
    done = subprocess.run([sys.executable, "-m", "rerun", "rrd", "verify", path], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["film.rrd"]


def test_without_rerun(film, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingDependency, match=r'pip install "torchcloth\[viz\]"'):
        write_rrd(film, tmp_path / "film.rrd")
    assert list(tmp_path.iterdir()) == []
