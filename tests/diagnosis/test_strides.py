"""Strides on the given mesh between two looks."""

import math
from dataclasses import replace

import linear_toys as toys
import pytest
import torch

from torchcloth.diagnosis import gather, strides
from torchcloth.diagnosis.cells import cells_of
from torchcloth.diagnosis.leaping import leap
from torchcloth.diagnosis.noise import least, whitened
from torchcloth.errors import SimulationDiverged

TRUTH = 0.4
STEP = torch.tensor([0.3], dtype=torch.float64)


@pytest.fixture
def curved(monkeypatch):
    """(a model at 0, its evidence, where was glanced): residuals bend, and their optimum is at ``TRUTH``."""
    there = toys.fitted(toys.evidence(toys.smooth(1, 2), 1, [], torch.zeros(1).double(), 0))
    bent = lambda u: math.sin(2 * u) - math.sin(2 * TRUTH)  # noqa: E731

    class Seen(list):
        edge, sign = torch.inf, 1.0  # beyond which nothing is possible; how much is off, beside what is known

    seen = Seen()

    def at(u: float):
        cells = [c._replace(value=c.value + seen.sign * bent(u) * c.jacobian[:, 0]) for c in there.evidence.cells]
        return replace(there.evidence, cells=cells)

    def glance(model, like, setting):
        u = float(model.point[0])
        if u > seen.edge:
            raise SimulationDiverged("x", got="nan", expected="numbers")
        seen.append(u)
        cells = [a._replace(value=b.value) for a, b in zip(like.cells, at(u).cells, strict=True)]
        return replace(like, cells=cells)

    monkeypatch.setattr(strides, "glance", glance)
    return there.model, at(0.0), seen


def test_they_go_where_the_data_are_though_slopes_bend(curved):
    model, here, seen = curved
    found, last = strides.further(model, here, least(), STEP, None)  # type: ignore[arg-type]
    assert float(found.point[0]) == pytest.approx(TRUTH, abs=0.05)
    assert abs(float(STEP) - TRUTH) > 0.05
    assert last is not None
    assert last < strides.LITTLE
    assert 1 < len(seen) < strides.MOST


def test_the_first_step_is_taken_whatever_a_glance_says(curved):
    model, here, seen = curved
    seen.sign = 20.0
    found, last = strides.further(model, here, least(), STEP, None)  # type: ignore[arg-type]
    assert float(found.point[0]) == float(STEP)
    assert last is None


def test_none_goes_into_the_impossible(curved):
    model, here, seen = curved
    seen.edge = 0.32
    found, last = strides.further(model, here, least(), STEP, None)  # type: ignore[arg-type]
    assert float(found.point[0]) == float(STEP)
    assert last is not None
    assert last >= strides.LITTLE


def test_what_the_given_mesh_does_not_see_is_not_looked_for_there(curved):
    model, here, seen = curved
    model, step = model.plus(toys.hypothesis("crease", finer=True)), torch.tensor([0.3, 0.1])
    found, last = strides.further(model, here, least(), step, None)  # type: ignore[arg-type]
    assert torch.equal(found.point, step)
    assert last is None
    assert not seen


def test_corrected_slopes_lead_where_the_step_did(curved):
    """And what goes across it is left alone, in units of the priors."""
    model, here, _ = curved
    model = replace(model, parameters=(*model.parameters, toys.parameter("other", 0.2))).at(torch.zeros(2).double())
    columns = toys.smooth(2, 1)[..., 0]
    before = replace(
        here,
        own=2,
        cells=[
            c._replace(jacobian=torch.cat([c.jacobian[:, :1], other[:, None], c.jacobian[:, 1:]], 1))
            for c, other in zip(here.cells, columns, strict=True)
        ],
    )
    seen = replace(before, cells=[c._replace(value=c.value + 1e-3 * torch.rand_like(c.value)) for c in before.cells])
    step = torch.tensor([0.1, -0.3]).double()
    found = strides.corrected(before, seen, step, model)
    wide = torch.tensor([p.std for p in model.parameters])
    across = wide**2 * torch.tensor([0.3, 0.1])
    assert float((across / wide) @ (step / wide)) == pytest.approx(0.0)
    for old, new in zip(before.cells, found.cells, strict=True):
        torch.testing.assert_close(new.jacobian[:, :2] @ step, new.value - old.value)
        torch.testing.assert_close(new.jacobian[:, :2] @ across, old.jacobian[:, :2] @ across)
        assert torch.equal(new.jacobian[:, 2:], old.jacobian[:, 2:])


def test_a_glance_is_the_given_mesh_less_what_the_meshes_differed_by(made):
    model, setting = made
    here = gather(model, setting)
    again = strides.glance(model, here, setting)
    for first, second in zip(here.cells, again.cells, strict=True):
        torch.testing.assert_close(first.value, second.value, rtol=0, atol=1e-15)
    beside = model.at(model.point + 0.1)
    seen = strides.glance(beside, here, setting)
    frames = beside.world().frames(setting.episodes[0], setting.dt)
    plain = cells_of(frames, None, setting.episodes[0], setting.sheet, setting.rest)
    values = dict(zip(plain.key.tolist(), plain.value.tolist(), strict=True))
    own = seen.cells[0]
    for key, value, difference in zip(own.key.tolist(), own.value.tolist(), seen.numerics[0].tolist(), strict=True):
        assert value == pytest.approx(values[key] - difference, abs=1e-15)
    step, ahead = leap(whitened(here, least()), model)
    assert torch.isfinite(step).all()
    assert ahead >= 0
