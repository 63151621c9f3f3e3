"""A small sheet for tests of ``Cloth``."""

import torchcloth as tc


def make_sheet(n=4, *, effects=None, boundaries=None, contact=None, Y=100.0):
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(n, n))
    return tc.Cloth(
        mesh,
        tc.materials.AEP(Y * 1e3, 0.3, contact_stiffness=1e6, shear_stiffness=2e5),
        0.2,
        effects,
        boundaries,
        contact,
    )
