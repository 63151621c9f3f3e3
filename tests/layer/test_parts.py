"""Effects, boundaries and laws of a cloth: what of them is refused, and that a cloth leaves them as they are."""

import copy
import gc

import pytest
import torch
from helpers.small_sheet import make_sheet
from torch.func import functional_call

import torchcloth as tc
from torchcloth.dynamics.model import shallow_clone_module
from torchcloth.errors import InvalidInput


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (lambda e, v: {"effects": {"part": tc.effects.MassDamping(torch.ones(e))}}, r"rate; got .*scalar or \[B, 1\]"),
        (
            lambda e, v: {"effects": {"part": tc.effects.AirDrag(torch.ones(v))}},
            "normal; got shape .*one per triangle",
        ),
        (
            lambda e, v: {"effects": {"part": tc.effects.BodyForce(torch.ones(7, 3))}},
            "7 rows; expected 16, one per vertex",
        ),
        (lambda e, v: {"boundaries": {"part": tc.boundaries.Plane(friction=torch.ones(2))}}, "friction; got shape"),
        (lambda e, v: {"effects": {"a.b": tc.effects.Gravity()}}, "name of an effect or boundary; got 'a.b'"),
        (lambda e, v: {"boundaries": {"keys": tc.boundaries.Plane()}}, "name of an effect or boundary; got 'keys'"),
        (lambda e, v: {"effects": {"training": tc.effects.Gravity()}}, "name of an effect or boundary; got 'training'"),
        (lambda e, v: {"effects": {"_mesh": tc.effects.Gravity()}}, "name of an effect or boundary; got '_mesh'"),
    ],
)
def test_parts_whose_numbers_do_not_fit_the_mesh_are_refused(parts, message):
    with pytest.raises(InvalidInput, match=message):
        make_sheet(**parts(18, 16))


def test_coefficients_never_reach_beyond_their_rows():
    """Wrong numbers that come later, in the engine: it would read other memory."""
    cloth = make_sheet(effects={"damping": tc.effects.MassDamping(1.0)})
    cloth.engine = "fused"
    for count in (7, 15, 17, 18):
        with pytest.raises(InvalidInput, match=rf"damping.rate; got shape \({count},\); expected a scalar or \[B, 1\]"):
            functional_call(
                cloth, {"effects.damping.rate.raw": torch.ones(count)}, (cloth.rest_state(), {}, (0.0, 0.01))
            )


def test_a_field_wants_an_effect_that_was_made_with_one():
    """Stencils of bending differ, and are built with the cloth."""
    cloth = make_sheet(effects={"bending": tc.effects.Bending(1e-5)})
    field = {"effects.bending.stiffness.raw": torch.full((18,), 1e-5)}
    with pytest.raises(InvalidInput, match=r"18 values for an effect that was made with one.*Bending\(torch.full"):
        functional_call(cloth, field, (cloth.rest_state(), {}, (0.0, 0.01)))


def test_a_part_of_another_cloth_is_not_bound_anew():
    bending, hand = tc.effects.Bending(1e-3), tc.boundaries.Grasp.corner("upper-right", radius=1e-3)
    first = make_sheet(effects={"bending": bending}, boundaries={"hand": hand})
    gripped = hand.index.clone()
    for parts in ({"effects": {"bending": bending}}, {"boundaries": {"hand": hand}}):
        with pytest.raises(InvalidInput, match=r"an effect or boundary of another cloth.*copy.deepcopy"):
            make_sheet(7, **parts)
    assert torch.equal(first.boundaries["hand"].index, gripped)
    make_sheet(4, effects={"bending": bending})  # the same mesh
    make_sheet(7, effects={"bending": copy.deepcopy(bending)})
    del first
    gc.collect()
    make_sheet(7, boundaries={"hand": hand})  # nobody's any more


def test_a_cloth_has_one_precision():
    torch.set_default_dtype(torch.float32)
    wide = torch.full((18,), 1e5, dtype=torch.float64)
    cloth = tc.Cloth(
        make_sheet().mesh, tc.materials.AEP(wide, 0.3), 0.2, {"air": tc.effects.AirDrag(wide / 1e5)}, contact=None
    )
    for cloth.engine in ("reference", "fused"):
        assert cloth(cloth.rest_state(), times=(0.0, 1e-3)).x.dtype == torch.float32


def test_a_law_on_two_solids_survives_sensitivities():
    rubber = tc.boundaries.Coulomb(0.3)
    solids = {"table": tc.boundaries.Plane(friction=rubber), "ball": tc.boundaries.Sphere(0.1, friction=rubber)}
    cloth = make_sheet(effects={"gravity": tc.effects.Gravity()}, boundaries=solids)
    along = tc.Directions({"boundaries.table.friction.raw": torch.tensor([1.0, 2.0])})
    cloth.sensitivities(cloth.rest_state(), {}, (0.0, 0.01), along=along)
    assert isinstance(rubber.raw, torch.nn.Parameter)
    assert rubber.raw.shape == ()


