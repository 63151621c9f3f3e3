"""Layers of cloth on each other: gap, search for near layers, collision, friction."""

import math
import warnings

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import torchcloth as tc
from torchcloth.dynamics.contact import REST_GAP_SPACINGS, compression_at, layer_pressure, self_contact
from torchcloth.dynamics.contact.neighbours import find_overlapping_triangles
from torchcloth.training.validation.verification.contact import press_layers  # pyright: ignore[reportMissingImports]

SPACING, STIFFNESS, DENSITY = 0.01, 100.0, 0.15  # m, k h [N/m], kg/m^2


def layers(height, *, upper=(0.04, 3), contact=None, cone=0.3, stiffness=STIFFNESS, effects=None, angle=0.2):
    """(a small sheet above a held one of 0.1 m as one cloth, its vertices)."""
    below, above = (
        tc.meshes.rectangle(0.1, 0.1, resolution=(5, 5)),
        tc.meshes.rectangle(upper[0], upper[0], resolution=(upper[1],) * 2),
    )
    count = len(below.vertices)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    vertices = np.concatenate([below.vertices, above.vertices @ turn.T + np.array([0.02, 0.03, height])])
    uv = np.concatenate([below.uv, above.uv + np.array([1.0, 0.0])])
    mesh = tc.meshes.Mesh.build(vertices, np.concatenate([below.faces, above.faces + count]), uv)
    material = tc.materials.AEP(1e5, 0.3, contact_stiffness=1e3 * stiffness, shear_stiffness=1e3 * stiffness, cone=cone)
    effects = {"bending": tc.effects.Bending(1e-4, 0.005), **(effects or {})}
    contact = contact or tc.Contact(spacing=SPACING)
    return tc.Cloth(mesh, material, DENSITY, effects, {"pin": tc.boundaries.Grasp(range(count))}, contact), slice(
        count, None
    )


def still(duration=9.0):
    return {
        "pin": tc.Trajectory(
            torch.tensor([0.0, duration]), torch.eye(4).repeat(2, 1, 1), torch.ones(2, dtype=torch.bool)
        )
    }


def gravity(angle=0.0):
    return {"gravity": tc.effects.Gravity((9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle)))}


@torch.no_grad()
def test_a_sheet_alone_needs_no_grid():
    """No triangle of a sheet that is moderately bent takes part, and the motion is bitwise that without contact."""
    torch.manual_seed(0)
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(9, 9))
    runs = []
    for contact in (None, tc.Contact(spacing=0.02)):
        parts = (mesh, tc.materials.AEP(1e5, 0.3, contact_stiffness=1e4), DENSITY, {"gravity": tc.effects.Gravity()})
        cloth = tc.Cloth(*parts, contact=contact, engine="reference")
        x = torch.as_tensor(mesh.vertices).clone()
        x[:, 2] = 0.03 * torch.sin(20 * x[:, 0])
        runs.append(cloth(cloth.state(x), times=[0.0, 0.02], dt=1e-4))
    assert torch.equal(runs[0].x, runs[1].x)
    assert (
        len(self_contact.find_contact_candidates(cloth.build_model(), cloth.build_model().grid, runs[1].x[-1]).active)
        == 0
    )


@torch.no_grad()
def test_only_triangles_near_another_layer_take_part():
    """Folded in half: all but those at the sharp crease; half unrolled: about half of them."""
    mesh = tc.meshes.rectangle(0.4, 0.1, resolution=(41, 11))
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), DENSITY, contact=tc.Contact(spacing=0.01))
    model, flat = cloth.build_model(), torch.as_tensor(mesh.vertices)

    def folded(at):
        x = flat.clone()
        over = x[:, 0] > at
        x[over, 0] = 2 * at - x[over, 0]
        x[over, 2] = 0.014
        return x

    share = [
        len(self_contact.find_contact_candidates(model, model.grid, folded(at)).active) / len(mesh.faces)
        for at in (0.2, 0.3)
    ]
    assert 0.9 < share[0] < 1.0
    assert 0.45 < share[1] < 0.75


@torch.no_grad()
def test_layers_are_found_as_well_far_from_the_origin():
    """Float32 at 60 m has 4 micrometres between numbers; squares of 60 m have none for a gap of millimetres."""
    mesh = tc.meshes.rectangle(0.4, 0.1, resolution=(41, 11))
    cloth = tc.Cloth(mesh, tc.materials.AEP(1e5), DENSITY, contact=tc.Contact(spacing=0.005)).float()
    x, model = torch.as_tensor(mesh.vertices).float(), cloth.build_model()
    x[x[:, 0] > 0.2, 0] = 0.4 - x[x[:, 0] > 0.2, 0]
    x[torch.arange(len(x)) % 41 > 20, 2] = 0.006
    result = []
    for away in (0.0, 60.0):
        there = x + torch.tensor([away, -away, 0.5 * away]).float()
        layers = self_contact.find_contact_candidates(model, model.grid, there)
        result.append((len(layers.active), self_contact.initial_directors(model, model.grid, there)))
    assert result[0][0] == pytest.approx(result[1][0], abs=4)
    assert result[0][0] > 300
    torch.testing.assert_close(result[0][1], result[1][1], rtol=0, atol=0.01)


