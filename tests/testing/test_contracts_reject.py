"""A contract is worth what it rejects: every promise is broken once, on purpose, and its test must notice."""

import pytest
import torch

import torchcloth as tc
from torchcloth._utils.linalg import dot
from torchcloth.testing import BoundaryContract, ColliderContract, EffectContract, GraspContract, MaterialContract


def material_contract(law):
    class Contract(MaterialContract):
        def make(self):
            return law(1e5, 0.3, contact_stiffness=4e5, shear_stiffness=7e4, cone=0.4)

    return Contract()


class WrongSign(tc.materials.AEP):
    def membrane_stress(self, c, surface):
        return tuple(-column for column in super().membrane_stress(c, surface))


class SlightlyWrongStress(tc.materials.AEP):
    def membrane_stress(self, c, surface):
        return super().membrane_stress(c._replace(lam=c.lam * (1 + 1e-6)), surface)


class WorldAxes(tc.materials.AEP):
    """Stiffer along the world's x: what a QR in world axes does."""

    def membrane_energy(self, c, surface):
        return super().membrane_energy(c, surface) + 0.01 * c.mu * (surface.f1[..., :1] ** 2)

    def membrane_stress(self, c, surface):
        first, second = super().membrane_stress(c, surface)
        axis = torch.tensor([1.0, 0.0, 0.0]).to(first)
        return first + 0.02 * c.mu * surface.f1 * axis, second


class Prestressed(tc.materials.AEP):
    def membrane_stress(self, c, surface):
        first, second = super().membrane_stress(c, surface)
        return first + 1e-6 * c.mu * surface.f1, second


class CreepingReturnMap(tc.materials.AEP):
    def return_map(self, c, n, d3):
        once = super().return_map(c, n, d3)
        return once + 0.5 * (n - once) * (dot(n, once) < 1)


class DetachedParameter(tc.materials.AEP):
    def coefficients(self):
        c = super().coefficients()
        return c._replace(shear=c.shear.detach())


class YieldsWhenTurned(tc.materials.AEP):
    """The DiffCP paper's |F - 1| <= c: a rotation sets."""

    def initial_memory(self, triangles):
        return torch.eye(2).flatten().expand(triangles, 4)

    def flow(self, c, elastic, inelastic):
        f = torch.stack([elastic.f1, elastic.f2], dim=-1)
        length = (f - torch.eye(3, 2).to(f)).flatten(-2).norm(dim=-1, keepdim=True)
        return inelastic * (0.02 / length).clamp(max=1.0)


class NaNAtRest(tc.materials.AEP):
    def director_energy(self, c, n, d3):
        r = d3 - dot(n, d3) * n
        return super().director_energy(c, n, d3) + 0 * r.norm(dim=-1, keepdim=True).sqrt()


class Understated(tc.materials.AEP):
    def stiffness(self, c):
        return super().stiffness(c)._replace(in_plane_shear=0.9 * c.mu)


class ForgetsTheBatch(tc.materials.AEP):
    def membrane_stress(self, c, surface):
        return tuple(column - 1e-9 * column.mean(0) for column in super().membrane_stress(c, surface))


class AlwaysDouble(tc.materials.AEP):
    def membrane_energy(self, c, surface):
        return super().membrane_energy(c, surface).double()


@pytest.mark.parametrize(
    ("law", "promise"),
    [
        (WrongSign, "test_stress_is_the_derivative_of_the_energy"),
        (SlightlyWrongStress, "test_stress_is_the_derivative_of_the_energy"),
        (WorldAxes, "test_is_frame_indifferent"),
        (Prestressed, "test_rest_is_stress_free"),
        (CreepingReturnMap, "test_return_map_is_idempotent"),
        (DetachedParameter, "test_gradients_in_state_and_parameters"),
        (YieldsWhenTurned, "test_is_frame_indifferent"),
        (NaNAtRest, "test_gradients_are_finite_at_rest"),
        (Understated, "test_stiffness_bounds_the_tangents_at_rest"),
        (ForgetsTheBatch, "test_batches_equal_loops"),
        (AlwaysDouble, "test_works_in_float32"),
    ],
)
def test_material(law, promise):
    contract = material_contract(law)
    with pytest.raises(AssertionError):
        getattr(contract, promise)()
    with pytest.raises(AssertionError):
        contract.check()


