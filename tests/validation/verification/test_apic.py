"""APIC, the usual material point scheme, compared with the scheme of the library."""

import pytest
import torch

import torchcloth as tc
from torchcloth.dynamics.kinematics import surface
from torchcloth.dynamics.stability import stability_limits
from torchcloth.training.validation.verification import apic
from torchcloth.training.validation.verification.apic import APICCloth

DENSITY = 0.15  # kg/m^2


def test_apic_falls_freely_and_needs_a_grid():
    """Free fall is exact, momentum is kept."""
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(6, 6))
    cloth = APICCloth(mesh, tc.materials.AEP(1e5), DENSITY, {"gravity": tc.effects.Gravity()})
    with torch.no_grad():
        out = cloth(cloth.rest_state(), times=[0.0, 0.05])
    assert float(out.v[-1, :, 2].mean()) == pytest.approx(-9.81 * 0.05, rel=1e-9)
    with pytest.raises(tc.errors.InvalidInput, match="needs its grid"):
        APICCloth(mesh, tc.materials.AEP(1e5), DENSITY, contact=None)


def test_particles_have_all_mass():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(5, 5))
    cloth = APICCloth(mesh, tc.materials.AEP(1e5), DENSITY, {"hem": tc.effects.LineMass(0.02)})
    model, state = cloth.build_model(), cloth.rest_state()
    masses = apic._particle_masses(model, state, surface(model.geometry, state.x, state.v))
    torch.testing.assert_close(masses.sum(), model.mass.sum())
    assert bool((masses > 0).all())


def test_apic_brakes_a_turning_sheet_and_our_scheme_does_not():
    """The reason why ours is not APIC: 0.3 m sheet at 6 rad/s in vacuum."""
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(6, 6))
    remaining = []
    for cloth_type in (tc.Cloth, APICCloth):
        contact = tc.Contact(everywhere=True, free_compression=0.0)
        cloth = cloth_type(
            mesh, tc.materials.AEP(3e5, 0.3, contact_stiffness=1e6, shear_stiffness=2e5), DENSITY, contact=contact
        )
        x = cloth.rest_state().x - 0.15 * torch.tensor([1.0, 1.0, 0.0])
        v = torch.linalg.cross(torch.tensor([6.0, 0.0, 0.0]).expand_as(x), x)
        with torch.no_grad():
            state = cloth(cloth.state(x, v), times=[0.0, 0.2]).state
        angular = [
            (cloth.build_model().mass * torch.linalg.cross(a, b)).sum(0)[0] for a, b in ((x, v), (state.x, state.v))
        ]
        remaining.append(float(angular[1] / angular[0]))
    assert remaining[0] == pytest.approx(1.0, abs=1e-9)
    assert remaining[1] < 0.99


def test_apic_ignores_added_mass():
    """Neither its mass nor the force that goes with it acts."""
    mesh = tc.meshes.rectangle(0.1, 0.1, triangles=8)
    v = torch.randn(9, 3, generator=torch.Generator().manual_seed(0))
    after = []
    for effects in ({}, {"air": tc.effects.AddedMass(0.15)}):
        cloth = APICCloth(mesh, tc.materials.AEP(1e4), DENSITY, effects)
        with torch.no_grad():
            after.append(cloth(cloth.state(cloth.rest_state().x, v), times=[0.0, 1e-4], dt=1e-5).v)
    assert torch.equal(*after)


def test_apic_has_no_viscous_stages():
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(4, 4))
    cloth = APICCloth(mesh, tc.materials.AEP(3e5, 0.3), 0.2, {"viscous": tc.effects.KelvinVoigt(3.0)})
    assert cloth.stable_step() == stability_limits(cloth.build_model(), cloth._gradient).stable_step(0)


def test_the_fused_engine_refuses_apic():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))
    cloth = APICCloth(mesh, tc.materials.AEP(1e5), DENSITY, engine="fused")
    with pytest.raises(tc.errors.InvalidInput, match=r"substep 'apic' has no kernels"):
        cloth(cloth.rest_state(), times=(0.0, 1e-3))


def test_settled_particles_are_at_rest():
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))
    cloth = APICCloth(mesh, tc.materials.AEP(1e5), DENSITY)
    with torch.no_grad():
        moving = cloth.state(cloth.rest_state().x, 0.02 * torch.randn(16, 3))
        assert float(cloth(moving, times=[0.0, 1e-3]).state.memory["apic"].abs().max()) > 0
        assert not cloth.settle(moving, duration=0.01).memory["apic"].any()
