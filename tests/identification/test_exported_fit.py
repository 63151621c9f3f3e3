"""A saved fit in another engine's parameters."""

import json

import pytest

from torchcloth.export import export_fit


def test_fitted_values_are_exported(pair, recording, tmp_path):
    path = pair.save(tmp_path / "fit")
    export_fit(path, "newton", tmp_path / "cloth.json", recording=recording)
    physical = json.loads((tmp_path / "cloth.json").read_text())["physical"]
    thickness = recording.cloth.thickness or 1e-3
    assert physical["membrane_stiffness"] / thickness == pytest.approx(
        pair.parameters["youngs_modulus"].value, rel=1e-5
    )
    assert physical["drag_normal"] == pytest.approx(pair.parameters["air.normal"].value)
