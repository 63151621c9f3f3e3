"""Derivatives of the simulated episode and of the residuals, against finite differences and against reverse mode."""

import pytest
import torch
from helpers.twins import build_cloth_at

from torchcloth.episodes.observed_surface import build_surface_of_mesh
from torchcloth.episodes.replay import simulate, simulate_with_tangents
from torchcloth.episodes.unknowns import collect_unknowns
from torchcloth.identification import build_episode
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.residuals.blocks import point_rows
from torchcloth.identification.residuals.rows import match_points

NAMES = ("youngs_modulus", "poisson_ratio", "bending.stiffness", "air.normal")
EARLY = 0.35  # five frames: 200 ms of the motion, 0.3 s of settling before it


@pytest.fixture
def short(recording, model):
    """(cloth, unknowns with density, five frames)."""
    unknowns = collect_unknowns(model, NAMES, recording.cloth.measured_areal_density)
    return model, unknowns, build_episode(model, recording).first_fraction(EARLY)


def start(unknowns):
    return torch.tensor([u.start for u in unknowns])


def test_tangents_are_central_differences_for_every_unknown(short):
    """The error must fall as h^2 until it is negligible: then the tangent is the derivative, not merely near it.

    The step is fixed: the stable one moves with the parameters, and with it the number of substeps.
    """
    model, unknowns, seen = short
    dt, raw = 0.5 * model.stable_step(), start(unknowns)
    frames, tangent = (part.x for part in simulate_with_tangents(model, unknowns, raw, seen, dt))
    with torch.no_grad():
        torch.testing.assert_close(frames, simulate(model, unknowns, raw, seen, dt).x, rtol=0, atol=1e-12)
        for k, unknown in enumerate(unknowns):
            size = min(1.0, abs(unknown.value(unknown.start)))
            errors = []
            for h in (1e-2 * size, 1e-3 * size):
                step = torch.zeros_like(raw)
                step[k] = h
                ahead, behind = (simulate(model, unknowns, raw + s * step, seen, dt).x for s in (1, -1))
                errors.append(float(((ahead - behind) / (2 * h) - tangent[k]).norm() / tangent[k].norm()))
            # truncation at the larger step is a few 1e-3; |v_n| in the drag has a kink, so the order is only near 2
            assert errors[1] < 1e-4, (unknown.name, errors)
            assert errors[1] < errors[0] / 20 or errors[1] < 1e-8, (unknown.name, errors)


def test_tangents_equal_reverse_mode(short):
    """Two independent ways through the same arithmetic: they agree to rounding over some 500 substeps."""
    model, unknowns, seen = short
    raw = start(unknowns).requires_grad_()
    frames = simulate(model, unknowns, raw, seen).x
    weight = torch.randn(frames.shape, generator=torch.Generator().manual_seed(0), dtype=frames.dtype)
    (reverse,) = torch.autograd.grad((weight * frames).sum(), raw)
    _, tangent = simulate_with_tangents(model, unknowns, raw.detach(), seen)
    forward = (weight * tangent.x).sum((1, 2, 3))
    torch.testing.assert_close(forward, reverse, rtol=1e-8, atol=1e-12)


def test_tangents_do_not_keep_the_substeps(short, monkeypatch):
    """Proxy for memory: no graph is recorded, and no state of a substep outlives the next few."""
    import weakref

    from torchcloth.dynamics import substep

    model, unknowns, seen = short
    model.engine = "reference"
    alive, most, step = [], 0, substep.step

    def watched(*args, **kwargs):
        nonlocal most
        state, impulses = step(*args, **kwargs)
        assert not state.x.requires_grad
        alive.append(weakref.ref(state.x))
        most = max(most, sum(ref() is not None for ref in alive[-50:]))
        return state, impulses

    monkeypatch.setattr(substep, "step", watched)
    simulate_with_tangents(model, unknowns[:2], start(unknowns[:2]), seen.first_fraction(0.0))
    assert len(alive) > 100
    assert most <= 4  # the present one, its predecessor, the last frame's


def test_jacobian_of_the_rows_with_hits_held(short):
    """Envelope theorem: with the hit triangle and weights held, the rows' slope is the distances' own.

    For a point inside the surface the foot moves within the plane, which does not change the distance to first order.
    So free differences (hits searched anew) must agree as well, but for rows whose hit jumps.
    """
    model, unknowns, seen = short
    raw, dt = start(unknowns), 0.5 * model.stable_step()
    sheet = build_surface_of_mesh(model.mesh)
    frames, tangent = simulate_with_tangents(model, unknowns, raw, seen, dt)
    part = point_rows(match_points(frames, tangent, seen, sheet))
    h = 1e-6
    for k in range(len(unknowns)):
        moves = (frames._replace(x=frames.x + s * h * tangent.x[k]) for s in (1, -1))
        ahead, behind = (point_rows(match_points(moved, None, seen, sheet)).residual for moved in moves)
        slope = (ahead - behind) / (2 * h)
        error = (slope - part.jacobian[:, k]).abs() / part.jacobian[:, k].abs().max()
        assert float((error < 1e-4).double().mean()) > 0.98  # the others hit an edge between two triangles


