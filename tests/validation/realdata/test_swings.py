"""The IRI runs as recordings: clock, hanger, rejected frames, and what the format stores of them."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import torchcloth as tc
from torchcloth import recordings
from torchcloth._utils.constants import STANDARD_AIR_DENSITY_KG_PER_M3
from torchcloth.boundaries import Grasp
from torchcloth.identification import build_cloth, build_episode, identify
from torchcloth.training.validation.realdata import swings
from torchcloth.training.validation.realdata.free_swing import chain_frequency
from torchcloth.training.validation.realdata.swings import IRI_BENDING_N_M, IRI_DAMPING_TIME_S, SHEET_SIDE_M

pytestmark = pytest.mark.realdata

EXAMPLE_RUN = "range60_rep5"


@pytest.fixture
def source(measured_in) -> Path:
    return measured_in("iri_cloth_swings")


@cache
def read_all_episodes(source: Path) -> dict[str, recordings.Recording]:
    return {run: swings.read_episode(source, run) for run in swings.read_runs(source)}


@pytest.fixture
def episodes(source) -> dict[str, recordings.Recording]:
    return read_all_episodes(source)


@pytest.fixture
def recording(source, tmp_path) -> recordings.Recording:
    """Return the episode as it is read from the disk."""
    return recordings.read(recordings.write(swings.read_episode(source, EXAMPLE_RUN), tmp_path / "episode"))


def test_lag_of_the_mesh(source, episodes):
    """0.32 s within 0.03 s (README of the data); std over runs 10 ms, standard error of each up to 6 ms."""
    lags = [swings.estimate_lag(run) for run in swings.read_runs(source).values()]
    values = np.array([lag.value for lag in lags])
    assert np.median(values) == pytest.approx(0.32, abs=0.03)
    assert np.abs(values - 0.32).max() < 0.04
    assert max(lag.std for lag in lags) < 0.008
    assert values.std() < 0.015
    assert [e.clock_offset for e in episodes.values()] == [-v for v in values]


def test_an_added_lag_is_recovered(source):
    """The mesh's stamps are shifted by 50 ms, a known truth."""
    run = swings.read_runs(source)[EXAMPLE_RUN]
    later = {**run, "t_mesh_s": run["t_mesh_s"] + 0.05}
    assert swings.estimate_lag(later).value - swings.estimate_lag(run).value == pytest.approx(0.05, abs=0.005)


def test_hanger_offset(source):
    """0.09 m below the tool, about -0.03 m along x (README): all runs within 5 mm in height, half within 4 mm in x."""
    offsets = np.array([swings.estimate_hanger_offset(run).value for run in swings.read_runs(source).values()])
    assert offsets[:, 2] == pytest.approx(-0.088, abs=0.005)
    assert np.median(offsets[:, 0]) == pytest.approx(-0.03, abs=0.005)
    assert np.abs(offsets[:, 1]).max() < 0.012


def test_rejected_frames(episodes):
    """3 to 32 %: NaN counts as unseen, and no rejected frame is among the points."""
    rejected = []
    for e in episodes.values():
        assert e.markers is not None
        assert e.points is not None
        is_accepted = e.markers.extra["accepted"]
        rejected.append(1 - is_accepted.mean())
        assert set(e.points.t) <= set(e.markers.t[is_accepted])
        assert np.isfinite(e.points.xyz).all()
        nodes = np.isfinite(e.markers.xyz[np.isin(e.markers.t, e.points.t)]).all(-1)
        assert e.points.counts.tolist() == nodes.sum(1).tolist()
        lengths = swings.arc_lengths(e.markers.xyz[is_accepted].reshape(-1, 8, 8, 3))
        assert (np.abs(lengths / SHEET_SIDE_M - 1) < 0.1).all()
    assert min(rejected) > 0.03
    assert max(rejected) < 0.35
    assert np.median(rejected) == pytest.approx(0.14, abs=0.03)


def test_commands_do_not_repeat(source):
    """So no run is a replicate of another, though their names say rep1 to rep10: strokes differ by centimetres."""
    paths = [run["cmd_t_pos_quatwxyz"][::10, 2][:85] for run in swings.read_runs(source).values()]
    differences = [np.abs(a - b).max() for i, a in enumerate(paths) for b in paths[:i]]
    assert min(differences) > 0.005


