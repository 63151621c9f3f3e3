"""Recordings that begin in mid-motion: the cloth starts with its velocities and does not settle."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import twins
from helpers.occluded_twins import build_cloth

from torchcloth.episodes.replay import Replay
from torchcloth.identification import build_episode
from torchcloth.identification.nuisances import NUISANCE_KINDS, implied_nuisances, select_nuisances
from torchcloth.identification.residuals.blocks import select_blocks
from torchcloth.identification.uncertainty.richardson import refine_cloth, refine_recording
from torchcloth.pose import PosePrediction, estimate_pose, first_shape, rest_coordinates
from torchcloth.pose.modes import compute_modes
from torchcloth.pose.objective import CorrectedObjective, CorrectiveForce, add_correction_effect, split_into_windows

BEGIN_FRAME = 6


@pytest.fixture(scope="module")
def later(scene):
    """The scene's recording from a frame on in which the cloth moves, with its true state there; and that motion."""
    with twins.use_float64(), torch.no_grad():
        cloth = build_cloth(scene, twins.TRUE_FABRIC)
        whole = Replay(cloth)(build_episode(cloth, scene.recording))
    points = scene.recording.require("points")
    frames = np.arange(len(points)) >= BEGIN_FRAME
    state = {"initial_vertices": whole.x[BEGIN_FRAME].numpy(), "initial_velocities": whole.v[BEGIN_FRAME].numpy()}
    info = replace(scene.recording.cloth, **state)
    return replace(scene.recording, cloth=info, points=points.select(frames), markers=None), whole.x[BEGIN_FRAME:]


def test_it_goes_on_as_the_whole_motion_does(scene, later):
    recording, frames = later
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    episode = build_episode(cloth, recording)
    assert episode.is_first_shape_measured
    assert not episode.needs_settling
    with torch.no_grad():
        torch.testing.assert_close(Replay(cloth)(episode).x, frames, rtol=0, atol=1e-5)
        still = replace(recording.cloth, initial_velocities=None)
        at_rest = Replay(cloth)(build_episode(cloth, replace(recording, cloth=still))).x
    assert float((at_rest - frames).norm(dim=-1).max()) > 5e-3


def test_tangents_along_the_first_state_are_the_slopes(scene, later):
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    episode = build_episode(cloth, later[0]).first_fraction(0.3)
    fields = compute_modes(cloth.mesh, 2).fields
    force = CorrectiveForce(split_into_windows(episode.times, 0.1), fields, torch.full((2,), 0.5))
    nuisances = [kind.with_fields(fields) for kind in select_nuisances([], ["shape", "velocity"])]
    objective = CorrectedObjective(
        add_correction_effect(cloth), [], episode, force, None, nuisances, select_blocks(None)
    )
    raw = 0.1 * objective.prior_std * torch.sin(torch.arange(len(objective.start)).double())
    _, moved = objective.simulate_with_tangents(raw)
    for part in (s.index for s in objective.nuisance_slices[0]):
        along = torch.zeros_like(raw)
        along[part] = 1e-5 * torch.cos(torch.arange(len(along[part])).double()) * objective.prior_std[part]
        ahead, behind = (objective.simulate_vertices(raw + sign * along)[0] for sign in (1, -1))
        slope = torch.einsum("k,ktvc->tvc", along, moved.x)
        torch.testing.assert_close(slope, (ahead - behind) / 2, rtol=0, atol=2e-4 * float(slope.abs().max()) + 1e-12)


def test_the_velocity_is_a_nuisance_of_a_cloth_in_motion_only(scene, later):
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    moving, still = (build_episode(cloth, r) for r in (later[0], scene.recording))
    assert implied_nuisances(["points"], [moving]) == ["rim", "shape", "velocity"]
    assert implied_nuisances(["points"], [still]) == ["rim"]
    velocity = NUISANCE_KINDS["velocity"]()
    assert velocity.number_names(cloth, still) == []
    assert velocity.initial_velocity_modes(cloth, still) is None
    assert len(velocity.number_names(cloth, moving)) == 9


def test_a_wrong_velocity_is_corrected(scene, later):
    recording, frames = later
    points = recording.require("points")
    velocities = 0.5 * recording.cloth.initial_velocities
    wrong = replace(
        recording,
        cloth=replace(recording.cloth, initial_velocities=velocities),
        points=points.select(np.arange(len(points)) < 7),
    )
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    result = estimate_pose(cloth, wrong, modes=2, window=0.2, checks=False)
    truth = frames[: len(result.x)]
    error, uncorrected = ((x - truth).square().sum(-1).mean().sqrt() for x in (result.x, result.uncorrected))
    assert error < 0.5 * uncorrected


def test_the_finer_mesh_begins_with_the_same_velocities(scene, later):
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    fine = refine_cloth(cloth)
    refined = refine_recording(later[0], cloth.mesh, fine.mesh)
    count = len(cloth.mesh.vertices)
    velocity = build_episode(fine, refined).initial_velocity
    torch.testing.assert_close(velocity[:count], torch.as_tensor(later[0].cloth.initial_velocities), rtol=0, atol=0.02)


class _Answers:
    """A network that says at each call where the cloth is, with an error that stays, among other hypotheses."""

    def __init__(self, frames, jump=0.0):
        self.frames, self.jump, self.calls = frames, jump, 0

    def __call__(self, inputs, samples=1):
        self.calls += 1
        x = (self.frames[self.calls] + 0.01 + self.jump * (-1) ** self.calls).float()
        hypotheses = torch.stack([x + 0.3, x])[None]
        nothing = torch.zeros(1)
        return PosePrediction(x[None], nothing, x[None], hypotheses, nothing, nothing, nothing, nothing)


@pytest.mark.parametrize(("has_next_clouds", "jump"), [(True, 0.0), (True, 0.05), (False, 0.0)])
def test_velocities_are_slopes_of_the_answers_to_the_next_clouds(scene, later, has_next_clouds, jump, monkeypatch):
    monkeypatch.setattr(first_shape, "VELOCITY_FIT_S", 0.2)  # the twin has few frames a second
    cloth = build_cloth(scene, twins.TRUE_FABRIC)
    episode = build_episode(cloth, later[0])
    if not has_next_clouds:
        episode = replace(episode, clouds=[episode.clouds[0], *(cloud[:0] for cloud in episode.clouds[1:])])
    frames, network = later[1], _Answers(later[1], jump)
    first = torch.zeros(1, 2, *frames.shape[1:])
    prediction = PosePrediction(*[torch.zeros(1)] * 2, first[:, 0], first, *[torch.zeros(1)] * 4)
    start = (frames[0] + 0.01).float()[None]
    v = first_shape._velocities(network, cloth, episode, rest_coordinates(cloth.mesh), prediction, start)[0]
    truth = torch.as_tensor(later[0].cloth.initial_velocities).float()
    if not has_next_clouds or jump:
        assert float(v.abs().max()) == 0
        return
    assert network.calls >= 3
    assert float((v - truth).square().mean().sqrt()) < 0.35 * float(truth.square().mean().sqrt())
