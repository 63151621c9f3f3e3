"""Frozen clouds and clocks that are off, before a diagnosis."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import sheet_episodes

from torchcloth.cli import build_parser
from torchcloth.diagnosis import diagnose, run
from torchcloth.diagnosis.inference import episode_simulation
from torchcloth.diagnosis.inference.episode_simulation import CLOCK_STD_S, simulate_episode
from torchcloth.episodes.world_cache import WorldCache
from torchcloth.inspection.corrections import CheckedRecording

CORRECTED_CLOCK_STD_S = 0.02
NO_RUNS = {"shifted": [], "grasp_shifted": [], "with_hypotheses": [], "fine_hypotheses": set()}


class Stopped(Exception):
    pass


def freeze_last(recording):
    """Let the last cloud repeat the one before."""
    points = recording.points
    frames = [points.frame(i) for i in range(len(points))]
    return replace(recording, points=replace(points, xyz=np.concatenate([*frames[:-1], frames[-2]])))


@pytest.mark.parametrize("checks", [True, False])
def test_frozen_clouds_are_left_out_of_a_diagnosis_and_named(monkeypatch, checks):
    recording = freeze_last(sheet_episodes.make_episode())
    used = []

    def judge_nothing(result, *_):
        content = {"warnings": ["the last"]}
        return run.Diagnosis("adequate", content, result)

    monkeypatch.setattr(run, "search", lambda model, data, *_: used.append(data) or SimpleNamespace())
    monkeypatch.setattr(run, "check_against_laws", lambda result, *_: result)
    monkeypatch.setattr(run, "_judge_with_unknowns", judge_nothing)
    monkeypatch.setattr(run, "make_overlays", lambda *_: ())
    answer = diagnose([recording], hypotheses=[], checks=checks)
    assert recording.points is not None
    count = len(recording.points)
    assert len(used[0].recordings[0].points) == count - checks
    named = ["camera was frozen" in text for text in answer.content["warnings"]]
    assert named == ([True, False] if checks else [False])
    assert answer.content["episodes"][0]["frames"] == count  # the recording as it was given


def test_a_corrected_clock_is_as_uncertain_as_its_correction(made, monkeypatch):
    model, data = made
    recording = data.recordings[0]
    checked = CheckedRecording(recording, ["the clock was corrected"], CORRECTED_CLOCK_STD_S)
    used = []

    def stop(model, data, *_):
        used.append(data.clock_stds)
        raise Stopped

    monkeypatch.setattr(run, "check_recording", lambda _: checked)
    monkeypatch.setattr(run, "search", stop)
    with pytest.raises(Stopped):
        diagnose([recording], hypotheses=[])
    assert used == [(CORRECTED_CLOCK_STD_S,)]
    world, (episode,) = model.build_world(), data.episodes
    monkeypatch.setattr(
        episode_simulation, "run_episode", lambda *_, **__: SimpleNamespace(plain=frames, fine=frames, **NO_RUNS)
    )
    frames = world.simulate_observed(episode)
    worlds, fine = WorldCache(model), replace(data, fine_mesh=data)
    for clock_stds, expected in (((None,), CLOCK_STD_S), (used[0], CORRECTED_CLOCK_STD_S)):
        evidence = simulate_episode(worlds, replace(fine, clock_stds=clock_stds), 0, (), None)
        assert float(evidence.nuisance_stds[0]) == expected


@pytest.mark.parametrize("verb", [["identify", "e"], ["pose", "e"], ["diagnose", "e"]])
def test_every_verb_that_fits_an_episode_checks_it_unless_told_not_to(verb):
    parser = build_parser()
    assert parser.parse_args([*verb, "--out", "o"]).checks is True
    assert parser.parse_args([*verb, "--out", "o", "--no-checks"]).checks is False
