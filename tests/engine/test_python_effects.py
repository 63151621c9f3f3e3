"""A user's effects and materials in Python, together with the engine: exact values, gradients in both modes, memory."""

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from helpers.engine_cloths import check_close, make_opening_motion, make_perturbed_state, make_sheet

import torchcloth as tc
from torchcloth.effects import AbstractEffect, Amplitude
from torchcloth.errors import InvalidInput
from torchcloth.simulation.sensitivities import Directions

END = 0.012
TIMES = (0.0, 0.4 * END, END)


class Pull(AbstractEffect):
    """On vertices, and it is felt in proportion to the speed."""

    amplitudes = {"strength": Amplitude(unit="N", typical=1e-3, smallest=1e-4)}

    def __init__(self, strength=1e-3):
        super().__init__()
        self.strength = tc.PhysicalParameter(strength, "N", "nonnegative", name="pull")

    def coefficients(self):
        return self.strength.field

    def force(self, c, inputs):
        return c * torch.stack([inputs.v[..., 1], torch.sin(inputs.x[..., 2]), -inputs.v[..., 0]], dim=-1)


class Blow(Pull):
    """On triangles."""

    acts_on = "triangles"

    def force(self, c, inputs):
        return c * inputs.surface.n * inputs.surface.J


class Fading(Pull):
    """With a memory."""

    def initial_memory(self, x):
        return torch.zeros_like(x)

    def update_memory(self, c, inputs):
        return inputs.memory + inputs.dt * (inputs.v - 10 * inputs.memory)

    def force(self, c, inputs):
        return -100 * c * inputs.memory


class Ballast(Pull):
    """With a mass."""

    def mass(self, c):
        return c * torch.ones(25, 1, dtype=c.dtype)


class Heavy(Pull):
    """Its inertia goes through the velocities: not from outside."""

    def inertia(self, c, surface):
        return c * surface.area


class Slippery(Pull):
    """It loosens a grasp: not from outside."""

    grasp = "left"

    def grip_velocities(self, c, index, free, held, mass, dt, resistance):
        return held + c * (free - held)


class Softening(tc.materials.AEP):
    """A subclass has a law of its own, whatever it does."""

    def membrane_stress(self, c, surface):
        p1, p2 = super().membrane_stress(c, surface)
        soft = 1 / (1 + (surface.J - 1) ** 2)
        return soft * p1, soft * p2


def cloth_with(engine, part):
    effects = {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2), "bending": tc.effects.Bending(1e-4)}
    if part == "material":
        return make_sheet(engine, effects=effects, material=Softening(1e5, 0.3))
    if part == "both":
        return make_sheet(engine, effects={**effects, "own": Fading(0.02)}, material=Softening(1e5, 0.3))
    return make_sheet(engine, effects={**effects, "own": part(0.02)})


def outcome(engine, part, batch=(), checkpoint=True):
    cloth = cloth_with(engine, part).requires_grad_(True)  # also of facts about the world
    motion = make_opening_motion(END)
    state = make_perturbed_state(cloth, batch)
    pose = motion["left"].pose.clone().requires_grad_()
    x = state.x.clone().requires_grad_()
    motion["left"] = motion["left"]._replace(pose=pose)
    out = cloth(state._replace(x=x), motion, TIMES, checkpoint=checkpoint)
    parts = {"x": out.x, "v": out.v, **out.wrench, **out.state.memory}
    generator = torch.Generator().manual_seed(0)
    loss = sum((torch.randn(p.shape, generator=generator, dtype=p.dtype) * p).sum() for p in parts.values())
    inputs = {"x0": x, "pose": pose, **dict(cloth.named_parameters())}
    grads = torch.autograd.grad(loss, list(inputs.values()), allow_unused=True)
    return parts, dict(zip(inputs, grads, strict=True))