@torch.no_grad()
@pytest.mark.parametrize(
    ("speed", "stiffness"),
    [(2.0, 100.0), pytest.param(0.3, 20.0, marks=pytest.mark.slow), pytest.param(2.0, 1000.0, marks=pytest.mark.slow)],
)
def test_layers_come_to_rest_at_the_stated_gap(speed, stiffness):
    """Dropped: never through (2 m/s), at rest at GAP spacings within 15 %, and not sinking any more."""
    cloth, upper = layers(
        2.6 * SPACING, stiffness=stiffness, effects={**gravity(), "drag": tc.effects.MassDamping(8.0)}
    )
    v = torch.zeros(len(cloth.mesh.vertices), 3)
    v[upper, 2] = -speed
    out = cloth(cloth.state(cloth.rest_state().x, v), still(), times=torch.linspace(0, 0.3, 7))
    height = out.x[:, upper, 2] / SPACING
    assert float(height.min()) > 0.5
    assert float(height[-1].mean()) == pytest.approx(REST_GAP_SPACINGS, rel=0.15)
    assert float((height[-1] - height[-2]).mean().abs()) < 0.02


@pytest.mark.parametrize(("is_turned", "tolerance"), [(False, 0.04), (True, 0.1)])
def test_layers_press_as_the_closed_form_says_wherever_they_lie_in_the_grid(is_turned, tolerance):
    """Held layers that come together: compression and pressure are the same at all places and in all attitudes."""
    rng, gaps = np.random.default_rng(0), np.array([0.8, 0.8, 1.1, 1.1])
    for gap, expected in zip(gaps, layer_pressure(gaps, tc.Contact().free_compression), strict=True):
        turn = Rotation.random(None, rng) if is_turned else Rotation.identity()
        compression, pressure = press_layers(gap, rng.uniform(size=3), turn)
        assert compression == pytest.approx(float(compression_at(torch.tensor(gap))), abs=0.01)
        assert pressure == pytest.approx(expected, rel=tolerance)


@torch.no_grad()
@pytest.mark.parametrize("start", [1.4, pytest.param(1.0, marks=pytest.mark.slow)])
def test_layers_that_start_near_stay_there(start):
    """A garment laid flat must not collapse by the play when time begins: it sinks by less than a tenth of the gap."""
    cloth, upper = layers(start * SPACING, effects={**gravity(), "drag": tc.effects.MassDamping(20.0)})
    out = cloth(cloth.rest_state(), still(), times=[0.0, 0.2])
    assert float(out.x[-1, upper, 2].mean()) / SPACING == pytest.approx(start, rel=0.12)


@torch.no_grad()
def test_without_damping_layers_bounce_and_with_it_they_do_not():
    """Contact itself loses no energy; what is lost is the stated damping."""
    back = []
    for damping in (0.0, 0.1):
        contact = tc.Contact(spacing=SPACING, damping=damping)
        cloth, upper = layers(2.6 * SPACING, contact=contact)
        v = torch.zeros(len(cloth.mesh.vertices), 3)
        v[upper, 2] = -0.5
        out = cloth(cloth.state(cloth.rest_state().x, v), still(), times=torch.linspace(0, 0.12, 25))
        back.append(float(out.v[:, upper, 2].mean(-1).max()) / 0.5)
    assert back[0] > 0.85
    assert back[1] < 0.6


@torch.no_grad()
def test_momentum_passes_between_layers_without_loss():
    cloth, upper = layers(2.4 * SPACING)
    cloth = tc.Cloth(cloth.mesh, cloth.material, DENSITY, contact=cloth.contact)
    v = torch.zeros(len(cloth.mesh.vertices), 3)
    v[upper] = torch.tensor([0.2, 0.1, -1.0])
    state = cloth.state(cloth.rest_state().x, v)
    mass = cloth.build_model().mass
    out = cloth(state, times=[0.0, 0.03])
    before, after = (mass * state.v).sum(0), (mass * out.v[-1]).sum(0)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-12 * float(mass.sum()))
    turning = [(mass * torch.linalg.cross(x, v)).sum(0) for x, v in ((state.x, state.v), (out.x[-1], out.v[-1]))]
    torch.testing.assert_close(turning[1], turning[0], rtol=0, atol=1e-10 * float(turning[0].norm()))
    assert float((mass * out.v[-1])[: upper.start].sum(0).norm()) > 0.1 * float(before.norm())  # they did collide


