"""Programs as CUDA C++, by a stand-in that runs anywhere; ``agreement.agree`` looks at every kernel."""

from contextlib import contextmanager
from unittest.mock import patch

import on_host
import pytest
import torch
from agreement import moving
from clothes import opening, sheet, start

import torchcloth as tc
from torchcloth.boundaries.motion import drive
from torchcloth.engine import apart, devices, running
from torchcloth.engine.building import Unbuilt
from torchcloth.engine.cuda import arithmetic, layers, runs
from torchcloth.engine.fused import Fused
from torchcloth.engine.library import kernels
from torchcloth.self_contact import near_layers

TIMES = [0.0, 0.01, 0.02]


@contextmanager
def elsewhere(**how):
    """Tensors of the CPU are a device's."""
    with on_host.stand_in(**how), patch.object(devices, "elsewhere", lambda tensor: True):
        yield


def job_of(cloth, scenes=(2,), substeps=12):
    state, dt = moving(cloth, scenes), 1e-4
    times = torch.arange(substeps + 1, dtype=torch.float64) * dt
    drives = {name: drive(t, times) for name, t in opening(float(times[-1])).items()}
    job = Fused(cloth.model(), state, drives).job(state, torch.full((substeps,), dt), drives)
    return job._replace(inputs={f: t.detach().contiguous() for f, t in job.inputs.items()})


def adjoints(job):
    generator = torch.Generator().manual_seed(0)
    seeds = {
        f: torch.randn(job.scenes, f.rows, f.comps, generator=generator, dtype=job.like.dtype)
        for f in job.program.outputs
    }
    return runs.reverse(job, seeds, set(job.inputs))


def test_order_of_threads_between_waits_does_not_matter():
    """Bit by bit: nobody reads what another thread of a block writes before both have waited."""
    job, found = job_of(sheet()), []
    for reverse in (False, True):
        with on_host.stand_in(4, reverse):
            found.append((runs.forward(job)[0], adjoints(job)))
    for one, other in zip(*found, strict=True):
        assert all(torch.equal(t, other[f]) for f, t in one.items())


def test_adjoints_do_not_depend_on_how_many_substeps_are_kept():
    job = job_of(sheet())
    with on_host.stand_in():
        usual = adjoints(job)
        with patch.object(runs, "MOST", 5):
            other = adjoints(job)
    for f, t in usual.items():
        torch.testing.assert_close(other[f], t, rtol=0, atol=1e-12 * float(t.abs().max()))


def test_how_far_a_vertex_came_is_told():
    job = job_of(sheet())
    known = torch.stack(
        [running.forward(job._replace(ends=(k, 12)))[0][job.program.outputs[0]][:, 0] for k in range(1, 12)]
    )
    with on_host.stand_in():
        _, way = runs.forward(job)
    torch.testing.assert_close(way[:, 0], (known - job.inputs[job.program.inputs[0]]).abs().amax((0, 2, 3)))


def simulated(cloth, times=TIMES):
    """(rollout, gradients by name) of a batch."""
    state, motion = start(cloth, (2,)), opening(times[-1])
    poses = {name: t._replace(pose=t.pose.to(state.x).requires_grad_()) for name, t in motion.items()}
    x = state.x.clone().requires_grad_()
    cloth.zero_grad()
    out = cloth(state._replace(x=x), poses, times)
    (out.x.square().sum() + out.state.d3.square().sum() + 1e-3 * out.wrench["left"].square().sum()).backward()
    named = {"x": x, "pose": poses["right"].pose, **dict(cloth.named_parameters())}
    return out, {name: t.grad for name, t in named.items() if t.grad is not None}


@pytest.mark.parametrize(("dtype", "mark"), [(torch.float64, 1e-9), (torch.float32, 1e-3)])
@pytest.mark.parametrize("contact", [tc.Contact(), None])
def test_the_layer(contact, dtype, mark):
    torch.set_default_dtype(dtype)
    cloth = sheet(contact=contact).to(dtype)
    known, before = simulated(cloth)
    with elsewhere():
        assert cloth.engine_in_use == ("fused" if contact is None else "fused; reference where layers of cloth meet")
        out, after = simulated(cloth)
        with torch.no_grad():
            plain = cloth(start(cloth, (2,)), opening(TIMES[-1]), TIMES)
    for one, other in ((known.x, out.x), (known.x, plain.x), (known.wrench["left"], out.wrench["left"])):
        torch.testing.assert_close(other, one, rtol=0, atol=mark * float(one.detach().abs().max()))
    torch.testing.assert_close(out.state.d3, known.state.d3, rtol=0, atol=mark)
    assert set(before) >= set(after)
    for name, t in before.items():
        if name not in after:  # of contact, which nobody asked for
            assert float(t.abs().max()) == 0, name
            continue
        torch.testing.assert_close(after[name], t, rtol=0, atol=10 * mark * float(t.abs().max()), msg=name)


