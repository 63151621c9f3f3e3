"""Goals: distances, what pulls towards them, and files that hold them."""

import numpy as np
import pytest
import torch

from torchcloth import meshes
from torchcloth import recordings as rec
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.losses import chamfer_to_surface
from torchcloth.planning import Goal, read_goal

MESH = meshes.rectangle(0.2, 0.2, triangles=72)
FACES = torch.as_tensor(MESH.faces)
FLAT = torch.as_tensor(MESH.vertices)


def bent(height: float = 0.03) -> torch.Tensor:
    x = FLAT.clone()
    x[:, 2] = height * torch.sin(12 * x[:, 0]) + 0.01
    return x


def test_a_cloud_is_asked_for_one_way_and_a_surface_both_ways():
    half = FLAT[FLAT[:, 0] < 0.11] + torch.tensor([0.0, 0.0, 0.02])
    assert float(Goal(half).distance(FLAT, FACES)) == pytest.approx(0.02)  # what lies beyond the cloud is not seen
    small = meshes.rectangle(0.1, 0.2, triangles=36)
    known = Goal(torch.as_tensor(small.vertices), torch.as_tensor(small.faces))
    there = float(chamfer_to_surface(known.points, FLAT, FACES))
    back = float(chamfer_to_surface(FLAT, known.points, known.faces))
    assert there == pytest.approx(0.0, abs=1e-12)
    assert float(known.distance(FLAT, FACES)) == pytest.approx(back / 2)
    assert back > 0.02


@pytest.mark.parametrize("faces", [None, FACES], ids=["cloud", "surface"])
def test_the_pull_is_the_derivative_of_the_mean_square(faces):
    goal, x = Goal(bent(), faces), bent(0.01) + 0.003 * torch.randn(len(FLAT), 3)
    ways = torch.randn(3, len(FLAT), 3)
    pull = goal.pull(x, FACES, ways)
    assert float(pull.value) == pytest.approx(goal.square(x, FACES))
    for way, slope in zip(ways, pull.gradient.tolist(), strict=True):
        errors = []
        for h in (1e-4, 1e-5, 1e-6):
            up, down = (goal.square(x + sign * h * way, FACES) for sign in (1, -1))
            errors.append(abs((up - down) / (2 * h) - slope))
        assert min(errors) < 1e-6 * abs(slope)
    assert float(torch.linalg.eigvalsh(pull.curvature).min()) > 0


def test_the_curvature_lets_cloth_slide_along_the_goal():
    goal, middle = Goal(FLAT[(FLAT[:, :2] - 0.1).abs().amax(1) < 0.04]), torch.eye(3)[:, None, :]
    ways = middle.expand(3, len(FLAT), 3)
    along, aside, across = goal.pull(FLAT, FACES, ways).curvature.diagonal().tolist()
    assert across == pytest.approx(2.0)
    assert along == pytest.approx(0.2)
    assert aside == pytest.approx(0.2)


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
    from scenes import by_hand

    rec.write(by_hand(), tmp_path / "blind")
    with pytest.raises(RecordingError, match="points"):
        read_goal(tmp_path / "blind")
