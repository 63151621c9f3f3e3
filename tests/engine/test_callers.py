"""Several callers may simulate at once, with one program or with several."""

from concurrent.futures import ThreadPoolExecutor

import torch

import torchcloth as tc


def cloth(stiffness: float, drag: float) -> tc.Cloth:
    effects = {"gravity": tc.effects.Gravity(), "bending": tc.effects.Bending(1e-5)}
    if drag:
        effects["air"] = tc.effects.AirDrag(drag)
    material = tc.materials.AEP(stiffness, 0.3)
    return tc.Cloth(
        tc.meshes.rectangle(0.2, 0.2, resolution=(13, 13)), material, 0.2, effects, contact=None, engine="fused"
    )


def fallen(stiffness: float, drag: float) -> torch.Tensor:
    with torch.no_grad():
        layer = cloth(stiffness, drag)
        return layer(layer.rest_state(), {}, [0.02 * k for k in range(16)]).x


def test_threads_do_not_disturb_each_other():
    """Programs that are new to the engine, used by all threads at once: the same numbers as one after the other."""
    cases = [(1e4 * (1 + k % 7), drag) for k in range(8) for drag in (0.0, 1.0)]
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(lambda case: fallen(*case), cases))
    for case, found in zip(cases, together, strict=True):
        assert torch.equal(found, fallen(*case)), case
