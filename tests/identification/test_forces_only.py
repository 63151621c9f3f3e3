"""Episodes of which nothing was seen: grippers felt them."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import stretched_sheets, twins

from torchcloth.episodes import streams
from torchcloth.episodes.replay import Frames
from torchcloth.errors import InvalidInput, RecordingError
from torchcloth.identification import build_cloth, build_episode, identify, print_fit, replay_fit, save_fit_pictures
from torchcloth.identification.residuals.rigid_carry import (
    CARRIED_NULL,
    STATIC_NULL,
    ZERO_FORCE_NULL,
    find_unbeaten_null,
)

STIFFNESS = ["youngs_modulus"]


@pytest.fixture(scope="module")
def felt():
    with twins.use_float64():
        return replace(
            stretched_sheets.record_episode(seed=5, setting=stretched_sheets.EpisodeSettings(frames=9, strain=0.08)),
            points=None,
        )


@pytest.fixture(scope="module")
def fit(felt):
    with twins.use_float64():
        return identify(build_cloth(felt), felt, STIFFNESS, guess={"youngs_modulus": 1e5}, exact_bench=True)


def test_forces_alone_tell_stiffness(fit):
    result = fit.parameters["membrane_stiffness"]
    assert result.identifiable
    assert result.value == pytest.approx(60.0, rel=0.05)
    assert abs(result.value - 60.0) < 3 * result.std


def test_forces_are_compared_with_their_own_nulls(fit, felt):
    f = fit.fit
    assert all(math.isnan(f[f"{what}_{key}"]) for what in ("chamfer", "rms") for key in ("before", "after", "null"))
    assert f["points"] == 0
    # two grippers, three axes of 0.02 N each; a frame's mean is over one or two readings
    assert 0.015 < f["force_rms_after"] < 0.04
    measured = torch.cat([w[1:, :3] for w in build_episode(build_cloth(felt), felt).wrenches.values()])
    assert f["force_rms_null"] == pytest.approx(float(measured.square().sum(-1).mean().sqrt()))
    assert f["force_rms_after"] < 0.2 * f["force_rms_constant"] < 0.2 * f["force_rms_null"]


def test_frames_are_the_thinned_readings(felt):
    times = build_episode(build_cloth(felt), felt).times.numpy()
    knots = felt.grippers["left"].t
    assert np.isin(times, knots).all()
    assert times[0] == knots[0]
    assert len(times) / (times[-1] - times[0]) == pytest.approx(streams.MAX_FORCE_RATE_HZ, rel=0.1)
    slow = {name: replace(m, t=4 * m.t) for name, m in felt.grippers.items()}
    assert len(build_episode(build_cloth(felt), replace(felt, grippers=slow)).times) == len(knots)  # slow ones: all


def test_what_was_not_seen_is_null_on_disk_and_a_dash_in_the_table(fit, felt, tmp_path, capsys):
    path = fit.save(tmp_path)
    content = json.loads(path.read_text())
    assert content["fit"]["chamfer_after"] is None
    assert {entry["chamfer"] for entry in content["history"]} == {None}
    assert content["fit"]["force_rms_after"] == fit.fit["force_rms_after"]
    print_fit(fit)
    row = next(line for line in capsys.readouterr().out.splitlines() if "fitted values" in line)
    assert row.split()[-3:] == ["–", "–", f"{fit.fit['force_rms_after']:.6f}"]
    again = replay_fit(path, felt)
    assert again.warning == ""
    assert len(again.chamfer) == 0
    shifted = {name: replace(m, force=m.force + 0.1) for name, m in felt.grippers.items()}
    assert again.was_fitted
    assert not replay_fit(path, replace(felt, grippers=shifted)).was_fitted


def test_its_pictures_show_forces(fit, felt, tmp_path):
    (tmp_path / "fit.png").write_text("of an earlier fit, to points")
    drawn = save_fit_pictures(fit, [build_episode(build_cloth(felt), felt)], build_cloth(felt).mesh.faces, tmp_path)
    assert [p.name for p in drawn] == ["forces.png", "parameters.png"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["forces.png", "parameters.png"]


def test_a_fit_is_held_against_the_null_of_the_data_that_tell(felt):
    """Cloth that hangs still lies where it lay, whatever it is: only force tells of it, and only where it is in use."""
    model = build_cloth(felt)
    of_part = build_episode(model, felt)
    here = [of_part.initial + 1e-4 * torch.randn(400, *of_part.initial.shape)[0] for _ in of_part.times]
    still = replace(
        of_part,
        motion={n: m._replace(pose=m.pose[:1].expand_as(m.pose)) for n, m in of_part.motion.items()},
        clouds=here,
    )
    moved = replace(of_part, clouds=[x + torch.tensor([0.0, 0.0, 0.1]) for x in here])

    def informed(data, *kinds, force=1.0, shift=0.0):
        uses = lambda *asked: not set(asked).isdisjoint(kinds)  # noqa: E731
        scene = SimpleNamespace(uses=uses, episodes=[data], faces=torch.as_tensor(model.mesh.faces))
        x = torch.stack(list(data.clouds)) + shift
        wrench = {n: force * w.nan_to_num() for n, w in data.wrenches.items()}
        return find_unbeaten_null(scene, [Frames(x, 0 * x, wrench, torch.zeros(len(x), 0))])

    assert informed(still, "points", "force") == ""
    assert informed(still, "points", "force", force=-1.0) == ZERO_FORCE_NULL
    assert informed(still, "points") == ""
    assert informed(still, "points", shift=0.5) == STATIC_NULL
    assert informed(moved, "points", "force", force=-1.0) == ""
    assert informed(moved, "points", "force", shift=0.5) == CARRIED_NULL
    assert informed(moved, "force", shift=0.5) == ""


@pytest.mark.parametrize("options", [{"method": "adam"}, {"stop": "paper"}])
def test_what_follows_the_chamfer_distance_needs_something_seen(felt, options):
    with pytest.raises(InvalidInput, match="neither points nor markers; expected points or markers"):
        identify(build_cloth(felt), felt, STIFFNESS, **options)


def test_nothing_seen_and_nothing_felt_is_refused(felt):
    silent = {name: replace(m, force=None) for name, m in felt.grippers.items()}
    with pytest.raises(RecordingError, match="has no points, which a fit needs"):
        build_episode(build_cloth(felt), replace(felt, grippers=silent))
