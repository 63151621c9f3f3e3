"""A user's cloth on the engine: the same results as the reference, the same errors, and word of what runs."""

import warnings

import pytest
import torch
from helpers.engine_cloths import check_close, make_opening_motion, make_perturbed_state, make_sheet

import torchcloth as tc
from torchcloth.boundaries import AbstractBoundary
from torchcloth.engine import execution
from torchcloth.engine.dispatch import choose_engine, stationary_prescribed
from torchcloth.engine.fused import FusedEngine
from torchcloth.errors import InvalidInput, SimulationDiverged

END = 0.012
TIMES = (0.0, 0.4 * END, END)


class Floor(AbstractBoundary):
    """A user's own."""

    def bind(self, mesh):
        return self

    def constrain(self, x, v, dt, drive, substep):
        low = x[..., 2:] + dt * v[..., 2:] < -0.02
        return torch.where(low, -v, v)


def outcome(engine, batch=(), settle=False, checkpoint=True, times=TIMES, **options):
    """All that comes out of a simulation, and all gradients."""
    cloth = make_sheet(engine, **options).requires_grad_(True)  # also facts
    motion = make_opening_motion(END)
    leaves = {name: t.pose.clone().requires_grad_() for name, t in motion.items()}
    motion = {name: t._replace(pose=leaves[name]) for name, t in motion.items()}
    state = make_perturbed_state(cloth, batch)
    x, v = state.x.clone().requires_grad_(), state.v.clone().requires_grad_()
    state = state._replace(x=x, v=v)
    if settle:
        state = cloth.settle(state, motion, duration=0.02)
    out = cloth(state, motion, times, checkpoint=checkpoint)
    parts = {"x": out.x, "v": out.v, **out.wrench, "end": out.state.v}
    generator = torch.Generator().manual_seed(0)
    loss = sum((torch.randn(p.shape, generator=generator, dtype=torch.float64).to(p) * p).sum() for p in parts.values())
    parameters = {name: p for name, p in cloth.named_parameters()}
    inputs = {"x0": x, **({} if settle else {"v0": v}), **leaves, **parameters}
    grads = torch.autograd.grad(loss, list(inputs.values()), allow_unused=True)
    return parts, dict(zip(inputs, grads, strict=True))


CASES = {
    "plain": {},
    "settled": {"settle": True},
    "batch": {"batch": (2, 3)},
    "no checkpoints": {"checkpoint": False},
    "one interval": {"times": (0.0, END)},
    "fields": {"material": lambda: tc.materials.AEP(torch.linspace(0.8e5, 1.2e5, 32), 0.3)},
    "batch of fabrics": {"batch": (2,), "material": lambda: tc.materials.AEP(torch.tensor([[0.8e5], [1.2e5]]), 0.3)},
}


@pytest.mark.parametrize("case", CASES)
def test_fused_equals_reference(case):
    def options():
        return {key: value() if callable(value) else value for key, value in CASES[case].items()}

    parts, grads = outcome("fused", **options())
    expected, slopes = outcome("reference", **options())
    for name, value in parts.items():
        check_close(value, expected[name], 1e-10, name)
    assert [n for n, g in grads.items() if g is None] == [n for n, g in slopes.items() if g is None]
    for name, grad in grads.items():
        if grad is not None:
            assert grad.shape == slopes[name].shape
            check_close(grad, slopes[name], 1e-8, f"gradient of {name}")


def test_auto_is_fused_where_it_can_be():
    """Bitwise: it is the same program."""
    auto, fused = (outcome(engine) for engine in ("auto", "fused"))
    for name in auto[0]:
        assert torch.equal(auto[0][name], fused[0][name])


def test_float32():
    """Values 1e-4, gradients 1e-3 in the norm, against float64."""
    exact, fine = outcome("fused")
    torch.set_default_dtype(torch.float32)
    parts, grads = outcome("fused")
    for name, value in parts.items():
        assert value.dtype == torch.float32
        check_close(value.double(), exact[name], 1e-4, name)
    for name, grad in grads.items():
        if grad is not None:
            check_close(grad.double(), fine[name], 1e-3, name)


