"""The parts that torchcloth ships keep the contracts that it ships."""

import torch

import torchcloth as tc
from torchcloth.testing import BoundaryContract, EffectContract, GraspContract, MaterialContract


class TestAEP(MaterialContract):
    def make(self):
        return tc.materials.AEP(1e5, 0.3, 4e5, 7e4, cone=0.4)


class TestAEPInThePapersConvention(MaterialContract):
    def make(self):
        return tc.materials.AEP(1e5, 0.3, 4e5, 7e4, cone=0.4, convention="paper")


class TestAEPWithFields(MaterialContract):
    def make(self):
        field = torch.linspace(0.8, 1.2, self.triangles)
        return tc.materials.AEP(1e5 * field, 0.3 * field, 4e5 / field, 7e4 * field, cone=0.4 / field)


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


class TestBending(EffectContract):
    def make(self, amplitude):
        return tc.effects.Bending(amplitude, damping_time=0.01)


class TestPlane(BoundaryContract):
    def make(self):
        return tc.boundaries.Plane(friction=0.4)


class TestGrasp(GraspContract):
    def make(self):
        return tc.boundaries.Grasp(self.held())

    def held(self):
        return [0, 3, 4]


def test_contracts_do_not_depend_on_the_default_precision():
    """A user's tests run with float32 by default."""
    torch.set_default_dtype(torch.float32)
    TestAEPWithFields().check()
    TestBending().check()
    TestPlane().check()
    TestGrasp().check()
    assert torch.get_default_dtype() == torch.float32
