"""A force that is learned for an effect which the catalogue lacks, and none where nothing is missing."""

import pytest
import sheets
import torch

from torchcloth.diagnosis import base_model, fit, learn_residual, load_model, save_model, setting_of
from torchcloth.diagnosis.residual import RESIDUAL
from torchcloth.effects import AirDrag

HIDDEN = 1.5  # C_n, of air


def learned(change, seed=0):
    recordings = [sheets.recorded(motion, change, seed + k) for k, motion in enumerate(sheets.MOTIONS)]
    model = base_model(recordings[0])
    setting = setting_of(model, recordings)
    fitted = fit(model, setting)
    return recordings[0], fitted.model, learn_residual(fitted, setting)


@pytest.fixture(scope="module")
def without_air():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield learned(lambda world: world.with_cloth({"air": AirDrag(HIDDEN)}))
    torch.set_default_dtype(before)


def test_it_predicts_motions_that_were_held_out(without_air):
    _, _, residual = without_air
    assert residual.gain.after < 0.4 * residual.gain.before
    (first, *_) = residual.as_dict()["terms"]
    assert "opposes motion across the cloth" in first["told"]
    assert [s["kept"] for s in residual.as_dict()["path"]] == list(residual.terms)


def test_it_is_kept_with_the_model_and_can_be_left_out(without_air, tmp_path):
    recording, plain, residual = without_air
    path = save_model(tmp_path / "m.tcm", plain, recording, residual=residual.model)
    loaded, left_out = load_model(path), load_model(path, residual=False)
    assert dict(zip([h.name for h in loaded.accepted], loaded.amplitudes, strict=True)) == {
        f"{RESIDUAL}.{term}": c for term, c in residual.terms.items()
    }
    assert torch.equal(loaded.values, residual.model.values)
    assert RESIDUAL in loaded.world().cloth.effects
    assert RESIDUAL not in left_out.world().cloth.effects
    assert torch.equal(left_out.values, plain.values)


def test_where_nothing_is_missing_nothing_is_learned():
    _, _, residual = learned(lambda world: world, seed=20)
    assert residual.terms == {}
    assert residual.gain is None
