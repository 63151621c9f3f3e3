"""Viscous forces in stages: the polynomial, its accuracy, its stability, and what it must leave as it is."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

import torchcloth as tc
from torchcloth.dynamics import substep
from torchcloth.dynamics.stability import StabilityLimits, stability_limits
from torchcloth.dynamics.viscous_stages import CHEBYSHEV_PEAK, MAX_STAGES, StagePolynomial

E = tc.effects


@pytest.fixture(autouse=True)
def _values_only():
    with torch.no_grad():
        yield


def sheet(effects, n=7, boundaries=None):
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(n, n))
    return tc.Cloth(mesh, tc.materials.AEP(3e5, 0.3), 0.2, effects, boundaries, contact=None)


def limits(cloth):
    return stability_limits(cloth.build_model(), cloth._gradient)


@pytest.mark.parametrize("stages", range(2, MAX_STAGES + 1))
def test_the_polynomial_is_between_nothing_and_half_where_it_damps_fast(stages):
    first, slope = StagePolynomial.for_stages(stages)
    reach = StagePolynomial.for_stages(stages).largest_rate
    z = np.linspace(0, reach, 4001)
    values = (1 + np.polynomial.chebyshev.chebval(first - slope * z, [0] * stages + [1])) / (1 + CHEBYSHEV_PEAK)
    assert values[0] == pytest.approx(1, abs=1e-12)
    step = 1e-4
    near = (1 + np.polynomial.chebyshev.chebval(first - slope * np.array([-step, step]), [0] * stages + [1])) / (
        1 + CHEBYSHEV_PEAK
    )
    assert (near[1] - near[0]) / (2 * step) == pytest.approx(-1, abs=1e-6)  # exp(-z) to first order
    assert values.min() >= -1e-12
    assert values[z > math.log(4)].max() <= 2 / (1 + CHEBYSHEV_PEAK) + 1e-9
    assert 0.8 * stages**2 < reach < stages**2


class Inertia(E.AddedMass):
    """Of air, without what is of second order in velocities."""

    def force(self, c, inputs):
        return None


def test_one_step_is_the_polynomial_of_the_viscous_force():
    """Against powers of the matrix, with air that moves along."""
    cloth = sheet({"viscous": E.KelvinVoigt(1.0), "bending": E.Bending(1e-4, 0.05), "air": Inertia(0.3)}, 4)
    torch.manual_seed(0)
    state = cloth.state(cloth.rest_state().x @ torch.linalg.qr(torch.randn(3, 3))[0], torch.randn(16, 3))
    dt, stages = 1e-3, 5
    still = state._replace(v=torch.zeros_like(state.v))

    def after(begin, stages):
        return substep.step(cloth.build_model()._replace(stages=stages), begin, dt, {}, 0)[0].v

    pushed = after(still, 0)  # elastic forces alone
    unit = torch.eye(48).reshape(48, 16, 3)
    minus_D = torch.stack([after(still._replace(v=u), 0) - u - pushed for u in unit]).reshape(48, 48).T
    first, slope = StagePolynomial.for_stages(stages)
    before, now = torch.eye(48), first * torch.eye(48) + slope * minus_D
    for _ in range(stages - 1):
        before, now = now, 2 * (first * now + slope * minus_D @ now) - before
    expected = ((torch.eye(48) + now) / (1 + CHEBYSHEV_PEAK) @ state.v.flatten()).reshape(16, 3) + pushed
    torch.testing.assert_close(after(state, stages), expected, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("effects", [
    {"viscous": E.KelvinVoigt(3.0)},
    {"bending": E.Bending(1e-3, 0.3)},
    {"viscous": E.KelvinVoigt(0.3), "bending": E.Bending(1e-4, 0.3), "damping": E.MassDamping(3.0)},
], ids=["membrane", "bending", "both"])  # fmt: skip
def test_the_stable_step_is_stable_and_loses_energy_only(effects):
    cloth = sheet(effects)
    result = limits(cloth)
    assert result.stages_for(result.cheapest_step) > 0
    torch.manual_seed(0)
    state = cloth.state(cloth.rest_state().x, 0.05 * torch.randn(49, 3))
    out = cloth(state, times=torch.linspace(0, 2000 * result.cheapest_step, 21))
    energies = cloth.energy(tc.ClothState(out.x, out.v, out.x[..., :0, :]))
    total = energies["kinetic"] + energies["membrane"]
    assert (total[1:] < 1.01 * total[:-1]).all()


def swung(cloth):
    """By an edge, to and fro by 0.1 m: (motion, frame times)."""
    t = torch.linspace(0, 0.3, 5)
    pose = torch.eye(4).repeat(5, 1, 1)
    pose[:, 0, 3] = 0.1 * torch.sin(2 * math.pi * t / 0.3)
    return {"hand": tc.Trajectory(t, pose, torch.ones(5, dtype=bool))}, t


@pytest.mark.parametrize("viscosity", [1.0, 3.0])
def test_a_sheet_in_a_hand_moves_as_it_does_with_short_steps(viscosity):
    """To first order in the step, 0.17 mm off; three times that if the vertices in the hand yielded to the stages."""
    effects = {"viscous": E.KelvinVoigt(viscosity), "gravity": E.Gravity()}
    cloth = sheet(effects, boundaries={"hand": tc.boundaries.Grasp(range(7))})
    motion, t = swung(cloth)
    result = limits(cloth)
    exact = cloth(cloth.rest_state(), motion, t, dt=result.stable_step(0) ** 2 / result.cheapest_step).x
    steps = [result.cheapest_step / 2**k for k in range(3)]
    assert result.cheapest_step > 5 * result.stable_step(0)
    assert all(result.stages_for(dt) > 0 for dt in steps)
    errors = [float((cloth(cloth.rest_state(), motion, t, dt=dt).x - exact).square().mean().sqrt()) for dt in steps]
    assert errors[0] < 2.5e-4
    assert errors[0] > 1.5 * errors[1] > 1.5**2 * errors[2]


def test_no_stages_where_nothing_is_viscous_or_the_step_is_short():
    plain = sheet({"gravity": E.Gravity(), "damping": E.MassDamping(1.0)})
    assert limits(plain).stages_for(limits(plain).cheapest_step) == 0
    thick = limits(sheet({"viscous": E.KelvinVoigt(1.0)}))
    assert (
        thick.stages_for(thick.cheapest_step)
        > thick.stages_for(0.5 * thick.cheapest_step)
        > thick.stages_for(thick.stable_step(0) ** 2 / thick.cheapest_step)
    )
    assert thick.stages_for(thick.stable_step(0) ** 2 / thick.cheapest_step) == 0


def test_a_shorter_step_is_for_cloth_that_is_pulled_farther():
    """Its rate of damping is four times that at rest: the fewest stages of any step would have been too few."""
    ends = {"left": tc.boundaries.Grasp(range(7)), "right": tc.boundaries.Grasp(range(42, 49))}
    cloth = sheet({"viscous": E.KelvinVoigt(3.0)}, boundaries=ends)
    x = cloth.rest_state().x.clone()
    across = int((x[42] - x[0]).abs().argmax())
    x[:, across] *= 2
    t = torch.linspace(0, 0.2, 5)
    still = tc.Trajectory(t, torch.eye(4).repeat(5, 1, 1), torch.ones(5, dtype=bool))
    torch.manual_seed(0)
    state = cloth.state(x, 0.3 * torch.randn(49, 3))
    step = limits(cloth).cheapest_step
    with pytest.raises(tc.errors.SimulationDiverged):
        cloth(state, dict.fromkeys(ends, still), t)
    assert cloth(state, dict.fromkeys(ends, still), t, dt=step / 8).v[-1].abs().max() < 0.5


def test_the_step_costs_as_the_root_of_the_viscosity():
    rates = [1e4, 4e4, 16e4, 64e4]
    result = [StabilityLimits(1e7, 0.0, rate) for rate in rates]
    assert [f.stages_for(f.cheapest_step) for f in result] == sorted(f.stages_for(f.cheapest_step) for f in result)
    cost = [f.stages_for(f.cheapest_step) / f.cheapest_step for f in result]
    assert all(later < 2.6 * before for before, later in pairwise(cost))
    assert result[-1].cheapest_step > 20 * result[-1].stable_step(0)


def test_a_step_that_overflows_is_told():
    cloth = sheet({"viscous": E.KelvinVoigt(1e307)})
    assert "stable step" in str(cloth)
    with pytest.raises(tc.errors.UnstableStep, match="substep"):
        cloth(cloth.rest_state(), times=[0.0, 0.1])


@pytest.mark.parametrize("engine", ["reference", "auto"])
@pytest.mark.parametrize("effect", [E.KelvinVoigt(3.0), E.Bending(1e-3, 0.3)])
def test_a_hand_feels_what_the_cloth_is_given(effect, engine):
    """In vacuum: the hand's impulse is the cloth's momentum, also of forces that act in stages."""
    mesh = tc.meshes.rectangle(0.1, 0.1, resolution=(6, 6))
    hand = {"hand": tc.boundaries.Grasp(range(6))}
    cloth = tc.Cloth(mesh, tc.materials.AEP(3e5, 0.3), 0.2, {"viscous": effect}, hand, contact=None, engine=engine)
    assert limits(cloth).stages_for(limits(cloth).cheapest_step) > 1
    t = torch.linspace(0, 0.03, 6)
    pose = torch.eye(4).repeat(6, 1, 1)
    pose[:, 1, 3], pose[:, 2, 3] = -20 * t**2, 10 * t**2
    out = cloth(cloth.rest_state(), {"hand": tc.Trajectory(t, pose, torch.ones(6, dtype=torch.bool))}, t)
    impulse = -(out.wrench["hand"][1:, :3] * t.diff()[:, None]).sum(0)
    torch.testing.assert_close(impulse, (cloth.build_model().mass * out.state.v).sum(0), rtol=1e-9, atol=1e-12)
