"""A force that is learned for an effect which the catalogue lacks, and none where nothing is missing."""

import json

import pytest
import sheets
import torch

from torchcloth.diagnosis import (
    base_model,
    catalogue,
    diagnose,
    fit,
    learn_residual,
    load_model,
    setting_of,
    write_diagnosis,
)
from torchcloth.diagnosis.residual import RESIDUAL
from torchcloth.effects import AirDrag

HIDDEN = 1.5  # C_n, of air
MOTIONS = ("slow", "fast")


def recorded(change, seed):
    return [sheets.recorded(motion, change, seed + k) for k, motion in enumerate(MOTIONS)]


@pytest.fixture(scope="module")
def without_air():
    """A catalogue that knows nothing of air, before cloth in air."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    recordings = recorded(lambda world: world.with_cloth({"air": AirDrag(HIDDEN)}), 0)
    known = [h for h in catalogue(base_model(recordings[0]), recordings) if h.name == "rest.skew"]
    yield recordings, diagnose(recordings, hypotheses=known)
    torch.set_default_dtype(before)


def test_it_predicts_motions_that_were_held_out(without_air):
    _, answer = without_air
    assert answer.verdict == "unexplained"
    assert answer.residual.gain.after < 0.4 * answer.residual.gain.before
    told = answer.content["residual"]
    assert "opposes motion across the cloth" in told["terms"][0]["told"]
    assert [step["kept"] for step in told["path"]] == list(answer.residual.terms)
    assert "It names no cause." in answer.summary()
    assert answer.content["causes"] == []


def test_the_missing_force_opposes_the_motion(without_air):
    _, answer = without_air
    fast = answer.missing.parts[1]
    window, vertex = fast.strongest
    middle = answer.found.end.evidence.cells[1].time
    assert float(middle.min()) <= float(fast.windows[window].mean()) <= float(middle.max())
    velocity = torch.gradient(fast.x, dim=0)[0][window, vertex]
    assert float(fast.force[window, vertex] @ velocity) < 0


def test_it_is_kept_with_the_model_and_can_be_left_out(without_air, tmp_path):
    recordings, answer = without_air
    content = json.loads(write_diagnosis(answer, recordings, tmp_path).read_text())
    assert {row["kind"] for row in content["lack_of_fit"]} == {"points", "edges"}
    assert len(content["missing_force"]["motions"]) == len(MOTIONS)
    assert "The force that is missing" in (tmp_path / "report.html").read_text()
    loaded, left_out = (load_model(tmp_path / content["model"], residual=r) for r in (True, False))
    assert dict(zip([h.name for h in loaded.accepted], loaded.amplitudes, strict=True)) == {
        f"{RESIDUAL}.{term}": c for term, c in answer.residual.terms.items()
    }
    assert torch.equal(loaded.values, answer.residual.model.values)
    assert RESIDUAL in loaded.world().cloth.effects
    assert RESIDUAL not in left_out.world().cloth.effects
    assert torch.equal(left_out.values, answer.model.values)


def test_where_nothing_is_missing_nothing_is_learned():
    recordings = recorded(lambda world: world, 20)
    model = base_model(recordings[0])
    setting = setting_of(model, recordings)
    residual = learn_residual(fit(model, setting), setting)
    assert residual.terms == {}
    assert residual.gain is None
