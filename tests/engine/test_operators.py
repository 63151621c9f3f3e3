"""The operators of torch: contracts, and every way to differentiate through them."""

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
from helpers.engine_cloths import check_close, make_opening_motion, make_perturbed_state, make_sheet
from torch.func import functional_call, hessian, jacfwd, jacrev, jvp, vjp, vmap

import torchcloth as tc
from torchcloth.engine.dispatch import stationary_prescribed
from torchcloth.engine.fused import FusedEngine
from torchcloth.engine.operators import Rollout, ops
from torchcloth.errors import InvalidInput
from torchcloth.testing import check_gradients

STEPS = 4
END = 0.012


@pytest.fixture(params=[torch.float64, torch.float32], ids=["double", "float"])
def call(request):
    """(program, inputs) of a small cloth; the first input is what is called x below."""
    return program(request.param)


def program(dtype, batch=()):
    cloth = make_sheet("fused").to(dtype)
    state = make_perturbed_state(cloth, batch)
    model = cloth.build_model()
    prescribed = stationary_prescribed(model, STEPS)
    job = FusedEngine(model, state, prescribed).job(state, torch.full((STEPS,), 1e-4), prescribed)
    return job.program, [tensor.detach() for tensor in job.inputs.values()]


def leaves(inputs):
    return [t.clone().requires_grad_() for t in inputs]


@pytest.mark.parametrize("every", [0, 1, 2])
def test_opcheck_of_the_values(call, every):
    known, inputs = call
    torch.library.opcheck(ops.rollout.default, (known.number, STEPS, every, leaves(inputs)))


def test_opcheck_of_the_adjoint(call):
    known, inputs = call
    *results, records = ops.rollout(known.number, STEPS, 1, inputs)
    seeds = [torch.randn_like(r) for r in results]
    wanted = list(range(len(inputs)))
    torch.library.opcheck(ops.rollout_backward.default, (known.number, STEPS, 1, inputs, records, seeds, wanted))


def test_opcheck_of_the_tangents(call):
    known, inputs = call
    dots = [torch.randn(1, 5, *t.shape[1:], dtype=t.dtype) for t in inputs[:2]]
    torch.library.opcheck(ops.rollout_tangent.default, (known.number, STEPS, inputs, dots, [0, 1]))


def test_fakes_have_the_real_shapes(call):
    from torch._subclasses.fake_tensor import FakeTensorMode

    known, inputs = call
    real = ops.rollout(known.number, STEPS, 1, inputs)
    with FakeTensorMode() as mode:
        fake = ops.rollout(known.number, STEPS, 1, [mode.from_tensor(t) for t in inputs])
    assert [(t.shape, t.dtype) for t in fake] == [(t.shape, t.dtype) for t in real]


def test_gradients_by_autograd_of_the_operator_and_of_the_function(call):
    """With records, with coarse ones, and with none, where the adjoint goes through the substeps itself."""
    known, inputs = call
    gradients = []
    for run in (ops.rollout, lambda n, k, e, values: Rollout.apply(n, k, e, *values)):
        for every in (1, 2, 0):
            mine = leaves(inputs)
            *results, _ = run(known.number, STEPS, every, mine)
            torch.manual_seed(0)
            loss = sum((r * torch.randn_like(r)).sum() for r in results)
            gradients.append(torch.autograd.grad(loss, mine))
    for other in gradients[1:]:
        for a, b in zip(gradients[0], other, strict=True):
            torch.testing.assert_close(a, b)


def test_second_derivatives_are_refused():
    known, inputs = program(torch.float64)
    x = inputs[0].requires_grad_()
    (gradient,) = torch.autograd.grad(Rollout.apply(known.number, STEPS, 1, *inputs)[0].sum(), x, create_graph=True)
    with pytest.raises(InvalidInput, match=r'second derivatives; .*engine="reference"'):
        gradient.sum().backward()


