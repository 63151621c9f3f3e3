"""The share of an oracle's gain, on small sheets of the same engine: nothing for who learned nothing."""

import pytest
import torch
from helpers import sheet_episodes

from torchcloth import recordings as rec
from torchcloth.diagnosis import build_base_model, fit, prepare_data, save_model
from torchcloth.diagnosis.causes.hypotheses import list_known_hypotheses
from torchcloth.recordings.consistency import merge_scene
from torchcloth.training.studies import hidden_gain
from torchcloth.training.studies.hidden_gain import build_oracle, relative_gain

DRAG = next(h for h in list_known_hypotheses() if h.name == "air.drag_n")
TRUE = 1.5


def truth(hypothesis="air.drag_n", sign=1.0):
    return {"effects": [{"name": "?", "amplitude": TRUE, "hypothesis": hypothesis, "sign": sign, "is_enabling": False}]}


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Folders of two episodes and an unseen one, and the base model fitted to the two."""
    before, folder = torch.get_default_dtype(), tmp_path_factory.mktemp("case")
    torch.set_default_dtype(torch.float64)
    paths = {}
    for k, motion in enumerate(("slow", "lift", "fast")):
        recording = sheet_episodes.record_changed_world(motion, lambda world: DRAG.apply(world, TRUE), k)
        paths[motion] = rec.write(recording, folder / motion)
    recordings = [rec.read(paths[name]) for name in ("slow", "lift")]
    model = build_base_model(recordings[0])
    fitted = fit(model, prepare_data(model, recordings))
    yield folder, paths, recordings[0], fitted
    torch.set_default_dtype(before)


@pytest.fixture(scope="module")
def oracle(case):
    """Fitted once: it knows the same in all of these."""
    _, paths, _recording, _ = case
    recordings = [rec.read(paths[name]) for name in ("slow", "lift")]
    base = build_base_model(merge_scene([*recordings, rec.read(paths["fast"])]))
    return hidden_gain._fit(build_oracle(base, truth()), prepare_data(base, recordings))


@pytest.mark.slow
@pytest.mark.parametrize(("amplitude", "low", "high"), [(None, -1e-9, 1e-9), (TRUE, 0.7, 1.0), (0.5 * TRUE, 0.3, 0.7)])
def test_share_of_the_oracles_gain(case, oracle, monkeypatch, amplitude, low, high):
    """The oracle's fabric is fitted beside the drag, the others' was without it: no 1 can be had here."""
    asked = []
    monkeypatch.setattr(hidden_gain, "_fit", lambda *given: asked.append(given[0].hidden) or oracle)
    folder, paths, recording, fitted = case
    model = fitted.model if amplitude is None else fitted.model.with_hypothesis(DRAG, amplitude)
    save = lambda name, model: save_model(folder / name, model, recording, torch.eye(len(model.point)).double())  # noqa: E731
    base, path = save("base.tcm", fitted.model), save(f"{amplitude}.tcm", model)
    share = lambda named: relative_gain([paths["slow"], paths["lift"]], base, path, named, paths["fast"], truth())  # noqa: E731
    assert low <= share({"air.drag_n"}) <= high
    assert share(set()) == 0.0  # what has no name is not said
    assert [[(h.name, a) for h, a in hidden] for hidden in asked] == 2 * [[("air.drag_n", TRUE)]]


def test_what_nobody_can_know_is_not_compared(case):
    base = case[3].model
    assert build_oracle(base, truth("")) is None
    assert build_oracle(base, truth(sign=0.0)) is None
    assert build_oracle(base, {"effects": []}) is None
    oracle = build_oracle(base, truth(sign=-1.0))
    assert [(h.name, a) for h, a in oracle.hidden] == [("air.drag_n", -TRUE)]
    effects = truth("air.wind[x]")["effects"] + [truth()["effects"][0] | {"is_enabling": True}]
    assert [h.name for h, _ in build_oracle(base, {"effects": effects}).hidden] == ["air.wind[x]"]