def test_world_axes_are_caught_by_symmetry_alone():
    """Its stress is the exact derivative of its energy: only the turned frame shows the mistake."""
    material_contract(WorldAxes).test_stress_is_the_derivative_of_the_energy()


def effect_contract(kind):
    class Contract(EffectContract):
        def make(self, amplitude):
            return kind(amplitude)

    return Contract()


class Leaks(tc.effects.MassDamping):
    def force(self, c, inputs):
        return super().force(c, inputs) - 1e-12 * inputs.mass * inputs.v


class Undeclared(tc.effects.MassDamping):
    acts_on = "triangles"


class OffByOneInTenThousand(tc.effects.MassDamping):
    def force(self, c, inputs):
        force = super().force(c, inputs)
        return force - 1e-4 * (force - force.detach())  # right value, derivative off by 1e-4


class RootOfSpeed(tc.effects.MassDamping):
    def force(self, c, inputs):
        speed = dot(inputs.v, inputs.v).sqrt()
        return super().force(c, inputs) * speed / (speed + 1.0)


class SilentlyStiff(tc.effects.Bending):
    def stability_bounds(self, c, mass):
        return mass.new_zeros(()), mass.new_zeros(())


class TwiceAsViscous(tc.effects.KelvinVoigt):
    def viscous(self, c, inputs):
        return 2 * super().viscous(c, inputs)


class ViscousWithoutRate(tc.effects.KelvinVoigt):
    def viscous_stability_bound(self, c, mass):
        return mass.new_zeros(())


class StiffAtZero(tc.effects.MassDamping):
    def stability_bounds(self, c, mass):
        return mass.new_full((), 1e9), c.amax()


class MixesTheBatch(tc.effects.MassDamping):
    def force(self, c, inputs):
        return super().force(c, inputs) * (1 + inputs.v.mean())


@pytest.mark.parametrize(
    ("kind", "promise"),
    [
        (Leaks, "test_amplitude_zero_is_bitwise_the_base_model"),
        (StiffAtZero, "test_amplitude_zero_is_bitwise_the_base_model"),
        (Undeclared, "test_declares_itself"),
        (OffByOneInTenThousand, "test_gradients"),
        (RootOfSpeed, "test_gradients_are_finite_at_rest"),
        (SilentlyStiff, "test_rates_bound_the_spectrum_at_rest"),
        (TwiceAsViscous, "test_viscous_is_the_part_of_the_force_that_it_says"),
        (ViscousWithoutRate, "test_viscous_is_the_part_of_the_force_that_it_says"),
        (MixesTheBatch, "test_batches_equal_loops"),
    ],
)
def test_effect(kind, promise):
    with pytest.raises(AssertionError):
        getattr(effect_contract(kind), promise)()


def boundary_contract(kind):
    class Contract(BoundaryContract):
        def make(self):
            return kind()

    return Contract()


class PlainNorm(tc.boundaries.Plane):
    def constrain(self, x, v, dt, drive, substep):
        after = super().constrain(x, v, dt, drive, substep)
        return after + 0 * v.norm(dim=-1, keepdim=True).sqrt()


class Brakes(tc.boundaries.Plane):
    def constrain(self, x, v, dt, drive, substep):
        after = super().constrain(x, v, dt, drive, substep)
        return 0.9 * after


class FarAway(tc.boundaries.Plane):
    def __init__(self):
        super().__init__(point=(0.0, 0.0, -9.0))


class DetachedFriction(tc.boundaries.Plane):
    def constrain(self, x, v, dt, drive, substep):
        value = self.friction.value
        after = super().constrain(x, v, dt, drive, substep)
        return after - 0.1 * (value - value.detach()) * (after - v)


