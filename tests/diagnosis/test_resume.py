"""A stopped diagnosis resumes and gives the same result bit by bit."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from helpers import sheet_episodes

from torchcloth import recordings as rec
from torchcloth.cli import main
from torchcloth.diagnosis import build_base_model, diagnose, list_hypotheses, run
from torchcloth.diagnosis.inference import linearise
from torchcloth.errors import InvalidInput

ASKED = ("air.drag_n", "obs.extrinsic[y]")


@pytest.fixture(scope="module")
def episodes():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    drag = next(
        h
        for h in list_hypotheses(build_base_model(sheet_episodes.make_episode()), [sheet_episodes.make_episode()])
        if h.name == "air.drag_n"
    )
    yield [
        sheet_episodes.record_changed_world(m, lambda world: drag.apply(world, 1.5), k)
        for k, m in enumerate(("slow", "fast"))
    ]
    torch.set_default_dtype(before)


@pytest.fixture
def counted(monkeypatch):
    """Calls of the simulations of an episode; ``stop`` interrupts after so many."""
    work, state = linearise.simulate_episode, {"calls": 0, "stop": 10**9}

    def piece(*arguments):
        if state["calls"] == state["stop"]:
            raise KeyboardInterrupt
        state["calls"] += 1
        return work(*arguments)

    monkeypatch.setattr(linearise, "simulate_episode", piece)
    return state


@pytest.mark.slow
def test_the_answer_of_a_resumed_diagnosis_is_the_same(episodes, counted, tmp_path):
    asked = [h for h in list_hypotheses(build_base_model(episodes[0]), episodes) if h.name in ASKED]
    search = partial(diagnose, episodes, hypotheses=asked, journal=tmp_path / "progress")
    whole = search()
    total, size = counted["calls"], sum(f.stat().st_size for f in (tmp_path / "progress").iterdir())
    assert size < 2e6  # 80 points a frame; a few hundred kilobytes an episode at most
    done = 0
    for stop in (3, 10**9):
        counted.update(calls=0, stop=stop)
        try:
            again = search(resume=done > 0)
        except KeyboardInterrupt:
            done += stop
    assert done == 3
    assert counted["calls"] == total - done
    assert again.content == whole.content
    assert torch.equal(again.model.point, whole.model.point)
    assert torch.equal(again.search.end.covariance, whole.search.end.covariance)


@pytest.mark.slow
def test_another_diagnosis_is_not_resumed(episodes, counted, tmp_path):
    counted["stop"] = 1
    with pytest.raises(KeyboardInterrupt):
        diagnose(episodes, hypotheses=[], journal=tmp_path / "progress")
    with pytest.raises(InvalidInput, match="another fit"):
        diagnose(episodes[::-1], hypotheses=[], journal=tmp_path / "progress", resume=True)
    camera = {name: replace(c, T_world_camera=c.T_world_camera + 0.1) for name, c in episodes[0].cameras.items()}
    open_ = {n: replace(g, closed=np.zeros_like(g.closed)) for n, g in episodes[0].grippers.items()}
    for edited in (replace(episodes[0], cameras=camera), replace(episodes[0], grippers=open_)):
        with pytest.raises(InvalidInput, match="another fit"):
            diagnose([edited, *episodes[1:]], hypotheses=[], journal=tmp_path / "progress", resume=True)
    base = build_base_model(episodes[0])
    seen = replace(
        base, base=base.base.with_observation_transform(lambda frames, e: frames._replace(x=frames.x + 0.01))
    )
    with pytest.raises(InvalidInput, match="another fit"):  # a function of the user's, which shows in what it does
        diagnose(episodes, seen, hypotheses=[], journal=tmp_path / "progress", resume=True)


@pytest.mark.slow
def test_the_command_says_how_to_go_on(episodes, counted, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(run, "list_hypotheses", lambda *_: [])
    folders = [str(rec.write(e, tmp_path / e.split["motion"])) for e in episodes]
    out, counted["stop"] = tmp_path / "out", 0
    assert main(["diagnose", *folders, "--out", str(out)]) == 130
    assert capsys.readouterr().err.splitlines() == ["torchcloth: stopped; nothing was stored yet"]
    counted["stop"] = 2
    assert main(["diagnose", *folders, "--out", str(out)]) == 130
    assert capsys.readouterr().err.splitlines() == ["torchcloth: stopped; `--resume` goes on from there"]
    assert len(list((out / "progress").glob("episode*.pt"))) == 2
    counted["stop"] = 10**9
    assert main(["diagnose", *folders, "--out", str(out)]) == 2, "what was done is not thrown away"
    said = capsys.readouterr().err.splitlines()
    assert len(said) == 1
    assert "--resume" in said[0]
    assert f"to start over, delete {out / 'progress'}" in said[0]
    assert len(list((out / "progress").glob("episode*.pt"))) == 2
    assert main(["diagnose", *folders, "--out", str(out), "--resume"]) == 0
    assert "base model: fit 1: slow, 1 of 2" in capsys.readouterr().out
    assert json.loads((out / "diagnosis.json").read_text())["causes"] == []
    assert not (out / "progress").exists()
    assert main(["diagnose", *folders, "--out", str(out), "--resume"]) == 2
