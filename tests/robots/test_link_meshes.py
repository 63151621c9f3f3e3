"""Solids of arms whose URDF has meshes only."""

import re

import numpy as np
import pytest
import torch

from torchcloth import observe, robots
from torchcloth.errors import InvalidInput, MissingDependency
from torchcloth.observe.render import import_open3d
from torchcloth.recordings.robot_files import locate_mesh_file
from torchcloth.robots import link_meshes
from torchcloth.robots.description import locate_urdf

trimesh = pytest.importorskip("trimesh")
GEOMETRY = re.compile(r"<geometry>\s*<(cylinder|box|sphere) ([^>]*)/>\s*</geometry>")
LINK = '<link name="tip"><collision><geometry><mesh filename="{}"/></geometry></collision></link>'
JOINT = '<joint name="j" type="continuous"><parent link="base"/><child link="tip"/></joint>'


def size_of(kind: str, text: str) -> tuple[float, ...]:
    numbers = {key: value for key, value in re.findall(r'(\w+)="([^"]*)"', text)}
    keys = {"cylinder": ("radius", "length"), "box": ("size",), "sphere": ("radius",)}[kind]
    return tuple(float(word) for key in keys for word in numbers[key].split())


@pytest.fixture
def needs_open3d():
    try:
        import_open3d()
    except MissingDependency as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def mesh_arm(tmp_path_factory):
    """The shipped arm with each solid in a file of millimetres, STL and OBJ in turn, as a ROS package has it."""
    package = tmp_path_factory.mktemp("ros") / "some_arm"
    (package / "meshes").mkdir(parents=True)
    (package / "urdf").mkdir()
    count = 0

    def to_file(match):
        nonlocal count
        count += 1
        suffix = ("stl", "obj")[count % 2]
        vertices, faces = observe.build_solid_mesh(match[1], size_of(match[1], match[2]), np.eye(4))
        trimesh.Trimesh(1000 * vertices, faces).export(package / "meshes" / f"{count}.{suffix}")
        name = f"package://some_arm/meshes/{count}.{suffix}"
        return f'<geometry><mesh filename="{name}" scale="0.001 0.001 0.001"/></geometry>'

    path = package / "urdf" / "arm.urdf"
    path.write_text(GEOMETRY.sub(to_file, locate_urdf("rizon4").read_text()))
    return robots.load(path, frame="tcp_closed")


def test_meshes_are_the_solids_that_they_were_made_from(mesh_arm):
    arm = robots.load("rizon4", frame="tcp_closed")
    q = arm.home + 0.2
    expected, solids = arm.geometry(q), mesh_arm.geometry(q)
    assert {solid.kind for solid in solids} == {"mesh"}
    assert mesh_arm.unread_meshes == {}
    assert [solid.link for solid in solids] == [solid.link for solid in expected]
    for solid, (x, _), (y, _) in zip(
        solids, observe.build_solid_meshes(solids), observe.build_solid_meshes(expected), strict=True
    ):
        np.testing.assert_allclose(np.ptp(x, axis=0), np.ptp(y, axis=0), atol=1e-5)
        np.testing.assert_allclose(x.min(0), y.min(0), atol=1e-5)
        assert trimesh.Trimesh(*solid.mesh).is_watertight


def test_points_of_an_arm_of_meshes_are_removed_as_those_of_primitives(mesh_arm, needs_open3d):
    """An arm above a cloth on a table, seen by a noisy camera."""
    arm = robots.load("rizon4", frame="tcp_closed")
    q = arm.home
    tip = arm(q)[:3, 3].numpy()
    sheet = np.array([[x, y, 0.0] for x in (-0.2, 0.2) for y in (-0.2, 0.2)]) + tip - [0, 0, 0.02]
    K = np.array([[120.0, 0, 79.5], [0, 120, 71.5], [0, 0, 1]])
    camera = observe.DepthCamera(160, 144, K, observe.look_at(tip + np.array([0.9, 0.5, 0.5]), tip), (0.3, 4.0))
    meshes = {kind: observe.build_solid_meshes(a.geometry(q)) for kind, a in (("primitive", arm), ("mesh", mesh_arm))}
    clean, ids = observe.render_depth(camera, [(sheet, np.array([[0, 1, 2], [1, 3, 2]])), *meshes["primitive"]])
    depth = observe.DepthNoise().apply(clean, np.random.default_rng(0))
    stages = observe.Segmentation(max_depth_step=None, outlier_neighbours=None, cluster_gap=None)
    results = {kind: observe.segment_depth(camera, depth, stages, robot=solids) for kind, solids in meshes.items()}
    np.testing.assert_array_equal(results["mesh"].indices, results["primitive"].indices)
    is_arm = (ids > 0)[depth > 0]
    assert is_arm.sum() > 1000
    assert is_arm[results["mesh"].indices].sum() < 0.005 * is_arm.sum()  # pixels of a silhouette show the cloth


