"""Units of substeps that are captured and replayed, with a stand-in for CUDA's graphs that runs anywhere."""

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

import torchcloth as tc
from torchcloth.engine import cuda_graphs
from torchcloth.engine.cuda_graphs import GraphedRollout, segment_length
from torchcloth.errors import InvalidInput
from torchcloth.simulation.rollout import run_schedule

pytestmark = pytest.mark.slow  # CUDA graphs of the torch reference, replayed on the CPU: half a minute

FRAMES = [0.0, 0.02, 0.04, 0.08]


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    """Short simulations are captured, too."""
    monkeypatch.setattr(cuda_graphs, "WARMUP_SEGMENTS", 0)
    monkeypatch.setattr(cuda_graphs, "MIN_REPLAYS", 0)


def again(work: cuda_graphs.Work, device: torch.device | None = None) -> tuple[list[Tensor], cuda_graphs.Replay]:
    """Computes again what a graph would replay, in the same memory."""
    results = work()

    def replay() -> None:
        for slot, now in zip(results, work(), strict=True):
            slot.copy_(now.detach())

    results = [t.detach() for t in results]
    return results, replay


def refused(work: cuda_graphs.Work, device: torch.device) -> tuple[list[Tensor], cuda_graphs.Replay]:
    raise RuntimeError("operation not permitted when stream is capturing\nand more")


def scene(contact: bool = True, opens: bool = False, effects: dict[str, tc.effects.AbstractEffect] | None = None, n=5):
    """A sheet that a corner lifts from a table."""
    t = torch.linspace(0, 0.08, 9)
    pose = torch.eye(4).repeat(9, 1, 1)
    pose[:, 2, 3] = t
    closed = torch.ones(9, dtype=torch.bool)
    if opens:
        closed[4:] = False
    cloth = tc.Cloth(
        tc.meshes.rectangle(0.2, 0.2, resolution=(n, n)),
        tc.materials.AEP(5e3 if contact else 5e4),
        0.3,
        {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(), "bending": tc.effects.Bending()}
        | (effects or {}),
        {"hand": tc.boundaries.Grasp.corner("upper-left"), "table": tc.boundaries.Plane((0.0, 0.0, -0.1))},
        contact=tc.Contact() if contact else None,
        engine="reference",
    )
    return cloth, cloth.rest_state(), {"hand": tc.Trajectory(t, pose.requires_grad_(), closed)}


def outcome(made, capture: cuda_graphs.Capture | None = None):
    """(the rollout, gradients of a function of it, the graphs)."""
    cloth, state, motion = made
    cloth.requires_grad_(True)  # also of gravity and wind
    x = state.x.clone().requires_grad_()
    plan = cloth.schedule(state._replace(x=x), motion, FRAMES, None)
    graphs = None if capture is None else GraphedRollout(plan.model, sum(plan.counts), capture)
    out = run_schedule(plan._replace(graphs=graphs), checkpoint=True)
    weight = torch.randn(out.x.shape, generator=torch.Generator().manual_seed(1), dtype=out.x.dtype)
    ((weight * out.x).sum() + out.wrench["hand"].square().sum()).backward()
    named = {"x": x, "pose": motion["hand"].pose, **dict(cloth.named_parameters())}
    return out, {name: t.grad for name, t in named.items() if t.grad is not None}, graphs


def agree(one, other, marks: tuple[float, float]) -> None:
    (a, before, _), (b, after, _) = one, other
    for first, second in ((a.x, b.x), (a.v, b.v), (a.wrench["hand"], b.wrench["hand"])):
        first, second = first.detach(), second.detach()
        torch.testing.assert_close(second, first, rtol=marks[0], atol=marks[0] * float(first.abs().max()))
    assert set(before) == set(after)
    assert len(before) > 6
    for name, gradient in before.items():
        torch.testing.assert_close(after[name], gradient, rtol=0, atol=marks[1] * float(gradient.abs().max()), msg=name)


@pytest.mark.parametrize(("dtype", "marks"), [(torch.float64, (1e-12, 1e-11)), (torch.float32, (1e-6, 1e-4))])
@pytest.mark.parametrize("contact", [True, False])
def test_replays_give_what_substeps_give_one_by_one(dtype, marks, contact):
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        usual, other = (outcome(scene(contact), capture) for capture in (None, again))
    finally:
        torch.set_default_dtype(before)
    assert other[2]._segments
    agree(usual, other, marks)


def test_without_gradients_nothing_is_kept():
    cloth, state, motion = scene()
    with torch.no_grad():
        plan = cloth.schedule(state, motion, FRAMES, None)
        graphs = GraphedRollout(plan.model, sum(plan.counts), again)
        usual, other = run_schedule(plan, True), run_schedule(plan._replace(graphs=graphs), True)
    torch.testing.assert_close(other.x, usual.x, rtol=1e-12, atol=1e-13)
    assert all(unit.backward is None for unit in graphs._segments.values())
    assert graphs._segments


def test_grippers_that_open_are_another_unit():
    usual, other = (outcome(scene(opens=True), capture) for capture in (None, again))
    agree(usual, other, (1e-12, 1e-11))
    assert {key[1] for key in other[2]._segments} == {(("hand", True),), (("hand", False),)}


def test_internal_variables_go_along():
    made = lambda: scene(effects={"friction": tc.effects.BendingFriction(2e-4)})  # noqa: E731
    usual, other = (outcome(made(), capture) for capture in (None, again))
    assert usual[0].state.memory.keys() == other[0].state.memory.keys()
    agree(usual, other, (1e-12, 1e-11))


