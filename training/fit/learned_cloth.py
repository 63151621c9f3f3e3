"""What of a cloth is learned: numbers, fields with one value per triangle, or a network that gives them."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from importlib import import_module

import numpy as np
import torch
from torch import Tensor, nn

from torchcloth import Cloth, PhysicalParameter
from torchcloth.episodes.unknowns import find_scalar_parameters, collect_unknowns
from torchcloth.errors import InvalidInput
from torchcloth.meshes import Mesh
from torchcloth.parameters import to_physical

from .config import Learn, Network


class Learned(nn.Module):
    """A cloth of which some parameters are learned; the rest is frozen.

    Args:
        cloth: the start; it is changed.
        what: names; fields and what a network gives belong to the material, or are the areal density.

    Raises:
        InvalidInput: names that the model does not have, or nothing to learn.
    """

    _places: Tensor
    _pairs: Tensor

    def __init__(self, cloth: Cloth, what: Learn) -> None:
        super().__init__()
        self.what, self.cloth = what, cloth.requires_grad_(False)
        given = [] if what.network is None else what.network.gives
        names = [*what.parameters, *what.fields, *given]
        if not names or len(set(names)) < len(names):
            got = f"{', '.join(names) or 'no name'}"
            raise InvalidInput("config: learn", got=got, expected="one or more names, each once")
        self.units = {u.name: u.typical_amplitude or 1.0 for u in collect_unknowns(cloth, names, None)}
        self.paths = {name: find_scalar_parameters(cloth)[name] for name in names}
        for name in [*what.fields, *given]:
            if not self.paths[name].startswith(("material.", "areal_density")):
                raise InvalidInput(
                    "config: learn", got=f"a field of {name}", expected="areal_density or one of the material"
                )
        for name in what.fields:
            self.parameter(name).raw = nn.Parameter(self.parameter(name).raw.expand(len(cloth.mesh.faces)).clone())
        for name in (*what.parameters, *what.fields):
            self.parameter(name).raw.requires_grad_(True)
        self.network = None if what.network is None else _made(what.network).to(cloth.areal_density.raw)
        if next(self.with_units(), None) is None:
            expected = "some parameter that may change"
            raise InvalidInput("config: learn.network", got="a network without any", expected=expected)
        self.register_buffer("_places", places(cloth.mesh).to(cloth.areal_density.raw), persistent=False)
        self.register_buffer("_pairs", neighbours(cloth.mesh), persistent=False)

    def parameter(self, name: str) -> PhysicalParameter:
        """By public name."""
        return self.cloth.get_submodule(self.paths[name])  # type: ignore[return-value]

    def with_units(self) -> Iterator[tuple[nn.Parameter, float]]:
        """What is learned, with the size of an ordinary change: amplitudes are stored as they are, others as logs."""
        for name in (*self.what.parameters, *self.what.fields):
            yield self.parameter(name).raw, self.units[name]
        if self.network is not None:
            yield from ((p, 1.0) for p in self.network.parameters() if p.requires_grad)

    def raw(self) -> dict[str, Tensor]:
        """Unconstrained values by name, differentiable; a network's, times their units, are added to the start's."""
        own: dict[str, Tensor] = {name: self.parameter(name).raw for name in (*self.what.parameters, *self.what.fields)}
        if self.network is None or self.what.network is None:
            return own
        out, names = self._given(self.network, self.what.network.module), self.what.network.gives
        if not isinstance(out, Tensor) or out.shape != (len(self._places), len(names)):
            got = list(out.shape) if isinstance(out, Tensor) else type(out).__name__
            expected = f"[{len(self._places)}, {len(names)}], a column for each of {', '.join(names)}"
            raise InvalidInput(f"{self.what.network.module}: output", got=got, expected=expected)
        given = {name: self.parameter(name).raw + self.units[name] * out[:, i] for i, name in enumerate(names)}
        amplitudes = {
            name: raw.clamp(min=0.0) for name, raw in given.items() if self.parameter(name).domain == "nonnegative"
        }
        return own | given | amplitudes

    def _given(self, network: nn.Module, name: str) -> Tensor:
        try:
            return network(self._places)
        except Exception as error:  # of somebody's code, whatever it raises
            got = f"{type(error).__name__}: {error}".splitlines()[0]
            expected = f"a network that takes places {list(self._places.shape)}"
            raise InvalidInput(f"{name}: forward", got=got, expected=expected) from error

    def entries(self) -> dict[str, Tensor]:
        """What the network gives, by the names of the cloth's stored tensors."""
        given = () if self.what.network is None else self.what.network.gives
        return {f"{self.paths[name]}.raw": value for name, value in self.raw().items() if name in given}

    def roughness(self) -> Tensor:
        """Mean squared difference of unconstrained values between neighbouring triangles, summed over the fields."""
        a, b = self._pairs
        parts = [(raw[a] - raw[b]).square().mean() for raw in self.raw().values() if raw.ndim]
        return torch.stack(parts).sum() if parts else self._places.new_zeros(())

    def clip(self) -> None:
        """Amplitudes are stored as they are: back to 0 where a step made them negative."""
        for name in (*self.what.parameters, *self.what.fields):
            self.parameter(name).clip_()

    @torch.no_grad()
    def settled(self) -> dict[str, Tensor]:
        """As ``raw``, without what is random in a network while it is trained."""
        training = self.training
        try:
            return self.eval().raw()
        finally:
            self.train(training)

    @torch.no_grad()
    def values(self) -> dict[str, Tensor]:
        """Physical values by name: scalars [], fields [F]."""
        return {name: to_physical(raw, self.parameter(name).domain).clone() for name, raw in self.settled().items()}

    @torch.no_grad()
    def baked(self) -> Cloth:
        """A copy of the cloth with everything that was learned in it."""
        cloth = deepcopy(self.cloth)
        for name, raw in self.settled().items():
            cloth.get_submodule(self.paths[name]).raw = nn.Parameter(raw.clone())
        return cloth.requires_grad_(True)


def places(mesh: Mesh) -> Tensor:
    """[F, 2], the triangles' middles on the pattern (else in x and y), from -1 to 1 along its longer side."""
    corners = mesh.vertices[mesh.faces][..., :2] if mesh.pattern is None else mesh.pattern
    middle = corners.mean(1)
    low, high = middle.min(0), middle.max(0)
    return torch.as_tensor((2 * middle - low - high) / (high - low).max())


def neighbours(mesh: Mesh) -> Tensor:
    """[2, N] int64, pairs of triangles with a common edge."""
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    same = (edges[order[1:]] == edges[order[:-1]]).all(1)
    return torch.as_tensor(np.stack([order[:-1][same], order[1:][same]]) // 3)


def _made(network: Network) -> nn.Module:
    where, _, name = network.module.rpartition(".")
    try:
        made = getattr(import_module(where), name)(**network.arguments)
    except Exception as error:  # of somebody's code, whatever it raises
        expected = "package.module.Class that can be imported and made with the arguments"
        raise InvalidInput("config: learn.network", got=f"{network.module} ({error})", expected=expected) from None
    if not isinstance(made, nn.Module):
        raise InvalidInput("config: learn.network", got=network.module, expected="a torch.nn.Module")
    return made


def summary(values: Tensor) -> float:
    """One number for tables and logs: the value, or a field's mean."""
    return float(values.mean())
