"""Air drag against closed forms and a change of frame."""

import math

import pytest
import torch

import torchcloth as tc

RHO = 1.204


@pytest.fixture(autouse=True)
def _values_only():
    with torch.no_grad():
        yield


def sheet(air, density=0.15, gravity=None):
    effects = {} if air is None else {"air": air}
    if gravity is not None:
        effects["gravity"] = tc.effects.Gravity(gravity)
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(4, 4))
    return tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), density, effects, contact=None)


def moving(cloth, v):
    x = cloth.rest_state().x
    return cloth.state(x, torch.tensor(v).expand_as(x))


def test_a_flat_sheet_slows_down_along_and_across_itself():
    """v' = -rho C v^2 / (2 rho_A) for each direction by itself: v = v0 / (1 + rho C v0 t / (2 rho_A))."""
    cloth = sheet(tc.effects.AirDrag(1.2, tangential=0.5))
    v0, t = torch.tensor([1.8, -2.4, 2.0]), 0.2
    out = cloth(moving(cloth, v0.tolist()), times=[0.0, t], dt=2e-4).v[-1]
    along = v0[:2] / (1 + RHO * 0.5 * 3.0 * t / 0.3)
    across = v0[2] / (1 + RHO * 1.2 * 2.0 * t / 0.3)
    expected = torch.cat([along, across[None]]).expand_as(out)
    torch.testing.assert_close(out, expected, rtol=1e-3, atol=0)


def test_laminar_friction_is_what_a_boundary_layer_has():
    """Blasius: 1.328 / sqrt(Re) on each side; 0.3 m at 1 m/s decelerates by 0.06 m/s^2 (150 g/m^2)."""
    typical = tc.effects.AirDrag.amplitudes["tangential"].typical
    assert typical == pytest.approx(2 * 1.328 / math.sqrt(3e4), rel=0.05)
    cloth = sheet(tc.effects.AirDrag(0.0, tangential=typical))
    dt = cloth.stable_step()
    out = cloth(moving(cloth, (1.0, 0.0, 0.0)), times=[0.0, dt])
    slope = float((1 - out.v[-1, :, 0]).mean() / dt)
    assert slope == pytest.approx(RHO * typical / 2 / 0.15, rel=1e-9)
    assert 0.05 < slope < 0.07


def test_wind_is_a_change_of_frame():
    """A sheet at rest in the wind does what a sheet does that is moved against still air, seen from the air."""
    torch.manual_seed(0)
    wind = torch.tensor([0.7, -0.4, 0.5])
    still = sheet(tc.effects.AirDrag(1.2, tangential=0.1))
    blown = sheet(tc.effects.AirDrag(1.2, tangential=0.1, wind=wind.tolist()))
    x = still.rest_state().x + 0.005 * torch.randn(16, 3)
    v = 0.5 * torch.randn(16, 3)
    dt = 0.9 * blown.stable_step()
    a = still(still.state(x, v - wind), times=[0.0, 0.1], dt=dt)
    b = blown(blown.state(x, v), times=[0.0, 0.1], dt=dt)
    torch.testing.assert_close(b.v[-1], a.v[-1] + wind, rtol=0, atol=1e-12)
    torch.testing.assert_close(b.x[-1], a.x[-1] + 0.1 * wind, rtol=0, atol=1e-12)


def test_a_strip_hangs_inclined_in_the_wind():
    """rho_A g sin(a) = rho C_n (w cos a)^2 / 2 all along, so the strip is straight. Not a tilt of gravity by itself:
    one picture cannot tell, and the same angle comes from ``Gravity(tilt=...)``.
    """
    w, density = 1.0, 0.15
    mesh = tc.meshes.rectangle(0.05, 0.2, resolution=(2, 6))
    top = [k for k, uv in enumerate(mesh.uv) if uv[1] > 0.2 - 1e-9]
    still = tc.Trajectory(torch.tensor([0.0, 9.0]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=bool))
    q = RHO * 1.2 * w * w / (2 * density * 9.81)
    sine = (math.sqrt(1 + 4 * q * q) - 1) / (2 * q)  # sin a = q (1 - sin^2 a)
    down = (0.0, -9.81, 0.0)
    tips = []
    for effects in (
        {"gravity": tc.effects.Gravity(down), "air": tc.effects.AirDrag(1.2, wind=(0.0, 0.0, w))},
        {"gravity": tc.effects.Gravity(down, tilt=(-math.asin(sine), 0.0))},
    ):
        cloth = tc.Cloth(
            mesh, tc.materials.AEP(1e5, 0.02), density, effects, {"rod": tc.boundaries.Grasp(top)}, contact=None
        )
        x = cloth.rest_state().x
        angle = 0.8 * math.asin(sine)
        turned = torch.stack([x[:, 0], 0.2 + (x[:, 1] - 0.2) * math.cos(angle), (0.2 - x[:, 1]) * math.sin(angle)], -1)
        x = cloth.settle(cloth.state(turned), {"rod": still}, duration=1.0, rate=12.0).x
        offset = x[:, 2] / (0.2 - x[:, 1]).clamp(min=1e-9)
        below = x[:, 1] < 0.199
        tan = sine / math.sqrt(1 - sine * sine)
        torch.testing.assert_close(offset[below], torch.full_like(offset[below], tan), rtol=0.01, atol=0)
        tips.append(x[0, 2])
    assert abs(tips[1] / tips[0] - 1) < 0.01


@pytest.mark.parametrize("options", [{"tangential": -0.1}, {"wind": (1.0, 2.0)}, {"wind": (0.0, 0.0, math.nan)}])
def test_refusals(options):
    with pytest.raises(tc.errors.InvalidInput, match="|".join(options)):
        tc.effects.AirDrag(**options)


def test_wind_without_drag_does_nothing():
    cloth, base = sheet(tc.effects.AirDrag(0.0, wind=(3.0, 0.0, 1.0))), sheet(None)
    torch.manual_seed(0)
    x, v = base.rest_state().x + 0.005 * torch.randn(16, 3), torch.randn(16, 3)
    a, b = (c(c.state(x, v), times=[0.0, 0.02]).x for c in (cloth, base))
    assert torch.equal(a, b)
