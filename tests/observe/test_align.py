"""A mesh laid onto a cloud: the state behind the cloud comes back, and what is no such cloud is refused."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.errors import InvalidInput
from torchcloth.observe import DepthCamera, align, look_at, thin_to_count, to_points

NOISE = 0.002  # m


@dataclass(frozen=True)
class Scene:
    mesh: tc.meshes.Mesh
    x: np.ndarray  # [V, 3] m, truth
    eye: np.ndarray  # [3] m
    cloud: np.ndarray  # [N, 3] m
    normal: np.ndarray  # [3] of the bench it lies on


def bent(mesh: tc.meshes.Mesh, slope: float = 0.35, wave: float = 0.6, bump: float = 0.01) -> np.ndarray:
    """Placed over a ridge, isometrically (arc length along y, layers along the normal), and a small smooth bump."""
    s = np.linspace(-1.0, 1.0, 4001)
    phi = slope * np.sin(2 * np.pi * (s - 0.05) / wave)
    y, z = (np.concatenate([[0.0], np.cumsum(f((phi[1:] + phi[:-1]) / 2))]) * (s[1] - s[0]) for f in (np.cos, np.sin))
    at, tilt = mesh.vertices[:, 1], np.interp(mesh.vertices[:, 1], s, phi)
    lift = bump * np.exp(-((mesh.vertices[:, :2] - [0.08, -0.1]) ** 2).sum(1) / (2 * 0.15**2))
    height = mesh.vertices[:, 2]
    return np.column_stack(
        [
            mesh.vertices[:, 0],
            np.interp(at, s, y) - np.interp(0.0, s, y) - height * np.sin(tilt),
            np.interp(at, s, z) - np.interp(0.0, s, z) + height * np.cos(tilt) + lift,
        ]
    )


def turned(axis, angle: float) -> np.ndarray:
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def seen(render, mesh: tc.meshes.Mesh, R: np.ndarray, points: int = 1500) -> Scene:
    """The bent garment somewhere in the room; one depth image from 1.4 m above it, thinned, with noise."""
    x = bent(mesh) @ R.T + [0.3, -0.2, 0.5]
    eye = x.mean(0) + R @ [0.1, 0.2, 1.4]
    camera = DepthCamera.azure_kinect_nfov(look_at(eye, x.mean(0)))
    depth, _ = render(camera, [(x, mesh.faces)])
    rng = np.random.default_rng(0)
    cloud = thin_to_count(to_points(camera, depth), points, rng)
    return Scene(mesh, x, eye, cloud + rng.normal(0, NOISE, cloud.shape), R[:, 2])


def rms(error: np.ndarray) -> float:
    return float(np.sqrt((error**2).sum(-1).mean()))


def check(scene: Scene, result, hidden: float, seen: float = 2.5 * NOISE) -> None:
    error = result.x.numpy() - scene.x
    front = np.unique(scene.mesh.faces[: len(scene.mesh.faces) // 2])
    along = error @ scene.normal
    assert result.rms == pytest.approx(NOISE, rel=0.25)
    assert result.coverage > 0.95
    assert result.strain < 0.03
    assert np.sqrt((along[front] ** 2).mean()) < NOISE
    assert rms(error[front]) < seen
    assert rms(error) < hidden


@pytest.mark.parametrize(("axis", "angle"), [((0, 0, 1), np.pi / 2), ((1, 0, 0), np.pi / 2)], ids=["turned", "upright"])
def test_a_bent_shirt_comes_back_to_the_noise(render, axis, angle):
    """Rigid motions alone leave 20 mm. The side that no point shows follows the one that points show."""
    scene = seen(render, tc.meshes.shirt(triangles=300), turned(axis, angle))
    result = align(scene.mesh, scene.cloud, viewpoint=scene.eye, noise=NOISE)
    check(scene, result, hidden=2.5 * NOISE)
    rigid = scene.mesh.vertices @ result.pose[:3, :3].numpy().T + result.pose[:3, 3].numpy()
    assert rms(rigid - scene.x) > 0.015
    torch.testing.assert_close(result.pose[:3, :3] @ result.pose[:3, :3].mT, torch.eye(3, dtype=torch.float64))


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.5, np.pi / 2, 2.5, np.pi])
@pytest.mark.parametrize("name", ["shirt", "trousers", "dress"])
def test_garments_of_full_size_come_back(render, name, angle):
    scene = seen(render, getattr(tc.meshes, name)(), turned((0.1, 0, 1), angle), points=3000)
    result = align(scene.mesh, scene.cloud, viewpoint=scene.eye, noise=NOISE)
    check(scene, result, hidden=3 * NOISE, seen=3 * NOISE)  # within the surface nothing but the outline holds it


def test_a_part_that_something_hides_follows_the_rest(render):
    """A strip across the body has no points: it is not pulled to where there are some."""
    scene = seen(render, tc.meshes.shirt(triangles=300), np.eye(3))
    across = scene.cloud[:, 1] - scene.x[:, 1].mean()
    partial = scene.cloud[np.abs(across + 0.1) > 0.06]
    result = align(scene.mesh, partial, viewpoint=scene.eye, noise=NOISE)
    assert 0.7 < result.coverage < 0.95
    assert rms(result.x.numpy() - scene.x) < 4 * NOISE


def test_a_sheet_without_a_viewpoint():
    """One layer cannot be confused with another; a rectangle is found up to its own symmetry."""
    mesh = tc.meshes.rectangle(0.5, 0.3, triangles=200)
    rng = np.random.default_rng(0)
    inside = rng.uniform(0, [0.5, 0.3], (800, 2))
    R = turned((0, 0, 1), 0.4)
    cloud = np.column_stack([inside, np.zeros(800)]) @ R.T + [0.2, 0.1, 0.7] + rng.normal(0, 1e-3, (800, 3))
    result = align(mesh, torch.as_tensor(cloud, dtype=torch.float32).requires_grad_(), noise=1e-3)
    truth = mesh.vertices @ R.T + [0.2, 0.1, 0.7]
    assert rms(result.x.numpy() - truth) < 0.004
    assert result.strain < 0.01


def test_a_single_triangle_has_no_hinge():
    mesh = tc.meshes.Mesh.build([[0, 0, 0], [0.3, 0, 0], [0, 0.3, 0]], [[0, 1, 2]])
    rng = np.random.default_rng(0)
    cloud = rng.dirichlet(np.ones(3), 300) @ mesh.vertices + rng.normal(0, 1e-3, (300, 3))
    assert align(mesh, cloud, noise=1e-3).coverage > 0.5


def nonsense():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(300, 3))
    yield 0.2 * ball / np.linalg.norm(ball, axis=1, keepdims=True), "mm from the surface"  # a sphere of 0.4 m
    yield rng.uniform(-0.2, 0.2, (300, 3)), "mm from the surface"  # a filled cube
    yield rng.uniform(0, [0.15, 0.15, 0.0], (300, 3)), "of the visible area"  # a corner of a table
    yield 1e3 * rng.uniform(0, [0.5, 0.5, 0.0], (500, 3)), "cloud; got points over 6.* m; .* units"  # millimetres


@pytest.mark.parametrize(("cloud", "message"), list(nonsense()), ids=["sphere", "cube", "corner", "millimetres"])
def test_a_cloud_of_something_else_is_refused(cloud, message):
    with pytest.raises(InvalidInput, match=message):
        align(tc.meshes.rectangle(0.5, 0.5, triangles=150), cloud)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cloud": np.zeros((5, 3))}, "cloud; got 5 points"),
        ({"cloud": np.zeros((50, 2))}, r"cloud; got shape \(50, 2\)"),
        ({"cloud": np.full((50, 3), np.nan)}, "cloud; .* expected finite"),
        ({"start": np.zeros((7, 3))}, "start; got 7 rows; expected 4, one per vertex"),
        ({"noise": 0.0}, "noise; got 0"),
        ({"strain": np.inf}, "strain; got inf"),
        ({"viewpoint": [0.0, 0.0]}, r"viewpoint; got shape \(2,\)"),
    ],
)
def test_arguments_are_checked(change, message):
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(2, 2))
    with pytest.raises(InvalidInput, match=message):
        align(mesh, **{"cloud": np.zeros((50, 3)), **change})


@pytest.mark.parametrize("seed", [0, 4])
def test_held_corners_are_not_exchanged(seed):
    """A flat sheet fits a noisy cloud as well with its sides exchanged; the grippers tell which corner is whose."""
    rng = np.random.default_rng(seed)
    mesh = tc.meshes.rectangle(0.3, 0.28, triangles=72)
    places = np.column_stack([mesh.uv - [0.15, 0.14], np.zeros(len(mesh.uv))]) @ turned((1, 0, 0), np.pi / 2).T
    u, v = rng.uniform(-0.5, 0.5, (2, 800))
    truth = np.stack([0.3 * u, 0 * u, 0.28 * v], 1)
    cloud = truth + 6e-3 * rng.standard_normal((800, 3)) * [0.1, 1.0, 0.1]
    held_vertices = [int(np.linalg.norm(mesh.uv - corner, axis=1).argmin()) for corner in ((0.0, 0.28), (0.3, 0.28))]
    result = align(mesh, cloud, start=places, viewpoint=[0.0, -1.0, 0.0], held_vertices=held_vertices)
    assert rms(result.x.numpy() - places) < 5e-3
