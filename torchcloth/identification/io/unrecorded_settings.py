"""Find settings of a cloth that its episode does not describe: values by name cannot restore them."""

from __future__ import annotations

import torch
from torch import Tensor

from ...cloth import Cloth
from ...episodes.recorded_cloth import build_cloth
from ...episodes.unknowns import find_scalar_parameters
from ...errors import TorchclothError
from ...recordings import Recording

PRECISION_RELATIVE_TOLERANCE = 1e-5  # relative difference that single precision explains


def find_unrecorded_settings(cloth: Cloth, recording: Recording) -> list[str]:
    """Return names of settings that differ from the cloth that the episode describes.

    The mesh and the named values do not count. Examples are a tilted gravity, a wind, a law or a thickness. For an
    episode that describes no cloth at all, the list is empty.
    """
    try:
        described = _list_settings(build_cloth(recording, contact=cloth.contact))
    except TorchclothError:
        return []
    actual = _list_settings(cloth)
    names = actual.keys() | described.keys()
    return sorted(name for name in names if not _is_equal(actual.get(name), described.get(name)))


def _list_settings(cloth: Cloth) -> dict[str, object]:
    """Classes of parts, their attributes that are numbers and strings, and parameters without a public name."""
    named = {f"{path}.raw" for path in find_scalar_parameters(cloth).values()}
    settings: dict[str, object] = {path: type(part).__name__ for path, part in cloth.named_modules() if path}
    for path, part in cloth.named_modules():
        for name, value in vars(part).items():
            if name != "training" and not name.startswith("_") and isinstance(value, (bool, int, float, str, tuple)):
                settings[f"{path}.{name}".lstrip(".")] = value
    return settings | {name: value.detach() for name, value in cloth.named_parameters() if name not in named}


def _is_equal(first: object, second: object) -> bool:
    if isinstance(first, Tensor) and isinstance(second, Tensor):
        if first.shape != second.shape:
            return False
        return torch.allclose(first.double(), second.double(), PRECISION_RELATIVE_TOLERANCE, 1e-9)
    if isinstance(first, float) and isinstance(second, float):
        return abs(first - second) <= PRECISION_RELATIVE_TOLERANCE * abs(first)
    return type(first) is type(second) and not isinstance(first, Tensor) and first == second