def test_layers_that_meet_are_not_captured(monkeypatch):
    """A sheet folded onto itself; where a vertex moves farther than was looked at, neither."""
    cloth, state, motion = scene(n=11)
    folded = state.x.clone()
    right = folded[:, 0] > 0.1
    folded[right, 0], folded[right, 2] = 0.2 - folded[right, 0], folded[right, 2] + 0.004
    plan = cloth.schedule(cloth.state(folded), motion, FRAMES[:2], None)
    graphs = GraphedRollout(plan.model, sum(plan.counts), again)
    with torch.no_grad():
        run_schedule(plan._replace(graphs=graphs), True)
    assert not graphs._segments
    usual = outcome(scene())
    monkeypatch.setattr(cuda_graphs.GraphedRollout, "max_displacement_m", property(lambda self: 1e-9))
    other = outcome(scene(), again)
    assert other[2]._segments
    agree(usual, other, (1e-12, 1e-11))


def test_few_units_do_not_pay(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(cuda_graphs, "WARMUP_SEGMENTS", 100)
        assert not outcome(scene(), again)[2]._segments
    monkeypatch.setattr(cuda_graphs, "MIN_REPLAYS", 100)
    assert not outcome(scene(), again)[2]._segments


def test_what_cannot_be_captured_is_launched_one_by_one():
    usual = outcome(scene())
    with pytest.warns(
        UserWarning, match="no CUDA graph of the substeps.*: operation not permitted when stream is"
    ) as messages:
        other = outcome(scene(), refused)
    assert len(messages) == 1
    agree(usual, other, (1e-12, 1e-11))


class Push(tc.effects.AbstractEffect):
    """A force that knows its size by another name than a parameter's."""

    def __init__(self, size: Tensor) -> None:
        super().__init__()
        self.sizes = [size]

    def coefficients(self):
        return None

    def force(self, c, inputs):
        return self.sizes[0] * inputs.mass * torch.ones_like(inputs.x)


def test_gradients_of_what_is_no_parameter_are_not_lost():
    size = torch.tensor(2.0, requires_grad=True)
    results = []
    for capture in (None, again):
        size.grad = None
        made = scene(effects={"push": Push(size)})
        if capture is None:
            outcome(made)
        else:
            with pytest.warns(UserWarning, match="a part has a tensor .* with a gradient that is no parameter"):
                outcome(made, capture)
        results.append(float(size.grad))
    assert results[0] != 0
    assert results[1] == pytest.approx(results[0], rel=1e-9)


def test_gradients_of_gradients_are_refused():
    cloth, state, motion = scene()
    x = state.x.clone().requires_grad_()
    plan = cloth.schedule(state._replace(x=x), motion, FRAMES, None)
    out = run_schedule(plan._replace(graphs=GraphedRollout(plan.model, sum(plan.counts), again)), checkpoint=True)
    with pytest.raises(InvalidInput, match=r'create_graph=True; expected one; .*engine="reference"'):
        torch.autograd.grad(out.x.square().sum(), x, create_graph=True)


def test_a_callers_checkpoint_is_not_captured():
    """It would compute the caller's work again in the midst of a capture."""
    times, results = [], []
    for capture in (None, again):
        cloth, state, motion = scene()

        def work(x, cloth=cloth, state=state, motion=motion, capture=capture):
            times.append(capture)
            plan = cloth.schedule(state._replace(x=x), motion, FRAMES, None)
            graphs = None if capture is None else GraphedRollout(plan.model, sum(plan.counts), capture)
            return run_schedule(plan._replace(graphs=graphs), checkpoint=True).x

        x = state.x.clone().requires_grad_()
        checkpoint(work, x, use_reentrant=False).square().sum().backward()
        results.append(x.grad)
    assert times.count(None) == times.count(again) == 2
    torch.testing.assert_close(results[1], results[0], rtol=1e-10, atol=1e-12)


def test_what_is_done_to_a_cloth_later_does_not_reach_its_graphs():
    """Graphs know addresses: what lies there is theirs."""
    cloth, state, motion = scene()
    for p in cloth.parameters():
        p.requires_grad_(False)
    plan = cloth.schedule(state, motion, FRAMES, None)
    own_model = GraphedRollout(plan.model, 1, again).own_model
    for name, part in own_model.boundaries.items():
        for key, buffer in part.named_buffers():
            theirs = cloth.boundaries[name].get_buffer(key)
            assert buffer is not theirs
            assert buffer.data_ptr() != theirs.data_ptr()
            assert torch.equal(buffer, theirs)


def test_a_backward_pass_comes_long_after():
    """Of two simulations of which the second has run before the first is differentiated."""
    cloth, state, motion = scene()
    results = []
    for capture in (None, again):
        cloth.zero_grad()
        plan = cloth.schedule(state, motion, FRAMES, None)
        plan = plan._replace(graphs=None if capture is None else GraphedRollout(plan.model, sum(plan.counts), capture))
        first = run_schedule(plan, True)
        faster = plan._replace(state=plan.state._replace(v=plan.state.v + 0.1))
        second = run_schedule(faster, True)
        (first.x.square().sum() - second.x.sum()).backward()
        results.append([p.grad.clone() for p in cloth.parameters() if p.grad is not None])
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(b, a, rtol=1e-9, atol=1e-11 * float(a.abs().max()))


@pytest.mark.parametrize(("count", "unit"), [(240, 24), (250, 10), (239, 17), (38, 19), (75, 15), (22, 22)])
def test_units_leave_few_over(count, unit):
    assert segment_length(count) == unit
