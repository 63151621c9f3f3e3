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
    for case, results in zip(cases, together, strict=True):
        assert torch.equal(results, fallen(*case)), case


def folded(stiffness: float) -> list[torch.Tensor]:
    """Values and gradients of cloth in contact with itself; one program for all stiffnesses."""
    material = tc.materials.AEP(stiffness, 0.3)
    effects = {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.0)}
    layer = tc.Cloth(tc.meshes.rectangle(0.2, 0.2, resolution=(9, 9)), material, 0.2, effects, engine="fused")
    start = layer.rest_state()
    crumpled = start.x + 0.02 * torch.sin(40 * start.x[..., [1, 2, 0]])
    out = layer(layer.state(crumpled), {}, [0.0, 0.01, 0.02])
    out.x[-1].square().sum().backward()
    return [out.x.detach(), layer.material.youngs_modulus.raw.grad]


def test_one_program_serves_many_at_once():
    cases = [1e4 * (1 + k % 3) for k in range(12)]
    with ThreadPoolExecutor(6, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        together = list(pool.map(folded, cases))
    alone = {stiffness: folded(stiffness) for stiffness in set(cases)}
    for stiffness, results in zip(cases, together, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(results, alone[stiffness], strict=True)), stiffness