@pytest.mark.parametrize(
    "second",
    [
        lambda f, r: hessian(f)(r),
        lambda f, r: jacfwd(jacfwd(f))(r),
        lambda f, r: jacrev(jacrev(f))(r),
        lambda f, r: jvp(jacrev(f), (r,), (torch.ones_like(r),)),
    ],
    ids=["hessian", "forward over forward", "reverse over reverse", "forward over reverse"],
)
def test_no_order_of_modes_drops_the_curvature(second):
    """First derivatives work under the same transforms; second ones are refused, not zero."""
    cloth = tc.Cloth(tc.meshes.rectangle(0.1, 0.1, resolution=(3, 3)), tc.materials.AEP(1e5, 0.3), 0.15, contact=None)
    state = cloth.state(cloth.rest_state().x, 0.1 * torch.randn(9, 3))
    name, raw = "material.youngs_modulus.raw", cloth.material.youngs_modulus.raw.detach()

    def loss(raw):
        return functional_call(cloth, {name: raw}, (state, {}, [0, 0.01]), {"checkpoint": False}).x[-1].square().sum()

    check_close(jacfwd(loss)(raw), jacrev(loss)(raw), 1e-8, "slope")
    with pytest.raises(InvalidInput, match="second derivatives"):
        second(loss, raw)


def test_a_jacobian_is_one_call_with_many_directions():
    """vmap of jvp: the tangents' batch becomes directions; against reverse mode."""
    known, inputs = program(torch.float64)

    def position(step, i=1):
        moved = list(inputs)
        moved[i] = inputs[i] + step
        return Rollout.apply(known.number, STEPS, 0, *moved)[0][0, :3].flatten()

    forward = jacfwd(position)(torch.zeros_like(inputs[1]))
    mine = inputs[1].clone().requires_grad_()
    out = Rollout.apply(known.number, STEPS, 1, inputs[0], mine, *inputs[2:])[0][0, :3].flatten()
    backward = torch.stack([torch.autograd.grad(value, mine, retain_graph=True)[0] for value in out])
    check_close(forward, backward, 1e-10, "jacobian")


@pytest.mark.parametrize("mapped", [(0,), (0, 1), (3,)], ids=str)
def test_vmap_equals_a_loop(mapped):
    """Values, gradients and tangents, over states and over a parameter that the others share."""
    known, inputs = program(torch.float64)
    torch.manual_seed(0)
    many = {i: inputs[i] + 1e-3 * torch.randn(3, *inputs[i].shape) for i in mapped}

    def run(*moved):
        values = list(inputs)
        for i, t in zip(mapped, moved, strict=True):
            values[i] = t
        return Rollout.apply(known.number, STEPS, 0, *values)[0]

    def slope(*moved):
        out, back = vjp(run, *moved)
        return back(torch.ones_like(out))

    def push(*moved):
        return jvp(run, moved, tuple(torch.ones_like(t) for t in moved))[1]

    for function in (run, slope, push):
        together = vmap(function)(*many.values())
        alone = [function(*(t[k] for t in many.values())) for k in range(3)]
        if not isinstance(together, tuple):
            together, alone = (together,), [(a,) for a in alone]
        for part, single in zip(together, zip(*alone, strict=True), strict=True):
            check_close(part, torch.stack(single), 1e-10, function.__name__)


def test_what_is_too_short_is_not_read_beyond():
    known, inputs = program(torch.float64)
    with pytest.raises(ValueError, match=rf"expected \[1 or 1, {STEPS + 5}, 1\]"):
        torch.ops.torchcloth.rollout(known.number, STEPS + 5, 0, inputs)
    two, three = (inputs[0].expand(n, -1, -1).contiguous() for n in (2, 3))
    with pytest.raises(ValueError, match=r"got shape \[2, .*expected \[1 or 3"):
        torch.ops.torchcloth.rollout(known.number, STEPS, 0, [two, three, *inputs[2:]])


def test_vmap_over_scenes_that_share_a_parameter():
    """Each entry of the batch is itself a batch: adjoints of what its scenes share are summed within it."""
    known, inputs = program(torch.float64, batch=(2,))
    torch.manual_seed(0)
    shared = next(i for i, t in enumerate(inputs) if len(t) == 1 and i > 2)
    many = inputs[0] + 1e-3 * torch.randn(3, *inputs[0].shape)

    def slope(x):
        out, back = vjp(
            lambda p: Rollout.apply(known.number, STEPS, 0, x, *inputs[1:shared], p, *inputs[shared + 1 :])[0],
            inputs[shared],
        )
        return back(out)[0]

    check_close(vmap(slope)(many), torch.stack([slope(x) for x in many]), 1e-10, "gradient")


