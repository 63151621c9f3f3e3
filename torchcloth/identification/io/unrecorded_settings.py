"""What of a cloth the episode does not describe that it was fitted to: values by name do not bring that back."""

from __future__ import annotations

import torch
from torch import Tensor

from ...cloth import Cloth
from ...episodes.observed import cloth_from
from ...episodes.unknowns import available
from ...errors import TorchclothError
from ...recordings import Recording

SAME = 1e-5  # relative difference that precisions explain


def beyond(cloth: Cloth, recording: Recording) -> list[str]:
    """Names of what differs from the cloth that the episode describes, whatever the mesh and the named values.

    A gravity that leans, a wind, a law, a thickness. Of an episode that describes no cloth at all, nothing.
    """
    try:
        plain = _facts(cloth_from(recording, contact=cloth.contact))
    except TorchclothError:
        return []
    own = _facts(cloth)
    return sorted(name for name in own.keys() | plain.keys() if not _alike(own.get(name), plain.get(name)))


def _facts(cloth: Cloth) -> dict[str, object]:
    """Kinds of parts, what they keep as numbers and words, and parameters without a public name."""
    named = {f"{path}.raw" for path in available(cloth).values()}
    facts: dict[str, object] = {path: type(part).__name__ for path, part in cloth.named_modules() if path}
    for path, part in cloth.named_modules():
        for name, value in vars(part).items():
            if name != "training" and not name.startswith("_") and isinstance(value, (bool, int, float, str, tuple)):
                facts[f"{path}.{name}".lstrip(".")] = value
    return facts | {name: value.detach() for name, value in cloth.named_parameters() if name not in named}


def _alike(one: object, other: object) -> bool:
    if isinstance(one, Tensor) and isinstance(other, Tensor):
        return one.shape == other.shape and torch.allclose(one.double(), other.double(), SAME, 1e-9)
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) <= SAME * abs(one)
    return type(one) is type(other) and not isinstance(one, Tensor) and one == other