@pytest.mark.parametrize("options", [{}, {"batch": (2,)}, {"checkpoint": False}], ids=str)
@pytest.mark.parametrize("part", [Pull, Blow, Fading, Ballast, "material", "both"])
def test_values_and_gradients_equal_the_reference(part, options):
    parts, grads = outcome("fused", part, **options)
    expected, slopes = outcome("reference", part, **options)
    assert parts.keys() == expected.keys()
    for name, value in parts.items():
        check_close(value, expected[name], 1e-10, name)
    for name, grad in grads.items():
        assert (grad is None) == (slopes[name] is None), name
        if grad is not None:
            check_close(grad, slopes[name], 1e-8, name)


@pytest.mark.parametrize("part", [Fading, "both"])
def test_forward_mode(part):
    """One direction by forward_ad, and several by ``sensitivities``."""
    results = []
    for engine in ("fused", "reference"):
        cloth = cloth_with(engine, part)
        state = make_perturbed_state(cloth)
        torch.manual_seed(0)
        dx = 1e-3 * torch.randn(2, *state.x.shape)
        with torch.no_grad(), forward_ad.dual_level():
            out = cloth(state._replace(x=forward_ad.make_dual(state.x, dx[0])), make_opening_motion(END), TIMES)
            one = forward_ad.unpack_dual(out.x).tangent.clone()
        moved = tc.ClothState(dx, torch.zeros_like(dx), dx[..., :0, :],
                              {name: torch.zeros(2, *m.shape) for name, m in state.memory.items()})  # fmt: skip
        along = Directions({"effects.bending.stiffness.raw": torch.tensor([0.0, 1.0])}, moved)
        _, many = cloth.sensitivities(state, make_opening_motion(END), TIMES, along=along)
        check_close(many.x[0], one, 1e-9, "the same direction")
        results.append((one, many.x, many.wrench["left"]))
    for a, b in zip(*results, strict=True):
        check_close(a, b, 1e-8, "tangent")


def test_print_names_what_torch_computes():
    assert "engine: fused, with effects.own in torch" in str(cloth_with("auto", Pull))
    assert "engine: fused, with effects.own, material in torch" in str(cloth_with("auto", "both"))
    heavy, slippery = (str(cloth_with("auto", part)) for part in (Heavy, Slippery))
    assert "engine: reference (effect 'own' (Heavy), which adds inertia, has no kernels)" in heavy
    assert "engine: reference (effect 'own' (Slippery), which loosens a grasp, has no kernels)" in slippery


@pytest.mark.parametrize("part", [Heavy, Slippery])
def test_hooks_that_reach_into_the_substep_are_left_to_the_reference(part):
    assert torch.equal(outcome("auto", part)[0]["x"], outcome("reference", part)[0]["x"])


def test_settling_and_a_grip_effect():
    """While it settles, grips do not slip: that part can then run on the engine."""
    auto, reference = (cloth_with(engine, Slippery) for engine in ("auto", "reference"))
    a, b = (c.settle(make_perturbed_state(c), make_opening_motion(END), duration=0.01) for c in (auto, reference))
    check_close(a.x, b.x, 1e-10, "x")


def test_memory_is_bounded_by_checkpoints(monkeypatch):
    """Tensors that the graph keeps: about one state for every 48 substeps instead of all of each."""

    def saved_bytes(checkpoint):
        cloth = cloth_with("fused", Pull)
        total = 0

        def pack(tensor):
            nonlocal total
            total += tensor.numel()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
            state = make_perturbed_state(cloth)
            cloth(
                state._replace(x=state.x.requires_grad_()), make_opening_motion(0.1), (0.0, 0.1), checkpoint=checkpoint
            )
        return total

    assert saved_bytes(True) < saved_bytes(False) / 20


class Clumsy(Pull):
    """One row for all."""

    def force(self, c, inputs):
        return c * inputs.v.mean(-2, keepdim=True)


class Misplaced(Blow):
    """Rows of the vertices where those of triangles are due."""

    def force(self, c, inputs):
        return c * inputs.v


@pytest.mark.parametrize("engine", ["reference", "auto"])
@pytest.mark.parametrize("kind", [Clumsy, Misplaced])
def test_a_force_of_another_shape_is_refused_by_name(engine, kind):
    cloth = cloth_with(engine, kind)
    with pytest.raises(tc.errors.InvalidInput, match=r"force of effect 'own'.*a row for each of the"):
        cloth(make_perturbed_state(cloth), make_opening_motion(END), TIMES)


