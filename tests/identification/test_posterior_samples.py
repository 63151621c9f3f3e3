"""Cloths drawn from what a fit leaves open."""

import json
import math

import numpy as np
import pytest

from torchcloth.episodes.unknowns import find_scalar_parameters
from torchcloth.identification import sample_posterior


@pytest.fixture
def fit(pair, recording, tmp_path):
    """(folder, episode, names) of a fit on disk; its errors are made up."""
    path = pair.save(tmp_path / "fit")
    content = json.loads(path.read_text())
    names = list(content["correlation"])
    for name in names:
        content["parameters"][name]["std"] = 0.1 * content["model"]["values"][name]
        content["correlation"][name] = {other: float(other == name) for other in names}
    a, b = names[:2]
    content["correlation"][a][b] = content["correlation"][b][a] = -0.9
    path.write_text(json.dumps(content))
    return path.parent, recording, names


def values(cloth, name):
    return cloth.get_submodule(find_scalar_parameters(cloth)[name]).value.item()


@pytest.mark.slow
def test_the_first_is_the_fit_and_the_others_scatter_as_it_says(fit):
    folder, recording, names = fit
    cloths = sample_posterior(folder, recording, 200)
    content = json.loads((folder / "identification.json").read_text())["model"]["values"]
    table = np.array([[values(c, name) for name in names] for c in cloths])
    assert table[0] == pytest.approx([content[name] for name in names])
    scatter = table[1:].std(axis=0) / table[0]
    assert scatter == pytest.approx(np.full(len(names), 0.1), rel=0.2)
    assert np.corrcoef(table[1:, 0], table[1:, 1])[0, 1] == pytest.approx(-0.9, abs=0.06)


def test_what_nobody_knows_stays_a_fabric(fit, tmp_path):
    folder, recording, names = fit
    content = json.loads((folder / "identification.json").read_text())
    for name in names:
        content["parameters"][name]["std"] = 1e3 * content["model"]["values"][name]
    (tmp_path / "identification.json").write_text(json.dumps(content))
    cloths = sample_posterior(tmp_path, recording, 20)
    for name in names:
        of_part = [values(c, name) for c in cloths]
        assert min(of_part) >= 0
        assert all(math.isfinite(value) for value in of_part)
        if name == "youngs_modulus":
            assert max(of_part) <= 10.001 * of_part[0]
            assert min(of_part) >= of_part[0] / 10.001


def test_the_same_seed_draws_the_same(fit):
    folder, recording, names = fit
    one, two, other = (sample_posterior(folder, recording, 3, seed)[2] for seed in (1, 1, 2))
    assert values(one, names[0]) == values(two, names[0]) != values(other, names[0])


@pytest.mark.slow
def test_an_amplitude_is_drawn_by_its_errors_alone(fit, tmp_path):
    """Those of 1/s and the like had been held within 2.3 of their units."""
    folder, recording, _ = fit
    content = json.loads((folder / "identification.json").read_text())
    content["model"]["values"]["air.normal"] = 40.0
    content["parameters"]["air.normal"]["std"] = 5.0
    (tmp_path / "identification.json").write_text(json.dumps(content))
    of_part = [values(c, "air.normal") for c in sample_posterior(tmp_path, recording, 200)]
    assert np.std(of_part) == pytest.approx(5.0, rel=0.2)
