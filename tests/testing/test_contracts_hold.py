"""The parts that torchcloth ships keep the contracts that it ships."""

import textwrap

import torch
import trimesh

import torchcloth as tc
from torchcloth.diagnosis.causes.catalogue import list_effect_classes
from torchcloth.testing import (
    BoundaryContract,
    ColliderContract,
    EffectContract,
    GraspContract,
    MaterialContract,
)


class TestAEP(MaterialContract):
    def make(self):
        return tc.materials.AEP(1e5, 0.3, contact_stiffness=4e5, shear_stiffness=7e4, cone=0.4)


class TestAEPInThePapersConvention(MaterialContract):
    def make(self):
        return tc.materials.AEP(1e5, 0.3, contact_stiffness=4e5, shear_stiffness=7e4, cone=0.4, convention="paper")


class TestAEPWithFields(MaterialContract):
    def make(self):
        field = torch.linspace(0.8, 1.2, self.triangles)
        return tc.materials.AEP(
            1e5 * field, 0.3 * field, contact_stiffness=4e5 / field, shear_stiffness=7e4 * field, cone=0.4 / field
        )


class TestOrthotropicAEP(MaterialContract):
    def make(self):
        return tc.materials.OrthotropicAEP(1e5, 3e4, 2e3, 0.3, contact_stiffness=4e5, shear_stiffness=7e4, cone=0.4)


class TestStiffeningAEP(MaterialContract):
    def make(self):
        return tc.materials.StiffeningAEP(
            1e5, 0.3, stiffening=8.0, contact_stiffness=4e5, shear_stiffness=7e4, cone=0.4
        )


class TestStiffeningOrthotropicAEPWithFields(MaterialContract):
    def make(self):
        field = torch.linspace(0.8, 1.2, self.triangles)
        moduli = (1e5 * field, 3e6 / field, 2e3 * field, 0.3 * field)
        director = {"contact_stiffness": 4e5 / field, "shear_stiffness": 7e4 * field, "cone": 0.4 / field}
        return tc.materials.OrthotropicAEP(*moduli, **director, warp_stiffening=30 * field, weft_stiffening=10 / field)


class TestPlasticAEP(MaterialContract):
    def make(self):
        return tc.materials.AEP(
            1e5, 0.3, contact_stiffness=4e5, shear_stiffness=7e4, cone=0.4, plastic=tc.materials.NormYield(0.02)
        )


class TestPlasticOrthotropicAEPWithFields(MaterialContract):
    def make(self):
        limit = torch.linspace(0.02, 0.04, self.triangles)
        plastic = tc.materials.NormYield(limit)
        return tc.materials.OrthotropicAEP(
            1e5, 3e4, 2e3, 0.3, contact_stiffness=4e5, shear_stiffness=7e4, cone=0.4, plastic=plastic
        )


class TestCottonPreset(MaterialContract):
    def make(self):
        return tc.materials.AEP.preset("cotton")


class TestGravity(EffectContract):
    def make(self, amplitude):
        return tc.effects.Gravity((0.6 * amplitude, 0.0, -0.8 * amplitude))


class TestAirDrag(EffectContract):
    def make(self, amplitude):
        return tc.effects.AirDrag(amplitude)


class TestMassDamping(EffectContract):
    def make(self, amplitude):
        return tc.effects.MassDamping(amplitude)


class TestAdhesion(EffectContract):
    def make(self, amplitude):
        return tc.effects.Adhesion(amplitude, gap=0.4, point=(0.0, 0.0, -0.2))


class TestResidualForce(EffectContract):
    def make(self, amplitude):
        laws = ("across", "across2@edge", "along@inside", "along2", "mass@edge", "strain_rate@inside")
        return tc.effects.ResidualForce({**dict.fromkeys(laws, amplitude), "bend@edge": 1e-4 * amplitude})


class TestBodyForce(EffectContract):
    def make(self, amplitude):
        return tc.effects.BodyForce(amplitude * torch.tensor([[0.6, 0.0, -0.8]]))


class TestBodyForceOfVertices(EffectContract):
    def make(self, amplitude):
        vertices = len(self.mesh().vertices)
        return tc.effects.BodyForce(amplitude * torch.linspace(0.5, 1.5, 3 * vertices).reshape(vertices, 3))


class TestBending(EffectContract):
    def make(self, amplitude):
        return tc.effects.Bending(amplitude, damping_time=0.01)


