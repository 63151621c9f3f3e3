"""A residual force against the effects that it generalises, and against what must not matter to it."""

import pytest
import torch

import torchcloth as tc
from torchcloth.dynamics import substep
from torchcloth.effects import AirDrag, Bending, KelvinVoigt, MassDamping, ResidualForce
from torchcloth.effects.residual import RESIDUAL_LAWS, RESIDUAL_PLACES, describe_term
from torchcloth.errors import InvalidInput
from torchcloth.types import EffectInputs

DENSITY = 0.2  # kg/m^2


@pytest.fixture(autouse=True)
def _values_only():
    with torch.no_grad():
        yield


def cloth_with(effect, n=5):
    mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(n, n))
    return tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), DENSITY, {"it": effect}, contact=None)


def force(cloth, x, v):
    """[V, 3] N."""
    model = cloth.build_model()
    effect, c = model.effects["it"]
    result = effect.force(c, EffectInputs(x, v, substep.surface(model.geometry, x, v), model.mass))
    if effect.acts_on == "vertices":
        return result
    corners = torch.as_tensor(cloth.mesh.faces)
    out = torch.zeros_like(x)
    for k in range(3):
        out = out.index_add(-2, corners[:, k], result / 3)
    return out


def moving(cloth):
    """Turned rigidly, so that rest areas are areas, and moving unevenly."""
    torch.manual_seed(1)
    x = cloth.rest_state().x
    turn = torch.linalg.qr(torch.randn(3, 3)).Q
    return x @ turn.mT, torch.randn(x.shape)


@pytest.mark.parametrize(
    ("terms", "known"),
    [
        (
            {"across2": 0.5 * 1.204 * 1.3, "along2": 0.5 * 1.204 * 0.1},
            lambda: AirDrag(1.3, density=1.204, tangential=0.1),
        ),
        ({"strain_rate": 0.7}, lambda: KelvinVoigt(0.7)),
    ],
)
def test_laws_are_those_of_known_effects(terms, known):
    parameter, other = cloth_with(ResidualForce(terms)), cloth_with(known())
    x, v = moving(parameter)
    assert torch.allclose(force(parameter, x, v), force(other, x, v), rtol=1e-9, atol=1e-14)


def normal(x):
    """Of a sheet that lies flat."""
    n = torch.linalg.cross(x[1] - x[0], x[-1] - x[0])
    return n / n.norm()


def test_across_and_along_make_up_linear_drag():
    """On a sheet that moves as a whole: the area's share of a triangle is the vertex's mass over the density."""
    parameter, other = cloth_with(ResidualForce({"across": 0.4, "along": 0.1})), cloth_with(MassDamping(0.4 / DENSITY))
    x, _ = moving(parameter)
    v = torch.tensor([0.3, -0.2, 0.5]).expand_as(x)
    every, n = force(other, x, v), normal(x)
    expected = 0.25 * every + 0.75 * (every @ n)[:, None] * n
    assert torch.allclose(force(parameter, x, v), expected, rtol=1e-9, atol=1e-14)


def test_mass_is_added_and_weighs():
    heavier = cloth_with(ResidualForce({"mass": 0.1}))
    bare = cloth_with(ResidualForce({"across": 0.0}))
    assert torch.allclose(heavier.build_model().mass, 1.5 * bare.build_model().mass)


@pytest.mark.parametrize("place", [p for p in RESIDUAL_PLACES if p])
def test_places_do_not_know_the_mesh(place):
    totals = []
    for n in (13, 25):
        mesh = tc.meshes.rectangle(0.3, 0.2, resolution=(n, n))
        corner = [int(((mesh.uv - [0.0, 0.2]) ** 2).sum(1).argmin())]
        effect = ResidualForce({f"mass@{place}": 0.1}, corner)
        cloth = tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), DENSITY, {"it": effect}, contact=None)
        totals.append(float(cloth.build_model().mass.sum()) - DENSITY * 0.06)
    assert totals[0] > 1e-4
    assert totals[0] == pytest.approx(totals[1], rel=0.03)


@pytest.mark.parametrize("law", [law for law in RESIDUAL_LAWS if law not in ("mass", "bend")])
def test_what_opposes_takes_power(law):
    cloth = cloth_with(ResidualForce({law: 1.0}))
    x, v = moving(cloth)
    assert float((force(cloth, x, v) * v).sum()) < 0


