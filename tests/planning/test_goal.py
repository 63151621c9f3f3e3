"""Goals: distances, what pulls towards them, and files that hold them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from torchcloth import meshes
from torchcloth import recordings as rec
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.losses import chamfer_to_surface
from torchcloth.planning import Goal, read_goal
from torchcloth.planning.objective import build_objective

MESH = meshes.rectangle(0.2, 0.2, triangles=72)
FACES = torch.as_tensor(MESH.faces)
FLAT = torch.as_tensor(MESH.vertices)


def bent(height: float = 0.03) -> torch.Tensor:
    x = FLAT.clone()
    x[:, 2] = height * torch.sin(12 * x[:, 0]) + 0.01
    return x


def test_a_cloud_is_asked_for_one_way_and_a_surface_both_ways():
    half = FLAT[FLAT[:, 0] < 0.11] + torch.tensor([0.0, 0.0, 0.02])
    assert float(build_objective(Goal(half), MESH).distance(FLAT)) == pytest.approx(
        0.02
    )  # what lies beyond the cloud is not seen
    small = meshes.rectangle(0.1, 0.2, triangles=36)
    known = Goal(torch.as_tensor(small.vertices), torch.as_tensor(small.faces))
    there = float(chamfer_to_surface(known.points, FLAT, FACES))
    back = float(chamfer_to_surface(FLAT, known.points, known.faces))
    assert there == pytest.approx(0.0, abs=1e-12)
    assert float(build_objective(known, MESH).distance(FLAT)) == pytest.approx(back / 2)
    assert back > 0.02


GOALS = {
    "cloud": Goal(bent()),
    "surface": Goal(bent(), FACES),
    "vertices": Goal(bent(), FACES, vertices=torch.arange(len(FLAT))),
    "pattern": Goal(torch.rand(4, 3), uv=torch.tensor([[0.0, 0.0], [0.2, 0.0], [0.0, 0.2], [0.05, 0.13]])),
}


@pytest.mark.parametrize("kind", GOALS)
def test_the_pull_is_the_derivative_of_the_mean_square(kind):
    aim, x = build_objective(GOALS[kind], MESH), bent(0.01) + 0.003 * torch.randn(len(FLAT), 3)
    ways = torch.randn(3, len(FLAT), 3)
    pull = aim.quadratic_model(x, ways)
    assert float(pull.value) == pytest.approx(aim.mean_square(x))
    assert float(aim.distance(x)) ** 2 <= aim.mean_square(x)
    for way, slope in zip(ways, pull.gradient.tolist(), strict=True):
        errors = []
        for h in (1e-4, 1e-5, 1e-6):
            up, down = (aim.mean_square(x + sign * h * way) for sign in (1, -1))
            errors.append(abs((up - down) / (2 * h) - slope))
        assert min(errors) < 1e-6 * abs(slope)
    assert float(torch.linalg.eigvalsh(pull.curvature).min()) > 0


def test_the_curvature_lets_cloth_slide_along_the_goal():
    goal, middle = Goal(FLAT[(FLAT[:, :2] - 0.1).abs().amax(1) < 0.04]), torch.eye(3)[:, None, :]
    ways = middle.expand(3, len(FLAT), 3)
    along, aside, across = build_objective(goal, MESH).quadratic_model(FLAT, ways).curvature.diagonal().tolist()
    assert across == pytest.approx(2.0)
    assert along == pytest.approx(0.2)
    assert aside == pytest.approx(0.2)


def test_of_pieces_it_counts_which_is_where():
    """Cloth that was turned over lies on itself, and each of its pieces somewhere else."""
    over = FLAT * torch.tensor([-1.0, 1.0, -1.0]) + torch.tensor([0.2, 0.0, 0.0])
    surface, pieces = Goal(FLAT, FACES), Goal(FLAT, FACES, vertices=torch.arange(len(FLAT)))
    assert float(build_objective(surface, MESH).distance(over)) == pytest.approx(0.0, abs=1e-9)
    assert float(build_objective(pieces, MESH).distance(over)) == pytest.approx(float((FLAT - over).norm(dim=1).mean()))
    ways = torch.eye(3)[:, None, :].expand(3, len(FLAT), 3)
    assert build_objective(pieces, MESH).quadratic_model(over, ways).curvature.diagonal().tolist() == pytest.approx(
        [2.0, 2.0, 2.0]
    )
    corner = Goal(torch.tensor([[0.3, 0.1, 0.0]]), uv=torch.tensor([[0.2, 0.1]]))
    assert float(build_objective(corner, MESH).distance(FLAT)) == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        (Goal(torch.zeros(1, 3), uv=torch.tensor([[0.3, 0.0]])), r"uv of the goal\[0\].*off the cloth"),
        (Goal(torch.zeros(1, 3), vertices=torch.tensor([len(FLAT)])), "vertices of the goal"),
        (Goal(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]), vertices=torch.arange(3)), "not the cloth's"),
    ],
    ids=["beyond the pattern", "beyond the mesh", "another mesh"],
)
def test_pieces_that_the_cloth_has_not_are_refused(goal, message):
    with pytest.raises(InvalidInput, match=message):
        build_objective(goal, MESH)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"uv": torch.zeros(2, 2), "vertices": torch.arange(2)}, "uv and vertices"),
        ({"uv": torch.zeros(3, 2)}, r"uv of the goal.*\[2, 2\]"),
        ({"vertices": torch.zeros(3, dtype=torch.int64)}, "vertices of the goal"),
        ({"vertices": torch.zeros(2)}, "vertices of the goal.*whole"),
        ({"vertices": torch.tensor([True, False])}, "vertices of the goal.*whole"),
        ({"uv": "corners"}, "uv of the goal"),
    ],
)
def test_pieces_that_are_none_are_refused(how, message):
    with pytest.raises(InvalidInput, match=message):
        Goal(torch.zeros(2, 3), **how)


@pytest.mark.parametrize(
    "points", [torch.zeros(0, 3), torch.zeros(4, 2), torch.full((3, 3), torch.nan)], ids=["none", "flat", "nan"]
)
def test_a_goal_that_is_none_is_refused(points):
    with pytest.raises(InvalidInput, match=r"goal.*expected \[N, 3\] finite"):
        Goal(points)


def test_files(tmp_path):
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.save(tmp_path / "cloud.npy", points)
    np.savez(tmp_path / "pose.npz", x=np.stack([points, points + 1]), faces=np.array([[0, 1, 2]]))
    assert np.allclose(read_goal(tmp_path / "cloud.npy").points, points)
    pose = read_goal(tmp_path / "pose.npz")
    assert np.allclose(pose.points, points + 1)
    assert pose.faces.tolist() == [[0, 1, 2]]
    lines = [f"v {x} {y} {z}" for x, y, z in MESH.vertices] + [f"f {a} {b} {c}" for a, b, c in MESH.faces + 1]
    (tmp_path / "mesh.obj").write_text("\n".join(lines) + "\n")
    assert read_goal(tmp_path / "mesh.obj").faces.shape == FACES.shape
    assert read_goal(tmp_path / "mesh.obj").vertices is None


def test_files_of_pieces(tmp_path):
    points = np.random.default_rng(0).normal(size=(5, 3))
    np.savez(tmp_path / "pose.npz", x=np.stack([points, points + 1]), faces=np.array([[0, 1, 2]]))
    assert read_goal(tmp_path / "pose.npz", correspondences=True).vertices.tolist() == [0, 1, 2, 3, 4]
    np.savez(tmp_path / "pieces.npz", x=points, uv=points[:, :2])
    for pieces in (False, True):
        result = read_goal(tmp_path / "pieces.npz", pieces)
        assert np.allclose(result.points, points)
        assert np.allclose(result.uv, points[:, :2])
    np.savez(tmp_path / "both.npz", x=np.stack([points, points + 1]), uv=points[:, :2], faces=np.array([[0, 1, 2]]))
    assert np.allclose(read_goal(tmp_path / "both.npz").uv, points[:, :2])
    assert np.allclose(read_goal(tmp_path / "both.npz").points, points + 1)
    lines = [f"v {x} {y} {z}" for x, y, z in MESH.vertices] + [f"vt {u} {v}" for u, v in MESH.uv]
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in MESH.faces + 1]
    (tmp_path / "mesh.obj").write_text("\n".join(lines) + "\n")
    assert np.allclose(read_goal(tmp_path / "mesh.obj", correspondences=True).uv, MESH.uv)
    np.save(tmp_path / "cloud.npy", points[::-1])
    assert np.allclose(Goal(points[::-1]).points, points[::-1])
    with pytest.raises(InvalidInput, match="without pattern coordinates"):
        read_goal(tmp_path / "cloud.npy", correspondences=True)


def test_markers_are_pieces_where_the_last_frame_has_them(tmp_path):
    from helpers.planning_scenes import make_hand_episode

    uv, xyz = np.array([[0.0, 0.0], [0.1, 0.1]]), np.zeros((3, 2, 3))
    xyz[-1] = [[np.nan] * 3, [0.1, 0.2, 0.3]]
    markers = rec.Markers(np.linspace(0, 0.2, 3), xyz, uv)
    result = read_goal(
        rec.write(replace(make_hand_episode(), markers=markers), tmp_path / "seen"), correspondences=True
    )
    assert result.points.tolist() == [[0.1, 0.2, 0.3]]
    assert result.uv.tolist() == [[0.1, 0.1]]
    unknown = rec.write(replace(make_hand_episode(), markers=replace(markers, uv=None)), tmp_path / "unknown")
    with pytest.raises(InvalidInput, match="without pattern coordinates"):
        read_goal(unknown, correspondences=True)
    with pytest.raises(RecordingError, match="markers"):
        read_goal(rec.write(make_hand_episode(), tmp_path / "blind"), correspondences=True)


def test_triangles_of_other_points_are_refused():
    with pytest.raises(InvalidInput, match="faces"):
        Goal(torch.zeros(3, 3), torch.tensor([[0, 1, 3]]))


def test_a_path_is_no_goal():
    with pytest.raises(InvalidInput, match="read_goal"):
        Goal("goal.npy")


@pytest.mark.parametrize("name", ["absent.npy", "words.txt", "damaged.npy", "other.npz", "torn.npz", "archive.npy"])
def test_files_that_show_no_cloth_are_refused_in_one_line(tmp_path, name):
    (tmp_path / "words.txt").write_text("left")
    (tmp_path / "damaged.npy").write_bytes(b"\x93NUMPY")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    (tmp_path / "torn.npz").write_bytes((tmp_path / "other.npz").read_bytes()[:40])
    (tmp_path / "archive.npy").write_bytes((tmp_path / "other.npz").read_bytes())
    with pytest.raises(InvalidInput, match=r"goal.*expected an episode") as caught:
        read_goal(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_an_episode_without_points_is_no_goal(tmp_path):
    from helpers.planning_scenes import make_hand_episode

    rec.write(make_hand_episode(), tmp_path / "blind")
    with pytest.raises(RecordingError, match="points"):
        read_goal(tmp_path / "blind")
