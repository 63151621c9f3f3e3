"""A newcomer's towel: nothing wrong counts as identified, and the grip is named."""

import json

import numpy as np
import pytest

from torchcloth import recordings
from torchcloth.identification.uncertainty.likely_reasons import REASONS_LEAD
from torchcloth.training.studies import honesty
from torchcloth.training.studies.command import main
from torchcloth.training.validation.independent.towel import TOWEL_CASES, make_towel_recording

GRIP_OR_FIRST_SHAPE = ("the grip", "the first shape")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The folder of the finished study, and its cases."""
    folder = tmp_path_factory.mktemp("towel") / "out"
    assert main(["honesty", "--towel", "--out", str(folder)]) == 0
    return folder, json.loads((folder / "towel.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("name", TOWEL_CASES)
def test_a_number_of_the_towel_holds_the_truth_or_is_not_identifiable(study, name):
    case = study[1][f"towel, {name}"]
    assert not case["refused"]
    assert case["parameters"].keys() == honesty.PARAMETER_SYMBOLS.keys()
    for fit in (case, case["exact"]):
        assert all(holds for _, holds in honesty.identified_numbers({0: fit}))


@pytest.mark.slow
@pytest.mark.parametrize("name", TOWEL_CASES)
def test_the_grip_or_the_first_shape_of_the_towel_is_the_likeliest_reason(study, name):
    """Where the bench is taken as exact: else what it gets wrong is fitted, and no misfit is left."""
    assert study[1][f"towel, {name}"]["reasons"].startswith(GRIP_OR_FIRST_SHAPE)


@pytest.mark.slow
def test_the_recordings_of_the_towel_state_no_noise(study):
    for name in TOWEL_CASES:
        assert recordings.read(study[0] / "episodes" / f"towel-{name}").observation_noise_std is None


@pytest.mark.slow
def test_the_bar_holds_one_row_of_the_towel_and_the_recording_says_two():
    made = make_towel_recording("bar", nodes=(9, 7))
    recording = made.recording
    uv, radius = np.asarray(recording.cloth.uv), recording.grasps["bar"].radius
    rise = uv[:, 1].max() - np.unique(uv[:, 1])[::-1]
    assert (rise <= radius).sum() == 2
    moved = made.vertices - made.vertices[:1]
    bar = recording.grippers["bar"].position
    travel = np.stack([np.interp(recording.points.t, recording.grippers["bar"].t, x) for x in (bar - bar[0]).T], 1)
    follows = np.abs(moved - travel[:, None]).max((0, 2))
    assert follows[uv[:, 1] > uv[:, 1].max() - 1e-9].max() < 1e-3
    assert follows[np.isclose(uv[:, 1], np.unique(uv[:, 1])[-2])].min() > 1e-3


def test_reasons_are_read_from_the_warning():
    warning = f"far off; {REASONS_LEAD}the grip (60 %), a lag (20 %); --nuisance grasp fits it"
    assert honesty.named_reasons(["other", warning]) == "the grip (60 %), a lag (20 %)"
    assert honesty.named_reasons(["other"]) == ""
