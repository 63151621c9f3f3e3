"""Description of an episode's cloth in plain tensors and numbers, so that a checkpoint can be loaded without data."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcloth import Cloth, Contact
from torchcloth._utils.torch_modes import default_dtype
from torchcloth.episodes.unknowns import find_scalar_parameters
from torchcloth.errors import InvalidInput
from torchcloth.identification import build_cloth
from torchcloth.recordings import ClothInfo, Collider, GraspInfo, Recording

from .config import Model

EPISODE_ONLY_FIELDS = {"extra", "initial_vertices", "initial_velocities"}


def describe_cloth(recording: Recording) -> dict[str, Any]:
    """Describe the cloth of an episode as nested dicts of tensors, numbers and text, without episode-specific data."""
    parts = {"grasps": recording.grasps, "colliders": recording.colliders}
    return {
        "cloth": _to_plain(recording.cloth),
        **{key: {name: _to_plain(part) for name, part in fields.items()} for key, fields in parts.items()},
        "gravity": torch.as_tensor(recording.gravity),
        "air_density": recording.air_density,
    }


def build_described_cloth(description: dict[str, Any], model: Model) -> Cloth:
    """Build the cloth from its description, at the start values of ``model``.

    Raises:
        InvalidInput: a start value belongs to an unknown parameter.
    """
    recording = Recording(
        cloth=ClothInfo(**_to_arrays(description["cloth"])),
        provenance="measured",
        grasps={name: GraspInfo(**_to_arrays(grasp)) for name, grasp in description["grasps"].items()},
        colliders={name: Collider(**_to_arrays(part)) for name, part in description["colliders"].items()},
        gravity=description["gravity"].numpy(),
        air_density=description["air_density"],
    )
    with default_precision(model.precision):
        cloth = build_cloth(recording, contact=Contact(model.contact) if model.contact else None)
        cloth.engine = model.engine  # type: ignore[assignment] - checked with the config
        names = find_scalar_parameters(cloth)
        for name, value in model.start.items():
            if name not in names:
                expected = f"one of {', '.join(sorted(names))}"
                raise InvalidInput("config: model.start", got=repr(name), expected=expected)
            cloth.get_submodule(names[name]).set(value)  # type: ignore[operator]
    return cloth


def same_cloth(first: dict[str, Any], other: dict[str, Any]) -> bool:
    """Tell whether two descriptions give the same model, except for start values and the density's error."""
    ignored = {"nominal", "areal_density_std"}
    first, second = ({**d, "cloth": {k: v for k, v in d["cloth"].items() if k not in ignored}} for d in (first, other))
    return _equal(first, second)


def default_precision(name: str) -> AbstractContextManager[None]:
    """Return a context in which torch's default float type is "float64" or "float32"."""
    return default_dtype(getattr(torch, name))


def _to_plain(part: Any) -> dict[str, Any]:
    fields = {key: value for key, value in asdict(part).items() if key not in EPISODE_ONLY_FIELDS}
    return {k: torch.as_tensor(v.copy()) if isinstance(v, np.ndarray) else v for k, v in fields.items()}


def _to_arrays(part: dict[str, Any]) -> dict[str, Any]:
    return {key: value.numpy() if isinstance(value, Tensor) else value for key, value in part.items()}


def _equal(first: Any, second: Any) -> bool:
    if isinstance(first, dict) and isinstance(second, dict):
        return first.keys() == second.keys() and all(_equal(first[key], second[key]) for key in first)
    if isinstance(first, Tensor) and isinstance(second, Tensor):
        return first.shape == second.shape and bool(torch.allclose(first.double(), second.double(), rtol=0, atol=1e-6))
    return bool(first == second)