class TestWovenBending(EffectContract):
    def make(self, amplitude):
        curls = {"curl_warp": 3.0, "curl_weft": -1.0}
        return tc.effects.Bending(amplitude, 0.01, poisson=0.3, weft_ratio=0.5, twist_ratio=0.7, **curls)


class TestBendingField(EffectContract):
    def make(self, amplitude):
        return tc.effects.Bending(amplitude * torch.linspace(0.5, 2.0, 18), 0.01)


class TestBendingDamping(EffectContract):
    amplitude = "damping_time"

    def make(self, amplitude):
        return tc.effects.Bending(1e-3, amplitude)

    def base(self):
        return {"bending": tc.effects.Bending(1e-3)}


class TestCurlWarp(EffectContract):
    amplitude = "curl_warp"

    def make(self, amplitude):
        return tc.effects.Bending(1e-3, curl_warp=amplitude)

    def base(self):
        return {"bending": tc.effects.Bending(1e-3)}


class TestCurlWeft(TestCurlWarp):
    amplitude = "curl_weft"

    def make(self, amplitude):
        return tc.effects.Bending(1e-3, curl_weft=amplitude)


class TestSaturatingBending(EffectContract):
    def make(self, amplitude):
        return tc.effects.SaturatingBending(amplitude, 2.0)


class TestBendingFriction(EffectContract):
    def make(self, amplitude):
        return tc.effects.BendingFriction(amplitude, 2.0)


class TestShearFriction(EffectContract):
    def make(self, amplitude):
        return tc.effects.ShearFriction(amplitude, 0.05)


class TestCreasingBending(EffectContract):
    def make(self, amplitude):
        return tc.effects.CreasingBending(1e-3, mobility=amplitude, yield_curvature=0.2, weft_ratio=0.5, curl_warp=1.0)

    def base(self):
        return {"bending": tc.effects.Bending(1e-3, weft_ratio=0.5, curl_warp=1.0)}


class TestTilt(EffectContract):
    amplitude = "tilt"

    def make(self, amplitude):
        return tc.effects.Gravity((0.5, 1.0, -9.0), tilt=(0.6 * amplitude, -0.8 * amplitude))

    def base(self):
        return {"gravity": tc.effects.Gravity((0.5, 1.0, -9.0))}


class TestTangentialAirDrag(EffectContract):
    amplitude = "tangential"

    def make(self, amplitude):
        return tc.effects.AirDrag(0.0, tangential=amplitude)


class TestWind(EffectContract):
    amplitude = "wind"

    def make(self, amplitude):
        return tc.effects.AirDrag(1.2, tangential=0.016, wind=(0.6 * amplitude, 0.0, 0.8 * amplitude))

    def base(self):
        return {"air": tc.effects.AirDrag(1.2, tangential=0.016)}


class TestAddedMass(EffectContract):
    def make(self, amplitude):
        return tc.effects.AddedMass(amplitude)


class TestKelvinVoigt(EffectContract):
    def make(self, amplitude):
        return tc.effects.KelvinVoigt(amplitude)


class TestKelvinVoigtWithAField(EffectContract):
    def make(self, amplitude):
        return tc.effects.KelvinVoigt(amplitude * torch.linspace(0.5, 1.5, len(self.mesh().faces)))


class TestHem(EffectContract):
    def make(self, amplitude):
        return tc.effects.LineMass(amplitude)


class TestShrinkWarp(EffectContract):
    amplitude = "shrink_warp"

    def make(self, amplitude):
        return tc.effects.RestShape(shrink_warp=amplitude)


class TestShrinkWeft(EffectContract):
    amplitude = "shrink_weft"

    def make(self, amplitude):
        return tc.effects.RestShape(shrink_weft=amplitude)


class TestSkew(EffectContract):
    amplitude = "skew"

    def make(self, amplitude):
        return tc.effects.RestShape(skew=amplitude)


class TestGripMobility(EffectContract):
    def make(self, amplitude):
        return tc.effects.GripSlip("hand", amplitude, hold=0.0)


class TestGripHold(EffectContract):
    amplitude = "hold"

    def make(self, amplitude):
        return tc.effects.GripSlip("hand", 0.01, hold=amplitude)

    def base(self):
        return {"slip": tc.effects.GripSlip("hand", 0.01, hold=0.0)}


class TestPlane(BoundaryContract):
    def make(self):
        return tc.boundaries.Plane(friction=0.4)


class TestGrasp(GraspContract):
    def make(self):
        return tc.boundaries.Grasp(self.gripped_vertices())

    def gripped_vertices(self):
        return [0, 3, 4]