def folded(cloth):
    """One half over the other."""
    x = cloth.rest_state().x.clone()
    right = x[:, 0] > 0.1
    x[right, 0], x[right, 2] = 0.2 - x[right, 0], x[right, 2] + 0.004
    return cloth.state(x)


def test_layers_that_meet_are_the_references():
    cloth = sheet(contact=tc.Contact(), n=11, boundaries={})
    with torch.no_grad():
        known = cloth(folded(cloth), times=TIMES[:2])
        with elsewhere(), patch.object(Fused, "measured", side_effect=AssertionError):
            out = cloth(folded(cloth), times=TIMES[:2])
    torch.testing.assert_close(out.x, known.x, rtol=1e-6, atol=1e-9)


def test_near_layers_are_found():
    """Scene by scene; the same as the reference finds."""
    cloth = sheet(contact=tc.Contact(), n=11, boundaries={})
    model, grid = cloth.model(), cloth.grid()
    flat, over = cloth.rest_state().x, folded(cloth).x
    up = torch.tensor([0.0, 0.0, 1.0])
    lifted = [over + height * (over[:, :1] < 0.1) * up for height in (0.0, -0.02, -0.05, -0.2)]
    with on_host.stand_in(threads=3):
        search = layers.LayerSearch(model, grid)
        for x in (flat, *lifted, torch.stack([flat, flat]), torch.stack([flat, over])):
            assert search.any_near(x) == bool(len(near_layers(model, grid, x).active))
        assert [search.any_near(x) for x in (flat, over)] == [False, True]
        assert layers.LayerSearch(model, grid._replace(apart=None)).any_near(flat), "not known"


@pytest.mark.parametrize("faster", [1e-9, 1e3])
def test_what_moves_farther_than_was_looked_at_goes_in_smaller_pieces(faster, monkeypatch):
    cloth = sheet(contact=tc.Contact())
    state = start(cloth)._replace(v=torch.full_like(start(cloth).v, 20.0))
    known = cloth(state, opening(TIMES[-1]), TIMES)
    monkeypatch.setattr(apart, "FASTER", faster)
    asked = []
    usual = Fused.measured
    monkeypatch.setattr(Fused, "measured", lambda self, *how: (asked.append(how[4]), usual(self, *how))[1])
    with elsewhere():
        out = cloth(state, opening(TIMES[-1]), TIMES)
    torch.testing.assert_close(out.x, known.x, rtol=0, atol=1e-9)
    assert min(asked) < max(asked) if faster < 1 else set(asked) == {1}


def test_what_it_cannot_do_is_said():
    class Own(tc.effects.Gravity):
        """Perhaps another law."""

    for effects, contact in (({"own": Own()}, None), ({"own": Own()}, tc.Contact())):
        with elsewhere():
            assert "effects.own in torch, on cuda" in sheet(effects=effects, contact=contact).engine_in_use
    with elsewhere(), patch.object(runs, "Kernels", side_effect=Unbuilt("no libnvrtc", "install it")):
        assert sheet().engine_in_use == "reference (no libnvrtc)"
        with pytest.raises(tc.errors.InvalidInput, match=r"no libnvrtc.*install it"):
            sheet(engine="fused")(start(sheet()), opening(TIMES[-1]), TIMES)


def test_directions_are_the_references():
    cloth = sheet()
    along = tc.Directions({"areal_density.raw": torch.ones(1)})
    known = cloth.sensitivities(start(cloth), opening(TIMES[-1]), TIMES, along=along)[1]
    with elsewhere():
        found = cloth.sensitivities(start(cloth), opening(TIMES[-1]), TIMES, along=along)[1]
    torch.testing.assert_close(found.x, known.x, rtol=0, atol=1e-7 * float(known.x.abs().max()))


def test_every_kernel_can_be_written_down():
    for name, (number, takes, gives) in kernels().items():
        kernel = arithmetic.kernel(number)
        assert len(kernel.out) == gives, name
        lines = list(kernel.values("n", [f"r{k}" for k in range(takes)]))
        lines += kernel.adjoints("n", ["g"] * gives, [f"b{k}" for k in range(takes)])
        assert all(line.endswith(";") and "{" not in line for line in lines), name