def write_arm(folder, name: str):
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="a"><link name="base"/>{LINK.format(name)}{JOINT}</robot>')
    return robots.load(path, frame="tip")


def test_a_mesh_with_holes_becomes_its_convex_hull(tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    box.update_faces(np.arange(12) > 1)
    box.export(tmp_path / "open.ply")
    (solid,) = write_arm(tmp_path, "open.ply").geometry(torch.zeros(1))
    assert trimesh.Trimesh(*solid.mesh).volume == pytest.approx(0.006)
    assert solid.size == pytest.approx((0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("name", "content", "match"),
    [
        ("package://a_package/x.stl", None, "no such file for the URDF .* up to four folders above"),
        ("x.dae", b"<COLLADA/>", r"got .dae; expected .stl, .obj, .ply; convert it"),
        ("x.stl", b"solid of nothing", "x.stl cannot be read|0 triangles"),
        ("x.stl", b"", "x.stl cannot be read|0 triangles"),
        ("x.stl", bytes(80) + b"\xff\xff\xff\xff", "x.stl cannot be read|0 triangles"),
        ("x.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "points of one plane"),
        ("x.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite vertices"),
        ("x.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "x.obj"),
        ("", None, "no such file"),
    ],
)
def test_a_mesh_that_cannot_be_read_is_left_out_with_its_reason(tmp_path, name, content, match):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    arm = write_arm(tmp_path, name)
    assert re.search(match, arm.unread_meshes["tip"]), arm.unread_meshes
    with pytest.warns(UserWarning, match="solid of 'tip' is left out: mesh"):
        assert arm.geometry(torch.zeros(1)) == []


def test_a_mesh_file_is_of_limited_size(tmp_path, monkeypatch):
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "x.stl")
    monkeypatch.setattr(link_meshes, "MAX_MESH_FILE_BYTES", 600)
    with pytest.raises(InvalidInput, match=r"x\.stl; got 0 MiB; expected at most 0 MiB; simplify it"):
        link_meshes.read_link_mesh("x.stl", tmp_path, (1.0, 1.0, 1.0))


def test_a_mesh_names_no_other_file(tmp_path):
    """An OBJ's materials are not read."""
    (tmp_path / "secret.mtl").write_text("newmtl a\nmap_Kd /dev/zero\n")
    text = trimesh.creation.box((1, 1, 1)).export(file_type="obj")
    (tmp_path / "x.obj").write_text(f"mtllib secret.mtl\nusemtl a\n{text}")
    (solid,) = write_arm(tmp_path, "x.obj").geometry(torch.zeros(1))
    assert len(solid.mesh[1]) == 12


def test_names_of_meshes(tmp_path):
    folder = tmp_path / "ws" / "src" / "arm" / "urdf"
    for path in (folder / "a.stl", folder.parent / "meshes" / "b.stl", tmp_path / "c.stl"):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    for name in ("a.stl", "file://a.stl", "../../a.stl", f"{folder}/a.stl", f"file://{folder}/a.stl"):
        assert locate_mesh_file(name, folder) == folder / "a.stl"  # a copy has what lay above in its own folder
    for name in ("package://arm/meshes/b.stl", "../meshes/b.stl"):
        assert locate_mesh_file(name, folder).resolve() == folder.parent / "meshes" / "b.stl"
    for name in ("package://c.stl/x", "", "x\0y", "../meshes"):
        assert locate_mesh_file(name, folder) is None
