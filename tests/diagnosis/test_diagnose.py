"""From recordings to an answer: one hidden effect, none, and input that cannot be used."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import sheet_episodes
from helpers.schema_checks import check_written

from torchcloth import recordings as rec
from torchcloth.cli import main
from torchcloth.diagnosis import (
    build_base_model,
    diagnose,
    list_hypotheses,
    load_model,
    prepare_data,
    run,
    search,
    write_diagnosis,
)
from torchcloth.diagnosis.decide.verdict import judge
from torchcloth.diagnosis.experiment.proposal import Proposal
from torchcloth.diagnosis.report.cloud_pictures import draw_cloud_overlays
from torchcloth.diagnosis.report.pictures import draw_residual_maps
from torchcloth.errors import InvalidInput

ASKED = ("air.drag_n", "air.linear", "mass.hem", "rest.shrink[weft]", "obs.extrinsic[y]")


def episodes(change, seed=0):
    return [
        sheet_episodes.record_changed_world(motion, change, seed + k) for k, motion in enumerate(sheet_episodes.MOTIONS)
    ]


def asked(recordings):
    return [h for h in list_hypotheses(build_base_model(recordings[0]), recordings) if h.name in ASKED]


@pytest.fixture(scope="module")
def with_drag():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    (hidden,) = (h for h in asked([sheet_episodes.make_episode()]) if h.name == "air.drag_n")
    recordings = episodes(lambda world: hidden.apply(world, 1.5))
    yield recordings, diagnose(recordings, hypotheses=asked(recordings))
    torch.set_default_dtype(before)


def test_hidden_drag_is_named(with_drag):
    _, answer = with_drag
    (cause,) = answer.content["causes"]
    assert cause["effect"] == "air.drag_n"
    assert cause["amplitude"] == pytest.approx(1.5, rel=0.15)
    low, high = cause["noise_ci95"]
    assert cause["ci95"][0] <= low < cause["amplitude"] < high <= cause["ci95"][1]
    assert 1.0 <= cause["effective_motions"] <= len(sheet_episodes.MOTIONS)
    gain = answer.content["gain"]
    assert gain["rms_after"] < 0.5 * gain["rms_before"]
    assert gain["explained_fraction"] > 0.9
    assert [row["motion"] for row in gain["per_motion"]] == list(sheet_episodes.MOTIONS)
    assert all(row["rms_after"] < row["rms_before"] for row in gain["per_motion"])
    for share, ends in (("explained_fraction", "explained_fraction_ci95"), ("log_density", "log_density_ci95")):
        assert all(row[ends][0] <= row[share] <= row[ends][1] for row in gain["per_motion"])
    squares = [[row[key] ** 2 for row in gain["per_motion"]] for key in ("rms_before", "rms_after")]
    assert min(squares[0]) < gain["rms_before"] ** 2 < max(squares[0])
    assert min(squares[1]) < gain["rms_after"] ** 2 < max(squares[1])
    assert "Cause: air.drag_n" in answer.summary()
    assert "of what can be explained" in answer.summary()
    assert answer.content["parameters"]["stiffening"]["ci95"][0] >= 0  # a number's interval ends where the number does


def test_a_cause_says_where_and_when_it_shows(with_drag):
    """Drag holds back what is free to move: the lower end of the sheet, and not in the first moment."""
    _, answer = with_drag
    (cause,) = answer.content["causes"]
    assert cause["where"]["at"][1] < 0.5 * sheet_episodes.SIDE_M
    assert cause["when"]["motion"] in sheet_episodes.MOTIONS
    assert (
        0.0
        < cause["when"]["from"]
        < cause["when"]["to"]
        <= 0.2 + sheet_episodes.FRAME_COUNT / sheet_episodes.FRAME_RATE_HZ
    )
    assert 1e-3 < cause["response"]["value"] < 0.1


def test_the_cloud_is_shown_over_both_models_where_the_first_is_farthest_off(with_drag):
    recordings, answer = with_drag
    assert [o.motion for o in answer.overlays] == list(sheet_episodes.MOTIONS)
    for o, recording in zip(answer.overlays, recordings, strict=True):
        frame = int(np.abs(recording.points.t - recording.points.t[0] - o.time).argmin())
        first = recording.points.counts[:frame].sum()
        own = recording.points.xyz[first : first + recording.points.counts[frame]]
        assert np.array_equal(o.points.numpy(), own)
        before, after = (float(d.mean()) for d in o.distances)
        assert after < (1.05 if o.motion == "lift" else 0.25) * before  # lifted, drag hardly shows
    figure = draw_cloud_overlays(answer.overlays, answer.search.data.surface.faces.numpy())
    assert len(figure.axes) == 2 * len(answer.overlays) + 1
    assert "with causes" in figure.axes[-2].get_title()


@pytest.mark.slow
def test_an_amplitude_that_no_world_can_have_ends_a_fit_and_not_the_diagnosis(with_drag):
    recordings, _ = with_drag
    (drag,) = (h for h in asked(recordings) if h.name == "air.drag_n")

    refused = []

    def brittle(world, amplitude):
        if amplitude > drag.typical:
            refused.append(amplitude)
            raise InvalidInput("brittle", got=amplitude, expected="no more than typical")
        return drag.apply(world, amplitude)

    model = build_base_model(recordings[0])
    found = search(model, prepare_data(model, recordings), [replace(drag, name="user.brittle", apply=brittle)])
    assert all(amplitude <= drag.typical for amplitude in found.end.model.amplitudes)
    assert refused


@pytest.mark.parametrize(
    ("verdict", "following", "warned"),
    [("ambiguous", None, True), ("ambiguous", {"why": "it tells"}, False), ("unexplained", None, False)],
)
def test_rivals_that_no_motion_would_tell_apart_are_warned_of(with_drag, monkeypatch, verdict, following, warned):
    """Only where experiments were tried: an answer of a search alone says nothing of them."""
    recordings, answer = with_drag
    open_ = replace(answer, verdict=verdict)
    proposal = None if following is None else Proposal(following, recordings[0])
    for name, result in (
        ("search", None),
        ("check_against_laws", None),
        ("_judge_with_unknowns", open_),
        ("propose_experiment", proposal),
    ):
        monkeypatch.setattr(run, name, lambda *_, result=result: result)
    found = diagnose(recordings, hypotheses=[])
    content = found.content
    assert content["next_experiment"] == following
    assert found.experiment is (proposal and recordings[0])
    assert (run.NO_EXPERIMENT_WARNING in content["warnings"]) is warned
    assert run.NO_EXPERIMENT_WARNING not in answer.content["warnings"]


def test_the_answer_is_written_and_its_model_is_a_layer(with_drag, tmp_path):
    recordings, answer = with_drag
    write_diagnosis(answer, recordings, tmp_path)
    content = json.loads((tmp_path / "diagnosis.json").read_text())
    check_written(content, "diagnosis")
    assert {"verdict", "causes", "ruled_out", "unresolvable", "gain", "next_experiment", "model", "warnings"} <= set(
        content
    )
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 5
    assert "<th>held-out motion</th>" in page
    assert "http" not in page  # self-contained
    assert "<th>smallest effect of interest</th><th>detectable from</th>" in page
    assert "which is not zero" in page
    world = load_model(tmp_path / content["model"]).build_world()
    assert float(world.cloth.effects["air"].normal.value) == pytest.approx(content["causes"][0]["amplitude"])


def test_the_map_of_residuals_says_which_part_of_the_fabric_a_row_is(with_drag):
    """Sixteen parts of a sheet of 0.2 m, the pattern's top first; missing drag shows at the free, lower end."""
    _, answer = with_drag
    figure = draw_residual_maps(answer)
    *maps, bar = figure.axes
    places = [tuple(map(float, label.get_text().split(","))) for label in maps[0].get_yticklabels()]
    assert len(places) == 16
    assert [v for _, v in places] == sorted((v for _, v in places), reverse=True)
    assert all(0 < u < 20 and 0 < v < 20 for u, v in places)
    assert "u, v in cm" in maps[0].get_ylabel()
    assert bar.get_ylabel() == "measured minus simulated, along the normal, mm"
    fast = maps[1].images[0].get_array()
    assert float(abs(fast[-4:]).mean()) > 3 * float(abs(fast[:4]).mean())