def test_the_stamps_of_the_tool_are_right(source):
    """Against the command, evenly spaced times leave more than the stamps where samples come in bursts."""
    from scipy.optimize import least_squares

    run = swings.read_runs(source)["range90_rep2"]
    t, y, command = run["t_tcp_s"], run["tcp_pos_m"][:, 1], run["cmd_t_pos_quatwxyz"]
    even = np.polyval(np.polyfit(np.arange(len(t)), t, 1), np.arange(len(t)))

    def misfit(times: np.ndarray) -> float:
        def residual(unknown: np.ndarray) -> np.ndarray:
            return y - unknown[1] - np.interp(times - unknown[0], command[:, 0], command[:, 2])

        return least_squares(residual, [swings.motion_start(run) - 0.3, 0.0], diff_step=1e-4).cost ** 0.5

    assert misfit(t) < 0.85 * misfit(even)


def test_the_sheet_starts_where_it_is_seen(recording):
    """The flat sheet is 0.30 m square, vertical, and a grid of 8 x 8 lies within 20 mm of the first nodes."""
    corners = recording.cloth.initial_vertices
    side = [np.linalg.norm(corners[1, j] - corners[0, j]) for j in (0, 1)]
    assert [*side, *np.linalg.norm(corners[:, 1] - corners[:, 0], axis=-1)] == pytest.approx([SHEET_SIDE_M] * 4)
    cloud = recording.points.frame(0)
    uv = np.stack(np.meshgrid(*[np.linspace(0, SHEET_SIDE_M, 31)] * 2, indexing="ij"), -1).reshape(-1, 2)
    sheet = recording.cloth.interpolate_initial_positions(uv)
    assert np.linalg.norm(cloud[:, None] - sheet, axis=-1).min(1).mean() < 0.015


def test_the_standing_cloth_leans(source):
    """By 11 mm in every run: a bias that no fit of fabric should explain."""
    lean = np.array([swings.measure_lean(run) for run in swings.read_runs(source).values()])
    assert np.median(lean) == pytest.approx(0.011, abs=0.002)
    assert lean.min() > 0.005


def test_an_episode_can_be_identified(recording):
    """The grasp holds the whole upper edge, and the first frame lies before the tool moves."""
    cloth = build_cloth(recording)
    grasp = cloth.boundaries["hanger"]
    assert isinstance(grasp, Grasp)
    assert cloth.mesh.uv is not None
    assert np.flatnonzero(cloth.mesh.uv[:, 1] > SHEET_SIDE_M - 1e-9).tolist() == grasp.index.tolist()
    episode = build_episode(cloth, recording)
    assert len(episode.clouds) == len(recording.points)
    motion = recording.grippers["hanger"]
    assert (
        np.linalg.norm(motion.position[motion.t < episode.times[0].item() + 0.3] - motion.position[0], axis=1).max()
        < 3e-3
    )


def test_notes_name_what_is_unknown(recording):
    notes = recording.extra["notes"]
    assert {"assumed", "not known", "lag (s)", "hanger from tool (m)", "frames"} <= notes.keys()
    assert recording.provenance == "measured"
    assert recording.truth is None
    assert recording.cloth.areal_density_std / recording.cloth.areal_density > 0.5


@pytest.mark.slow
def test_identify_finds_the_air_that_moves_along(recording):
    """The whole run, with its strokes, gives the frequency of the free swings, 0.90 Hz, which was not fitted.

    Reached: 0.91 Hz; three other runs 0.92 Hz. Without added mass the misfit is 16.1 mm instead of 14.9 mm. Tangents
    are useless beyond 2.4 s: they miss finite steps by their own size. The first 2.4 s, 22 of 98 frames, determine the
    fit. Over all frames the misfit is 15.9 mm (19.7 mm for a rigidly carried cloth). Rightly, no parameter is
    identifiable: nodes lean by 10 mm at rest, and drag has another coefficient at small amplitudes.
    """
    effects = {
        "gravity": tc.effects.Gravity(),
        "air": tc.effects.AirDrag(1.2, density=STANDARD_AIR_DENSITY_KG_PER_M3),
        "bending": tc.effects.Bending(IRI_BENDING_N_M, IRI_DAMPING_TIME_S),
        "added": tc.effects.AddedMass(0.1, STANDARD_AIR_DENSITY_KG_PER_M3),
    }
    cloth = build_cloth(recording, effects=effects)
    fit = identify(cloth, recording, ["air.normal", "added.length"], iterations=6, guess={"air.normal": 6.0})
    mass = STANDARD_AIR_DENSITY_KG_PER_M3 * fit.parameters["added.length"].value / fit.parameters["areal_density"].value
    assert chain_frequency(SHEET_SIDE_M) / (1 + mass) ** 0.5 == pytest.approx(0.90, rel=0.05)
    assert fit.fit["chamfer_after"] < 0.85 * fit.fit["chamfer_null"]
