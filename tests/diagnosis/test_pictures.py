"""Pictures show what the numbers say, where they belong."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import sheet_episodes

from torchcloth import diagnosis as dx
from torchcloth.diagnosis.data.binning import BIN_SECONDS, BLOCK_NAMES
from torchcloth.diagnosis.inference.screening import ScoreTest
from torchcloth.diagnosis.report.fabric_maps import choose_misfit_limit, draw_misfit_maps
from torchcloth.diagnosis.report.pictures import MAX_SHOWN_AMPLITUDE, draw_residual_maps, draw_scores


@pytest.fixture(scope="module")
def gathered():
    """(evidence, setting) of an episode whose points lie on a surface that wind has moved."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    blank = sheet_episodes.make_episode()
    wind = next(h for h in dx.list_hypotheses(dx.build_base_model(blank), [blank]) if h.name == "air.wind[y]")
    model = dx.build_base_model(blank)
    setting = dx.prepare_data(
        model, [sheet_episodes.record_changed_world("slow", lambda world: wind.apply(world, 0.5), 3)]
    )
    yield dx.linearise(model, setting), setting
    torch.set_default_dtype(before)


def test_a_part_of_the_fabric_has_its_misfit_where_it_lies(gathered):
    evidence, _ = gathered
    cells, figure = evidence.bins[0], draw_misfit_maps(*gathered)
    tiles = [axis for axis in figure.axes if axis.get_title().endswith(" s")]
    checked = 0
    for k in np.flatnonzero(cells.block == 0):
        assert tiles[cells.window[k]].get_title() == f"{BIN_SECONDS * cells.window[k]:.1f} s"
        image = tiles[cells.window[k]].images[0]
        left, right, low, high = image.get_extent()
        field, (u, v, _) = image.get_array(), cells.rest_position[k].tolist()
        rows, columns = field.shape
        row, column = int(rows * (v - low) / (high - low)), int(columns * (u - left) / (right - left))
        assert field[row, column] == pytest.approx(1e3 * cells.value[k].item())
        checked += 1
    assert checked > 30
    limit = choose_misfit_limit(evidence)
    assert tiles[0].images[0].get_clim() == (-limit, limit)
    assert limit > 3.0  # mm, what half a metre a second does


def test_parts_that_nobody_saw_are_grey(gathered):
    evidence, setting = gathered
    cells = evidence.bins[0]
    kept = ~((cells.window == 0) & (cells.channel < 3))
    less = replace(evidence, bins=[type(cells)(*(column[kept] for column in cells))])
    tile = draw_misfit_maps(less, setting).axes[0]
    unseen = tile.images[1].get_array()[..., 3] > 0
    assert 0 < unseen.mean() < 0.15
    assert not (tile.images[0].get_array().filled(np.nan)[~unseen] == 0).any()


def test_an_episode_without_points_has_an_empty_map_and_markers_do_as_well(gathered):
    evidence, _ = gathered
    cells = evidence.bins[0]
    blind = type(cells)(*(column[cells.block != 0] for column in cells))
    marked = cells._replace(
        block=torch.where(cells.block == 0, BLOCK_NAMES.index("markers"), cells.block), channel=3 * cells.channel + 2
    )

    def maps(*every):
        found = SimpleNamespace(linearisation=replace(evidence, bins=list(every)))
        searched = SimpleNamespace(start=found, end=found, accepted=[])
        return draw_residual_maps(SimpleNamespace(search=searched, content={"motions": ["a", "b"]}))  # type: ignore[arg-type]

    one, two, bar = maps(cells, blind).axes
    assert not np.isnan(one.images[0].get_array().filled(np.nan)).all()
    assert np.isnan(two.images[0].get_array().filled(np.nan)).all()
    assert "normal" in bar.get_ylabel()
    assert "upwards" in maps(marked, blind).axes[-1].get_ylabel()
    assert maps(blind, blind) is None


def test_amplitudes_beyond_the_picture_are_arrows_at_its_end():
    h = dx.Hypothesis("my.own", "N", 2.0, lambda world, a: world)
    rows = [ScoreTest(h, a, 0.1, 0.0, 9.0, 1e-3, 0.0, a, 4.5, "present") for a in (1.0, 50.0, -50.0)]
    (axis,) = draw_scores(rows).axes
    arrows = {line.get_marker(): float(line.get_xdata()[0]) for line in axis.lines if line.get_marker() in "<>"}
    assert arrows == {">": pytest.approx(MAX_SHOWN_AMPLITUDE - 0.05), "<": pytest.approx(0.05 - MAX_SHOWN_AMPLITUDE)}