def test_gradients_of_a_bodys_numbers_under_functional_call():
    """By recomputation, after ``functional_call`` has put the module's own back."""
    ball = tc.boundaries.Sphere(0.5, (0.1, 0.1, -0.5005), friction=0.3)
    cloth = make_sheet(7, effects={"gravity": tc.effects.Gravity()}, boundaries={"ball": ball}, Y=1.0)
    cloth.engine = "reference"
    state = cloth.state(cloth.rest_state().x, torch.tensor([0.3, 0.1, -0.1]).expand(49, 3))
    raw, slopes = torch.tensor(0.02, requires_grad=True), []
    for checkpoint in (True, False):
        entries, options = {"boundaries.ball.friction.raw": raw}, {"checkpoint": checkpoint}
        x = functional_call(cloth, entries, (state, {}, (0.0, 0.05)), options).x[-1]
        slopes.append(torch.autograd.grad(x.square().sum(), raw)[0])
    assert float(slopes[1]) != 0.0
    torch.testing.assert_close(slopes[0], slopes[1])


class Pull(tc.effects.AbstractEffect):
    """A user's."""

    def __init__(self):
        super().__init__()
        self.strength = tc.PhysicalParameter(0.05, "N", "nonnegative", name="pull")

    def coefficients(self):
        return self.strength.field

    def force(self, c, inputs):
        return c * torch.stack([inputs.v[..., 1], torch.sin(inputs.x[..., 2]), -inputs.v[..., 0]], dim=-1)


@pytest.mark.parametrize("engine", ["reference", "fused"])
def test_gradients_are_those_of_the_values_that_were_simulated(engine):
    """A sweep, and one backward pass at its end: what is computed again must not take the last values for the first."""
    ball = tc.boundaries.Sphere(0.5, (0.1, 0.1, -0.5005), friction=0.3)
    cloth = make_sheet(
        7, effects={"damping": tc.effects.MassDamping(0.5), "pull": Pull()}, boundaries={"ball": ball}, Y=1.0
    )
    cloth.engine = engine
    ball.radius.requires_grad_()
    raw = [n.raw for n in (cloth.effects["pull"].strength, cloth.effects["damping"].rate, ball.friction, ball.radius)]
    state = cloth.state(cloth.rest_state().x, torch.tensor([0.3, 0.1, -0.1]).expand(49, 3))

    def loss(scale):
        with torch.no_grad():
            for parameter, value in zip(raw, first, strict=True):
                parameter.copy_(scale * value)
        return cloth(state, {}, (0.0, 0.05)).x[-1].square().sum()

    first = [parameter.detach().clone() for parameter in raw]
    each = [torch.autograd.grad(loss(scale), raw) for scale in (1.0, 1.2)]
    together = torch.autograd.grad(sum(loss(scale) for scale in (1.0, 1.2)), raw)
    for sum_of, (one, two) in zip(together, zip(*each, strict=True), strict=True):
        assert float(one.norm()) > 0
        assert not torch.allclose(one, two, rtol=1e-3)
        torch.testing.assert_close(sum_of, one + two, rtol=1e-9, atol=0)


def test_a_body_that_is_held_elsewhere_later_is_computed_again_where_it_was():
    hand = tc.boundaries.Grasp([0])
    cloth = make_sheet(boundaries={"hand": hand})
    cloth.engine = "reference"
    path = torch.eye(4).repeat(2, 1, 1)
    path[1, 2, 3] = 0.01
    motion = {"hand": tc.Trajectory(torch.tensor([0.0, 0.01]), path, torch.ones(2, dtype=torch.bool))}
    stiffness, slopes = cloth.material.youngs_modulus.raw, []
    for later in (False, True):
        hand.index = torch.tensor([0])
        x = cloth(cloth.rest_state(), motion, (0.0, 0.01)).x[-1]
        if later:
            hand.index = torch.tensor([5])
        slopes.append(torch.autograd.grad(x.square().sum(), stiffness)[0])
    torch.testing.assert_close(*slopes, rtol=1e-9, atol=0)


@pytest.mark.parametrize(
    "part",
    [
        lambda: (tc.materials.OrthotropicAEP(1e6, 1e4, 4e3, 0.01), {}),
        lambda: (tc.materials.AEP(1e5, 0.3), {"shrunk": tc.effects.RestShape(0.03)}),
        lambda: (tc.materials.AEP(1e5, 0.3), {"bending": tc.effects.Bending(1e-3, weft_ratio=0.5)}),
        lambda: (tc.materials.AEP(1e5, 0.3), {"friction": tc.effects.ShearFriction(1.0)}),
    ],
)
def test_axes_need_a_pattern(part):
    """Without one each triangle has its own."""
    mesh = tc.meshes.rectangle(0.2, 0.1, resolution=(5, 3))
    material, effects = part()
    with pytest.raises(InvalidInput, match="no pattern coordinates; expected uv"):
        tc.Cloth(tc.meshes.Mesh.build(mesh.vertices, mesh.faces), material, 0.2, effects)
    tc.Cloth(mesh, material, 0.2, effects)


