"""Forward kinematics against outside truth, its derivatives, and every refusal of ``load``."""

import copy
import json
import math
import pickle
import sys
from pathlib import Path

import pytest
import torch
from torch.autograd import forward_ad

import torchcloth.robots as robots
from torchcloth.errors import InvalidInput, MissingDependency

ORACLE = json.loads((Path(__file__).parent / "data" / "rizon_fk_samples.json").read_text())


def rows(model, key):
    return torch.tensor([row[key] for row in ORACLE[model]], dtype=torch.float64)


@pytest.mark.parametrize("model", robots.list_models())
def test_flange_against_the_oracle(model):
    pose = robots.load(model)(rows(model, "q"))
    # The oracle is rounded to 12 decimals in q and in the pose: up to 7 joints x 0.5e-12 rad x 1.2 m.
    torch.testing.assert_close(pose, rows(model, "T_flange"), rtol=0, atol=5e-12)


def test_wrist_generations_differ_by_40_mm():
    new, old = robots.load("rizon4"), robots.load("rizon4_gen2022")
    q = rows("rizon4", "q")
    apart = (new(q) - old(q))[:, :3, 3].norm(dim=-1)
    torch.testing.assert_close(apart, torch.full_like(apart, math.hypot(0.040, 0.003)), rtol=0, atol=1e-7)


def test_home_points_down():
    arm = robots.load("rizon4")
    expected = torch.tensor([0.687, -0.113, 0.3266], dtype=torch.float64)
    torch.testing.assert_close(arm(arm.home)[:3, 3], expected, rtol=0, atol=1e-4)
    torch.testing.assert_close(arm(arm.home)[:3, :3].diagonal().round(), torch.tensor([-1.0, 1, -1]).double())


@pytest.mark.parametrize(("frame", "beyond"), [("tcp_open", 0.150), ("tcp_closed", 0.200)])
def test_gripper_frames(frame, beyond):
    q = rows("rizon4", "q")
    flange, tcp = robots.load("rizon4")(q), robots.load("rizon4", frame=frame)(q)
    torch.testing.assert_close(tcp[..., :3, 3], flange[..., :3, 3] + beyond * flange[..., :3, 2], rtol=0, atol=1e-15)
    torch.testing.assert_close(tcp[..., :3, :3], flange[..., :3, :3], rtol=0, atol=1e-15)


def test_a_frame_before_the_last_link_has_fewer_joints():
    arm, whole = robots.load("rizon4", frame="link5"), robots.load("rizon4")
    assert torch.equal(arm.home, whole.home[: len(arm.joint_names)])
    assert arm(arm.home).shape == (4, 4)


def test_any_batch_shape(random_q):
    arm = robots.load("rizon4")
    q = random_q(arm, 12)
    expected = arm(q)
    torch.testing.assert_close(arm(q.reshape(2, 3, 2, 7)), expected.reshape(2, 3, 2, 4, 4), rtol=0, atol=1e-15)
    torch.testing.assert_close(arm(q[5]), expected[5], rtol=0, atol=1e-15)
    assert arm(q[:0]).shape == (0, 4, 4)


def test_base_moves_the_world_and_takes_gradients():
    base = torch.eye(4, dtype=torch.float64)
    base[:3, :3] = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    base[0, 3] = 0.5
    base.requires_grad_()
    q = rows("rizon4", "q")[3]
    placed = robots.load("rizon4", base=base)(q)
    torch.testing.assert_close(placed, base @ robots.load("rizon4")(q))
    assert torch.autograd.grad(placed[0, 3], base)[0].abs().sum() > 0


def test_a_base_that_an_optimiser_would_change_is_no_copy():
    base = torch.eye(4, dtype=torch.float32, requires_grad=True)
    with pytest.raises(InvalidInput, match=r"base that is learned; got torch\.float32; .*torch\.float64"):
        robots.load("rizon4", base=base)
    assert robots.load("rizon4", base=base, dtype=torch.float32).base is base


