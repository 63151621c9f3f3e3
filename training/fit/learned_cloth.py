"""A cloth with learned parameters: scalars, fields with one value per triangle, or outputs of a network."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from copy import deepcopy
from importlib import import_module

import numpy as np
import torch
from torch import Tensor, nn

from torchcloth import Cloth, PhysicalParameter
from torchcloth.episodes.unknowns import collect_unknowns, find_scalar_parameters
from torchcloth.errors import InvalidInput
from torchcloth.meshes import Mesh
from torchcloth.parameters import to_physical

from .config import Learn, Network


class LearnedCloth(nn.Module):
    """A cloth with some learned parameters; the others are frozen.

    Args:
        cloth: at its start values; it is changed.
        what: names of the learned parameters. Fields and outputs of a network must belong to the material, or be the
            areal density.
        network_class: of ``what.network``; None: the class of that name, if it is imported already.

    Raises:
        InvalidInput: a name is unknown, or there is nothing to learn.
    """

    _places: Tensor
    _pairs: Tensor

    def __init__(self, cloth: Cloth, what: Learn, network_class: type[nn.Module] | None = None) -> None:
        super().__init__()
        self.what, self.cloth = what, cloth.requires_grad_(False)
        network_names = [] if what.network is None else what.network.outputs
        names = [*what.parameters, *what.fields, *network_names]
        if not names or len(set(names)) < len(names):
            got = f"{', '.join(names) or 'no name'}"
            raise InvalidInput("config: learn", got=got, expected="one or more names, each once")
        self.units = {u.name: u.typical_amplitude or 1.0 for u in collect_unknowns(cloth, names, None)}
        self.paths = {name: find_scalar_parameters(cloth)[name] for name in names}
        for name in [*what.fields, *network_names]:
            if not self.paths[name].startswith(("material.", "areal_density")):
                raise InvalidInput(
                    "config: learn", got=f"a field of {name}", expected="areal_density or one of the material"
                )
        for name in what.fields:
            self.parameter(name).raw = nn.Parameter(self.parameter(name).raw.expand(len(cloth.mesh.faces)).clone())
        for name in (*what.parameters, *what.fields):
            self.parameter(name).raw.requires_grad_(True)
        self.network = None
        if what.network is not None:
            network_class = network_class or find_imported_network(what.network.module)
            self.network = _build_network(what.network, network_class).to(cloth.areal_density.raw)
        if next(self.iterate_with_units(), None) is None:
            expected = "some parameter that may change"
            raise InvalidInput("config: learn.network", got="a network without any", expected=expected)
        self.register_buffer("_places", triangle_centres(cloth.mesh).to(cloth.areal_density.raw), persistent=False)
        self.register_buffer("_pairs", adjacent_triangles(cloth.mesh), persistent=False)

    def parameter(self, name: str) -> PhysicalParameter:
        """Return a parameter by its public name."""
        return self.cloth.get_submodule(self.paths[name])  # type: ignore[return-value]

    def iterate_with_units(self) -> Iterator[tuple[nn.Parameter, float]]:
        """Iterate over the learned tensors and their units.

        The unit of an amplitude is its typical size; other parameters are stored as logarithms and have unit 1.
        """
        for name in (*self.what.parameters, *self.what.fields):
            yield self.parameter(name).raw, self.units[name]
        if self.network is not None:
            yield from ((p, 1.0) for p in self.network.parameters() if p.requires_grad)

    def raw(self) -> dict[str, Tensor]:
        """Return the unconstrained values by name, differentiable.

        Outputs of the network are multiplied by their units and added to the start values.
        """
        stored: dict[str, Tensor] = {
            name: self.parameter(name).raw for name in (*self.what.parameters, *self.what.fields)
        }
        if self.network is None or self.what.network is None:
            return stored
        output, names = self._network_output(self.network, self.what.network.module), self.what.network.outputs
        if not isinstance(output, Tensor) or output.shape != (len(self._places), len(names)):
            got = list(output.shape) if isinstance(output, Tensor) else type(output).__name__
            expected = f"[{len(self._places)}, {len(names)}], a column for each of {', '.join(names)}"
            raise InvalidInput(f"{self.what.network.module}: output", got=got, expected=expected)
        network_names = {
            name: self.parameter(name).raw + self.units[name] * output[:, i] for i, name in enumerate(names)
        }
        amplitudes = {
            name: raw.clamp(min=0.0)
            for name, raw in network_names.items()
            if self.parameter(name).domain == "nonnegative"
        }
        return stored | network_names | amplitudes

    def _network_output(self, network: nn.Module, name: str) -> Tensor:
        try:
            return network(self._places)
        except Exception as error:  # the user's code may raise anything
            got = f"{type(error).__name__}: {error}".splitlines()[0]
            expected = f"a network that takes places {list(self._places.shape)}"
            raise InvalidInput(f"{name}: forward", got=got, expected=expected) from error

    def entries(self) -> dict[str, Tensor]:
        """Return the network's outputs by the names of the cloth's stored tensors."""
        network_names = () if self.what.network is None else self.what.network.outputs
        return {f"{self.paths[name]}.raw": value for name, value in self.raw().items() if name in network_names}

    def roughness(self) -> Tensor:
        """Return the mean squared difference of unconstrained values of adjacent triangles, summed over the fields."""
        a, b = self._pairs
        parts = [(raw[a] - raw[b]).square().mean() for raw in self.raw().values() if raw.ndim]
        return torch.stack(parts).sum() if parts else self._places.new_zeros(())

    def clip(self) -> None:
        """Set amplitudes that a step made negative to 0."""
        for name in (*self.what.parameters, *self.what.fields):
            self.parameter(name).clip_()

    @torch.no_grad()
    def evaluate(self) -> dict[str, Tensor]:
        """Return ``raw`` in evaluation mode, without random layers of the network."""
        training = self.training
        try:
            return self.eval().raw()
        finally:
            self.train(training)

    @torch.no_grad()
    def values(self) -> dict[str, Tensor]:
        """Return the physical values by name: scalars [], fields [F]."""
        return {name: to_physical(raw, self.parameter(name).domain).clone() for name, raw in self.evaluate().items()}

    @torch.no_grad()
    def bake_cloth(self) -> Cloth:
        """Return a copy of the cloth with the learned values."""
        cloth = deepcopy(self.cloth)
        for name, raw in self.evaluate().items():
            cloth.get_submodule(self.paths[name]).raw = nn.Parameter(raw.clone())
        return cloth.require_default_gradients_()


def triangle_centres(mesh: Mesh) -> Tensor:
    """Return the centres [F, 2] of the triangles on the pattern (else in x and y), scaled to -1 to 1."""
    corners = mesh.vertices[mesh.faces][..., :2] if mesh.pattern is None else mesh.pattern
    middle = corners.mean(1)
    low, high = middle.min(0), middle.max(0)
    return torch.as_tensor((2 * middle - low - high) / (high - low).max())


def adjacent_triangles(mesh: Mesh) -> Tensor:
    """Return the pairs [2, N] int64 of triangles with a common edge."""
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort(edges.T)
    is_same = (edges[order[1:]] == edges[order[:-1]]).all(1)
    return torch.as_tensor(np.stack([order[:-1][is_same], order[1:][is_same]]) // 3)


def import_network(name: str) -> type[nn.Module]:
    """Import the class "package.module.Class" that a user's config names; importing runs the module.

    Raises:
        InvalidInput: it cannot be imported, or is no subclass of torch.nn.Module.
    """
    where, _, attribute = name.rpartition(".")
    try:
        candidate = getattr(import_module(where), attribute)
    except Exception as error:  # the user's code may raise anything
        expected = "package.module.Class that can be imported"
        raise InvalidInput("config: learn.network", got=f"{name} ({error})", expected=expected) from None
    return _check_network_class(name, candidate)


def find_imported_network(name: str) -> type[nn.Module]:
    """Return the class "package.module.Class" of a module that is imported already: a checkpoint imports nothing.

    Raises:
        InvalidInput: its module is not imported, or it is no subclass of torch.nn.Module.
    """
    where, _, attribute = name.rpartition(".")
    candidate = vars(sys.modules[where]).get(attribute) if where in sys.modules else None
    if candidate is None:
        raise InvalidInput(
            "checkpoint: learn.network",
            got=f"{name}, which is not imported",
            expected="a class that is imported before the checkpoint is loaded",
            remedy="import it, or load_from_checkpoint(FILE, network_class=CLASS)",
        )
    return _check_network_class(name, candidate)


def _check_network_class(name: str, candidate: object) -> type[nn.Module]:
    """Refuse everything but a subclass of nn.Module, before it is called."""
    if not (isinstance(candidate, type) and issubclass(candidate, nn.Module)):
        raise InvalidInput("config: learn.network", got=name, expected="a subclass of torch.nn.Module")
    return candidate


def _build_network(network: Network, network_class: type[nn.Module]) -> nn.Module:
    try:
        return network_class(**network.arguments)
    except Exception as error:  # the user's code may raise anything
        expected = "a class that can be made with the arguments"
        raise InvalidInput("config: learn.network", got=f"{network.module} ({error})", expected=expected) from None


def scalar_summary(values: Tensor) -> float:
    """Return one number for tables and logs: the value, or the mean of a field."""
    return float(values.mean())
