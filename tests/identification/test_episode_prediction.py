"""An episode that was not fitted, predicted: where the truth lies, how sure that is said to be, and what is refused."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import twins

import torchcloth as tc
from torchcloth import recordings as rec
from torchcloth.episodes.replay import Frames, simulate, simulate_with_tangents
from torchcloth.episodes.unknowns import collect_unknowns
from torchcloth.errors import InvalidInput, RecordingError, UnstableStep
from torchcloth.identification import build_cloth, build_episode, episode_prediction, predict_episode
from torchcloth.identification.episode_prediction import _replace_wrong_tangents, propagate_errors
from torchcloth.identification.prediction_report import print_episode_prediction


@pytest.fixture(scope="module")
def other():
    """The same fabric, shaken faster and less far."""
    with twins.use_float64():
        return twins.take_first_frames(twins.make_twin(seed=3, amplitude=0.05, rate=3.5), 8)


@pytest.fixture(scope="module")
def result(pair, other, tmp_path_factory):
    with twins.use_float64():
        return predict_episode(pair.save(tmp_path_factory.mktemp("fit")), other)


def test_what_was_not_fitted_is_as_near_as_what_was(result, pair):
    """Noise of 1 mm; the null is far off."""
    assert result.metrics["rms"] < 1.2 * pair.fit["rms_after"]
    assert result.metrics["rms"] < 0.3 * result.metrics["rms_null"]
    assert result.misfit_std == pair.fit["rms_after"]


def test_the_error_is_that_of_finite_steps(result, pair, other):
    """A tenth of a standard error of each parameter, with their correlation, through whole simulations."""
    cloth = result.cloth
    unknowns = collect_unknowns(cloth, list(pair.correlation), None)
    raw = torch.tensor([u.start for u in unknowns])
    std = torch.tensor([pair.parameters[u.name].std / u.slope(u.start) for u in unknowns])
    data = build_episode(cloth, other)
    with torch.no_grad():
        centre = simulate(cloth, unknowns, raw, data).x
        steps = 0.1 * torch.diag(std)
        moved = torch.stack([simulate(cloth, unknowns, raw + step, data).x - centre for step in steps]) / 0.1
    matrix = torch.tensor([[pair.correlation[a.name][b.name] for b in unknowns] for a in unknowns])
    expected = torch.einsum("ktvc,kl,ltvc->tv", moved, matrix, moved).sqrt()
    assert result.vertex_std.shape == expected.shape
    assert float((result.vertex_std - expected).abs().max()) < 0.02 * float(expected.max())
    assert float(result.vertex_std[0].max()) < float(result.vertex_std.max())


def test_the_interval_holds_what_is_measured(result, pair):
    """Of the whole: parameters, grips and what the fit left; at most one in twenty of 960 points is outside."""
    assert 0.92 < result.coverage < 0.995
    assert result.half_width.shape == (8, len(result.cloth.mesh.faces))
    assert float(result.half_width.min()) >= 1.959 * pair.fit["rms_after"]
    assert float(result.half_width.max()) <= 1.97 * (pair.fit["rms_after"] + float(result.vertex_std.max()))


def test_only_forces_are_compared_where_there_is_nothing_else(pair, other, tmp_path, capsys):
    grip = {name: replace(m, force=np.tile([0.0, 0.0, 0.4], (len(m.t), 1))) for name, m in other.grippers.items()}
    felt = predict_episode(pair.save(tmp_path), replace(other, points=None, grippers=grip))
    print_episode_prediction(felt)
    printed = capsys.readouterr().out
    assert "nan" not in printed
    assert "force rms N" in printed
    assert "no points and no markers" in printed
    assert felt.as_dict()["interval"]["coverage"] is None


def test_what_it_says_is_json(result):
    content = json.loads(json.dumps(result.as_dict(), allow_nan=False))
    assert content["frames"] == 8
    assert 0 < content["std_parameters"]["rms"] <= content["std_parameters"]["max"]


def test_what_nobody_has_seen_yet_is_predicted_along_its_motion(pair, other, tmp_path, capsys):
    """Where the frames are does not matter to where the cloth goes, but for the intervals that are integrated."""
    result, seen = (predict_episode(pair.save(tmp_path), e) for e in (replace(other, points=None), other))
    start = float(next(iter(result.episode.motion.values())).t[0])
    torch.testing.assert_close(result.episode.times[:3], start + torch.tensor([0.0, 0.05, 0.1]))
    same = (seen.episode.times - result.episode.times[:, None]).abs() < 1e-9
    k, known = same.nonzero(as_tuple=True)
    assert len(k) > 3
    torch.testing.assert_close(result.frames.x[k], seen.frames.x[known], atol=1e-6, rtol=0)
    brief = {name: replace(g, t=0.01 * g.t) for name, g in other.grippers.items()}
    with pytest.raises(RecordingError, match=r"at least 0\.05 s"):
        predict_episode(pair.save(tmp_path), replace(other, points=None, grippers=brief))
    assert result.as_dict()["std_parameters"]["rms"] > 0
    assert set(result.as_dict()["measured"].values()) == {None}
    print_episode_prediction(result)
    assert "the episode has no data to compare with" in capsys.readouterr().out


def test_another_model_is_refused(pair, other, tmp_path):
    airless = replace(other, air_density=None)
    with pytest.raises(InvalidInput, match="a fit of another model; got air"):
        predict_episode(pair.save(tmp_path), airless)
    with pytest.raises(InvalidInput, match=r"got no .*identification.json"):
        predict_episode(tmp_path / "nothing", other)
    path = pair.save(tmp_path)
    content = json.loads(path.read_text())
    path.write_text(json.dumps({**content, "correlation": {"youngs_modulus": {}}}))
    with pytest.raises(RecordingError, match="does not say which model was fitted"):
        predict_episode(path, other)


def test_tangents_of_an_unstable_motion_are_replaced_by_steps():
    """A sheet that buckles: by tangents a vertex was known to metres, where a standard error moves it by 2 cm."""
    mesh = tc.meshes.rectangle(0.4, 0.4, resolution=(8, 8))
    t, (u, v) = np.linspace(0.0, 0.6, 61), mesh.uv.T
    away = 0.15 * (1 - np.cos(2 * np.pi * t))
    hands = {
        name: rec.GripperMotion(
            t, np.stack([away, 0 * t + 0.9 * x, 0 * t + 0.7], -1), np.tile([1.0, 0, 0, 0], (61, 1)), np.ones(61, bool)
        )
        for name, x in (("a", 0.0), ("b", 0.4))
    }
    nominal = {"membrane_stiffness": 130.0, "poisson_ratio": 0.3, "bending_stiffness": 1e-5}
    buckled = np.stack([0.05 * np.sin(6 * u) * v, 0.9 * u, v + 0.3], -1)
    info = rec.ClothInfo(areal_density=0.1, thickness=1e-3, vertices=mesh.vertices, faces=mesh.faces, uv=mesh.uv,
                         initial_vertices=buckled, nominal=nominal)  # fmt: skip
    grasps = {"a": rec.GraspInfo(np.array([[0.0, 0.4]]), 0.02), "b": rec.GraspInfo(np.array([[0.4, 0.4]]), 0.02)}
    clouds = rec.PointClouds(t[::20], np.tile([[0.0, 0.0, 0.5]], (4, 1)), np.ones(4, int))
    said = {"air_density": 1.2, "provenance": "synthetic: test"}
    swing = rec.Recording(cloth=info, grasps=grasps, grippers=hands, points=clouds, **said)
    with twins.use_float64():
        cloth = build_cloth(swing)
        data, unknowns = build_episode(cloth, swing), collect_unknowns(cloth, ["youngs_modulus", "air.normal"], None)
        raw, covariance = torch.tensor([u.start for u in unknowns]), torch.diag(torch.tensor([0.02, 0.03]) ** 2)
        both = simulate_with_tangents(cloth, unknowns, raw, data)
        moved, missing, untried = _replace_wrong_tangents(cloth, unknowns, raw, data, None, *both, covariance)
        before, after = (
            propagate_errors(cloth, data, both[0], m, covariance, 1e-3).vertex_std for m in (both[1], moved)
        )
    assert missing
    assert not untried
    assert float(after.max()) < 0.2
    assert float(before[-1].square().mean()) > 100 * float(after[-1].square().mean())


@pytest.mark.parametrize("possible", [(-1,), ()])
def test_a_standard_error_more_that_cannot_be_simulated_is_tried_as_one_less(monkeypatch, possible):
    tried, std = [], 0.1
    still = Frames(torch.zeros(2, 3, 3), torch.zeros(2, 3, 3), {}, torch.zeros(2))
    unknown = SimpleNamespace(name="stiffness", clip=lambda raw: raw)

    def simulate(cloth, unknowns, raw, data, dt):
        tried.append(round(float(raw[0]) / std))
        if tried[-1] not in possible:
            raise UnstableStep("too large a step")
        return still._replace(x=still.x + 2 * raw[0])

    monkeypatch.setattr(episode_prediction, "simulate", simulate)
    slopes = Frames(*(torch.zeros(1, *part.shape) for part in still[:2]), {}, torch.zeros(1, 2))
    moved, missing, untried = _replace_wrong_tangents(
        None, [unknown], torch.zeros(1), None, None, still, slopes, torch.eye(1) * std**2
    )
    assert tried == [1, -1]
    assert (missing, untried) == ((["stiffness"], []) if possible else ([], ["stiffness"]))
    assert float(moved.x.mean()) == pytest.approx(2.0 if possible else 0.0)
