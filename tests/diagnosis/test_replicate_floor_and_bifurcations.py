"""Floor from repeated motions, and bins whose response is discontinuous."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import linear_evidence as toys
from helpers import sheet_episodes

from torchcloth import recordings as rec
from torchcloth.diagnosis import build_base_model
from torchcloth.diagnosis.data.dataset import prepare_data
from torchcloth.diagnosis.data.replicate_floor import estimate_replicate_floor, find_replicate_pairs
from torchcloth.diagnosis.decide.criteria import CRITERIA
from torchcloth.diagnosis.inference.bifurcations import _perturb_initial_shape, _select_discontinuous, drop_bins
from torchcloth.diagnosis.inference.comparison import HeldOutPrediction
from torchcloth.meshes import topology


def told(values: list[torch.Tensor]) -> HeldOutPrediction:
    """Residuals of one cell after the other, as if predicted."""
    size, every = len(values[0]), torch.cat(values)
    key = torch.arange(size).repeat(len(values))
    episode = torch.arange(len(values)).repeat_interleave(size)
    return HeldOutPrediction(every, every, 0 * every, key, episode, 0 * key, episode, 0 * key, 1 + 0 * every)


def test_the_floor_is_what_repetitions_differ_by_whatever_the_model_gets_wrong():
    rng = torch.Generator().manual_seed(0)
    wrong = 0.02 * torch.randn(4000, generator=rng).double()
    spread = torch.linspace(1e-3, 3e-3, 4000).double()
    noise = [spread * torch.randn(4000, generator=rng).double() for _ in range(3)]
    found = estimate_replicate_floor(told([wrong + n for n in noise]), [(0, 1), (0, 2), (1, 2)])
    assert found.rms == pytest.approx(float(spread.square().mean().sqrt()), rel=0.03)
    assert estimate_replicate_floor(told(noise), []) is None


def test_repetitions_are_of_one_command(tmp_path):
    def kept(name, motion, split, shift=0.0, turn=1.0):
        own = replace(sheet_episodes.make_episode(motion), split=split)
        facing = np.array([turn, 0.0, 0.0, (1 - turn**2) ** 0.5])
        moved = {
            n: replace(g, position=g.position + shift * g.t[:, None], quat_wxyz=np.tile(facing, (len(g.t), 1)))
            for n, g in own.grippers.items()
        }
        return rec.read(rec.write(replace(own, grippers=moved), tmp_path / name))

    recordings = [
        kept("a", "slow", {"motion": "swing"}),
        kept("b", "slow", {"motion": "swing"}),
        kept("c", "fast", {"motion": "swing"}),  # another amplitude
        kept("d", "slow", {"motion": "other", "replicate_of": "a"}),
        kept("e", "slow", {"motion": "swing"}, shift=0.1),  # 3 cm farther on
        kept("f", "lift", {"motion": "lift"}),
        kept("g", "slow", {"motion": "swing"}, turn=0.9),  # another heading
    ]
    setting = prepare_data(build_base_model(recordings[0]), recordings)
    assert find_replicate_pairs(setting.recordings, setting.episodes) == [(0, 1), (0, 3), (1, 3)]
    free = [replace(e, motion={}) for e in setting.episodes]  # cloth that no gripper drives
    assert find_replicate_pairs(recordings[:2], free[:2]) == [(0, 1)]
    assert find_replicate_pairs(recordings[:2], [free[0], setting.episodes[1]]) == []


def test_first_shapes_are_off_by_smooth_fields_along_the_normal_there_and_back():
    blank = sheet_episodes.make_episode()
    model = build_base_model(blank)
    (e,) = prepare_data(model, [blank]).episodes
    begun = _perturb_initial_shape(e, model.build_world(), torch.Generator().manual_seed(0))
    off = [b.initial - e.initial for b in begun]
    assert all(b.needs_settling for b in begun)
    assert torch.equal(
        begun[0].initial, _perturb_initial_shape(e, model.build_world(), torch.Generator().manual_seed(0))[0].initial
    )
    torch.testing.assert_close(off[1], -off[0])
    assert (off[0] - off[2]).norm() > 0.5 * off[0].norm()
    edges = torch.as_tensor(topology.find_edges(model.base.cloth.mesh.faces)[0])
    for field in (off[0], off[2]):
        assert float(field.square().sum(1).mean().sqrt()) == pytest.approx(CRITERIA.bifurcation.initial_shape_rms_m)
        assert float(field[:, 1].square().mean().sqrt()) == pytest.approx(
            CRITERIA.bifurcation.initial_shape_rms_m, rel=0.01
        )  # the sheet hangs in x and z
        assert (
            float((field[edges[:, 0]] - field[edges[:, 1]]).square().sum(1).mean().sqrt())
            < CRITERIA.bifurcation.initial_shape_rms_m
        )


def test_a_cell_that_does_not_follow_its_slope_is_left_out():
    slopes = toys.draw_jacobian(3, 4)
    found = toys.make_model_fit(toys.draw_linearisation(slopes, 1, ["one", "two"], torch.zeros(3).double(), 0))
    cells = found.linearisation.bins[0]
    step = torch.tensor([0.2]).double()
    follows = cells._replace(value=cells.value + cells.jacobian[:, 0] * 0.2)
    assert len(_select_discontinuous(found.linearisation, 0, [follows, None], [step, step])) == 0
    turned = follows._replace(value=follows.value.clone())
    turned.value[[7, 30]] += 0.05
    keys = _select_discontinuous(found.linearisation, 0, [follows, turned], [step, step])
    assert keys.tolist() == cells.key[[7, 30]].tolist()
    none = torch.zeros(0, dtype=torch.int64)
    less = drop_bins(found, [keys, none, none, none])
    assert len(less.whitened.value) == len(found.whitened.value) - 2
    assert float(less.covariance[0, 0]) >= float(found.covariance[0, 0]) * 0.5
    assert not torch.isin(keys, less.linearisation.bins[0].key).any()


@pytest.mark.parametrize("share", [0.4, 0.6])
def test_what_forgets_how_it_began_is_left_out_only_where_that_is_more_than_it_is_off(share):
    """Of the cells that are 3 mm off some are moved by 2 mm by another first shape, and twelve by 20."""
    found = toys.make_model_fit(
        toys.draw_linearisation(toys.draw_jacobian(3, 4), 1, ["one", "two"], torch.zeros(3).double(), 0)
    )
    cells = found.linearisation.bins[0]
    count = round(share * len(cells.value))
    off = 3e-3 * (1 - 2 * (torch.arange(len(cells.value)) % 2)).double()
    seen = found.linearisation.bins[0] = cells._replace(value=off)
    moved = off.clone()
    moved[:count] += 2e-3
    moved[:12] += 18e-3
    same = torch.zeros(1).double()
    keys = _select_discontinuous(found.linearisation, 0, [seen._replace(value=moved)], [same])
    assert keys.tolist() == cells.key[: count if share < 0.5 else 12].tolist()
    assert (
        len(_select_discontinuous(found.linearisation, 0, [seen._replace(value=moved)], [same + 1e-9])) == count
    )  # of parameters
