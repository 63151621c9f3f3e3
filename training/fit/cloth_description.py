"""The cloth that an episode describes, as plain tensors and numbers: what a checkpoint keeps to load without data."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchcloth import Cloth, Contact
from torchcloth.episodes.unknowns import find_scalar_parameters
from torchcloth.errors import InvalidInput
from torchcloth.identification import build_cloth
from torchcloth.recordings import ClothInfo, Collider, GraspInfo, Recording

from .config import Model

LEFT_OUT = {"extra", "initial_vertices"}


def described(recording: Recording) -> dict[str, Any]:
    """Nested dicts of tensors, numbers and text, without what only one episode has."""
    parts = {"grasps": recording.grasps, "colliders": recording.colliders}
    return {
        "cloth": _plain(recording.cloth),
        **{key: {name: _plain(part) for name, part in own.items()} for key, own in parts.items()},
        "gravity": torch.as_tensor(recording.gravity),
        "air_density": recording.air_density,
    }


def built(description: dict[str, Any], model: Model) -> Cloth:
    """The cloth again, at the start values of ``model``.

    Raises:
        InvalidInput: start values of parameters that it does not have.
    """
    recording = Recording(
        cloth=ClothInfo(**_arrays(description["cloth"])),
        provenance="measured",
        grasps={name: GraspInfo(**_arrays(grasp)) for name, grasp in description["grasps"].items()},
        colliders={name: Collider(**_arrays(part)) for name, part in description["colliders"].items()},
        gravity=description["gravity"].numpy(),
        air_density=description["air_density"],
    )
    with precision(model.precision):
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
    """Whether two descriptions give the same model, but for start values and the density's error."""
    free = {"nominal", "areal_density_std"}
    one, two = ({**d, "cloth": {k: v for k, v in d["cloth"].items() if k not in free}} for d in (first, other))
    return _same(one, two)


@contextmanager
def precision(name: str) -> Iterator[None]:
    """torch's default type for floats, "float64" or "float32", for a while."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(getattr(torch, name))
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def _plain(part: Any) -> dict[str, Any]:
    own = {key: value for key, value in asdict(part).items() if key not in LEFT_OUT}
    return {k: torch.as_tensor(v.copy()) if isinstance(v, np.ndarray) else v for k, v in own.items()}


def _arrays(part: dict[str, Any]) -> dict[str, Any]:
    return {key: value.numpy() if isinstance(value, Tensor) else value for key, value in part.items()}


def _same(one: Any, two: Any) -> bool:
    if isinstance(one, dict) and isinstance(two, dict):
        return one.keys() == two.keys() and all(_same(one[key], two[key]) for key in one)
    if isinstance(one, Tensor) and isinstance(two, Tensor):
        return one.shape == two.shape and bool(torch.allclose(one.double(), two.double(), rtol=0, atol=1e-6))
    return bool(one == two)
