"""Times of frames from the upper edge: on a synthetic rig with known times, and on the runs."""

import numpy as np
import pytest
from helpers.iri_rig import EDGE_OFFSET_M, TRUE_JITTER_STD_S, TRUE_LAG_S, make_run

from torchcloth.training.validation.realdata import frame_times, swings


def test_lag_jitter_and_offset_of_a_synthetic_run_are_found():
    run, _ = make_run()
    clock = frame_times.estimate_clock(run)
    assert clock.lag == pytest.approx(TRUE_LAG_S, abs=0.01)
    assert clock.jitter_std == pytest.approx(TRUE_JITTER_STD_S, rel=0.3)
    assert clock.edge_offset == pytest.approx(EDGE_OFFSET_M, abs=1e-3)


def test_times_of_frames_are_found_with_their_errors():
    """While the edge moves fast the times are right within some milliseconds; at rest the prior remains."""
    run, taken = make_run(seed=1)
    times = frame_times.estimate_frame_times(run, frame_times.estimate_clock(run))
    error, known = times.t - taken, np.isfinite(times.t)
    sharp = known & (times.std < 0.015)
    assert sharp.sum() > 15
    assert np.sqrt((error[sharp] ** 2).mean()) < 0.010
    assert np.sqrt(((error[known] / times.std[known]) ** 2).mean()) < 1.4
    assert times.std[known].max() == pytest.approx(TRUE_JITTER_STD_S, rel=0.3)
    assert not known[0]


def test_free_cloth_says_nothing_about_the_times():
    run, _ = make_run(seed=2)
    before = frame_times.estimate_frame_times(run, frame_times.estimate_clock(run))
    run["mesh_base_m"][:, :, 0, 1] += 0.02 * np.sin(run["t_mesh_s"])[:, None]  # arcs stay within 10 %
    after = frame_times.estimate_frame_times(run, frame_times.estimate_clock(run))
    both = np.isfinite(before.t) & np.isfinite(after.t)
    assert both.sum() > 40
    assert np.array_equal(before.t[both], after.t[both])


def test_the_tools_path_is_smooth_between_its_samples():
    """Of a sine of 0.5 Hz sampled at 20 Hz the spline misses micrometres, a straight line 0.6 mm."""
    run, _ = make_run()
    t = run["t_tcp_s"]
    y = 0.2 * np.sin(np.pi * t)
    path = frame_times.ToolPath({**run, "tcp_pos_m": np.stack([0 * t, y, 0 * t], -1)})
    between = t[5:-5] + 0.025
    true = 0.2 * np.sin(np.pi * between)
    assert np.abs(path.position(between)[:, 1] - true).max() < 5e-6
    assert np.abs(np.interp(between, t, y) - true).max() > 5e-4


@pytest.mark.realdata
def test_an_image_is_as_old_as_the_stamp_before_it(measured_in):
    """Behind the stamp of the frame before, the lag is 0.2 s in every run and the jitter is below 40 ms."""
    runs = swings.read_runs(measured_in("iri_cloth_swings"))
    clocks = [frame_times.estimate_clock(runs[name]) for name in list(runs)[::6]]
    assert [c.lag for c in clocks] == pytest.approx([0.21] * len(clocks), abs=0.02)
    assert frame_times.pool_clocks(clocks)[1] < 0.035
