"""Weight in a world that is askew."""

import math

import pytest
import torch

import torchcloth as tc


@pytest.fixture(autouse=True)
def _values_only():
    with torch.no_grad():
        yield


def generator(axis):
    return torch.linalg.cross(torch.eye(3)[axis].expand(3, 3), torch.eye(3)).T


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_no_tilt_changes_no_bit(dtype):
    torch.manual_seed(0)
    for vector in (torch.tensor([0.0, 0.0, -9.81]), *torch.randn(20, 3)):
        gravity = tc.effects.Gravity(vector.tolist()).to(dtype)
        assert torch.equal(gravity.coefficients(), gravity.acceleration.unsqueeze(-2))


def test_tilt_turns_about_x_then_y():
    torch.manual_seed(0)
    vector, (a, b) = torch.randn(3), (0.3, -0.7)
    turn = torch.linalg.matrix_exp(b * generator(1)) @ torch.linalg.matrix_exp(a * generator(0))
    got = tc.effects.Gravity(vector.tolist(), tilt=(a, b)).coefficients()[0]
    torch.testing.assert_close(got, turn @ vector, rtol=1e-12, atol=1e-15)
    level = tc.effects.Gravity(tilt=(0.01, 0.0)).coefficients()[0]
    torch.testing.assert_close(level, 9.81 * torch.tensor([0.0, math.sin(0.01), -math.cos(0.01)]))


def test_a_strip_hangs_along_the_tilted_plumb_line():
    """0.5 degrees move the end of a 0.4 m strip by 3.5 mm."""
    mesh = tc.meshes.rectangle(0.05, 0.4, resolution=(2, 6))
    top = [k for k, uv in enumerate(mesh.uv) if uv[1] > 0.4 - 1e-9]
    angle = math.radians(0.5)
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(1e5, 0.02),
        0.2,
        {"gravity": tc.effects.Gravity((0.0, -9.81, 0.0), tilt=(angle, 0.0))},
        {"rod": tc.boundaries.Grasp(top)},
        contact=None,
    )
    still = tc.Trajectory(torch.tensor([0.0, 9.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=bool))
    x = cloth.settle(cloth.rest_state(), {"rod": still}, duration=1.5, rate=8.0).x
    moved = float(x[0, 2])
    assert moved == pytest.approx(-0.4 * math.sin(angle), rel=0.01)


@pytest.mark.parametrize(
    "options", [{"acceleration": (0.0, 1.0)}, {"tilt": (0.0, 0.0, 0.0)}, {"tilt": (math.inf, 0.0)}]
)
def test_refusals(options):
    with pytest.raises(tc.errors.InvalidInput, match="|".join(options)):
        tc.effects.Gravity(**options)
