"""The fingerprint of a plan stays the same for the same decisions and changes with every one of them."""

from dataclasses import replace

from helpers import sheet_episodes

from torchcloth.diagnosis import build_base_model, list_hypotheses
from torchcloth.diagnosis.causes import user_hypotheses
from torchcloth.diagnosis.run import _fingerprint_plan

NAMES = ["swing", "hang"]


def decided():
    recording = sheet_episodes.make_episode()
    model = build_base_model(recording)
    return recording, model, list_hypotheses(model, [recording])


def test_the_same_decisions_are_the_same_plan():
    plans = [_fingerprint_plan(model, asked, NAMES) for _, model, asked in (decided(), decided())]
    assert plans[0] == plans[1]


def test_every_decision_changes_it(monkeypatch):
    recording, model, asked = decided()
    cloth = recording.cloth
    stiffer = cloth.nominal | {"membrane_stiffness": 1.1 * cloth.nominal["membrane_stiffness"]}
    first, *others = model.parameters
    plans = {
        "as it is": _fingerprint_plan(model, asked, NAMES),
        "held out": _fingerprint_plan(model, asked, ["swing", "swing"]),
        "asked": _fingerprint_plan(model, asked[1:], NAMES),
        "matters": _fingerprint_plan(model, [replace(asked[0], smallest_fraction=0.3), *asked[1:]], NAMES),
        "sheet": _fingerprint_plan(
            build_base_model(replace(recording, cloth=replace(cloth, nominal=stiffer))), asked, NAMES
        ),
        "prior": _fingerprint_plan(replace(model, parameters=(replace(first, prior_std=0.1), *others)), asked, NAMES),
        "given": _fingerprint_plan(model.with_hypothesis(asked[0], 0.1), asked, NAMES),
        "how much": _fingerprint_plan(model.with_hypothesis(asked[0], 0.2), asked, NAMES),
    }
    monkeypatch.setitem(user_hypotheses._files, "mine.py", "0123")
    plans["whose"] = _fingerprint_plan(model, asked, NAMES)
    assert len(set(plans.values())) == len(plans)