@pytest.mark.parametrize("custom", [False, True], ids=["rizon4", "custom"])
def test_derivatives(custom, crane, random_q):
    arm = robots.load(crane, frame="hook") if custom else robots.load("rizon4")
    q = random_q(arm, 2).requires_grad_()
    assert torch.autograd.gradcheck(arm, (q,), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(arm, (q,), check_fwd_over_rev=True)


def test_forward_mode_and_transforms_agree(random_q):
    arm = robots.load("rizon4")
    q, direction = random_q(arm, 2)
    jacobian = torch.autograd.functional.jacobian(arm, q)
    _, tangent = torch.func.jvp(arm, (q,), (direction,))
    torch.testing.assert_close(tangent, jacobian @ direction)
    with forward_ad.dual_level():
        dual = forward_ad.unpack_dual(arm(forward_ad.make_dual(q, direction)))
    torch.testing.assert_close(dual.tangent, tangent)
    torch.testing.assert_close(torch.func.jacrev(arm)(q), jacobian)
    torch.testing.assert_close(torch.func.vmap(arm)(torch.stack([q, direction])), arm(torch.stack([q, direction])))


@pytest.mark.parametrize("custom", [False, True], ids=["rizon4", "custom"])
def test_geometric_jacobian(custom, crane, random_q):
    arm = robots.load(crane, frame="hook") if custom else robots.load("rizon4")
    q = random_q(arm, 4)
    derivative = torch.func.vmap(torch.func.jacfwd(arm))(q)  # [4, 4, 4, J]
    spin = torch.einsum("nabj,ncb->nacj", derivative[:, :3, :3], arm(q)[:, :3, :3])
    angular = torch.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], dim=1)
    expected = torch.cat([derivative[:, :3, 3], angular], dim=1)
    torch.testing.assert_close(arm.jacobian(q), expected, rtol=0, atol=1e-14)


def test_precision_and_module_habits():
    arm = robots.load("rizon4")
    q = rows("rizon4", "q")
    single = robots.load("rizon4", dtype=torch.float32)
    torch.testing.assert_close(single(q), arm(q).float(), rtol=0, atol=1e-5)
    assert copy.deepcopy(arm).to(torch.float32)(q).dtype == torch.float32
    assert arm(q.float()).dtype == torch.float64
    assert not arm.state_dict()
    assert torch.equal(pickle.loads(pickle.dumps(arm))(q), arm(q))
    assert "rizon4" in repr(arm)
    assert "joint7" in repr(arm)


def test_own_robot_by_hand(crane):
    arm = robots.load(crane, frame="hook")
    assert arm.joint_names == ("slew", "travel", "luff")
    assert arm.joint_types == ("continuous", "prismatic", "revolute")
    inf = math.inf
    assert arm.limits.lower.tolist() == [-inf, 0.2, -1]
    assert arm.limits.soft_lower.tolist() == [-inf, 0.2, -0.8]
    assert arm.limits.soft_upper.tolist() == [inf, 1.5, 0.9]
    assert arm.limits.velocity.tolist() == [inf, 0.5, 2]
    assert arm.home.tolist() == [0, 0.2, 0]
    # URDF's default axis is x: the trolley runs along the mast's own x.
    pose = arm(torch.tensor([[0.0, 0.2, 0.0], [0.0, 1.2, 0.0]], dtype=torch.float64))
    cp, sp, cy, sy = math.cos(-0.2), math.sin(-0.2), math.cos(0.3), math.sin(0.3)
    expected = torch.tensor([cy * cp, sy * cp, -sp], dtype=torch.float64)
    torch.testing.assert_close(pose[1, :3, 3] - pose[0, :3, 3], expected)


def test_own_robot_agrees_with_yourdfpy(crane, random_q):
    yourdfpy = pytest.importorskip("yourdfpy")
    arm = robots.load(crane, frame="hook")
    other = yourdfpy.URDF.load(crane, load_meshes=False)
    for q in random_q(arm, 5):
        other.update_cfg(dict(zip(arm.joint_names, q.tolist(), strict=True)))
        torch.testing.assert_close(arm(q), torch.tensor(other.get_transform("hook")), rtol=0, atol=1e-12)


