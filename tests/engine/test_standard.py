"""The standard model: isotropic, weight, drag, damping, bending, a hand."""

from agreement import agree, held, moving

import torchcloth as tc


def test_standard():
    mesh = tc.meshes.rectangle(0.3, 0.2, triangles=60)
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(6e4, 0.3),
        0.15,
        {
            "gravity": tc.effects.Gravity(tilt=(0.1, -0.2)),
            "air": tc.effects.AirDrag(1.2, tangential=0.02, wind=(0.3, 0.1, 0)),
            "damping": tc.effects.MassDamping(0.4),
            "bending": tc.effects.Bending(1e-5, 0.01),
            "hem": tc.effects.LineMass(4e-3),
        },
        {"hand": tc.boundaries.Grasp.corner("upper-left")},
        contact=None,
    )
    print(agree(cloth, {"hand": held(0.01)}, moving(cloth)))
