"""Parts that are assigned, copied or removed later pass the same checks as in the constructor."""

import copy
import math
import pickle

import pytest
import torch

import torchcloth as tc
from torchcloth.errors import InvalidInput, UnstableStep
from torchcloth.meshes import Mesh

MESH = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))


def cloth(gripped=True, **parts):
    hands = {"hand": tc.boundaries.Grasp.corner("upper-left")} if gripped else {}
    return tc.Cloth(MESH, tc.materials.AEP(1e4), 0.2, parts, hands, contact=None)


@pytest.mark.parametrize("again", [copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))])
def test_a_copy_owns_its_parts(again):
    """Bound to another mesh they would hold other vertices there, and here."""
    twin = again(cloth(bending=tc.effects.Bending(1e-5)))
    other = tc.meshes.rectangle(0.4, 0.4, resolution=(4, 4))
    for kind, name in (("boundaries", "hand"), ("effects", "bending")):
        with pytest.raises(InvalidInput, match="of another cloth, bound to its mesh"):
            tc.Cloth(other, tc.materials.AEP(1e4), 0.2, **{kind: {name: getattr(twin, kind)[name]}}, contact=None)


def test_places_are_part_of_a_mesh():
    here, there = (Mesh.build(MESH.vertices, MESH.faces, MESH.uv, places={"tip": [k]}) for k in (0, 5))
    assert not here.is_equal(there)
    assert here.is_equal(Mesh.build(MESH.vertices, MESH.faces, MESH.uv, places={"tip": [0]}))
    assert not here.is_equal(MESH)
    first = tc.Cloth(here, tc.materials.AEP(1e4), 0.2, {}, {"hand": tc.boundaries.Grasp.at("tip", 0.0)})
    with pytest.raises(InvalidInput, match="of another cloth"):
        tc.Cloth(there, tc.materials.AEP(1e4), 0.2, {}, dict(first.boundaries.items()))


def test_an_effect_of_a_grip_that_is_not_there_does_not_pass_unnoticed():
    late = cloth(gripped=False)
    late.effects["slip"] = tc.effects.GripSlip("hnad")
    with pytest.raises(InvalidInput, match="grasp of effect 'slip'; got 'hnad'"):
        late(late.rest_state(), times=[0.0, 0.01])


def test_a_woven_material_needs_directions_later_too():
    bare = tc.Cloth(Mesh.build(MESH.vertices, MESH.faces), tc.materials.AEP(1e4), 0.2, contact=None)
    bare.material = tc.materials.OrthotropicAEP(1e4, 2e4, 3e3, 0.2)
    with pytest.raises(InvalidInput, match="no pattern coordinates"):
        bare(bare.rest_state(), times=[0.0, 0.01])


def test_who_still_moves_is_not_hidden_by_a_hundred_that_do_not():
    parameter = cloth(gripped=False)
    x = parameter.rest_state().x.expand(100, -1, -1).clone()
    v = torch.zeros_like(x)
    v[3, :, 2] = 0.5
    with pytest.warns(UserWarning, match="still moves"):
        parameter.settle(parameter.state(x, v), duration=0.01)


def test_settling_that_would_never_end_is_refused():
    parameter = cloth(gripped=False)
    with pytest.raises(UnstableStep, match="substeps"):
        parameter.settle(parameter.rest_state(), duration=1.0, rate=1e12)


def test_the_longest_piece_counts():
    """A short piece before a long one that lies folded."""
    short, long = tc.meshes.rectangle(0.1, 0.1, resolution=(3, 3)), tc.meshes.rectangle(1.0, 0.1, resolution=(21, 3))
    folded = long.vertices.copy()
    folded[:, 0] = abs((folded[:, 0] + 0.1) % 0.4 - 0.2)
    faces = torch.cat([torch.as_tensor(short.faces), torch.as_tensor(long.faces) + len(short.vertices)]).numpy()
    both = torch.cat([torch.as_tensor(short.vertices), torch.as_tensor(folded) + torch.tensor([0.5, 0.0, 0.0])]).numpy()
    uv = torch.cat([torch.as_tensor(short.uv), torch.as_tensor(long.uv) + torch.tensor([0.5, 0.0])]).numpy()
    mesh = Mesh.build(both, faces, uv)
    assert mesh.piece_count == 2
    assert mesh.extent == pytest.approx(long.extent)
    assert mesh.extent > 0.99


def test_a_value_is_as_precise_as_what_stores_it():
    torch.set_default_dtype(torch.float32)
    parameter = cloth().double()
    parameter.material.youngs_modulus.set(5e4)
    assert float(parameter.material.youngs_modulus.raw.detach()) == math.log(5e4)