def test_geometry(crane):
    arm = robots.load(crane, frame="hook", dtype=torch.float64)
    q = torch.tensor([[0.3, 0.5, 0.2], [0.1, 1.0, -0.4]], dtype=torch.float64)
    box, cylinder, sphere = arm.geometry(q)
    assert [(p.kind, p.size, p.link) for p in (box, cylinder, sphere)] == [
        ("box", (1, 2, 0.5), "ground"),
        ("cylinder", (0.05, 0.4), "trolley"),
        ("sphere", (0.03,), "hook"),
    ]
    torch.testing.assert_close(box.pose, torch.eye(4, dtype=torch.float64).expand(2, 4, 4))
    torch.testing.assert_close(sphere.pose, arm(q))
    trolley = robots.load(crane, frame="trolley")(q[:, :2])
    torch.testing.assert_close(cylinder.pose[:, :3, 2], trolley[:, :3, 0])  # laid along x by its origin
    torch.testing.assert_close(cylinder.pose[:, :3, 3], trolley[:, :3, 3] + 0.1 * trolley[:, :3, 0])


def test_gripper_is_drawn_only_with_its_frame():
    q = torch.zeros(7, dtype=torch.float64)
    assert "grav_base_link" not in {p.link for p in robots.load("rizon4").geometry(q)}
    assert {p.link for p in robots.load("rizon4", frame="tcp_closed").geometry(q)} >= {"grav_base_link", "tcp_closed"}


def refused(match, *args, **kwargs):
    with pytest.raises(InvalidInput, match=match):
        robots.load(*args, **kwargs)


def test_load_refuses(crane, tmp_path):
    refused("rizon4_gen2022", "rizon5")
    refused("no such URDF file", tmp_path / "missing.urdf")
    refused(r"no link for frame.*'tool'.*tcp_open", "rizon4", frame="tool")
    refused("'grip' mimics 'luff'", crane, frame="finger")
    refused("'slide'.*planar", crane, frame="puck")
    refused("no joint .* moves 'ground'", crane, frame="ground")
    refused(r"base .*\(3, 4\)", "rizon4", base=torch.eye(4)[:3])
    refused("base is not a rigid pose", "rizon4", base=2 * torch.eye(4))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("</robot>", "", "not a URDF file"),
        ('effort="5"', "", "effort"),
        ('xyz="1 1 0"', 'xyz="0 0 0"', "axis of joint 'luff'"),
        ('lower="-1"', 'lower="3"', "limits of joint 'luff'"),
        ('lower="-1"', 'lower="nan"', "limits of joint 'luff'"),
        ('velocity="2"', 'velocity="-1"', "velocity limit of joint 'luff'; got -1.0; expected a value > 0"),
        ('<parent link="ground"/>', '<parent link="hook"/>', "closes a loop"),
        ('<parent link="ground"/>', '<parent link="gone"/>', "no parent link"),
    ],
)
def test_load_refuses_a_broken_file(crane, old, new, match):
    assert old in crane.read_text()
    crane.write_text(crane.read_text().replace(old, new))
    refused(match, crane, frame="hook")


def test_a_velocity_of_zero_is_no_limit(crane):
    """As ROS reads it: 0 stands where nobody knew better, and a joint that cannot move is fixed."""
    assert robots.load(crane, frame="hook").limits.velocity[-1] == 2.0
    crane.write_text(crane.read_text().replace('velocity="2"', 'velocity="0"'))
    assert robots.load(crane, frame="hook").limits.velocity[-1] == torch.inf


def test_loading_is_silent(crane, capfd):
    robots.load(crane, frame="hook")
    out = capfd.readouterr()
    assert out.out == ""
    assert out.err == ""


@pytest.mark.parametrize("q", [torch.zeros(3, 6), torch.zeros(()), torch.zeros(7, dtype=torch.long)])
def test_forward_refuses(q):
    with pytest.raises(InvalidInput, match=r"q has the wrong shape or type.*joint7"):
        robots.load("rizon4")(q)


def test_missing_package_says_how_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytorch_kinematics", None)
    with pytest.raises(MissingDependency, match=r'pip install "torchcloth\[robots\]"'):
        robots.load("rizon4")