@pytest.mark.parametrize("law", [law for law in RESIDUAL_LAWS if law != "mass"])
@pytest.mark.parametrize("place", RESIDUAL_PLACES)
def test_it_turns_with_the_cloth(law, place):
    """In a room without a direction of its own: still air, no gravity."""
    cloth = cloth_with(ResidualForce({f"{law}@{place}".rstrip("@"): 1.0}, gripped_vertices=[0]))
    x, v = moving(cloth)
    x = x + 0.01 * torch.randn(x.shape)  # bent and strained
    turn = torch.linalg.qr(torch.randn(3, 3)).Q
    turn = turn * torch.linalg.det(turn)  # no mirror
    plain, turned = force(cloth, x, v), force(cloth, x @ turn.mT + 0.3, v @ turn.mT)
    assert float(plain.abs().max()) > 0
    assert torch.allclose(turned, plain @ turn.mT, rtol=1e-8, atol=1e-10 * float(plain.abs().max()))


def test_what_opposes_stretching_is_still_while_bent_cloth_turns_rigidly():
    cloth = cloth_with(ResidualForce({"strain_rate": 1.0}))
    x, v = moving(cloth)
    x = x + 0.01 * torch.randn(x.shape)
    rigid = torch.linalg.cross(torch.tensor([0.4, -1.0, 2.0]).expand_as(x), x) + torch.tensor([0.1, 0.2, -0.3])
    assert float(force(cloth, x, rigid).abs().max()) < 1e-9 * float(force(cloth, x, v).abs().max())


def test_what_opposes_bending_is_bending():
    """Without a curvature that it prefers, and the same in all directions."""
    parameter, other = cloth_with(ResidualForce({"bend": 0.7})), cloth_with(Bending(0.7, poisson=0.0))
    x, _ = moving(parameter)
    u, v = torch.as_tensor(parameter.mesh.uv).mT
    bent = x + 0.005 * torch.sin(7 * u + 4 * v)[:, None] * normal(x)
    result, expected = (force(cloth, bent, 0 * x) for cloth in (parameter, other))
    assert float(expected.abs().max()) > 0
    assert torch.allclose(result, expected, rtol=0.05, atol=0.02 * float(expected.abs().max()))


def test_what_opposes_bending_leaves_flat_cloth_alone():
    cloth = cloth_with(ResidualForce({"bend": 1.0}))
    x, v = moving(cloth)
    bent = float(force(cloth, x + 0.01 * torch.randn(x.shape), v).abs().max())
    assert float(force(cloth, x, v).abs().max()) < 1e-9 * bent


def test_it_says_what_it_does_and_refuses_what_it_does_not_know():
    assert (
        describe_term("across2@edge", 0.4)
        == "opposes motion across the cloth, growing as speed squared, near the free edges"
    )
    assert describe_term("mass", -0.1).startswith("the opposite of")
    for terms in ({}, {"magnetism": 1.0}, {"across@hem": 1.0}):
        with pytest.raises(InvalidInput, match="terms"):
            ResidualForce(terms)
    with pytest.raises(InvalidInput, match="gripped_vertices; got vertex 36; expected 0 to 35"):
        ResidualForce({"across": 1.0}, gripped_vertices=[0, 36]).bind(tc.meshes.rectangle(0.2, 0.2, resolution=(6, 6)))


def test_mass_that_is_taken_away_shortens_the_step():
    """Stable with a quarter of the mass, refused with less than none."""
    made = lambda mass: tc.Cloth(  # noqa: E731
        tc.meshes.rectangle(0.2, 0.2, resolution=(6, 6)), tc.materials.AEP(1e4, 0.3), 0.2,
        {"residual": ResidualForce({"mass": mass})}, contact=None,
    )  # fmt: skip
    cloth, plain = made(-0.15), made(0.0)
    assert cloth.stable_step() == pytest.approx(0.5 * plain.stable_step(), rel=1e-6)
    state = cloth.state(cloth.rest_state().x + 1e-4 * torch.randn(36, 3))
    assert float(cloth(state, times=(0.0, 0.2)).v.detach().abs().max()) < 1.0
    with pytest.raises(InvalidInput, match="mass; got -"):
        made(-0.25).stable_step()