def test_batched_poses_without_gradient_and_their_divergence():
    """Rows of some substeps of a batch are not contiguous."""
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(4, 4))
    t = torch.linspace(0, 0.02, 4)
    pose = torch.eye(4).repeat(3, 4, 1, 1)
    pose[..., 2, 3] = 0.1 * t * torch.arange(1, 4)[:, None]
    motion = {"hand": tc.Trajectory(t, pose, torch.ones(4, dtype=torch.bool))}

    def run(engine, motion):
        effects, hand = {"pull": Pull()}, {"hand": tc.boundaries.Grasp([0, 1])}
        cloth = tc.Cloth(mesh, tc.materials.AEP(1e5, 0.3), 0.2, effects, hand, contact=None, engine=engine)
        with torch.no_grad():
            return cloth(cloth.rest_state(), motion, [0, 0.01, 0.02]).x

    torch.testing.assert_close(run("auto", motion), run("reference", motion))
    pose[1, 2, 2, 3] = 1e200
    with pytest.raises(tc.errors.SimulationDiverged):
        run("auto", motion)


class Even(Pull):
    """On triangles, the same in every scene."""

    acts_on = "triangles"

    def force(self, c, inputs):
        return c * inputs.surface.area / inputs.surface.area.mean() * torch.tensor([1.0, 0.0, 0.0]).to(inputs.x)


def test_a_force_on_triangles_may_be_that_of_all_scenes():
    results = []
    for engine in ("reference", "fused"):
        cloth = make_sheet(effects={"even": Even()}, boundaries={})
        cloth.engine = engine
        state = cloth.state(make_perturbed_state(cloth).x.expand(2, -1, -1).clone())
        results.append(cloth(state, times=(0.0, 0.01)).x)
    check_close(results[1], results[0], 1e-10, "positions")


class Mixing(Pull):
    """Pull by a plain matrix that does not say how many axes it has."""

    def __init__(self, strength=1e-3):
        super().__init__(strength)
        self.matrix = torch.nn.Parameter(torch.eye(3))

    def force(self, c, inputs):
        return 1e-3 * inputs.v @ self.matrix


class Listed(Pull):
    """With coefficients in a list."""

    def coefficients(self):
        return [self.strength.value[..., None, None] * torch.ones(1, 1)]

    def force(self, c, inputs):
        return super().force(c[0], inputs)


def test_a_plain_matrix_has_slopes_of_one_scene_and_is_refused_of_several():
    cloth = cloth_with("auto", Mixing)
    state = make_perturbed_state(cloth)
    torch.manual_seed(0)
    direction = torch.randn(2, 3, 3)
    along = Directions({"effects.own.matrix": direction})
    moved = cloth.sensitivities(state, make_opening_motion(END), TIMES, along=along)[1].x[0]
    with torch.no_grad():
        ends = []
        for sign in (1, -1):
            cloth.effects["own"].matrix.copy_(torch.eye(3) + sign * 1e-3 * direction[0])
            ends.append(cloth(state, make_opening_motion(END), TIMES).x)
    check_close(moved, (ends[0] - ends[1]) / 2e-3, 1e-6, "slope")
    several = state.map(lambda field: field.expand(2, *field.shape))
    with pytest.raises(
        InvalidInput, match=r"effects.own.matrix.*shape \(3, 3\), and several scenes.*PhysicalParameter"
    ):
        cloth.sensitivities(several, make_opening_motion(END), TIMES, along=along)


@pytest.mark.parametrize("engine", ["auto", "reference"])
def test_coefficients_in_a_list_may_be_batched(engine):
    cloth = cloth_with(engine, Listed)
    cloth.effects["own"].strength = tc.PhysicalParameter(torch.tensor([1e-3, 2e-3]), "N", "nonnegative", name="pull")
    out = cloth(make_perturbed_state(cloth), make_opening_motion(END), TIMES)
    assert out.x.shape[:2] == (2, 3)  # scenes, frames
    assert not torch.equal(out.x[0, -1], out.x[1, -1])