@pytest.mark.slow
def test_where_nothing_is_hidden_nothing_is_named():
    recordings = episodes(lambda world: world, seed=10)
    answer = diagnose(recordings, hypotheses=asked(recordings))
    assert answer.content["causes"] == []
    assert answer.verdict in ("adequate", "inconclusive")
    assert answer.content["gain"] is None
    withdrawn = replace(answer.search, withdrawn=("air.drag_n",))  # a law did more, and then did not hold
    assert judge(withdrawn, withdrawn.data.motions).verdict == "unexplained"
    end = answer.search.end
    apart = [
        torch.full_like(n, 0.03) for n in end.linearisation.mesh_differences
    ]  # m, and N: both meshes fold the cloth elsewhere
    folded = replace(answer.search, end=replace(end, linearisation=replace(end.linearisation, mesh_differences=apart)))
    assert judge(folded, folded.data.motions).verdict == "numerics"
    setting, (first, *others) = answer.search.data, answer.search.data.episodes
    late = replace(answer.search, data=replace(setting, episodes=(replace(first, frames_after_motion=3), *others)))
    assert any("come after the motion's end" in text for text in judge(late, setting.motions).content["warnings"])


def test_no_episode_and_one_given_twice_are_refused(tmp_path, capsys):
    with pytest.raises(InvalidInput, match="episodes; got none"):
        diagnose([])
    only = sheet_episodes.make_episode()
    with pytest.raises(InvalidInput, match="twice"):
        diagnose([only, only])
    folder = rec.write(only, tmp_path / "a")
    assert main(["diagnose", str(folder), str(folder), "--out", str(tmp_path / "out")]) == 2
    assert "twice" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_single_precision_is_refused(with_drag):
    torch.set_default_dtype(torch.float32)
    with pytest.raises(InvalidInput, match=r"got torch\.float32; expected torch\.float64"):
        diagnose(with_drag[0])


def test_a_model_that_is_none_is_refused(tmp_path, capsys):
    folder = rec.write(sheet_episodes.make_episode(), tmp_path / "a")
    (tmp_path / "m.tcm").write_text("x")
    assert main(["diagnose", str(folder), "--model", str(tmp_path / "m.tcm"), "--out", str(tmp_path / "out")]) == 2
    assert "m.tcm: unreadable" in capsys.readouterr().err


def test_a_cause_is_asked_about_once(with_drag):
    recordings, _ = with_drag
    with pytest.raises(InvalidInput, match=r"hypotheses; got 'air\.drag_n' twice; expected each once"):
        diagnose(recordings, hypotheses=2 * asked(recordings))
