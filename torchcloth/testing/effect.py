"""The contract of an effect."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from .. import functional
from ..cloth import Cloth
from ..effects import AbstractEffect
from ..materials import AEP
from ..meshes import Mesh, rectangle
from ..types import ClothState
from . import samples
from .contract import Contract, batched, call_with, close, demand, finite_gradients, float64, parameters_of, single
from .finite_differences import check_gradients


class EffectContract(Contract):
    """What the layer relies on in an effect. Override ``make``, and ``mesh`` if the effect needs another."""

    @abstractmethod
    def make(self, amplitude: float) -> AbstractEffect:
        """The effect, not yet bound to a mesh, with this amplitude in its own unit."""

    def mesh(self) -> Mesh:
        """The sheet on which the effect is tried."""
        return rectangle(0.3, 0.2, resolution=(4, 4))

    def _effect(self, amplitude: float | None = None) -> AbstractEffect:
        typical = type(self.make(0.0)).typical if amplitude is None else amplitude
        with float64():
            return self.make(typical).double().bind(self.mesh()).double()

    def _cloth(self, effects: dict[str, AbstractEffect]) -> Cloth:
        with float64():
            return Cloth(self.mesh(), AEP(1e5, 0.3), 0.2, effects, contact=None).double()

    def _state(self) -> dict[str, Tensor]:
        """Bent, stretched and moving."""
        rest = torch.as_tensor(self.mesh().vertices) @ samples.rotation(2).mT
        x = rest + 0.01 * samples.normal(tuple(rest.shape), 3)
        return {"x": x, "v": samples.normal(tuple(rest.shape), 4)}

    def _force(self) -> Callable[..., Tensor]:
        """force(effect, x, v) [..., V or E, 3] on the mesh."""
        model = self._cloth({}).model()

        def force(effect: AbstractEffect, x: Tensor, v: Tensor) -> Tensor:
            geometry, mass = _cast(model.geometry, x.dtype), model.mass.to(x.dtype).detach()
            surface = functional.surface(geometry, x, v)
            return effect.force(effect.coefficients(), ClothState(x, v, x[..., :0, :]), surface, mass)

        return force

    def _on_vertices(self, effect: AbstractEffect, x: Tensor, v: Tensor) -> Tensor:
        force = self._force()(effect, x, v)
        if effect.acts_on == "vertices":
            return force
        index = torch.as_tensor(self.mesh().faces)
        out = torch.zeros_like(x)
        for corner in range(3):
            out = out.index_add(-2, index[:, corner], force / 3)
        return out

    def test_declares_itself(self) -> None:
        """Unit, typical and smallest amplitude, equivalences, and one row of force per vertex or triangle."""
        effect = self._effect()
        kind = type(effect)
        demand(isinstance(getattr(kind, "unit", None), str), "the effect declares no unit")
        demand(getattr(kind, "typical", 0) > 0, "the effect declares no typical amplitude")
        demand(0 < getattr(kind, "smallest", 0) <= kind.typical, "smallest must lie in (0, typical]")
        demand(all(isinstance(name, str) for name in kind.equivalences), "equivalences must be names")
        demand(kind.acts_on in ("vertices", "triangles"), f"acts_on must not be {kind.acts_on!r}")
        mesh = self.mesh()
        rows = len(mesh.vertices if kind.acts_on == "vertices" else mesh.faces)
        shape = tuple(self._force()(effect, **self._state()).shape)
        demand(shape == (rows, 3), f"force has shape {shape}; acts_on = {kind.acts_on!r} promises ({rows}, 3)")

    def test_amplitude_zero_is_bitwise_the_base_model(self) -> None:
        """Also the stable step must be the same, or the comparison of models would compare steps."""
        state = self._state()
        runs = []
        for effects in ({}, {"effect": self.make(0.0)}):
            cloth = self._cloth(effects)
            with torch.no_grad():
                runs.append(cloth(cloth.state(**state), times=[0.0, 6 * self._cloth({}).stable_step()]))
        demand(torch.equal(runs[0].x, runs[1].x), "amplitude 0 changes the positions of the base model")
        demand(torch.equal(runs[0].v, runs[1].v), "amplitude 0 changes the velocities of the base model")

    def test_amplitude_reaches_the_force(self) -> None:
        """The typical amplitude does something."""
        force = self._force()(self._effect(), **self._state()).detach()
        demand(bool((force != 0).any()) and bool(torch.isfinite(force).all()), "the typical amplitude gives no force")

    def test_gradients(self) -> None:
        """Sweeps in positions, velocities and every parameter."""
        effect = self._effect()
        parameters = parameters_of(effect)
        force = self._force()

        def evaluate(x: Tensor, v: Tensor, **values: Tensor) -> Tensor:
            return call_with(effect, values, force, x, v)

        check_gradients(evaluate, {**self._state(), **parameters}, 1e-7)

    def test_gradients_are_finite_at_rest(self) -> None:
        """Flat and still, with typical amplitude and with 0: where every fit starts."""
        for amplitude in (None, 0.0):
            effect = self._effect(amplitude)
            x = torch.as_tensor(self.mesh().vertices).clone().requires_grad_()
            v = torch.zeros_like(x).requires_grad_()
            leaves = {"x": x, "v": v, **dict(effect.named_parameters())}
            where = f"at rest with {'typical amplitude' if amplitude is None else 'amplitude 0'}"
            force = self._force()(effect, x, v)
            demand(torch.isfinite(force).all(), f"the force is not finite {where}")
            if force.requires_grad:
                finite_gradients(force, leaves, where)

    def test_rates_bound_the_spectrum_at_rest(self) -> None:
        """A stiff or strongly damping effect must say so, or the step that the layer chooses is not stable."""
        effect = self._effect()
        mass = self._cloth({}).model().mass.detach()
        x = torch.as_tensor(self.mesh().vertices)
        still = torch.zeros_like(x)
        root = mass.sqrt().expand_as(x).reshape(-1)
        bounds = effect.rates(effect.coefficients(), mass)
        pairs = zip(("omega^2", "damping rate"), bounds, (self._stiffness, self._damping), strict=True)
        for name, bound, jacobian in pairs:
            matrix = -jacobian(effect, x, still).reshape(len(root), -1) / root[:, None] / root
            largest = float(torch.linalg.eigvals(matrix).real.max())
            allowed = float(bound.detach()) * (1 + 1e-9) + 1e-9
            demand(largest <= allowed, f"rates() bounds the {name} by {float(bound):.4g}, it is {largest:.4g}")

    def _stiffness(self, effect: AbstractEffect, x: Tensor, v: Tensor) -> Tensor:
        return torch.autograd.functional.jacobian(lambda moved: self._on_vertices(effect, moved, v), x)  # type: ignore[return-value]

    def _damping(self, effect: AbstractEffect, x: Tensor, v: Tensor) -> Tensor:
        return torch.autograd.functional.jacobian(lambda moved: self._on_vertices(effect, x, moved), v)  # type: ignore[return-value]

    def test_batches_equal_loops(self) -> None:
        """Batched states and parameters give what a loop gives."""
        effect, force = self._effect(), self._force()
        parameters = parameters_of(effect)
        many, state = batched(parameters, 3), self._state()
        x = torch.stack([state["x"], 1.1 * state["x"], 0.9 * state["x"]])
        v = torch.stack([state["v"], -state["v"], 2.0 * state["v"]])
        together = call_with(effect, many, force, x, v).detach()
        together = together.expand(3, *together.shape[-2:])
        for k in range(3):
            alone = call_with(effect, single(many, parameters, k), force, x[k], v[k]).detach()
            close(together[k], alone, 1e-12, f"batch entry {k} differs from the loop")

    def test_works_in_float32(self) -> None:
        """Same force to single precision, and no silent promotion."""
        state = self._state()
        exact = self._force()(self._effect(), **state).detach()
        got = self._force()(self._effect().float(), **{name: value.float() for name, value in state.items()}).detach()
        demand(got.dtype == torch.float32, f"force answers float32 with {got.dtype}")
        close(got.double(), exact, 1e-4, "force in float32")


def _cast(geometry: functional.Geometry, dtype: torch.dtype) -> functional.Geometry:
    def cast(value: Tensor) -> Tensor:
        return value.to(dtype)

    return geometry._replace(
        warp=tuple(map(cast, geometry.warp)), weft=tuple(map(cast, geometry.weft)), area=cast(geometry.area)
    )
