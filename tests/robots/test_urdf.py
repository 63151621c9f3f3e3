"""The shipped files: what is in them, and that other readers agree."""

import importlib.util
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import torch

import torchcloth.robots as robots

FOLDER = Path(robots.__file__).parent / "urdf"


def elements(name, tag):
    return list(ET.parse(FOLDER / f"{name}.urdf").getroot().iter(tag))


@pytest.fixture(params=robots.list_models())
def model(request):
    return request.param


def test_models():
    assert robots.list_models() == ["rizon4", "rizon4_gen2022", "rizon4s"]


def test_files_are_what_the_generator_writes(model):
    script = Path(__file__).parents[2] / "robots" / "urdf" / "generate.py"
    spec = importlib.util.spec_from_file_location("generate", script)
    generate = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(generate)
    assert sorted(generate.RIZON_VARIANTS) == robots.list_models()
    assert generate.render(model) == (FOLDER / f"{model}.urdf").read_text()


def test_header_names_the_wrist_and_the_sources(model):
    head = (FOLDER / f"{model}.urdf").read_text().split("<robot")[0]
    year = "2022" if model == "rizon4_gen2022" else "2024"
    for part in ("torchcloth", "Apache-2.0", "flexiv_rdk", "Grav", f"wrist generation {year}"):
        assert part in head


def test_only_urdf_primitives(model):
    assert {shape.tag for geometry in elements(model, "geometry") for shape in geometry} <= {
        "box",
        "cylinder",
        "sphere",
    }


def test_inertia_is_that_of_a_body(model):
    inertias = elements(model, "inertia")
    assert len(inertias) == 9
    for inertia in inertias:
        xx, yy, zz, xy, xz, yz = (float(inertia.get(key)) for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"))
        principal = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        assert principal[0] > 0
        assert principal[0] + principal[1] >= principal[2]
    arm_mass = sum(float(mass.get("value")) for mass in elements(model, "mass")[:8])
    assert arm_mass == pytest.approx(20.8 if model == "rizon4s" else 20.2)


def test_soft_limits_lie_five_degrees_inside(model):
    limits = robots.load(model).limits
    for soft, hard in ((limits.soft_lower, limits.lower), (limits.upper, limits.soft_upper)):
        torch.testing.assert_close(soft - hard, torch.full((7,), 0.0873, dtype=torch.float64), rtol=0, atol=1.1e-4)
    assert limits.velocity.tolist() == [2.0944, 2.0944, 2.4435, 2.4435, 4.8869, 4.8869, 4.8869]
    assert limits.effort.tolist() == [123, 123, 64, 64, 39, 39, 39]


def test_yourdfpy_agrees(model, random_q):
    yourdfpy = pytest.importorskip("yourdfpy")
    other = yourdfpy.URDF.load(FOLDER / f"{model}.urdf")
    assert other.validate()
    for frame in ("flange", "tcp_open", "tcp_closed"):
        arm = robots.load(model, frame=frame)
        for q in random_q(arm, 10):
            other.update_cfg(q.numpy())
            np.testing.assert_allclose(arm(q).numpy(), other.get_transform(frame), rtol=0, atol=5e-15)


def test_pytorch_kinematics_agrees_and_is_silent(model, random_q, capfd):
    pk = pytest.importorskip("pytorch_kinematics")
    text = (FOLDER / f"{model}.urdf").read_bytes()
    chain = pk.build_serial_chain_from_urdf(text, "tcp_closed").to(dtype=torch.float64)
    assert capfd.readouterr().err == ""
    arm = robots.load(model, frame="tcp_closed")
    q = random_q(arm, 50)
    expected = chain.forward_kinematics(q).get_matrix()
    torch.testing.assert_close(arm(q), expected, rtol=0, atol=1e-6)  # pytorch-kinematics rounds origins to float32
    assert list(arm.joint_names) == chain.get_joint_parameter_names()


def test_primitives_cover_the_measured_arm():
    """Bounding box of link 2 in its own frame, against that of the vendor's mesh."""
    arm = robots.load("rizon4")
    shapes = [shape for shape in arm.geometry(torch.zeros(7, dtype=torch.float64)) if shape.link == "link2"]
    spans = []
    for shape in shapes:
        radius, length = shape.size
        axis, centre = shape.pose[:3, 2], shape.pose[:3, 3]
        half = 0.5 * length * axis.abs() + radius * (1 - axis**2).clamp(min=0).sqrt()
        spans += [centre - half, centre + half]
    # Link 2 stands at (0, -0.030, 0.365), turned half a turn about z at q = 0.
    lower, upper = torch.stack(spans).amin(0), torch.stack(spans).amax(0)
    origin = torch.tensor([0, -0.030, 0.365], dtype=torch.float64)
    expected = torch.tensor([[-0.061, -0.089, -0.061], [0.061, 0.017, 0.200]], dtype=torch.float64) + origin
    torch.testing.assert_close(torch.stack([lower, upper]), expected, rtol=0, atol=5e-3)


def test_importing_is_light():
    heavy = ["pytorch_kinematics", "yourdfpy", "trimesh", "matplotlib"]
    code = f"import sys, torchcloth.robots; print([name for name in {heavy} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