def simulation(cloth, motion):
    values = {name: p.detach() for name, p in cloth.named_parameters()}
    state = make_perturbed_state(cloth)

    def run(x=state.x, pose=motion["left"].pose, **moved):
        driven = {**motion, "left": motion["left"]._replace(pose=pose)}
        out = functional_call(
            cloth, {**values, **moved}, (state._replace(x=x), driven, (0.0, 0.004, END)), {"dt": 4e-4}
        )
        return torch.cat([out.x[1:].flatten(), 0.1 * out.v[1:].flatten(), out.wrench["left"].flatten()])

    return run, state


def test_sweep_over_a_rollout():
    """Central differences of a whole simulation in which a grasp opens and closes."""
    cloth = make_sheet("fused")
    run, state = simulation(cloth, make_opening_motion(END))
    young, drag = (cloth.get_parameter(n).detach() for n in ("material.youngs_modulus.raw", "effects.air.normal.raw"))

    def moved(dx, **parameters):
        return run(state.x + 1e-3 * dx, **{name.replace("_", "."): value for name, value in parameters.items()})

    inputs = {"dx": torch.zeros_like(state.x)}
    steps = tuple(10.0 ** (-1 - k / 2) for k in range(9))
    check_gradients(moved, inputs, 1e-6, steps, acts=True)
    sizes = {"young": 1.0, "drag": 1.0}

    def fabric(young, drag):
        return run(**{"material.youngs_modulus.raw": young, "effects.air.normal.raw": drag})

    check_gradients(fabric, {"young": young, "drag": drag}, 1e-6, steps, sizes=sizes, acts=True)


@pytest.mark.parametrize("way", ["forward_ad", "torch.func.jvp"])
def test_forward_mode_through_a_cloth(way):
    """Against the reference, and against a gradient."""
    motion, results = make_opening_motion(END), []
    for engine in ("fused", "reference"):
        run, state = simulation(make_sheet(engine), motion)
        torch.manual_seed(0)
        dx, shift = 1e-3 * torch.randn_like(state.x), torch.zeros_like(motion["left"].pose)
        shift[:, :3, 3] = 1e-2 * torch.randn(7, 3)
        if way == "forward_ad":
            with forward_ad.dual_level():
                pair = forward_ad.make_dual(state.x, dx), forward_ad.make_dual(motion["left"].pose, shift)
                results.append(forward_ad.unpack_dual(run(*pair)).tangent.clone())
        else:
            results.append(jvp(run, (state.x, motion["left"].pose), (dx, shift))[1])
    check_close(*results, 1e-8, "tangent")


def test_jvp_of_a_number_of_steps_in_one_program():
    """Programs are shared: a second cloth with the same numbers, or new values of parameters, builds nothing."""
    first, second = make_sheet("fused"), make_sheet("fused")
    with torch.no_grad():
        second.material.youngs_modulus.set(2e5)
    numbers = set()
    for cloth in (first, second, first):
        model, state = cloth.build_model(), cloth.rest_state()
        numbers.add(FusedEngine(model, state, stationary_prescribed(model)).builder.program.number)
    assert len(numbers) == 1
    second.boundaries["left"].index = torch.tensor([2])  # a constant of a part
    model = second.build_model()
    numbers.add(FusedEngine(model, state, stationary_prescribed(model)).builder.program.number)
    assert len(numbers) == 2


def test_a_program_that_nobody_holds():
    with pytest.raises(KeyError):
        ops.rollout(10**9, 1, 0, [torch.zeros(1, 1, 1)])


def test_state_of_another_precision():
    """A parameter that was given in float64 to a cloth in float32 is cast, forward and backward."""
    cloth = make_sheet("fused").float()
    cloth.areal_density = tc.PhysicalParameter(torch.tensor(0.2, dtype=torch.float64), "kg/m^2")
    out = cloth(make_perturbed_state(cloth), make_opening_motion(END), (0.0, 0.004))
    assert out.x.dtype == torch.float32
    out.x.sum().backward()
    assert cloth.areal_density.raw.grad.dtype == torch.float64
