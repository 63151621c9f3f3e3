"""Specimens in a tension machine against closed forms and against the mesh, pulled to equilibrium."""

from __future__ import annotations

from math import cos, pi, radians, sin

import numpy as np
import pytest
import torch
from helpers.tension_strips import Strip

import torchcloth as tc
from torchcloth.errors import InvalidInput, SimulationDiverged
from torchcloth.identification import Trellis, Uniaxial
from torchcloth.identification.tension import specimens
from torchcloth.recordings import ForceDisplacement

WARP, WEFT, SHEAR, NU, H = 15e6, 59e6, 3e6, 0.2, 1e-3


def woven(**changes) -> tc.materials.OrthotropicAEP:
    return tc.materials.OrthotropicAEP(WARP, WEFT, SHEAR, NU, **{"thickness": H, **changes})


def table(strain, angle: float = 0.0, length: float = 0.1, width: float = 0.02, **more) -> ForceDisplacement:
    """Readings at the strains, forces unknown."""
    strain = np.asarray(strain, dtype=float)
    return ForceDisplacement(
        length=length, width=width, angle=angle, displacement=length * strain, force=np.ones(len(strain)), **more
    )


def off_axis(angle: float) -> tuple[float, float]:
    """Modulus Pa and contraction ratio at small strain (Jones, Mechanics of Composite Materials, 1975, eq. 2.97)."""
    c, s, ratio = cos(angle), sin(angle), NU * (WARP / WEFT) ** 0.5  # nu_12 = nu sqrt(E1 / E2)
    softness = c**4 / WARP + (1 / SHEAR - 2 * ratio / WARP) * s**2 * c**2 + s**4 / WEFT
    across = ratio / WARP * (s**4 + c**4) - (1 / WARP + 1 / WEFT - 1 / SHEAR) * s**2 * c**2
    return 1 / softness, across / softness


@pytest.mark.parametrize("degrees", [-45, 0, 20, 45, 70, 90])
def test_off_axis_at_small_strain(degrees):
    """To first order; the rest is of the size of the strain."""
    read = Uniaxial().curve(woven(), table([1e-6], radians(degrees)))
    modulus, ratio = off_axis(radians(degrees))
    assert read.force.item() == pytest.approx(modulus * H * 0.02 * 1e-6, rel=1e-4)
    assert read.lateral_strain.item() == pytest.approx(-ratio * 1e-6, rel=1e-4, abs=1e-11)


