"""What a picture of a fit shows can be read."""

from types import SimpleNamespace
from typing import Any

import torch

from torchcloth._utils.files import save_figure
from torchcloth.identification.pictures import _force_readings, plot_parameters


def estimate(value, initial, *ci95) -> Any:
    return SimpleNamespace(value=value, initial=initial, ci95=list(ci95), source="data", identifiable=True, unit="Pa")


def test_a_wide_interval_of_a_positive_parameter_is_logarithmic(tmp_path):
    shown = {
        "wide": estimate(3e5, 1e5, 3e3, 2.7e7),
        "narrow": estimate(0.2, 0.3, 0.15, 0.25),
        "signed": estimate(1.0, 0.1, -3.0, 5.0),
        "far start": estimate(1.0, 100.0, 0.9, 1.1),
    }
    fit: Any = SimpleNamespace(parameters=shown, is_withdrawn=False)
    figure = plot_parameters(fit)
    scales = dict(zip(shown, [axis.get_xscale() for axis in figure.axes], strict=True))
    assert scales == {"wide": "log", "narrow": "linear", "signed": "linear", "far start": "log"}
    low, high = figure.axes[0].get_xlim()
    place = figure.axes[0].transData.transform([(3e5, 0)])[0, 0]
    left, right = figure.axes[0].transData.transform([(low, 0), (high, 0)])[:, 0]
    assert 0.3 < (place - left) / (right - left) < 0.7  # the value stands in the middle, not at the left end
    assert save_figure(figure, tmp_path / "a.png").is_file()


def test_grippers_that_felt_no_force_are_not_drawn():
    """A torque alone has no main direction of a force."""
    both, torque = torch.rand(5, 6), torch.full((5, 6), torch.nan)
    torque[:, 3:] = 1.0
    e: Any = SimpleNamespace(wrenches={"left": both, "right": torque})
    assert list(_force_readings(e)) == ["left"]
    assert torch.equal(_force_readings(e)["left"], both[1:, :3])