@torch.no_grad()
@pytest.mark.parametrize(("slope", "cone"), [(0.2, 0.3), (0.5, 0.3), pytest.param(0.5, 0.6, marks=pytest.mark.slow)])
def test_layers_slide_by_the_cone(slope, cone):
    """Rest, then tilt: below arctan c_F the upper layer stays, above it slides with g (sin - c_F cos), 10 %."""
    angle = math.atan(slope)
    flat, upper = layers(1.45 * SPACING, cone=cone, effects=gravity(), angle=0.0)
    tilted, _ = layers(1.45 * SPACING, cone=cone, effects=gravity(angle), angle=0.0)
    rest = flat.settle(flat.rest_state(), still(), duration=0.12, rate=50.0)
    out = tilted(rest, still(), times=torch.linspace(0, 0.12, 5))
    if slope < cone:
        assert float((out.x[-1] - out.x[0])[upper, 0].mean().abs()) < 5e-4
        return
    speed = out.v[:, upper, 0].mean(-1)
    acceleration = float((speed[-1] - speed[1]) / (out.t[-1] - out.t[1]))
    assert acceleration == pytest.approx(9.81 * (math.sin(angle) - cone * math.cos(angle)), rel=0.1)


@torch.no_grad()
def test_scenes_of_a_batch_do_not_meet():
    """A batch in which one scene's layers touch and the other's do not equals the two alone."""
    cloth, upper = layers(1.6 * SPACING, effects=gravity())
    x = torch.stack([cloth.rest_state().x] * 2)
    x[1, upper, 2] += 0.2
    v = torch.zeros_like(x)
    v[:, upper, 2] = -1.0
    times = [0.0, 0.02]
    together = cloth(cloth.state(x, v), still(), times).x
    for k in range(2):
        torch.testing.assert_close(together[k], cloth(cloth.state(x[k], v[k]), still(), times).x, rtol=0, atol=1e-12)


@torch.no_grad()
def test_the_search_is_repeated_in_time():
    """A fall through many grid spacings in one call, from far beyond the reach."""
    cloth, upper = layers(0.12, contact=tc.Contact(spacing=0.005), stiffness=50.0)
    v = torch.zeros(len(cloth.mesh.vertices), 3)
    v[upper, 2] = -2.0
    model, state = cloth.build_model(), cloth.state(cloth.rest_state().x, v)
    assert len(self_contact.find_contact_candidates(model, model.grid, state.x).active) == 0
    out = cloth(state, still(), times=[0.0, 0.08])
    assert float(out.x[-1, upper, 2].min()) > 0.0


def test_wrong_contact_is_refused():
    for wrong in ({"damping": -1.0}, {"free_compression": 0.9}):
        with pytest.raises(tc.errors.InvalidInput):
            tc.Contact(**wrong)
    with pytest.raises(tc.errors.InvalidInput):
        layers(0.02, contact=tc.Contact(spacing=0.002, subdivisions=1))
    assert tc.Contact.with_gap(0.005).spacing == pytest.approx(0.005 / REST_GAP_SPACINGS)


@pytest.mark.parametrize("cell", [0.03, 0.06])
def test_large_cells_of_an_uneven_mesh_have_no_holes(cell):
    """Points were laid by the mean edge alone: a small sheet fell through cells of 30 mm beside fine ones."""
    ys = np.concatenate([np.arange(0.0, 0.021, 0.005), 0.02 + cell * np.arange(1, round(0.06 / cell) + 1)])
    xs = np.concatenate([np.arange(0.0, 0.061, 0.005), 0.06 + cell * np.arange(1, round(0.09 / cell) + 1)])
    u, v = np.meshgrid(xs, ys, indexing="ij")
    first = (np.arange(len(xs) - 1)[:, None] * len(ys) + np.arange(len(ys) - 1)).ravel()
    a, b, c, d = first, first + len(ys), first + len(ys) + 1, first + 1
    below = np.stack([u.ravel(), v.ravel(), 0 * u.ravel()], -1)
    upper, count = tc.meshes.rectangle(0.03, 0.03, resolution=(4, 4)), len(below)
    mesh = tc.meshes.Mesh.build(
        np.concatenate([below, upper.vertices + np.array([0.085, 0.035, 0.03])]),
        np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1), upper.faces + count]),
        np.concatenate([below[:, :2], upper.uv + np.array([1.0, 0.0])]),
    )
    material = tc.materials.AEP(1e5, 0.3, contact_stiffness=1e3 * STIFFNESS, shear_stiffness=1e3 * STIFFNESS)
    effects, pin = gravity() | {"damping": tc.effects.MassDamping(8.0)}, {"pin": tc.boundaries.Grasp(range(count))}
    cloth = tc.Cloth(mesh, material, DENSITY, effects, pin, tc.Contact(spacing=SPACING))
    with torch.no_grad():
        end = cloth(cloth.rest_state(), still(), times=[0.0, 0.2]).x[-1, count:, 2]
    assert float(end.min()) > 0.01


