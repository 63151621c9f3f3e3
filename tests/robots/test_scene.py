"""Several arms in one world."""

import pytest
import torch

import torchcloth.robots as robots
from torchcloth.errors import InvalidInput

T = torch.tensor([0.0, 1.0], dtype=torch.float64)


@pytest.fixture
def rig():
    return robots.bimanual_rig()


def homes(rig, count=None):
    q = {name: arm.home for name, arm in rig.arms.items()}
    return q if count is None else {name: home.repeat(count, 1) for name, home in q.items()}


def test_bimanual_rig_stands_as_measured(rig):
    poses = rig(homes(rig))
    apart = poses["left"] - poses["right"]
    assert apart[1, 3] == pytest.approx(0.632)
    assert apart[:, :3].abs().max() == 0
    torch.testing.assert_close(rig["left"].base[:3, 3], torch.tensor([0, 0.316, 0], dtype=torch.float64))
    assert robots.bimanual_rig("rizon4s", frame="flange", dtype=torch.float32)["right"].base.dtype == torch.float32


def test_is_a_module(rig):
    assert list(dict(rig.named_modules())) == ["", "arms", "arms.left", "arms.right"]
    assert rig.to(torch.float32)["left"].home.dtype == torch.float32


def test_motion(rig):
    closed = {"right": torch.tensor([False, True])}
    motions = rig.motion(homes(rig, 2), T, closed, period=0.5)
    assert list(motions) == ["left", "right"]
    assert motions["left"].closed.tolist() == [True, True, True]
    assert motions["right"].closed.tolist() == [False, False, True]
    torch.testing.assert_close(motions["left"].pose[-1], rig["left"](rig["left"].home))


def test_geometry_holds_both_arms(rig):
    q = homes(rig)
    assert len(rig.geometry(q)) == 2 * len(rig["left"].geometry(q["left"]))


def test_refuses_other_names(rig):
    with pytest.raises(InvalidInput, match="arms is empty"):
        robots.Scene({})
    with pytest.raises(InvalidInput, match="arm 'left'; got int; expected an Arm"):
        robots.Scene({"left": 3})
    for name in ("arm.left", "keys", ""):
        with pytest.raises(InvalidInput, match=f"name of an arm; got '{name}'"):
            robots.Scene({name: rig["left"]})
    with pytest.raises(
        InvalidInput, match=r"q names other arms; got \['left'\]; expected by name, \['left', 'right'\]"
    ):
        rig({"left": rig["left"].home})
    with pytest.raises(InvalidInput, match="closed names unknown arms"):
        rig.motion(homes(rig, 2), T, {"middle": torch.ones(2, dtype=torch.bool)})


def test_the_table_stands_where_the_arms_work(rig):
    """UniFolding's: its top level with the bases, 0.82 x 1.64 m."""
    board = rig.table.primitive()
    assert board.kind == "box"
    assert board.size == pytest.approx((0.82, 1.64, 0.04))
    low, high = board.pose[:3, 3] - torch.tensor(board.size) / 2, board.pose[:3, 3] + torch.tensor(board.size) / 2
    torch.testing.assert_close(low, torch.tensor([0.20, -0.82, -0.04], dtype=torch.float64))
    torch.testing.assert_close(high, torch.tensor([1.02, 0.82, 0.0], dtype=torch.float64))
    assert robots.Scene({"one": rig["left"]}).table is None


@pytest.mark.parametrize("bad", [{"height": float("nan")}, {"x": (1.02, 0.2)}, {"thickness": 0.0}])
def test_a_table_that_would_be_in_nobodys_way_is_refused(rig, bad):
    with pytest.raises(InvalidInput, match=r"table; got Table\("):
        robots.Scene({"one": rig["left"]}, robots.scene.Table(**bad))


def test_robot_infos_name_model_place_and_tool(rig):
    info = rig.robot_infos()["right"]
    assert (info.model, info.tool_frame) == ("rizon4", "tcp_closed")
    assert info.T_world_base[1, 3] == pytest.approx(-0.316)
