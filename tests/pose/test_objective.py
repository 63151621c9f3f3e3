"""The windows: their derivatives, and that nothing is lost between them."""

from itertools import pairwise

import pytest
import torch
from helpers import twins
from helpers.occluded_twins import build_cloth

from torchcloth.episodes.replay import Replay
from torchcloth.episodes.unknowns import collect_unknowns
from torchcloth.identification import build_episode
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.nuisances import select_nuisances
from torchcloth.identification.residuals.blocks import select_blocks
from torchcloth.pose.modes import compute_modes
from torchcloth.pose.objective import CorrectedObjective, CorrectiveForce, add_correction_effect, split_into_windows


@pytest.fixture
def objective(scene):
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    data = build_episode(cloth, twins.take_first_frames(scene.recording, 6))
    correction = CorrectiveForce(
        split_into_windows(data.times, 0.1), compute_modes(cloth.mesh, 2).fields, torch.full((2,), 0.5)
    )
    nuisances = select_nuisances(["clock", "grasp", "shape"], ["rim"])
    unknowns = collect_unknowns(cloth, ["youngs_modulus"], None)
    return CorrectedObjective(
        add_correction_effect(cloth), unknowns, data, correction, None, nuisances, select_blocks(None)
    )


def test_without_force_it_is_the_simulation(objective, scene):
    frames = objective.simulate_vertices(objective.start)[0]
    with torch.no_grad():
        whole = Replay(build_cloth(scene, twins.TRUE_FABRIC))(objective.episodes[0]).x
    torch.testing.assert_close(frames, whole, rtol=0, atol=1e-12)


def test_tangents_are_the_slopes(objective):
    """Of each kind of unknown along one direction, against central differences."""
    raw = objective.start + 0.3 * objective.prior_std * torch.sin(torch.arange(len(objective.start)).double())
    frames, moved = objective.simulate_with_tangents(raw)
    torch.testing.assert_close(frames.x, objective.simulate_vertices(raw)[0], rtol=0, atol=1e-10)
    for part in (slice(0, 1), *(s.index for s in objective.nuisance_slices[0]), objective.force_slice):
        along = torch.zeros_like(raw)
        along[part] = 1e-5 * torch.cos(torch.arange(len(along[part])).double()) * objective.prior_std[part]
        ahead, behind = (objective.simulate_vertices(raw + sign * along)[0] for sign in (1, -1))
        slope = torch.einsum("k,ktvc->tvc", along, moved.x)
        torch.testing.assert_close(slope, (ahead - behind) / 2, rtol=0, atol=2e-4 * float(slope.abs().max()) + 1e-12)


def test_reverse_mode_agrees(objective):
    """Frames are torch tensors of the unknowns: a loss of one's own has a gradient."""
    raw = objective.start.clone().requires_grad_()
    frames = objective.simulate(raw, 0).x
    weights = torch.sin(torch.arange(frames.numel()).double()).reshape(frames.shape)
    (weights * frames).sum().backward()
    forward = (objective.simulate_with_tangents(raw.detach())[1].x * weights).sum((1, 2, 3))
    torch.testing.assert_close(raw.grad, forward, rtol=1e-6, atol=1e-9 * float(forward.abs().max()))


def test_a_later_force_moves_nothing_before(objective):
    _, moved = objective.simulate_with_tangents(objective.start)
    each = objective.force.count_per_window
    for w, (first, _) in enumerate(objective.force.windows):
        of_part = moved.x[objective.force_slice.start + w * each : objective.force_slice.start + (w + 1) * each]
        assert float(of_part[:, : first + 1].abs().max()) == 0.0 or w == 0  # the first acts while the cloth settles
        assert float(of_part[:, first + 1].abs().max()) > 0


@pytest.mark.parametrize(("times", "length"), [(torch.arange(10) / 30, 0.1), (torch.arange(3) * 0.5, 0.1)])
def test_windows_cover_all_frames(times, length):
    windows = split_into_windows(times, length)
    assert windows[0][0] == 0
    assert windows[-1][1] == len(times) - 1
    assert all(before[1] == after[0] for before, after in pairwise(windows))


def test_no_window_is_shorter_than_a_frame_however_short_is_asked_for():
    """1e-9 s asked for a number for each nanosecond before."""
    assert split_into_windows(torch.arange(4) / 10, 1e-9) == [(0, 1), (1, 2), (2, 3)]


def test_windows_far_from_zero():
    torch.set_default_dtype(torch.float32)
    times = torch.arange(11, dtype=torch.float64) / 30
    assert split_into_windows(times + 1.7e9, 0.1) == split_into_windows(times, 0.1) == [(0, 3), (3, 7), (7, 10)]


def test_a_part_is_the_beginning_of_the_same_motion(objective):
    part, raw = objective.first_fraction(0.5), objective.start + 0.3 * objective.prior_std
    torch.testing.assert_close(
        part.simulate_vertices(raw)[0][:3], objective.simulate_vertices(raw)[0][:3]
    )  # the last has no end to lean on


def test_the_early_frames_of_a_fit_are_the_beginning_of_the_same_motion(scene):
    """``identify`` never sets velocity or rest shape anew: what it begins with is a prefix."""
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    data = build_episode(cloth, twins.take_first_frames(scene.recording, 8))
    whole = Objective(cloth, collect_unknowns(cloth, ["youngs_modulus"], None), [data])
    raw = whole.start + 0.1
    torch.testing.assert_close(
        whole.first_fraction(0.5).simulate_vertices(raw)[0], whole.simulate_vertices(raw)[0][:4], rtol=0, atol=1e-12
    )