def test_rows_keep_their_order_and_leave_the_first_frame_out(short):
    model, unknowns, seen = short
    problem = Objective(model, unknowns, [seen])
    linear = problem.linearise(problem.start)
    value, patch = problem.evaluate(problem.start)
    off = (
        value - linear.residual
    ).abs()  # m: two kernels, last digits differ, and a point between two triangles may turn
    assert float(off.max()) < 1e-4
    assert float((off < 1e-9).double().mean()) > 0.98
    assert float((patch == linear.error_group).double().mean()) > 0.98
    points = linear.block == 0
    counts = [len(cloud) for cloud in seen.clouds]
    assert torch.bincount(linear.frame[points]).tolist() == [0, *counts[1:]]
    pieces = problem.surface.rim.piece_count
    assert torch.bincount(linear.frame[linear.block == 1]).tolist() == [0, *(pieces for _ in counts[1:])]
    assert linear.jacobian.shape == (sum(counts[1:]) + pieces * (len(counts) - 1), len(unknowns))


def test_secants_of_small_steps_are_tangents(short):
    """One-sided differences: the error is of the order of the step, 1e-4 in the logarithm."""
    model, unknowns, seen = short
    problem = Objective(model, unknowns, [seen], 0.5 * model.stable_step())
    steps = 1e-4 * torch.tensor([min(1.0, abs(u.value(u.start))) for u in unknowns])
    exact, (finite, reach) = problem.linearise(problem.start), problem.linearise_by_differences(problem.start, steps)
    missed = (exact.jacobian - finite.jacobian).norm(dim=0) / exact.jacobian.norm(dim=0)
    moved = simulate_with_tangents(model, unknowns, problem.start, seen, 0.5 * model.stable_step())[1].x
    torch.testing.assert_close(reach.position, moved.square().sum(-1).mean((1, 2)).sqrt(), rtol=0.02, atol=1e-9)
    assert float(missed.max()) < 1e-2


@pytest.mark.parametrize("open_to", ["back", "neither"])
def test_where_nothing_can_be_simulated_ahead_secants_go_back(short, monkeypatch, open_to):
    """A solution just below the stiffness that a given step allows: the search is not lost at its end."""
    model, unknowns, seen = short
    problem = Objective(model, unknowns, [seen], 0.5 * model.stable_step())
    simulated = problem._simulate_fabrics
    steps = 1e-4 * torch.tensor([min(1.0, abs(u.value(u.start))) for u in unknowns])

    def within(raw, fabrics, i, dt):
        is_open = [open_to == "back" and bool((fabric <= problem.start).all()) for fabric in fabrics]
        pairs = zip(is_open, simulated(raw, fabrics, i, dt), strict=True)
        return [frames if can_be_simulated else None for can_be_simulated, frames in pairs]

    monkeypatch.setattr(problem, "_simulate_fabrics", within)
    exact, (finite, reach) = problem.linearise(problem.start), problem.linearise_by_differences(problem.start, steps)
    missed = (exact.jacobian - finite.jacobian).norm(dim=0) / exact.jacobian.norm(dim=0)
    assert float(missed.max()) < 1e-2
    assert torch.equal(finite.jacobian, exact.jacobian) is (open_to == "neither")
    assert bool((reach.position > 0).all())


def test_frames_are_remembered_and_simulations_counted(short):
    model, unknowns, seen = short
    problem = Objective(model, unknowns, [seen, seen])
    first = problem.observe(problem.start)
    assert problem.simulations == 2
    assert problem.observe(problem.start.clone()) is first
    assert problem.simulations == 2
    problem.linearise(problem.start)
    assert problem.simulations == 2 + 2 * len(unknowns)
    for k in range(5):
        problem.observe(problem.start + 0.01 * k)
    assert len(problem._recent_frames) == 4  # frames are large


def test_two_episodes_have_frames_of_their_own(short):
    """Windows of correlated residuals must not reach from one episode into the next."""
    model, unknowns, seen = short
    one, two = Objective(model, unknowns[:1], [seen]), Objective(model, unknowns[:1], [seen, seen])
    a, b = one.linearise(one.start), two.linearise(two.start)
    half = len(a.residual)
    torch.testing.assert_close(b.residual, a.residual.repeat(2))
    assert int(b.frame[half:].min()) - int(b.frame[:half].max()) > 5


def test_a_zero_amplitude_keeps_its_sensitivity(recording, short):
    """Amplitudes are stored as they are: at zero a logarithm would have none."""
    _, _, seen = short
    model = build_cloth_at(recording, **{"air.normal": 0.0})
    unknowns = collect_unknowns(model, ["air.normal"], None)
    _, tangent = simulate_with_tangents(model, unknowns, torch.zeros(1), seen)
    assert float(tangent.x[0, -1].abs().max()) > 1e-3  # m per unit of the drag coefficient