@pytest.mark.parametrize("thin", [1e-3, 1e-4, 1e-5])
def test_slivers_in_float32(thin):
    """Of a triangle squeezed to next to nothing, det(F^T F) has no digits left: forces are the reference's."""
    torch.set_default_dtype(torch.float32)
    results = []
    for engine in ("reference", "fused"):
        cloth = tc.Cloth(tc.meshes.rectangle(0.1, 0.1, resolution=(2, 2)), tc.materials.AEP(1e4, 0.3), 0.2)
        cloth.engine = engine
        rest, squeezed = cloth.rest_state(), torch.tensor([[1.0, 1.0, 0.0], [1.0, 1.0 + thin, 0.0], [0.0, 0.0, 1.0]])
        state = cloth.state(rest.x @ squeezed)
        results.append(cloth(state, times=(0.0, 1e-5), dt=1e-5).v[-1])
    assert bool(results[1].isfinite().all())
    check_close(results[1], results[0], 1e-2, "velocity")


@pytest.mark.parametrize("budget", [0, 40_000, 10**9])
def test_memory_budget_changes_nothing(budget, monkeypatch):
    """No records at all, some, all: the same gradients to the last digit but the order of sums."""
    expected = outcome("fused", times=(0.0, 0.003, 0.006, END))[1]
    monkeypatch.setattr(execution, "RECORD_BUDGET_BYTES", budget)
    monkeypatch.setattr(execution, "RECOMPUTE_BUDGET_BYTES", budget)
    results = outcome("fused", times=(0.0, 0.003, 0.006, END))[1]
    for name, grad in results.items():
        assert (grad is None) == (expected[name] is None), name
        if grad is not None:
            check_close(grad, expected[name], 1e-12, name)


def test_records_are_kept_while_the_budget_lasts(monkeypatch):
    """Three intervals, room for the records of one and a half: the first keeps, the others go through it again."""
    cloth, intervals = make_sheet("fused"), []
    model, state = cloth.build_model(), make_perturbed_state(cloth)
    prescribed = stationary_prescribed(model, 9)
    size = execution.full_size(FusedEngine(model, state, prescribed).builder.program, 1, 9)
    monkeypatch.setattr(execution, "RECORD_BUDGET_BYTES", int(1.5 * size))
    fused, forward = FusedEngine(model, state, prescribed), execution.forward
    monkeypatch.setattr(
        execution,
        "forward",
        lambda job, record_interval=0: intervals.append(record_interval) or forward(job, record_interval),
    )
    for _ in range(3):
        state, _ = fused.rollout(state, 1e-4, prescribed, 9)
    assert intervals == [1, 0, 0]
    state.x.sum().backward()
    assert intervals == [1, 0, 0, 1, 1]


def test_a_loop_without_gradients_keeps_no_records(monkeypatch):
    intervals, forward = [], execution.forward
    monkeypatch.setattr(
        execution,
        "forward",
        lambda job, record_interval=0: intervals.append(record_interval) or forward(job, record_interval),
    )
    cloth = make_sheet("fused")
    with torch.no_grad():
        cloth(make_perturbed_state(cloth), make_opening_motion(END), TIMES)
    assert set(intervals) == {0}


# -- changes between calls --------------------------------------------------------------------------------------------


def changes():
    """What a user may do to a cloth between two calls."""

    def young(cloth):
        cloth.material.youngs_modulus.set(2e5)

    def density(cloth):
        cloth.effects["air"].density = 1.5

    def index(cloth):
        cloth.boundaries["right"].index = torch.tensor([20])

    def wind(cloth):
        with torch.no_grad():
            cloth.effects["air"].wind += 0.5

    def buffer(cloth):
        cloth.effects["bending"].operator.mul_(3.0)

    def effect(cloth):
        del cloth.effects["damping"]

    def geometry(cloth):
        cloth._gradient.div_(1.1)
        cloth._area.mul_(1.1**2)

    return [young, density, index, wind, buffer, effect, geometry]