@pytest.mark.parametrize(("contact", "reported"), [(tc.Contact(), True), (tc.Contact.with_gap(0.01), False)])
def test_layers_that_do_not_meet_are_told(contact, reported):
    """A shirt on a grid as coarse as its mesh: the way round its seams is too short for the layers to be any."""
    mesh = tc.meshes.shirt(triangles=2000 if not reported else 300)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3, contact_stiffness=5e4), DENSITY, contact=contact)
        tc.Cloth(tc.meshes.rectangle(0.3, 0.3, resolution=(9, 9)), tc.materials.AEP(1e5), DENSITY)
    texts = [str(w.message) for w in said]
    assert len(texts) == reported
    assert all("lie over another layer do not see it" in text for text in texts)


def test_layers_too_weak_to_carry_the_cloth_are_told():
    """Reported: in AEP(5e4, 0.3, 1e-3) the third number was the contact stiffness, not the thickness."""
    mesh, contact = tc.meshes.rectangle(0.3, 0.3, resolution=(9, 9)), tc.Contact(spacing=0.02)
    with pytest.raises(TypeError, match="positional"):
        tc.materials.AEP(5e4, 0.3, 1e-3)
    with pytest.warns(UserWarning, match=r"k h of 1e-06 N/m cannot carry the cloth's weight of 1.96 Pa, .* 1.1 N/m"):
        tc.Cloth(mesh, tc.materials.AEP(5e4, contact_stiffness=1e-3), 0.2, contact=contact)
    tc.Cloth(mesh, tc.materials.AEP(5e4, contact_stiffness=1.2e3), 0.2, contact=contact)
    tc.Cloth(mesh, tc.materials.AEP(5e4, contact_stiffness=1e-3), 0.2, contact=None)


@pytest.mark.parametrize(("triangles", "acts"), [(200, False), (450, True)])
def test_contact_that_cannot_act_is_off_by_default(triangles, acts):
    """Reported: on 200 triangles layers would have rested 47.8 mm apart, for a step 3.2 times shorter."""
    mesh, material = tc.meshes.rectangle(0.3, 0.3, triangles=triangles), tc.materials.AEP(1e5)
    cloth, without, asked = (
        tc.Cloth(mesh, material, 0.2, **c) for c in ({}, {"contact": None}, {"contact": tc.Contact()})
    )
    assert (cloth.contact == tc.Contact()) is acts
    assert cloth.stable_step() == (asked if acts else without).stable_step()
    assert asked.stable_step() < 0.5 * without.stable_step()
    assert ("contact: none, as the mesh is too coarse (layers rest 47.8 mm apart" in str(cloth)) is not acts


def test_a_garment_too_coarse_for_contact_is_told():
    with pytest.warns(UserWarning, match=r"layers pass through each other, as the mesh is too coarse .*with_gap"):
        tc.Cloth(tc.meshes.shirt(triangles=300), tc.materials.AEP(1e5), 0.2)


def test_contact_that_costs_a_hundred_times_as_much_is_told():
    mesh = tc.meshes.rectangle(0.5, 0.5, resolution=(21, 21))
    with pytest.warns(UserWarning, match=r"edges of some 28.5 mm take 64 points in each triangle near another layer"):
        tc.Cloth(mesh, tc.materials.AEP(1e5), DENSITY, contact=tc.Contact.with_gap(0.004))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tc.Cloth(mesh, tc.materials.AEP(1e5), DENSITY, contact=tc.Contact.with_gap(0.01))


def test_what_lies_over_what():
    """Two sheets 1 cm apart, each of whose triangles has some of the other over it; none of its own."""
    cloth, _ = layers(0.01)
    result = find_overlapping_triangles(cloth.mesh, 0.02)
    assert len(result)
    assert ((result[:, 0] < 32) != (result[:, 1] < 32)).all()
    assert not len(find_overlapping_triangles(cloth.mesh, 0.005))
    bent = tc.meshes.rectangle(0.3, 0.3, resolution=(20, 20))
    vertices = bent.vertices.copy()
    vertices[:, 2] = 0.05 * np.sin(20 * vertices[:, 0])
    assert not len(find_overlapping_triangles(tc.meshes.Mesh.build(vertices, bent.faces, bent.uv), 0.03))
