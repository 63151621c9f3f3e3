"""The contract of materials, for your own ones."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from ..materials import AbstractMaterial
from . import samples
from .contract import (
    Contract,
    batch_parameters,
    call_with,
    detached_parameters,
    float64,
    require,
    require_close,
    require_finite_gradients,
    unbatch_parameters,
)
from .finite_differences import check_gradients, finite_difference_sweep


def membrane_stress(material: AbstractMaterial, f1: Tensor, f2: Tensor) -> Tensor:
    """Compute both columns of the membrane stress, [..., E, 2, 3] N/m."""
    return torch.stack(material.membrane_stress(material.coefficients(), samples.surface(f1, f2)), dim=-2)


def membrane_energy(material: AbstractMaterial, f1: Tensor, f2: Tensor) -> Tensor:
    """Compute the energy density of the membrane, [..., E, 1] J/m^2."""
    return material.membrane_energy(material.coefficients(), samples.surface(f1, f2))


def director_stress(material: AbstractMaterial, n: Tensor, d3: Tensor) -> Tensor:
    """Compute the derivatives of the director's energy by n and d3, [..., E, S, 2, 3] N/m."""
    return torch.stack(torch.broadcast_tensors(*material.director_stress(_per_point(material), n, d3)), dim=-2)


def director_energy(material: AbstractMaterial, n: Tensor, d3: Tensor) -> Tensor:
    """Compute the energy density of the directors, [..., E, S, 1] J/m^2."""
    return material.director_energy(_per_point(material), n, d3)


def return_map(material: AbstractMaterial, n: Tensor, d3: Tensor) -> Tensor:
    """Apply the return map to directors, [..., E, S, 3]."""
    return material.return_map(_per_point(material), n, d3)


def plastic_flow(material: AbstractMaterial, f1: Tensor, f2: Tensor) -> Tensor:
    """Compute A [..., E, 4], the inverse plastic set of a new sheet that is brought to this deformation."""
    initial = material.initial_memory(f1.shape[-2])
    if initial is None:
        raise AssertionError("a material without plastic set was asked for its flow")
    return _flow(material, f1, f2, initial.to(f1))


def _flow(material: AbstractMaterial, f1: Tensor, f2: Tensor, inverse_plastic: Tensor) -> Tensor:
    trial1, trial2 = (torch.stack([f1, f2], dim=-1) @ inverse_plastic.unflatten(-1, (2, 2))).unbind(-1)
    return material.flow(material.coefficients(), samples.surface(trial1, trial2), inverse_plastic)


def _per_point(material: AbstractMaterial) -> Any:
    c = material.coefficients()
    return type(c)(*(value.unsqueeze(-2) for value in c))


_INVARIANT_LAWS = ("membrane_energy", "director_energy", "plastic_flow")  # scalars, or in the material's axes