@pytest.mark.parametrize(
    ("kind", "promise"),
    [
        (PlainNorm, "test_gradients_are_finite_at_rest"),
        (Brakes, "test_applying_twice_changes_nothing"),
        (FarAway, "test_acts"),
        (DetachedFriction, "test_gradients"),
    ],
)
def test_boundary(kind, promise):
    with pytest.raises(AssertionError):
        getattr(boundary_contract(kind), promise)()


def collider_contract(kind):
    class Contract(ColliderContract):
        def collider(self, **options):
            return kind(0.12, friction=0.4, **options)

    return Contract()


class Sphere(tc.boundaries.Sphere):
    """What the broken ones below start from."""


class Squared(Sphere):
    def distance(self, p):
        distance, normal = super().distance(p)
        return distance + 5 * distance**2, normal


class Leaning(Sphere):
    def distance(self, p):
        distance, normal = super().distance(p)
        tilt = normal + 1e-3 * normal.roll(1, -1)
        return distance, tilt / tilt.norm(dim=-1, keepdim=True)


class NaNAtTheCentre(Sphere):
    def distance(self, p):
        q = p - self.centre
        length = q.norm(dim=-1, keepdim=True)
        return length - self.radius.value, q / length


class ThrowsOut(Sphere):
    def __init__(self, *args, **options):
        super().__init__(*args, **{**options, "recovery": 1e9})


class HalfHearted(Sphere):
    def constrain(self, x, v, dt, drive, substep):
        return (super().constrain(x, v, dt, drive, substep) + v) / 2


class TooSticky(Sphere):
    def constrain(self, x, v, dt, drive, substep):
        after = super().constrain(x, v, dt, drive, substep)
        return after + 0.01 * (after - v)


class StandsStill(Sphere):
    def constrain(self, x, v, dt, drive, substep):
        still = None if drive is None else drive._replace(increment=torch.eye(4).to(drive.pose).expand_as(drive.pose))
        return super().constrain(x, v, dt, still, substep)


@pytest.mark.parametrize(
    ("kind", "promise"),
    [
        (Squared, "test_the_normal_is_the_gradient_of_the_distance"),
        (Squared, "test_the_distance_leads_to_the_surface"),
        (Leaning, "test_the_normal_is_the_gradient_of_the_distance"),
        (NaNAtTheCentre, "test_is_finite_everywhere"),
        (ThrowsOut, "test_what_starts_inside_is_moved_out_gently"),
        (HalfHearted, "test_nothing_enters"),
        (TooSticky, "test_friction_stays_in_the_cone"),
        (StandsStill, "test_moves_as_a_rigid_body"),
    ],
)
def test_collider(kind, promise):
    getattr(collider_contract(Sphere), promise)()
    with pytest.raises(AssertionError):
        getattr(collider_contract(kind), promise)()


def grasp_contract(kind):
    class Contract(GraspContract):
        def make(self):
            return kind(self.gripped_vertices())

        def gripped_vertices(self):
            return [0, 3, 4]

    return Contract()


class Drifts(tc.boundaries.Grasp):
    def constrain(self, x, v, dt, drive, substep):
        after = super().constrain(x, v, dt, drive, substep)
        return after if drive is None else after * (1 + 1e-9)


class NeverOpens(tc.boundaries.Grasp):
    def constrain(self, x, v, dt, drive, substep):
        return super().constrain(x, v, dt, drive._replace(closed=(True,) * len(drive.closed)), substep)


class KeepsQuiet(tc.boundaries.Grasp):
    def prescribed_vertices(self, drive, substep):
        return None


class Undriven(tc.boundaries.Grasp):
    is_prescribed = False


@pytest.mark.parametrize(
    ("kind", "promise"),
    [
        (Drifts, "test_held_vertices_follow_the_pose_exactly"),
        (NeverOpens, "test_an_open_gripper_lets_go"),
        (KeepsQuiet, "test_says_what_it_holds"),
        (Undriven, "test_is_driven"),
    ],
)
def test_grasp(kind, promise):
    with pytest.raises(AssertionError):
        getattr(grasp_contract(kind), promise)()
