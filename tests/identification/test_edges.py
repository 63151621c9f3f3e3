"""The rim's place from points, against sheets whose rim is known."""

import pytest
import torch

import torchcloth as tc
from torchcloth.episodes.observed import Episode
from torchcloth.episodes.observed_surface import RIM_BAND_M, build_surface_of_mesh
from torchcloth.episodes.replay import Frames
from torchcloth.identification.residuals.edges import edge_rows
from torchcloth.identification.residuals.rows import match_points
from torchcloth.training.fit.losses import Loss

SIDE = 0.3
MESH = tc.meshes.rectangle(SIDE, SIDE, resolution=(7, 7))
FRAMES = 60


def clouds(larger, generator, density=5000.0, blur=0.0, hidden=None):
    """Points of a sheet whose rim lies ``larger`` [m] farther out everywhere."""
    side = SIDE + 2 * larger
    out = []
    for _ in range(FRAMES):
        uv = torch.rand(round(density * side**2), 2, generator=generator) * side - larger
        if hidden is not None:
            uv = uv[~hidden(uv)]
        noise = blur * torch.randn(len(uv), 3, generator=generator)
        out.append(torch.nn.functional.pad(uv, (0, 1)) + noise)
    return out


def scene(cloud, moved=None, length=0.1, mesh=MESH, gripped=None):
    x = torch.as_tensor(mesh.vertices).expand(len(cloud), -1, -1)
    nothing = x.new_zeros(len(cloud))
    episode = Episode("fake", {}, torch.arange(len(cloud)) * 0.1, cloud, x[0], True, 1e-3)
    return match_points(Frames(x, 0 * x, {}, nothing), moved, episode, build_surface_of_mesh(mesh, gripped, length))


def offset(cloud, **options):
    """(mean [m], its standard error) over all frames and pieces."""
    value = edge_rows(scene(cloud, **options)).residual
    value = value[value != 0]
    return float(value.mean()), float(value.std() / len(value) ** 0.5)


@pytest.mark.parametrize("larger", [-8e-3, -2e-3, 0.0, 2e-3, 8e-3])
def test_the_rim_is_where_the_points_end(larger):
    """Inside as well as outside; a ratio of means is biased by some h / (6 n): 0.1 mm of 25 points a piece."""
    result, error = offset(clouds(larger, torch.Generator().manual_seed(0)))
    assert error < 0.2e-3
    assert result == pytest.approx(larger, abs=3 * error + 0.15e-3)


def test_noise_moves_the_rim_by_twice_its_variance_over_the_band():
    """As the file's head says: 2 mm of noise, 0.5 mm."""
    generator = torch.Generator().manual_seed(0)
    result, error = offset(clouds(0.0, generator, blur=2e-3))
    assert result == pytest.approx(2 * (2e-3) ** 2 / RIM_BAND_M, abs=3 * error + 0.15e-3)


def test_what_is_hidden_does_not_pull():
    """A bar across the sheet hides a third of two sides."""
    result, error = offset(
        clouds(0.0, torch.Generator().manual_seed(0), hidden=lambda uv: (uv[:, 0] - 0.15).abs() < 0.05)
    )
    assert result == pytest.approx(0.0, abs=3 * error + 0.15e-3)


def test_a_piece_without_points_says_nothing():
    rows = edge_rows(scene(clouds(0.0, torch.Generator().manual_seed(0), hidden=lambda uv: uv[:, 0] < 0.1)))
    left = rows.residual.reshape(FRAMES - 1, -1) == 0
    assert int(left.all(0).sum()) >= 3  # of the hidden side
    assert not bool(left.all(0).all())


def test_the_slope_is_that_of_the_rim():
    """A rim that moves outwards leaves the points behind, metre by metre."""
    cloud = clouds(0.0, torch.Generator().manual_seed(0))
    x = torch.as_tensor(MESH.vertices)
    grow = (x - x.mean(0)) / (SIDE / 2)  # 1 at every side, across it
    moved = Frames(grow.expand(1, FRAMES, -1, -1), 0 * grow.expand(1, FRAMES, -1, -1), {}, torch.zeros(1, FRAMES))
    rows = edge_rows(scene(cloud, moved))
    assert float(rows.jacobian[rows.residual != 0].mean()) == pytest.approx(-1.0, abs=1e-6)
    shifted = [edge_rows(scene(clouds(d, torch.Generator().manual_seed(1)))).residual.mean() for d in (0.0, 2e-3)]
    assert float(shifted[1] - shifted[0]) == pytest.approx(2e-3, rel=0.1)


def test_held_sides_are_no_rim():
    gripped = MESH.vertices_near_pattern_points([[0.0, v / 20 * SIDE] for v in range(21)], 0.01)
    assert build_surface_of_mesh(MESH, gripped, 0.1).rim.piece_count == 9
    assert build_surface_of_mesh(MESH, None, 0.1).rim.piece_count == 12


def test_another_layer_is_not_beyond_the_rim():
    """Points of the sheet's other end, folded to just beside this one's rim, belong there and not here."""
    x = torch.as_tensor(MESH.vertices).clone()
    over = x[:, 0] > SIDE / 2
    x[over, 2] = 8e-3
    x[over, 0] = SIDE - x[over, 0] + 0.02  # the upper rim lies 2 cm inside the lower one
    generator = torch.Generator().manual_seed(0)
    weights = -torch.rand(FRAMES, 600, 3, generator=generator).log()  # over their sum: evenly over a triangle
    weights = weights / weights.sum(-1, keepdim=True)
    faces = torch.as_tensor(MESH.faces)[torch.randint(len(MESH.faces), (FRAMES, 600), generator=generator)]
    cloud = list((weights.unsqueeze(-1) * x[faces]).sum(-2))
    given = scene(cloud)
    rows = edge_rows(
        match_points(given.frames._replace(x=x.expand(FRAMES, -1, -1)), None, given.episode, given.surface)
    )
    seen = rows.residual[rows.residual != 0]
    assert abs(float(seen.mean())) < 1.5e-3


def test_a_loss_is_a_mean_over_pieces_that_were_seen():
    whole, half = (
        scene(clouds(2e-3, torch.Generator().manual_seed(0), hidden=hidden))
        for hidden in (None, lambda uv: uv[:, 0] < 0.2)
    )
    of = Loss({"edges": 1e-3})
    assert float(of(half)) == pytest.approx(float(of(whole)), rel=0.2)  # half of it, when those unseen counted