class TestSphere(ColliderContract):
    def collider(self, **options):
        return tc.boundaries.Sphere(0.12, (0.02, 0.0, -0.03), friction=0.4, **options)


class TestBox(ColliderContract):
    def collider(self, **options):
        pose = torch.eye(4)
        pose[:3, :3] = torch.tensor([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
        pose[:3, 3] = torch.tensor([0.01, 0.02, -0.03])
        return tc.boundaries.Box((0.2, 0.15, 0.1), pose, friction=0.4, **options)


class TestCapsule(ColliderContract):
    def collider(self, **options):
        return tc.boundaries.Capsule((-0.1, 0.0, 0.0), (0.08, 0.05, 0.0), 0.08, friction=0.4, **options)


class TestCylinder(ColliderContract):
    def collider(self, **options):
        return tc.boundaries.Cylinder((0.0, 0.0, -0.1), (0.0, 0.0, 0.1), 0.09, friction=0.4, **options)


class TestSolidPlane(ColliderContract):
    def collider(self, **options):
        return tc.boundaries.Plane((0.0, 0.0, 0.0), (0.6, 0.0, 0.8), friction=0.4, **options)


class TestMeshSolid(ColliderContract):
    """A ball of triangles; the distance is interpolated on cells of 1 cm."""

    moving = True
    rounding = 4e-4
    slant = 0.04
    projections = 8

    def collider(self, **options):
        ball = trimesh.creation.icosphere(subdivisions=3, radius=0.12)
        return tc.boundaries.MeshSolid(ball.vertices, ball.faces, cell=0.01, friction=0.4, **options)


class TestMovingPlane(TestSolidPlane):
    moving = True


class TestMovingSphere(TestSphere):
    moving = True


class TestMovingBox(TestBox):
    moving = True


class TestMovingCapsule(TestCapsule):
    moving = True


class TestMovingCylinder(TestCylinder):
    moving = True


class TestStribeck(TestMovingSphere):
    test_friction_stays_in_the_cone = None  # mu depends on the speed

    def collider(self, **options):
        return tc.boundaries.Sphere(0.12, friction=tc.boundaries.Stribeck(0.3, 0.5, 0.5), **options)


class TestElliptic(TestSolidPlane):
    test_friction_stays_in_the_cone = None  # mu depends on the direction

    def collider(self, **options):
        return tc.boundaries.Plane(friction=tc.boundaries.Elliptic(0.4, 0.2, (0.6, 0.8, 0.0)), **options)


class DefaultEffect(EffectContract):
    """An effect as its constructor makes it, with one parameter at the amplitude."""

    def __init__(self, effect, parameter):
        self.effect, self.amplitude = effect, parameter

    def make(self, amplitude):
        return self.effect(**{self.amplitude: amplitude})


DefaultEffect.__test__ = False


def list_cases_by_hand():
    """(effect class, parameter) of the contract tests above."""
    cases = [c() for name, c in globals().items() if name.startswith("Test") and issubclass(c, EffectContract)]
    pairs = [(type(case.make(0.1)), case.amplitude) for case in cases]
    return {(effect, parameter or next(iter(effect.amplitudes))) for effect, parameter in pairs}


def test_every_declared_amplitude_keeps_the_contract():
    """What an effect declares beside its parents' amplitudes has a case above, or is tested as it is constructed."""
    known = list_cases_by_hand()
    assert (tc.effects.AirDrag, "wind") in known
    for effect in list_effect_classes():
        inherited = {name for parent in effect.__mro__[1:] for name in getattr(parent, "amplitudes", ())}
        for parameter in effect.amplitudes.keys() - inherited:
            if (effect, parameter) not in known and effect is not tc.effects.ResidualForce:
                DefaultEffect(effect, parameter).check()


def test_contracts_do_not_depend_on_the_default_precision():
    """A user's tests run with float32 by default."""
    torch.set_default_dtype(torch.float32)
    TestAEPWithFields().check()
    TestBending().check()
    TestPlane().check()
    TestGrasp().check()
    assert torch.get_default_dtype() == torch.float32


def test_the_example_in_the_docstring():
    """What a reader copies keeps the contract."""
    text = textwrap.dedent(
        tc.effects.AbstractEffect.__doc__.split("A constant force per vertex:\n\n")[1].split("    In all hooks")[0]
    )
    scope = {"torch": torch, "torchcloth": tc, "PhysicalParameter": tc.PhysicalParameter}
    scope |= {name: getattr(tc.effects, name) for name in ("AbstractEffect", "Amplitude")}
    exec(text, scope)
    scope["TestPull"]().check()
