"""Physical parameters: domains, refusals, storage; and a whole cloth's."""

import copy
import io
import math
import pickle

import pytest
import torch

import torchcloth as tc
from torchcloth.errors import InvalidInput

LEGAL = {"positive": 1e5, "unit_half": 0.3, "nonnegative": 0.0, "real": -9.81}


@pytest.mark.parametrize(("domain", "value"), LEGAL.items())
def test_keeps_its_value(domain, value):
    parameter = tc.PhysicalParameter(value, "Pa", domain)
    assert float(parameter.value.detach()) == pytest.approx(value, rel=1e-14, abs=0)


@pytest.mark.parametrize(
    ("domain", "value"),
    [
        *[("positive", v) for v in (0.0, -1.0, math.inf, math.nan)],
        *[("unit_half", v) for v in (0.0, 0.5, -0.1, 0.7, math.nan)],
        *[("nonnegative", v) for v in (-1e-30, math.inf, math.nan)],
        *[("real", v) for v in (math.inf, -math.inf, math.nan)],
    ],
)
def test_refuses_values_outside_its_domain(domain, value):
    with pytest.raises(InvalidInput, match=r"stiffness; got .* Pa; expected a"):
        tc.PhysicalParameter(value, "Pa", domain, name="stiffness")


@pytest.mark.parametrize("value", [[1.0, [2.0]], "soft", None])
def test_refuses_what_is_no_number(value):
    with pytest.raises(InvalidInput, match=r"stiffness; got .*; expected a number or a tensor"):
        tc.PhysicalParameter(value, "Pa", name="stiffness")


def test_refuses_an_unknown_domain():
    with pytest.raises(InvalidInput, match="nonnegative"):
        tc.PhysicalParameter(1.0, "Pa", "any")


def test_refuses_a_field_with_one_illegal_entry():
    with pytest.raises(InvalidInput, match=r"a field in \[-1, 2\] Pa"):
        tc.PhysicalParameter(torch.tensor([1.0, -1.0, 2.0]), "Pa")


def test_setting_a_value():
    parameter = tc.PhysicalParameter(torch.tensor([1.0, 2.0]), "Pa", name="stiffness")
    raw = parameter.raw
    parameter.set(torch.tensor([3.0, 4.0]))
    assert parameter.raw is raw  # optimisers hold on to it
    torch.testing.assert_close(parameter.value.detach(), torch.tensor([3.0, 4.0]), rtol=1e-14, atol=0)
    for illegal in (-1.0, torch.tensor([1.0, -1.0]), 5.0, torch.tensor([1.0, 2.0, 3.0])):
        with pytest.raises(InvalidInput, match="stiffness"):
            parameter.set(illegal)
    torch.testing.assert_close(parameter.value.detach(), torch.tensor([3.0, 4.0]), rtol=1e-14, atol=0)


@pytest.mark.parametrize("domain", ["positive", "unit_half"])
def test_no_optimiser_step_leaves_the_domain(domain):
    parameter = tc.PhysicalParameter(LEGAL[domain], "Pa", domain)
    optimiser = torch.optim.SGD(parameter.parameters(), lr=30.0 / LEGAL[domain])
    for sign in (1, 1, -1):
        (sign * parameter.value).backward()
        optimiser.step()
        value = float(parameter.value.detach())
        assert value > 0
        assert domain == "positive" or value < 0.5


def test_amplitude_zero_has_a_gradient():
    parameter = tc.PhysicalParameter(0.0, "-", "nonnegative")
    (3 * parameter.value).backward()
    assert float(parameter.raw.grad) == 3.0


def test_the_gradient_is_with_respect_to_the_logarithm():
    parameter = tc.PhysicalParameter(2.0, "Pa")
    parameter.value.backward()
    assert float(parameter.raw.grad) == pytest.approx(2.0)  # dE / d log E = E: steps are relative


@pytest.mark.parametrize("value", [3.0, torch.tensor([1.0, 2.0, 3.0])], ids=["scalar", "field"])
def test_pickle_deepcopy_and_state_dict(value):
    parameter = tc.PhysicalParameter(value, "Pa", name="stiffness")
    buffer = io.BytesIO()
    torch.save(parameter.state_dict(), buffer)
    buffer.seek(0)
    loaded = tc.PhysicalParameter(torch.full_like(torch.as_tensor(value), 7.0), "Pa")
    loaded.load_state_dict(torch.load(buffer, weights_only=True))
    for other in (pickle.loads(pickle.dumps(parameter)), copy.deepcopy(parameter), loaded):
        assert torch.equal(other.value, parameter.value)
        assert other.raw is not parameter.raw
    assert pickle.loads(pickle.dumps(parameter)).unit == "Pa"


@pytest.mark.parametrize(("stored", "present"), [(4, None), (None, 4), (4, 5), (1, 4)], ids=str)
def test_a_checkpoint_of_another_shape_is_refused(stored, present):
    """Reported: until torch 2.9 the field's first triangle became the value of all."""
    fields = [2.0 if n is None else torch.linspace(1.0, 2.0, n) for n in (stored, present)]
    part, other = (torch.nn.ModuleDict({"stiffness": tc.PhysicalParameter(field, "Pa")}) for field in fields)
    before = other["stiffness"].value.detach().clone()
    for assign in (False, True):
        with pytest.raises(
            RuntimeError, match=r"stiffness.raw; got shape \(.*\); expected shape \(.*\); build the cloth"
        ):
            other.load_state_dict(part.state_dict(), assign=assign)
    assert torch.equal(other["stiffness"].value, before)


