"""Simulate with an installed wheel that may neither compile nor find a library from elsewhere. Run as a script."""

import os
import tempfile

with tempfile.TemporaryDirectory() as empty:
    os.environ.update(PATH=empty, CXX="", TORCHCLOTH_CACHE=empty, XDG_CACHE_HOME=empty, TMPDIR=empty)
    tempfile.tempdir = empty

    import torch

    import torchcloth as tc
    from torchcloth.engine import library

    print(library.status())
    assert library.status().startswith("portable: "), "the wheel's portable library is not in use"
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(5, 5))
    effects = {"gravity": tc.effects.Gravity()}
    results = {}
    for engine in ("fused", "reference"):
        cloth = tc.Cloth(mesh, tc.materials.AEP(1e4, 0.3), 0.2, effects=effects, contact=None, engine=engine).double()
        out = cloth(cloth.rest_state(), times=[0.0, 0.05])
        out.x[-1].square().sum().backward()
        results[engine] = out.x.detach(), cloth.material.youngs_modulus.raw.grad.clone()
    fall = results["fused"][0][-1, :, 2].mean().item()
    print(f"fell by {1e3 * fall:.3f} mm in 0.05 s")
    assert abs(fall / (-0.5 * 9.81 * 0.05**2) - 1) < 0.1, fall  # symplectic Euler with steps of 3 ms
    for fused, reference in zip(results["fused"], results["reference"], strict=True):
        torch.testing.assert_close(fused, reference, rtol=1e-8, atol=1e-10)
    print("ok")
