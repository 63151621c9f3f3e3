"""What differs from episode to episode: derivatives, recovery, and that it is kept apart from the fabric."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import stretched_sheets, twins

from torchcloth.episodes.grip_patch_mesh import grip_extent_range
from torchcloth.episodes.replay import Frames, simulate
from torchcloth.episodes.unknowns import collect_unknowns
from torchcloth.errors import InvalidInput
from torchcloth.identification import build_episode, identify
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.nuisances import GRIP_EXTENT_STD_RADII, NUISANCE_KINDS, select_nuisances
from torchcloth.identification.residuals.blocks import select_blocks

EVERY = ("clock", "camera", "tare", "grasp", "shape")


@pytest.fixture(scope="module")
def pulled():
    with twins.use_float64():
        return stretched_sheets.record_episode(markers=5)


def near(recording):
    """A start that is wrong by a sixth: the search is short."""
    return stretched_sheets.build_start_cloth(recording, youngs_modulus=7e4, poisson_ratio=0.3)


@pytest.fixture
def objective(pulled):
    model = stretched_sheets.build_start_cloth(pulled)
    seen = build_episode(model, pulled).first_fraction(0.3)
    return Objective(
        model, collect_unknowns(model, ["youngs_modulus"], None), [seen, seen], 4e-4, select_nuisances(EVERY, ["rim"])
    )


@pytest.mark.slow
def test_every_unknown_has_its_slope(objective):
    """Against central differences away from zero, where turns are not linear: markers, forces and points alike."""
    generator = torch.Generator().manual_seed(0)
    raw = objective.start + 0.3 * objective.prior_std * torch.randn(len(objective.start), generator=generator)
    raw[0] = objective.start[0]
    raw[1] = 4e-3  # the clock, inside an interval: at the first frame the cloth stands before and moves after
    exact = objective.linearise(raw)
    assert exact.jacobian.shape[1] == 1 + 2 * (1 + 6 + 6 + 1 + 6 + 9)
    rows = exact.block >= 2  # markers and forces: points jump to another triangle, and the rim is right on average
    for k in range(exact.jacobian.shape[1]):
        h = 1e-4 * float(objective.prior_std[k])
        step = torch.zeros_like(raw)
        step[k] = h
        slope = (objective.evaluate(raw + step)[0] - objective.evaluate(raw - step)[0]) / (2 * h)
        error, size = ((part[rows]).norm() for part in (slope - exact.jacobian[:, k], exact.jacobian[:, k]))
        assert float(error) < 1e-3 * float(size) + 1e-9, k


def test_a_turned_grip_turns_what_it_holds_and_leaves_what_is_far(pulled):
    model = stretched_sheets.build_start_cloth(pulled)
    episode = build_episode(model, pulled)
    (turn,) = select_nuisances(["grasp_turn"])
    modes = turn.initial_shape_modes(model, episode)
    assert len(modes) == len(turn.number_names(model, episode)) == 3 * len(model.boundaries)
    for grasp, fields in zip(model.boundaries.values(), modes.split(3), strict=True):
        held, x = fields[:, grasp.index], episode.initial[grasp.index]
        apart, moved = x[:, None] - x, held[:, :, None] - held[:, None]
        assert float((apart * moved).sum(-1).abs().max()) < 1e-12  # distances stay, to first order
        lever = (episode.initial - x.mean(0)).norm(dim=-1)
        assert float(fields[1].norm(dim=-1)[lever.argmax()] / lever.max()) < 0.1
    with pytest.raises(InvalidInput, match="rad"):
        select_nuisances({"grasp_turn": -1.0})


def test_how_far_a_grip_reaches_has_its_slope_and_its_limits(pulled, monkeypatch):
    """Against central differences of markers and forces; the meshes of different reaches differ."""
    radius = 0.03
    monkeypatch.setattr(stretched_sheets, "GRASP_RADIUS_M", radius)
    model = stretched_sheets.build_start_cloth(pulled)
    seen = build_episode(model, pulled).first_fraction(0.3)
    blocks = select_blocks(["markers", "force"])
    unknowns = collect_unknowns(model, ["youngs_modulus"], None)
    result = Objective(model, unknowns, [seen], 4e-4, select_nuisances(["grip"]), blocks)
    assert result.nuisance_slices[0][0].names == ["grip.left", "grip.right"]
    assert result.prior_std[1:].tolist() == pytest.approx([GRIP_EXTENT_STD_RADII * radius] * 2)
    raw = result.start.clone()
    raw[1] = 1e-3
    exact = result.linearise(raw)
    for k in (1, 2):
        step = torch.zeros_like(raw)
        step[k] = 5e-4
        slope = (result.evaluate(raw + step)[0] - result.evaluate(raw - step)[0]) / 1e-3
        assert float((slope - exact.jacobian[:, k]).norm()) < 0.1 * float(slope.norm()) != 0
    raw[1:] = torch.tensor([-1.0, 1.0])
    least, most = (f * radius for f in grip_extent_range(model))
    assert -radius < least < -0.5 * radius
    assert 0.5 * radius < most
    assert result.clip(raw)[1:].tolist() == pytest.approx([least, most])


def test_a_first_shape_that_was_not_measured_does_not_settle(pulled):
    """Slopes along where the grippers hold, of cloth that moves from the first frame on."""
    model = stretched_sheets.build_start_cloth(pulled)
    seen = replace(build_episode(model, pulled).first_fraction(0.3), needs_settling=False)
    result = Objective(
        model, collect_unknowns(model, ["youngs_modulus"], None), [seen], 4e-4, select_nuisances(["grasp"])
    )
    still = simulate(model, result.unknowns, result.start[:1], seen, 4e-4)
    torch.testing.assert_close(result.observe(result.start)[0].x, still.x)


def test_what_a_late_clock_sees_moves_as_fast_as_it_is_seen_to(pulled):
    model = stretched_sheets.build_start_cloth(pulled)
    seen, of_part = build_episode(model, pulled).first_fraction(0.3), collect_unknowns(model, ["youngs_modulus"], None)
    frames, clock, h = simulate(model, of_part, torch.tensor([of_part[0].start]), seen), NUISANCE_KINDS["clock"](), 1e-6
    one, two = (clock.observe(frames, torch.tensor([0.004 + d]), seen) for d in (-h, h))
    torch.testing.assert_close((two.x - one.x)[:-1] / (2 * h), 0.5 * (one.v + two.v)[:-1], rtol=1e-5, atol=1e-6)


def test_an_episodes_nuisances_do_not_touch_the_other(objective):
    linear = objective.linearise(objective.start)
    first = linear.frame < len(objective.episodes[0].times)
    assert float(linear.jacobian[first, 30:].abs().max()) == 0.0
    assert float(linear.jacobian[~first, 1:30].abs().max()) == 0.0


def test_a_late_clock_is_found(pulled):
    late = stretched_sheets.record_episode(setting=stretched_sheets.EpisodeSettings(clock=0.02))
    fit = identify(near(late), late, ["youngs_modulus"], nuisances={"clock": 0.05}, iterations=4, exact_bench=True)
    (of_part,) = fit.nuisances.values()
    assert abs(of_part["clock"].value - 0.02) < 4 * of_part["clock"].std
    assert of_part["clock"].value == pytest.approx(0.02, abs=3e-3)
    assert of_part["clock"].unit == "s"
    assert "clock" not in fit.parameters


def test_a_late_clock_far_from_zero_and_in_single_precision(pulled):
    seen = build_episode(stretched_sheets.build_start_cloth(pulled), pulled)
    wave = lambda t: (torch.sin(9.0 * t), 9.0 * torch.cos(9.0 * t))  # noqa: E731
    since = seen.times - seen.times[0]
    x, v = (f.float()[:, None, None] for f in wave(since))
    frames = Frames(x, v, {}, x.new_zeros(len(since)))
    far = replace(seen, times=seen.times + 1.7e9)
    late = NUISANCE_KINDS["clock"]().observe(frames, torch.tensor([5e-3]), far).x[:-1, 0, 0]
    torch.testing.assert_close(late, wave(since[:-1] + 5e-3)[0].float(), rtol=0, atol=1e-3)


def test_a_late_clock_sees_what_comes_after_the_last_frame(pulled):
    """Against a simulation at the later times; without more frames the cloth would stand still at the last."""
    model = stretched_sheets.build_start_cloth(pulled)
    seen = build_episode(model, pulled)
    longer, late = seen.with_lookahead(0.09), 0.05
    assert longer.observed_count == len(seen.times)
    assert float(longer.times[-1]) == pytest.approx(float(seen.times[-1]) + 0.09)
    assert [len(longer.clouds[t]) for t in range(len(seen.times), len(longer.times))] == [0, 0]
    assert not bool(longer.markers[len(seen.times) :].isfinite().any())
    of_part = collect_unknowns(model, ["youngs_modulus"], None)
    raw = torch.tensor([of_part[0].start])
    truth = simulate(model, of_part, raw, replace(seen, times=torch.cat([seen.times, seen.times[-1:] + late]))).x[-1]
    clock = NUISANCE_KINDS["clock"]()
    errors = []
    for given in (longer, seen):
        frames = clock.observe(simulate(model, of_part, raw, given), torch.tensor([late]), given)
        errors.append((frames.x[len(seen.times) - 1] - truth).norm(dim=-1).max().item())
    assert errors[0] < 0.1 * errors[1]


def test_a_shifted_camera_is_found_and_the_fabric_stays(pulled):
    points, markers = pulled.points, pulled.markers
    shift = np.array([0.002, -0.003, 0.004])
    moved = replace(
        pulled,
        points=replace(points, xyz=points.xyz + shift),
        markers=replace(markers, xyz=markers.xyz + shift),
    )
    fit = identify(near(moved), moved, ["youngs_modulus"], nuisances={"camera": 0.01}, iterations=4, exact_bench=True)
    (of_part,) = fit.nuisances.values()
    for axis, value in zip("xyz", shift, strict=True):
        assert of_part[f"camera.{axis}"].value == pytest.approx(value, abs=1e-3)
    assert fit.parameters["membrane_stiffness"].value == pytest.approx(60.0, rel=0.05)


def test_names_and_deviations():
    result = select_nuisances({"clock": 0.4, "camera": None}, implied=["rim"])
    assert [(n.name, n.std) for n in result] == [("clock", 0.4), ("camera", 0.002), ("rim", 0.002)]
    assert select_nuisances({"rim": 0}, implied=["rim"]) == []
    assert select_nuisances(()) == []
    with pytest.raises(InvalidInput, match=r"nuisance; got 'clok'; expected one of clock, jitter, camera"):
        select_nuisances(["clok"])
    with pytest.raises(InvalidInput, match="nuisance clock; got -1"):
        select_nuisances({"clock": -1.0})
    assert set(EVERY) < set(NUISANCE_KINDS)