def test_a_checkpoint_of_one_entry_is_a_number():
    number = tc.PhysicalParameter(7.0, "Pa")
    number.load_state_dict(tc.PhysicalParameter(torch.tensor([3.0]), "Pa").state_dict())
    assert float(number.value.detach()) == pytest.approx(3.0)


def test_precision():
    parameter = tc.PhysicalParameter(1e5, "Pa")
    assert parameter.raw.dtype == torch.float64
    assert parameter.to(torch.float32).value.dtype == torch.float32
    assert float(parameter.value.detach()) == pytest.approx(1e5, rel=2e-6)  # 12 * 6e-8: float32 of the logarithm
    torch.set_default_dtype(torch.float32)
    assert tc.PhysicalParameter(1e5, "Pa").raw.dtype == torch.float32
    assert tc.PhysicalParameter(torch.tensor(1e5, dtype=torch.float64), "Pa").raw.dtype == torch.float64


def test_prints_like_a_line_of_a_data_sheet():
    assert repr(tc.PhysicalParameter(609.02, "Pa")) == "PhysicalParameter(609.02 Pa)"
    field = tc.PhysicalParameter(torch.tensor([1.0, 3.0]), "N m")
    assert repr(field) == "PhysicalParameter(field (2,), mean 2 N m)"


def test_errors_survive_pickling():
    """They cross process borders in data loaders."""
    error = InvalidInput("x", got=3, expected="4", remedy="add 1")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is InvalidInput
    assert str(again) == str(error) == "x; got 3; expected 4; add 1"
    assert again.remedy == "add 1"


# -- a whole cloth -----------------------------------------------------------------------------------------------------


def everything():
    effects = {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.1), "bending": tc.effects.Bending(2e-5)}
    boundaries = {"table": tc.boundaries.Plane((0.0, 0.0, -0.1), friction=0.3), "hand": tc.boundaries.Grasp([0])}
    mesh = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4))
    return tc.Cloth(
        mesh, tc.materials.AEP(1e5, 0.3, contact_stiffness=1e6, shear_stiffness=2e5), 0.2, effects, boundaries
    )


def simulated(cloth):
    pose = torch.eye(4, dtype=cloth.rest_state().x.dtype).repeat(2, 1, 1)
    still = tc.Trajectory(torch.tensor([0.0, 1.0]), pose, torch.tensor([True, True]))
    with torch.no_grad():
        return cloth(cloth.rest_state(), {"hand": still}, times=[0.0, 0.01]).x


def test_pickle_deepcopy_and_state_dict_simulate_the_same():
    cloth = everything()
    other = everything()
    other.material.youngs_modulus.set(5e4)
    other.boundaries["table"].friction.set(0.9)
    assert not torch.equal(simulated(other), simulated(cloth))
    other.load_state_dict(cloth.state_dict())
    for again in (pickle.loads(pickle.dumps(cloth)), copy.deepcopy(cloth), other):
        assert torch.equal(simulated(again), simulated(cloth))


def test_parameters_are_found_by_name_whatever_the_order():
    """Effects by name: a checkpoint of another order of effects must not swap them."""
    mesh, material = tc.meshes.rectangle(0.2, 0.2, resolution=(4, 4)), tc.materials.AEP(1e5)
    a = tc.Cloth(mesh, material, 0.2, {"air": tc.effects.AirDrag(1.1), "damping": tc.effects.MassDamping(3.0)})
    b = tc.Cloth(mesh, material, 0.2, {"damping": tc.effects.MassDamping(0.5), "air": tc.effects.AirDrag(0.1)})
    b.load_state_dict(a.state_dict())
    assert float(b.effects["air"].normal.value.detach()) == 1.1
    assert float(b.effects["damping"].rate.value.detach()) == 3.0


def test_precision_follows_the_module():
    cloth = everything().to(torch.float32)
    x = simulated(cloth)
    assert x.dtype == torch.float32
    torch.testing.assert_close(x.double(), simulated(everything()), rtol=0, atol=1e-6)
    assert cloth.to(torch.float64).rest_state().x.dtype == torch.float64


def test_prints_like_a_data_sheet():
    text = repr(everything())
    for line in (
        "16 vertices, 18 triangles, 0.04 m^2",
        "(youngs_modulus): PhysicalParameter(100000 Pa)",
        "(poisson_ratio): PhysicalParameter(0.3 -)",
        "(areal_density): PhysicalParameter(0.2 kg/m^2)",
        "(gravity): Gravity(acceleration=[0.0, 0.0, -9.81] m/s^2)",
        "(stiffness): PhysicalParameter(2e-05 N m)",
        "(hand): Grasp(1 vertices)",
        f"stable step: {everything().stable_step():.3g} s",
    ):
        assert line in text


def test_values_that_want_gradients_are_refused():
    """They would be copied, and stay without: a network's answer goes in by functional_call."""
    given = torch.tensor(1e5, requires_grad=True)
    vector = torch.tensor([0.0, 0.0, -9.81], requires_grad=True)
    for make in (
        lambda: tc.materials.AEP(given),
        lambda: tc.materials.AEP(1e5).youngs_modulus.set(given),
        lambda: tc.effects.Gravity(vector),
        lambda: tc.effects.AirDrag(wind=vector),
        lambda: tc.boundaries.Plane(point=vector),
        lambda: tc.boundaries.Box((0.1, 0.1, 0.1), pose=torch.eye(4) + 0 * given),
    ):
        with pytest.raises(InvalidInput, match=r"a tensor that wants gradients; .*functional_call"):
            make()
        with torch.no_grad():
            make()
