"""Meshes whose gripped patches end between vertices."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import sheet_episodes

from torchcloth import diagnosis as dx
from torchcloth import recordings as rec
from torchcloth.boundaries import Grasp
from torchcloth.cloth import Cloth
from torchcloth.diagnosis.data.dataset import prepare_data
from torchcloth.episodes.grip_patch_mesh import (
    MAX_GROWTH_RADII,
    MAX_SHRINKAGE_RADII,
    grip_extent_range,
    grip_patches,
    move_grip_patches,
    stretch_around_grips,
)
from torchcloth.episodes.observed import build_episode
from torchcloth.episodes.pattern_interpolation import move_vertices_to_patches
from torchcloth.episodes.replay import Frames
from torchcloth.errors import InvalidInput
from torchcloth.identification.uncertainty.richardson import refine_cloth
from torchcloth.materials import AEP
from torchcloth.meshes import rectangle
from torchcloth.meshes.patches import Patch

RADIUS = 0.051  # m, of sheets.py: 1.5 edges of the mesh


@pytest.fixture(scope="module")
def made():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    blank = sheet_episodes.make_episode()
    model = dx.build_base_model(blank)
    yield model, prepare_data(model, [blank]).episodes[0], blank
    torch.set_default_dtype(before)


def held(world, name):
    return world.cloth.mesh.uv[world.cloth.boundaries[name].index.numpy()]


@pytest.mark.parametrize("along", [-0.012, 0.007])
def test_the_edge_of_a_patch_goes_along_and_the_outline_stays(made, along):
    world = made[0].build_world()
    moved, before = move_grip_patches(world, along=along), world.cloth.mesh
    after = moved.cloth.mesh
    for name in ("left", "right"):
        assert torch.equal(moved.cloth.boundaries[name].index, world.cloth.boundaries[name].index)
    reach = lambda w: (held(w, "left")[:, 0].max(), held(w, "right")[:, 0].min())  # noqa: E731
    shift = np.subtract(reach(moved), reach(world))
    np.testing.assert_allclose(shift, along * held(world, "left")[:, 0].max() / RADIUS)  # in proportion, from the rim
    np.testing.assert_array_equal(held(moved, "left")[:, 1], held(world, "left")[:, 1])
    assert after.area.sum() == pytest.approx(before.area.sum(), rel=1e-12)
    assert after.area.min() > 0.4 * before.area.min()
    np.testing.assert_allclose(after.vertices[:, :2], after.uv, atol=1e-10)


def test_a_wider_patch_grows_on_all_sides_and_the_next_grows_from_there(made):
    world = made[0].build_world()
    wider = move_grip_patches(world, wider=0.01)
    far = lambda w: np.linalg.norm(held(w, "left") - [0.0, sheet_episodes.SIDE_M], axis=1)  # noqa: E731
    np.testing.assert_allclose(far(wider), far(world) * (RADIUS + 0.01) / RADIUS)
    both = move_grip_patches(wider, wider=0.01)
    np.testing.assert_allclose(far(both), far(world) * (RADIUS + 0.02) / RADIUS)
    assert both.cloth.boundaries["left"].radius == pytest.approx(RADIUS + 0.02)


def test_little_does_little_and_twice_as_much_twice_as_much(made):
    """Whole vertices would do nothing, and then all at once."""
    model, e, blank = made
    by = {h.name: h for h in dx.list_hypotheses(model, [blank])}
    base = model.build_world().simulate_observed(e).x
    for name in ("grip.width", "robot.regrasp"):
        moved = [
            float((model.build_world([(by[name], a)]).simulate_observed(e).x - base).norm()) for a in (1e-4, 1e-3, 2e-3)
        ]
        assert moved[0] > 1e-6
        assert moved[1] / moved[0] == pytest.approx(10.0, rel=0.2)
        assert moved[2] / moved[1] == pytest.approx(2.0, rel=0.2)


def test_nobody_sees_another_mesh(made):
    """A first shape that goes to the other mesh and comes back is what it was, if it is as smooth as a parabola."""
    world, e = made[0].build_world(), made[1]
    u, v = torch.as_tensor(world.cloth.mesh.uv).T
    shape = torch.stack([u - u * u, 3 * u * v, v + 2 * v * v], 1)
    other = move_grip_patches(world, wider=0.01, along=0.005)
    there = other.apply_motion(replace(e, initial=shape)).initial
    assert float((there - shape).norm(dim=1).max()) > 5e-3
    still = Frames(there[None], 2 * there[None], {}, torch.zeros(1))
    seen = other.observe(still, e)
    torch.testing.assert_close(seen.x[0], shape, atol=1e-8, rtol=0)
    torch.testing.assert_close(seen.v[0], 2 * shape, atol=1e-8, rtol=0)


def test_a_model_of_an_episode_starts_where_the_episode_says(made, tmp_path):
    model, _, blank = made
    by = {h.name: h for h in dx.list_hypotheses(model, [blank])}
    path = dx.save_model(tmp_path / "held.tcm", model.with_hypothesis(by["robot.regrasp"], 0.008), blank)
    cloth = dx.load_cloth_for(path, blank)
    first = build_episode(cloth, blank).initial
    u, bulge, v = (first - torch.tensor([0.0, 0.0, 1.0])).T.numpy()
    np.testing.assert_allclose(np.stack([u, v], 1), cloth.mesh.uv, atol=1e-6)
    np.testing.assert_allclose(bulge, 0.01 * np.sin(8 * cloth.mesh.uv[:, 0]), atol=1e-4)
    seen = sheet_episodes.record_changed_world("fast", lambda world: world, 3)
    found = dx.predict_episode(path, rec.read(rec.write(seen, tmp_path / "fast")))
    world = dx.load_world(path)
    torch.testing.assert_close(found.frames.x, world.simulate_observed(build_episode(model.base.cloth, seen)).x)


def test_grips_without_a_place_and_patterns_without_room(made):
    world = made[0].build_world()
    named = world.with_cloth(boundaries={n: Grasp(held.index.tolist()) for n, held in world.cloth.boundaries.items()})
    assert move_grip_patches(named, wider=0.01) is named
    with pytest.raises(InvalidInput, match="150 mm further along; expected as much"):
        move_grip_patches(world, along=0.15)
    with pytest.raises(InvalidInput, match=r"without a place.*given by uv"):
        Grasp([0, 1]).shifted(0.01, 0.0)


def test_a_finer_mesh_has_room_for_the_same_grips():
    """Two grips of 12 mm together, and each alone; small triangles beside a wider patch do not fold."""
    uv = {"left": [0.0, 0.3], "right": [0.3, 0.3]}
    mesh = move_vertices_to_patches(
        rectangle(0.3, 0.3, resolution=(13, 13)), [Patch(np.array([p]), 0.012) for p in uv.values()]
    )
    grasps = {name: Grasp(uv=[place], radius=0.012) for name, place in uv.items()}
    cloth = Cloth(mesh, AEP(youngs_modulus=3e5, thickness=1e-3), areal_density=0.2, boundaries=grasps)
    ends = (-MAX_SHRINKAGE_RADII, MAX_GROWTH_RADII)
    for one in (cloth, refine_cloth(cloth)):
        assert grip_extent_range(one) == pytest.approx(ends)
        for name, patch in grip_patches(one).items():
            for end in ends:
                stretched = stretch_around_grips(one, {name: end * patch.radius}).cloth
                assert stretched.mesh.area.min() > 0.05 * one.mesh.area.min()