class MaterialContract(Contract):
    """What the layer relies on in a material. Override ``make``, and the numbers if the law needs others.

    Attributes:
        triangles: number of test triangles; parameter fields of ``make`` must fit.
        points: contact points per triangle.
        strain: size of the random strains.
    """

    triangles = 12
    points = 4
    strain = 0.1

    @abstractmethod
    def make(self) -> AbstractMaterial:
        """Make a material with ordinary values, away from the borders of their domains."""

    def _material(self) -> AbstractMaterial:
        with float64():
            return self.make().double().requires_grad_()

    def _columns(self) -> dict[str, Tensor]:
        return dict(zip(("f1", "f2"), samples.frames(self.triangles, self.strain, 0), strict=True))

    def _directors(self) -> dict[str, Tensor]:
        f1, f2 = samples.frames(self.triangles, self.strain, 0)
        n = samples.surface(f1, f2).n.unsqueeze(-2)
        return {"n": n.expand(-1, self.points, -1).contiguous(), "d3": samples.directors(n, self.points, 5)}

    def _laws(self) -> dict[str, tuple[Callable[..., Tensor], dict[str, Tensor]]]:
        columns, directors = self._columns(), self._directors()
        plastic = self._material().initial_memory(self.triangles) is not None
        return {
            **({"plastic_flow": (plastic_flow, columns)} if plastic else {}),
            "membrane_energy": (membrane_energy, columns),
            "membrane_stress": (membrane_stress, columns),
            "director_energy": (director_energy, directors),
            "director_stress": (director_stress, directors),
            "return_map": (return_map, directors),
        }

    def test_rest_is_stress_free(self) -> None:
        """An undeformed, arbitrarily turned triangle with its director along the normal has no stress."""
        material = self._material()
        f1, f2 = samples.frames(self.triangles, 0.0, 3)
        n = samples.surface(f1, f2).n.unsqueeze(-2)
        stiff = max(float(value.detach().abs().max()) for value in material.stiffness(material.coefficients()))
        by_n, by_d3 = director_stress(material, n, n).unbind(-2)
        tangential = by_n - (by_n * n).sum(-1, keepdim=True) * n  # n has unit length: the layer drops the rest
        for name, stress in (("membrane", membrane_stress(material, f1, f2)), ("n", tangential), ("d3", by_d3)):
            largest = float(stress.detach().abs().max())
            require(largest <= 1e-12 * stiff, f"stress at rest ({name}): {largest:.2e} N/m beside {stiff:.2e} N/m")
        require_close(return_map(material, n, n), n, 1e-14, "the return map moves a director at rest")

    def test_stress_is_the_derivative_of_the_energy(self) -> None:
        """Membrane and director, elementwise against autograd and along a direction against a sweep."""
        material = self._material()
        membrane = membrane_energy, membrane_stress, self._columns()
        director = director_energy, director_stress, self._directors()
        for energy, stress, inputs in (membrane, director):
            leaves = [value.clone().requires_grad_() for value in inputs.values()]
            wanted = torch.stack(torch.autograd.grad(energy(material, *leaves).sum(), leaves), dim=-2)
            got = stress(material, *inputs.values()).detach()
            require_close(got, wanted, 1e-10, f"{stress.__name__} is not the derivative of {energy.__name__}")
            point = torch.stack(list(inputs.values()), dim=-2)
            direction = samples.normal(tuple(point.shape), 9)

            def total(moved: Tensor, energy: Callable[..., Tensor] = energy) -> Tensor:
                return energy(material, *moved.unbind(-2)).sum()

            finite_difference_sweep(total, point, direction, (got * direction).sum()).check(1e-7)

    def test_is_frame_indifferent(self) -> None:
        """P(QF) = Q P(F); energies and plastic set do not change; the return map turns with the sheet."""
        material, q = self._material(), samples.rotation(4)
        for name, (law, inputs) in self._laws().items():
            turned = law(material, *(value @ q.mT for value in inputs.values())).detach()
            expected = law(material, *inputs.values()).detach()
            expected = expected if name in _INVARIANT_LAWS else expected @ q.mT
            require_close(turned, expected, 1e-11, f"{name} changes when the frame is turned")

    def test_return_map_is_idempotent(self) -> None:
        """What has flowed once is on or inside the yield surface."""
        material, inputs = self._material(), self._directors()
        once = return_map(material, inputs["n"], inputs["d3"]).detach()
        require_close(return_map(material, inputs["n"], once).detach(), once, 1e-11, "the return map is not idempotent")

    def test_plastic_flow_is_idempotent(self) -> None:
        """What has set does not set again under the same deformation; elastic materials have nothing to show."""
        material, (f1, f2) = self._material(), self._columns().values()
        initial = material.initial_memory(self.triangles)
        if initial is None:
            return
        once = plastic_flow(material, f1, f2).detach()
        require((once != initial).any(), "nothing yields: give ``strain`` a size that does")
        require_close(_flow(material, f1, f2, once).detach(), once, 1e-12, "the plastic flow is not idempotent")

    def test_gradients_in_state_and_parameters(self) -> None:
        """A sweep for every law in every input and every parameter."""
        material = self._material()
        parameters = detached_parameters(material)
        for name, (law, inputs) in self._laws().items():

            def evaluate(law: Callable[..., Tensor] = law, keys: tuple = tuple(inputs), **values: Tensor) -> Tensor:
                state = [values[key] for key in keys]
                return call_with(material, {key: values[key] for key in parameters}, law, *state)

            try:
                check_gradients(evaluate, {**inputs, **parameters}, 1e-7)
            except AssertionError as error:
                raise AssertionError(f"{name}: {error}") from None

    def test_gradients_are_finite_at_rest(self) -> None:
        """Square roots and divisions of the law have derivatives at rest, where every simulation starts."""
        material = self._material()
        f1, f2 = samples.frames(self.triangles, 0.0, 3)
        n = samples.surface(f1, f2).n.unsqueeze(-2)
        for name, (law, inputs) in self._laws().items():
            state = (f1, f2) if "f1" in inputs else (n, n)
            leaves = {key: value.clone().requires_grad_() for key, value in zip(inputs, state, strict=True)}
            result = law(material, *leaves.values())
            require_finite_gradients(result, {**leaves, **dict(material.named_parameters())}, f"at rest ({name})")

    def test_stiffness_bounds_the_tangents_at_rest(self) -> None:
        """The stable step is built on it: no strain may be stiffer than stated, nor shear of d3."""
        material, h = self._material(), 1e-4
        bound = material.stiffness(material.coefficients())
        f = torch.stack(samples.frames(self.triangles, 0.0, 3), dim=-1)
        for seed in range(6):
            e = samples.normal((self.triangles, 2, 2), seed)
            e = (e + e.mT) / 2
            plus, minus = ((f + s * h * f @ e).unbind(-1) for s in (1, -1))
            slope = (membrane_stress(material, *plus) - membrane_stress(material, *minus)) / (2 * h)
            tangent = (slope * (f @ e).mT).sum((-2, -1))[..., None]
            warp, weft, shear = e[:, 0, 0, None], e[:, 1, 1, None], 2 * e[:, 0, 1, None]
            allowed = bound.warp * warp**2 + bound.weft * weft**2 + bound.in_plane_shear * shear**2
            allowed = allowed + 2 * bound.coupling * warp * weft
            require((tangent <= allowed * (1 + 1e-5)).all(), "stiffness() is below the membrane's tangent")
        n, aside = torch.linalg.cross(f[..., 0], f[..., 1]).unsqueeze(-2), f[..., 0].unsqueeze(-2)
        slope = director_stress(material, n, n + h * aside) - director_stress(material, n, n - h * aside)
        tangent = (slope[..., 1, :] * aside).sum(-1) / (2 * h)
        require((tangent <= bound.shear * (1 + 1e-5)).all(), "stiffness().shear is below the director's tangent")

    def test_batches_equal_loops(self) -> None:
        """Batched states and parameters give what a loop gives."""
        material = self._material()
        parameters = detached_parameters(material)
        many = batch_parameters(parameters, 3)
        for name, (law, inputs) in self._laws().items():
            factor = torch.tensor([1.0, 1.01, 0.98], dtype=torch.float64)
            states = [torch.einsum("b,...->b...", factor, value) for value in inputs.values()]
            together = call_with(material, many, law, *states)
            for k in range(3):
                alone = call_with(
                    material, unbatch_parameters(many, parameters, k), law, *(value[k] for value in states)
                )
                require_close(
                    together[k].detach(), alone.detach(), 1e-12, f"{name}: batch entry {k} differs from the loop"
                )

    def test_works_in_float32(self) -> None:
        """Same values to single precision, and no silent promotion."""
        exact, coarse = self._material(), self.make().float()
        for name, (law, inputs) in self._laws().items():
            if name == "return_map":
                inputs = {"n": inputs["n"], "d3": return_map(exact, *inputs.values()).detach()}
            got = law(coarse, *(value.float() for value in inputs.values())).detach()
            require(got.dtype == torch.float32, f"{name} answers float32 with {got.dtype}")
            require_close(got.double(), law(exact, *inputs.values()).detach(), 1e-4, f"{name} in float32")
