"""Slopes of observations along the model's parameters and along causes."""

from dataclasses import replace

import pytest
import torch
from helpers import sheet_episodes

from torchcloth.diagnosis.causes.hypotheses import list_hypotheses
from torchcloth.diagnosis.inference.linearise import linearise, linearise_hypotheses
from torchcloth.episodes.steps import list_steps, one_sided_steps
from torchcloth.errors import InvalidInput

RECORDING = sheet_episodes.make_episode()


def test_what_a_parameter_does_already_has_its_slopes(made):
    """By the share of its value, wherever that is; it is not simulated."""
    model, setting = made
    by, place = {h.name: h for h in list_hypotheses(model, [RECORDING])}, [p.name for p in model.parameters]
    there = model.at_point(torch.full_like(model.point, 0.1))
    asked = [by["mass.density"], by["air.drag_n"]]
    at_once, before = linearise(there, setting, asked), linearise(there, setting)
    later = linearise_hypotheses(before, there, setting, asked)
    for found in (at_once, later):
        assert [h.name for h in found.hypotheses] == ["air.drag_n", "mass.density"]
        slopes = found.bins[0].jacobian
        own = slopes[:, place.index("areal_density")]
        torch.testing.assert_close(
            slopes[:, found.n_coordinates + 1], own, rtol=2e-3, atol=0
        )  # of a logarithm, by differences
        assert float(own.abs().max()) > 0


def test_what_no_world_can_have_is_not_asked_about(made):
    """A patch of 15 mm that is 17 mm further along holds nothing at the edge."""
    model, setting = made
    (drag,) = (h for h in list_hypotheses(model, [RECORDING]) if h.name == "air.drag_n")

    def nowhere(world, amplitude):
        raise InvalidInput("grasp", got="no vertex", expected="a patch with vertices")

    far, unseen = (replace(drag, name=name, apply=nowhere) for name in ("user.far", "user.unseen"))
    found = linearise(model, setting, [far, drag, unseen])
    assert [h.name for h in found.hypotheses] == ["air.drag_n"]
    assert torch.equal(found.bins[0].jacobian, linearise(model, setting, [drag]).bins[0].jacobian)


def test_who_asks_later_is_told_the_same(made):
    model, setting = made
    asked = [
        h
        for h in list_hypotheses(model, [RECORDING])
        if h.name in ("bend.aniso", "air.drag_n", "obs.clock", "mass.hem")
    ]
    at_once, known = linearise(model, setting, asked), linearise(model, setting, asked[:1])
    later = linearise_hypotheses(known, model, setting, asked)
    assert [h.name for h in later.hypotheses] == [h.name for h in at_once.hypotheses]
    for a, b in zip(at_once.bins[0], later.bins[0], strict=True):
        assert torch.equal(a, b)


def test_slopes_along_wind_know_nothing_of_the_drag_that_it_brings(made):
    """It brakes whichever way the wind blows: of one sign it would be in the slope, of the other against it."""
    model, setting = made
    (wind,) = (h for h in list_hypotheses(model, [RECORDING]) if h.name == "air.wind[x]")
    alone, known = replace(wind, implies=""), linearise(model, setting)

    def slope(h):
        found = linearise(model, setting, [h])
        assert found.hypotheses == [h]
        later = linearise_hypotheses(known, model, setting, [h])
        torch.testing.assert_close(later.bins[0].jacobian, found.bins[0].jacobian, rtol=1e-9, atol=1e-12)
        return found.bins[0].jacobian[:, found.n_coordinates]

    there, back = slope(alone), slope(alone.opposite)
    torch.testing.assert_close(slope(wind), 0.5 * (there + back), rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(slope(wind.opposite), slope(wind), rtol=1e-9, atol=1e-12)
    assert (there - back).norm() > 0.1 * (there + back).norm()
    ends = replace(
        wind, min_amplitude=-0.5 * wind.typical
    )  # what cannot be reversed as a whole is asked about as it is
    torch.testing.assert_close(
        linearise(model, setting, [ends]).bins[0].jacobian[:, known.n_coordinates], there, rtol=1e-9, atol=1e-12
    )


def test_steps_end_at_bounds_and_slopes_know_it(made):
    """Poisson's ratio at its largest value: a step on from there is none, one back tells."""
    model, setting = made
    place = [p.name for p in model.parameters].index("poisson_ratio")
    end = model.at_point(model.point + 9.0 * torch.eye(len(model.point)).double()[place])
    step = model.parameters[place].step
    assert one_sided_steps(end) == [(k, -s if k == place else s) for k, s in list_steps(end)]
    near, _, back = (
        linearise(end, setting, (), shifts=[(place, s * step)]).bins[0].jacobian[:, 0] for s in (0.5, 1.0, -1.0)
    )
    assert near.abs().max() < 1e-9 * back.abs().max()
    short = end.at_point(end.point - 0.25 * step * torch.eye(len(end.point)).double()[place])
    on, off = (linearise(short, setting, (), shifts=[(place, s * step)]).bins[0].jacobian[:, 0] for s in (1.0, 0.25))
    assert torch.allclose(on, off, rtol=1e-9, atol=0.0)  # both end at the bound, and are divided by the way to there


def test_slopes_are_those_of_finite_steps(made):
    model, setting = made
    found = linearise(model, setting, [h for h in list_hypotheses(model, [RECORDING]) if h.name == "obs.extrinsic[y]"])
    points = found.bins[0].block == 0
    slope = found.bins[0].jacobian[points, found.n_coordinates]
    assert float(slope.abs().median()) == pytest.approx(1.0, abs=0.05)  # the sheet faces y


def test_slopes_along_parameters_are_central_and_their_disagreement_is_rough(made):
    """At the end of a coordinate one side is all there is, and says nothing of roughness."""
    model, setting = made
    steps, last = [p.step for p in model.parameters], len(model.parameters) - 1
    model = model.at_point(model.point + 2 * steps[last] * torch.eye(last + 1)[last])  # stiffening, off its end
    shifts = [(k, sign * step) for k, step in enumerate(steps) for sign in (1.0, -1.0)]
    raw, found = linearise(model, setting, shifts=shifts), linearise(model, setting)
    (one,), (cells,) = raw.bins, found.bins
    up, down = one.jacobian[:, 0 : raw.n_coordinates : 2], one.jacobian[:, 1 : raw.n_coordinates : 2]
    assert (raw.n_coordinates, found.n_coordinates) == (2 * len(steps), len(steps))
    shrunk, central = cells.jacobian[:, : found.n_coordinates].abs(), 0.5 * (up + down).abs()
    assert (shrunk <= central).all()
    assert (shrunk >= 0.9 * central).all(), "this sheet hardly ripples"
    torch.testing.assert_close(cells.roughness, (0.5 * torch.tensor(steps) * (up - down)).norm(dim=1))
    assert not one.roughness.any()
    ended = replace(
        model,
        parameters=(*model.parameters[:-1], replace(model.parameters[-1], min_coordinate=float(model.coordinates[-1]))),
    )
    (sided,) = linearise(ended, setting).bins
    torch.testing.assert_close(sided.jacobian[:, last], up[:, last])
    assert (sided.roughness <= cells.roughness + 1e-15).all()