@pytest.mark.parametrize("change", changes(), ids=lambda f: f.__name__)
def test_changes_between_calls_are_seen(change):
    """Programs are cached between calls, but never one that is no longer right."""
    results = {}
    for engine in ("fused", "reference"):
        cloth = make_sheet(engine)
        before = cloth(make_perturbed_state(cloth), make_opening_motion(END), TIMES).x.detach()
        change(cloth)
        results[engine] = cloth(make_perturbed_state(cloth), make_opening_motion(END), TIMES).x.detach()
        assert not torch.equal(before, results[engine])
    check_close(results["fused"], results["reference"], 1e-10, change.__name__)


def test_the_engine_may_be_set_at_any_time():
    cloth = make_sheet("fused")
    first = cloth(make_perturbed_state(cloth), make_opening_motion(END), TIMES).x
    cloth.engine = "reference"
    second = cloth(make_perturbed_state(cloth), make_opening_motion(END), TIMES).x
    assert not torch.equal(first, second)
    check_close(first, second, 1e-10, "x")
    with pytest.raises(InvalidInput, match='engine; got \'fast\'; expected "auto", "reference" or "fused"'):
        cloth.engine = "fast"
    assert cloth.engine == "reference"
    with pytest.raises(InvalidInput, match="engine"):
        make_sheet("CUDA")


# -- words ------------------------------------------------------------------------------------------------------------


def test_print_says_which_engine_runs_and_why():
    assert "\n  engine: fused\n" in str(make_sheet())
    assert make_sheet().engine_in_use == "fused"
    assert make_sheet("reference").engine_in_use == "reference (as asked for)"
    assert "engine: reference (as asked for)" in str(make_sheet("reference"))
    assert "engine: reference (boundary 'floor' (Floor) has no kernels)" in str(
        make_sheet(boundaries={"floor": Floor()})
    )


def test_other_precisions_and_devices_are_left_to_the_reference():
    cloth = make_sheet()
    model, state = cloth.build_model(), cloth.rest_state()
    for other, why in (
        (state.map(lambda t: t.half()), "float16"),
        (state.map(lambda t: t.to("meta")), "tensors on meta"),
    ):
        assert str(choose_engine("auto", model, other, stationary_prescribed(model))) == f"reference ({why})"


def test_unknown_boundary_runs_on_the_reference_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        auto, reference = (make_sheet(engine, boundaries={"floor": Floor()}) for engine in ("auto", "reference"))
        assert torch.equal(
            auto(make_perturbed_state(auto), times=TIMES).x, reference(make_perturbed_state(reference), times=TIMES).x
        )


def test_fused_refuses_what_it_cannot():
    cloth = make_sheet("fused", boundaries={"floor": Floor()})
    message = r"""engine; got "fused"; expected .*boundary 'floor' \(Floor\) has no kernels; use engine="auto\""""
    with pytest.raises(InvalidInput, match=message):
        cloth(make_perturbed_state(cloth), times=TIMES)


def test_divergence_names_time_and_vertex():
    """A pose that jumps tears the cloth; the engine goes through the interval again to say where."""
    messages = []
    for engine in ("fused", "reference"):
        cloth = make_sheet(engine, effects={})
        state = cloth.rest_state()
        v = state.v.clone()
        v[7] = 1e200
        with pytest.raises(
            SimulationDiverged, match=r"t = .*; got vertex \d+ not finite after substep \d+ of"
        ) as caught:
            cloth(state._replace(v=v), make_opening_motion(END, "nobody"), (0.0, END))
        messages.append(str(caught.value))
    assert messages[0] == messages[1]


def test_a_state_dict_and_a_copy_keep_working():
    import copy

    cloth = make_sheet("fused")
    twin = copy.deepcopy(cloth)
    twin.load_state_dict(cloth.state_dict())
    assert twin.engine == "fused"
    assert torch.equal(
        twin(make_perturbed_state(twin), make_opening_motion(END), TIMES).x,
        cloth(make_perturbed_state(cloth), make_opening_motion(END), TIMES).x,
    )