@pytest.mark.parametrize(
    ("what", "given", "got"),
    [
        ("mesh", None, "NoneType"),
        ("material", tc.materials.AEP, "the class AEP"),
        ("effects", [tc.effects.Gravity()], "list"),
        ("effects", {"air": 3}, "int"),
        ("effects", {"table": tc.boundaries.Plane()}, "Plane"),
        ("boundaries", {"gravity": tc.effects.Gravity()}, "Gravity"),
        ("contact", "fine", "str"),
        ("areal_density", torch.tensor(0.2 + 0.1j), "complex numbers"),
        ("areal_density", torch.zeros(0, 1), "none"),
    ],
)
def test_what_is_no_part_is_refused(what, given, got):
    parts = {"mesh": make_sheet().mesh, "material": tc.materials.AEP(1e5, 0.3), "areal_density": 0.2}
    with pytest.raises(InvalidInput, match=f"^{what}.*got {got}"):
        tc.Cloth(**(parts | {what: given}))


def test_no_scenes_are_no_state():
    with pytest.raises(InvalidInput, match=r"^x; got shape \(0, 9, 3\)"):
        make_sheet(3).state(torch.zeros(0, 9, 3))


def test_a_copy_that_a_simulation_works_with_owns_nothing():
    hand = tc.boundaries.Grasp.corner("upper-right", radius=1e-3)
    cloth = make_sheet(boundaries={"hand": hand})
    shallow_clone_module(cloth)
    gc.collect()
    with pytest.raises(InvalidInput, match="an effect or boundary of another cloth"):
        make_sheet(7, boundaries={"hand": hand})


def test_what_two_cloths_share_is_of_both():
    hand = tc.boundaries.Grasp.corner("upper-right", radius=1e-3)
    first, second = (make_sheet(boundaries={"hand": hand}) for _ in range(2))
    del second
    gc.collect()
    with pytest.raises(InvalidInput, match="an effect or boundary of another cloth"):
        make_sheet(7, boundaries={"hand": hand})
    assert first.boundaries["hand"] is hand


def test_an_effect_by_the_name_of_material_hides_no_law_with_axes():
    mesh = tc.meshes.Mesh.build([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    law = tc.materials.OrthotropicAEP(2e5, 1e5, 1e4)
    with pytest.raises(InvalidInput, match=r"no pattern coordinates.*for 'material'"):
        tc.Cloth(mesh, law, 0.2, {"material": tc.effects.MassDamping(1.0)}, contact=None)


class Named(Pull):
    """With coefficients that have names."""

    def coefficients(self):
        return {"k": self.strength.field}

    def force(self, c, inputs):
        return super().force(c["k"], inputs)


@pytest.mark.parametrize("kind", [Pull, Named])
def test_scenes_differ_in_a_users_own_coefficients(kind):
    pull = kind()
    pull.strength = tc.PhysicalParameter([[0.05], [0.1]], "N", "nonnegative", name="pull")
    cloth = make_sheet(effects={"pull": pull})
    v = torch.tensor([0.3, 0.1, -0.1]).expand(16, 3)
    result = cloth(cloth.state(cloth.rest_state().x, v), times=(0.0, 0.01)).x
    assert result.shape == (2, 2, 16, 3)
    assert not torch.equal(result[0], result[1])


def test_contact_is_kept_as_it_was_made():
    """What simulates is its grid: another value would be believed by fits alone."""
    cloth = make_sheet(contact=tc.Contact())
    with pytest.raises(AttributeError):
        cloth.contact = None
    assert cloth.contact == tc.Contact()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: make_sheet().state(None), r"x; got None; expected a tensor or an array"),
        (lambda: make_sheet().state([[1.0], [1.0, 2.0]]), r"x; got .*; expected a tensor or an array"),
        (lambda: make_sheet()(make_sheet().rest_state(), {1: 0, "hand": 0}), r"motion; got trajectories for"),
        (lambda: tc.boundaries.Sphere(torch.ones(2)), r"radius; got shape \(2,\); expected a scalar or \[B, 1\]"),
        (lambda: tc.boundaries.Box((1.0, 1.0, 1.0), pose="x"), r"pose; got"),
        (lambda: tc.materials.AEP(1e5, thickness=torch.full((18,), 1e-3)), r"thickness; got"),
        (lambda: make_sheet(contact=tc.Contact(subdivisions=float("nan"))), r"contact subdivisions; got nan"),
        (lambda: tc.effects.ResidualForce(["drag"]), r"terms; got \['drag'\]; expected a dict"),
    ],
)
def test_what_is_no_part_is_one_line(make, said):
    with pytest.raises(InvalidInput, match=said):
        make()
