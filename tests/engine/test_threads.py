"""Threads share the work of batches and directions, and change no bit of the results."""

import pytest
import torch

import torchcloth as tc

SCENES, TIMES = 3, [0.0, 0.01, 0.02]


@pytest.fixture
def cloth():
    return tc.Cloth(
        tc.meshes.rectangle(0.2, 0.2, triangles=72),
        tc.materials.AEP(6e4),
        0.15,
        {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(), "bending": tc.effects.Bending(1e-5)},
        contact=tc.Contact(everywhere=True),
    )


@pytest.fixture(params=[1, 2])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


FOUND: dict[str, list[torch.Tensor]] = {}


def same(name: str, results: list[torch.Tensor]) -> None:
    """Whatever came first is what all later runs must give."""
    first = FOUND.setdefault(name, results)
    assert all(torch.equal(a, b) for a, b in zip(first, results, strict=True))


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("run", [1, 2])
def test_values_and_gradients(cloth, run):
    noise = torch.randn(SCENES, len(cloth.mesh.vertices), 3, generator=torch.Generator().manual_seed(0))
    x = (cloth.rest_state().x + 1e-3 * noise.to(cloth.rest_state().x)).requires_grad_()
    end = cloth(cloth.state(x), times=TIMES).x[:, -1]
    parameters = [p for p in cloth.parameters() if p.requires_grad]
    grads = torch.autograd.grad((end**2).sum(), [x, *parameters], allow_unused=True)
    same("reverse", [end.detach(), *(g for g in grads if g is not None)])


@pytest.mark.usefixtures("threads")
def test_tangents(cloth):
    eye = torch.eye(9, 2, dtype=cloth.rest_state().x.dtype)  # three chunks
    along = tc.Directions({"material.youngs_modulus.raw": eye[:, 0].clone(), "areal_density.raw": eye[:, 1].clone()})
    rollout, moved = cloth.sensitivities(cloth.rest_state(), times=TIMES, along=along)
    same("forward", [rollout.x, moved.x])
