"""Swings and carries with the times of single frames: fit, scores and times on simulated runs, where truth is known."""

import numpy as np
import pytest
from helpers.iri_rig import EDGE_OFFSET_M, TRUE_JITTER_STD_S, TRUE_LAG_S, make_run

from torchcloth.training.studies.measured import rig, timed, timed_report
from torchcloth.training.validation.realdata.frame_times import Clock, TimedRun, ToolPath

TRUTH = {"air.normal": 1.2, "added.length": 0.10, "damping.rate": 1.5}
NOISE_M = 1e-3


def _simulated_run(seed, values=TRUTH, duration=5.0):
    """A run whose nodes are the vertices of the rig's own mesh, at the frames' true times."""
    fields, taken = make_run(seed, duration=duration)
    path = ToolPath(fields)
    use = (taken > path.t[0]) & (taken < path.t[-1] - 0.02)
    t, empty = taken[use], np.empty((0, 5, 9, 3))
    clock = Clock(TRUE_LAG_S, TRUE_JITTER_STD_S, EDGE_OFFSET_M)
    std, stamps = np.full(len(t), TRUE_JITTER_STD_S), fields["t_mesh_s"][use]
    run = TimedRun(f"run{seed}", path, clock, None, stamps, t, std, empty, t < 1, duration - 2, len(taken), 0, 0)
    [motions] = rig.simulate([run], [values])
    x = motions[run.name].at(t).reshape(len(t), rig.RIG_COLUMNS, rig.RIG_ROWS, 3)
    return run._replace(nodes=x + NOISE_M * np.random.default_rng(seed).normal(size=x.shape)), motions


@pytest.fixture(scope="module")
def runs():
    return [_simulated_run(seed, duration=4.2)[0] for seed in (1, 2)]


def test_values_are_recovered_from_simulated_runs(runs):
    start = {"air.normal": 0.9, "added.length": 0.08, "damping.rate": 1.2}
    result = timed.fit(runs, start, rounds=2)
    assert result["values"] == pytest.approx(TRUTH, rel=0.15)
    assert result["history"][-1] == pytest.approx(NOISE_M, rel=0.05)
    assert np.abs(result["offsets"]).max() < 1e-3
    mass = result["ratios"]["added mass per areal density"]
    assert mass["value"] == pytest.approx(1.204 * result["values"]["added.length"] / 0.3, rel=1e-3)
    assert 0 < mass["std"] < 0.1 * mass["value"]


def test_scores_separate_lower_edge_and_offsets(runs):
    """Nodes that are 5 mm in front, 9 mm at the lower edge, before the motion and in it."""
    shape = runs[0].nodes.shape[:3]
    distance = np.full(shape, 0.005)
    distance[:, :, 0] = 0.009
    row = timed.score(runs[:1], {runs[0].name: distance}, "none")
    assert row["lower"] == pytest.approx(0.009)
    assert row["all"] == pytest.approx(np.sqrt((8 * 0.005**2 + 0.009**2) / 9))
    assert timed.score(runs[:1], {runs[0].name: distance}, "still")["all"] == 0.0


def test_distances_are_along_the_normal_and_blind_along_the_cloth(runs):
    [run, _] = runs
    [motions] = rig.simulate([run], [TRUTH])
    x = motions[run.name].at(run.t[:1])
    nodes = x.reshape(1, rig.RIG_COLUMNS, rig.RIG_ROWS, 3)[:, 1:-1, 1:-1]  # hangs at rest in the plane of x and z
    in_front = rig.normal_distances(x, nodes + np.array([0.004, 0.003, 0.002]))
    assert np.abs(in_front) == pytest.approx(0.003, abs=1e-4)
    nodes = nodes.copy()
    nodes[0, 0, 0] = np.nan
    assert np.isnan(rig.normal_distances(x, nodes)[0, 0, 0])


def test_times_are_recovered_from_all_nodes(runs):
    [run, _] = runs
    [motions] = rig.simulate([run], [TRUTH])
    wrong = run._replace(t=run.t + 0.03 * np.sin(np.arange(len(run.t))))
    [again] = timed.retime([wrong], motions, np.zeros(run.nodes.shape[1:3]))
    moving = (run.t > 1.3) & (run.t < 3)
    before, after = (np.abs(r.t - run.t)[moving].mean() for r in (wrong, again))
    assert after < 0.4 * before


def test_one_lag_puts_the_jitter_back(runs):
    [run, _] = runs
    lagged = run.with_one_lag()
    assert np.median(lagged.t - run.t) == pytest.approx(0.0, abs=1e-9)
    assert np.ptp(lagged.t - run.t) > 0.05


def test_a_board_that_the_tool_carries(runs):
    """It has the cloth's first shape, and stays flat."""
    [run, _] = runs
    rigid, [motions] = rig.carry_rigidly(run), rig.simulate([run], [TRUTH])
    assert rigid.x[0] == pytest.approx(motions[run.name].x[0], abs=1e-9)
    assert np.ptp(rigid.x[:, :, 1], axis=1).max() < 1e-9


@pytest.mark.slow
def test_air_with_memory_is_simulated_for_many_runs_at_once():
    values = {"air.normal": 1.2, "entrained.length": 0.25, "entrained.time": 0.25}
    (first, motion), (second, _) = (_simulated_run(seed, values, duration=3.3) for seed in (3, 4))
    together = rig.simulate([first, second], [values, {**values, "entrained.time": 0.1}])
    assert together[0]["run3"].x[:200] == pytest.approx(motion["run3"].x[:200], abs=1e-9)
    assert np.abs(together[1]["run3"].x - together[0]["run3"].x).max() > 1e-3


def test_tables_and_figure(tmp_path, capsys):
    row = {"all": 0.0087, "lower": 0.0129, "median": 0.004}
    series = {"t": [0.0, 1.0], "y": [0.0, None]}
    ratio = {"value": 1.0, "std": 0.1, "low": 0.8, "high": 1.2}
    kinds = {"fitted": row, "still": row, "none": row}
    part = {
        "models": {"null": {"still": row, "none": row}, "no memory": kinds, "entrained": kinds},
        "frames": {"all": 100, "used": 80, "rejected_by_arc": 15, "rejected_by_edge": 5},
        "clock": {"lag": [0.2] * 3, "jitter_std": [0.03] * 3, "camera_turn_deg": [3.0] * 3},
        "standing": row,
        "free_swings": {label: {"frequency": 0.92, "decay": 31.0} for label in ("measured", "entrained")},
        "picture": {"run": "range90_rep9", "measured": series, "no memory": series, "entrained": series},
    }
    fits = {label: {"ratios": dict.fromkeys(timed.TIMED_UNITS, ratio)} for label in timed.TIMED_STARTS}
    steps = {label: {"one lag for a run": row, "times of frames from the upper edge": row} for label in fits}
    result = {
        "timed": {"fits": fits, "fitted_runs": ["a"], "predicted_runs": ["b"], "parts": steps, **part},
        "carries": part,
    }
    timed_report.print_tables(result)
    printed = capsys.readouterr().out
    assert "rejected 15 by arcs, 5 by the upper edge" in printed
    assert "8.7, 12.9" in printed
    assert timed_report.draw(result, tmp_path / "timed.png").is_file()