def test_isotropic_at_any_strain():
    """A-EP: no traction on the sides gives s2 = (2 mu + lambda s1) / (2 mu + lambda s1^2)."""
    E, nu, strain = 2e5, 0.35, np.linspace(-0.2, 1.5, 35)
    mu, lam = E * H / (2 * (1 + nu)), E * H * nu / (1 - nu**2)
    s1 = 1 + strain
    s2 = (2 * mu + lam * s1) / (2 * mu + lam * s1**2)
    force = 0.02 * (2 * mu * (s1 - 1) + lam * (s1 * s2 - 1) * s2)
    for degrees in (0, 33):
        read = Uniaxial().curve(tc.materials.AEP(E, nu, thickness=H), table(strain, radians(degrees)))
        assert read.force.detach().numpy() == pytest.approx(force, rel=1e-9, abs=1e-9)
        assert read.lateral_strain.detach().numpy() == pytest.approx(s2 - 1, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("degrees", [30, 60])
def test_a_long_mesh_reads_the_same(degrees):
    """43 widths long, 0 to 4 % strain, through the layer's own triangles; clamps hinder the ends by up to 1 %."""
    strain = np.array([0.01, 0.04])
    law = woven(warp_stiffening=20.0)
    mesh = Strip(0.097, 2.25e-3, degrees, law, (41, 5), clamped=True, crowded=0.9)
    force, _ = mesh.pull(torch.as_tensor(0.097 * strain))
    read = Uniaxial().curve(law, table(strain, radians(degrees), 0.097, 2.25e-3))
    assert read.force.detach().numpy() == pytest.approx(force.numpy(), rel=1e-2)


def test_preload():
    """The first reading is the preload, and later ones those of the curve without, seen from there."""
    law, strain = woven(warp_stiffening=20.0), np.linspace(0, 0.03, 7)
    bare = Uniaxial().curve(law, table(0.002 + 1.002 * strain))
    tight = Uniaxial().curve(law, table(strain, preload=bare.force[0].item()))
    assert tight.force.detach().numpy() == pytest.approx(bare.force.detach().numpy(), rel=1e-9)
    wide = 1 + bare.lateral_strain
    assert tight.lateral_strain.detach().numpy() == pytest.approx((wide / wide[0] - 1).detach().numpy(), abs=1e-12)


@pytest.mark.parametrize(
    ("specimen", "readings"),
    [
        (Uniaxial(), table([0.01, 0.05], 0.5, preload=1.0)),
        (Trellis(), table([0.01, 0.1], pi / 4, 0.2, 0.1, preload=0.01)),
    ],
)
@pytest.mark.parametrize("name", ["youngs_modulus", "shear_modulus", "poisson_ratio", "warp_stiffening"])
def test_slopes(specimen, readings, name):
    """Against central differences over four decades of steps, through preload and equilibrium."""
    law = woven(warp_stiffening=20.0)
    raw = getattr(law, name).raw

    def total() -> torch.Tensor:
        read = specimen.curve(law, readings)
        return read.force.sum() + 100 * read.lateral_strain.sum()

    exact = torch.autograd.grad(total(), raw)[0].item()
    result = []
    for step in (1e-3, 1e-4, 1e-5, 1e-6):
        with torch.no_grad():
            raw += step
            above = total().item()
            raw -= 2 * step
            result.append((above - total().item()) / (2 * step))
            raw += step
    assert min(abs(f - exact) for f in result) < 1e-6 * abs(total().item())


def test_trellis_in_closed_form():
    """Rigid yarns and no coupling: 8 G h sin^2(g / 4) J/m^2; areas and angle of a specimen of 1 x 2 by hand."""
    law = tc.materials.OrthotropicAEP(1e6, 1e6, SHEAR, 1e-6, thickness=H)
    strain = np.linspace(0.01, 0.15, 8)
    length, width = 0.2, 0.1
    shear = pi / 2 - 2 * np.arccos((1 + 2 * strain) / 2**0.5)

    def energy(g):
        whole, half = 0.5 * width**2, width**2
        return 8 * SHEAR * H * (whole * np.sin(g / 4) ** 2 + half * np.sin(g / 8) ** 2)

    step = 1e-5
    rate = [pi / 2 - 2 * np.arccos((1 + 2 * (strain + k * step)) / 2**0.5) for k in (-1, 1)]
    force = (energy(rate[1]) - energy(rate[0])) / (2 * step * length)
    readings = table(strain, pi / 4, length, width)
    assert Trellis().angle(readings).numpy() == pytest.approx(shear)
    assert Trellis().curve(law, readings).force.detach().numpy() == pytest.approx(force, rel=1e-5)


def test_a_mesh_with_stiff_yarns_reads_the_trellis():
    """Yarns 1e4 times stiffer than shear: 2 % up to 16 degrees (5 % at 31, where elements lag behind the kinks)."""
    law = tc.materials.OrthotropicAEP(1e9, 1e9, 1e5, 0.001, thickness=H)
    displacement = np.array([0.004, 0.008, 0.015])
    force, _ = Strip(0.23, 0.115, 45, law, (17, 9), clamped=True).pull(torch.as_tensor(displacement))
    read = Trellis().curve(law, table(displacement / 0.23, pi / 4, 0.23, 0.115))
    assert read.force.detach().numpy() == pytest.approx(force.numpy(), rel=0.02)


def test_what_is_refused():
    with pytest.raises(InvalidInput, match="45 degrees"):
        Trellis().curve(woven(), table([0.01], 0.3, 0.2, 0.1))
    with pytest.raises(InvalidInput, match="two widths"):
        Trellis().curve(woven(), table([0.01], pi / 4, 0.15, 0.1))
    with pytest.raises(InvalidInput, match="yarns meet"):
        Trellis().curve(woven(), table([0.25], pi / 4, 0.2, 0.1))
    with pytest.raises(InvalidInput, match="plastic set"):
        Uniaxial().curve(woven(plastic=tc.materials.NormYield(0.02)), table([0.01]))


def test_no_equilibrium_is_said(monkeypatch):
    monkeypatch.setattr(specimens, "MAX_NEWTON_STEPS", 1)
    with pytest.raises(SimulationDiverged, match="equilibrium; got none at a strain of"):
        Uniaxial().curve(woven(), table([0.5], 0.5))
