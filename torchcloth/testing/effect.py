"""The contract of effects, for your own ones."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable

import torch
from torch import Tensor

from ..boundaries import Grasp
from ..cloth import Cloth
from ..dynamics.kinematics import Geometry, surface
from ..effects import AbstractEffect, Amplitude
from ..materials import AEP
from ..meshes import Mesh, rectangle
from ..types import ClothState, EffectInputs, Trajectory
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
from .finite_differences import check_gradients


class EffectContract(Contract):
    """What the layer relies on in an effect. Override ``make``, and ``mesh`` if the effect needs another."""

    amplitude: str | None = None  # the parameter that ``make`` sets; None: the main one

    @abstractmethod
    def make(self, amplitude: float) -> AbstractEffect:
        """Make the effect, not yet bound to a mesh, with this amplitude in its unit and all others 0."""

    def base(self) -> dict[str, AbstractEffect]:
        """Return the effects of the model that amplitude 0 must leave unchanged.

        None of them for the bare membrane. For a parameter that only modifies another one (wind on drag, tilt on
        weight) the effect without it.
        """
        return {}

    def mesh(self) -> Mesh:
        """Build the sheet on which the effect is tested."""
        return rectangle(0.3, 0.2, resolution=(4, 4))

    def _effect(self, amplitude: float | None = None) -> AbstractEffect:
        with float64():
            size = self._size(self.make(0.0)).typical if amplitude is None else amplitude
            return self.make(size).double().bind(self.mesh()).double().requires_grad_()

    def _size(self, effect: AbstractEffect) -> Amplitude:
        amplitudes = getattr(type(effect), "amplitudes", {})
        require(len(amplitudes) > 0, "the effect declares no amplitudes")
        name = next(iter(amplitudes)) if self.amplitude is None else self.amplitude
        require(name in amplitudes, f"the effect declares no amplitude {name!r}")
        return amplitudes[name]

    def _cloth(self, effects: dict[str, AbstractEffect]) -> Cloth:
        with float64():
            return Cloth(self.mesh(), AEP(1e5, 0.3), 0.2, effects, contact=None, engine="reference").double()

    def _state(self) -> dict[str, Tensor]:
        """Return a state that is bent, stretched and moving."""
        rest = torch.as_tensor(self.mesh().vertices) @ samples.rotation(2).mT
        x = rest + 0.01 * samples.normal(tuple(rest.shape), 3)
        return {"x": x, "v": samples.normal(tuple(rest.shape), 4)}

    def _answers(self) -> Callable[..., dict[str, Tensor]]:
        """Return a function (effect, x, v) -> results by hook, without the hooks that the effect does not use.

        The memory of an effect has evolved from the flat sheet, through half the way, to ``x``.
        """
        model = self._cloth({}).build_model()
        rest = torch.as_tensor(self.mesh().vertices)

        def answers(effect: AbstractEffect, x: Tensor, v: Tensor) -> dict[str, Tensor]:
            geometry, mass = _cast(model.geometry, x.dtype), model.mass.to(x.dtype).detach()
            c = effect.coefficients()
            memory = effect.initial_memory(rest.to(x).expand_as(x))
            now = EffectInputs(x, v, surface(geometry, x, v), mass, memory, dt=1e-3)
            if now.memory is not None:
                half = (rest.to(x) + x) / 2
                between = now._replace(x=half, surface=surface(geometry, half, v))
                now = now._replace(memory=effect.update_memory(c, between))
                now = now._replace(memory=effect.update_memory(c, now))
            index = torch.arange(3)
            gripped = v.index_fill(-2, index, 0.0)
            slipped = effect.grip_velocities(c, index, v, gripped, mass, 1e-3, None)
            results = {
                "force": effect.force(c, now),
                "viscous": effect.viscous(c, now),
                "mass": effect.mass(c),
                "inertia": effect.inertia(c, now.surface),
                "rest_deformation": effect.rest_deformation(c),
                "memory": now.memory,
                "grip": None if effect.grasp is None else slipped,
            }
            return {name: value for name, value in results.items() if value is not None}

        return answers

    def _viscous(self, effect: AbstractEffect, x: Tensor, v: Tensor) -> Tensor:
        return self._answers()(effect, x, v).get("viscous", torch.zeros_like(x))

    def _on_vertices(self, effect: AbstractEffect, x: Tensor, v: Tensor) -> Tensor:
        force = self._answers()(effect, x, v).get("force", torch.zeros_like(x))
        if effect.acts_on == "vertices":
            return force
        index = torch.as_tensor(self.mesh().faces)
        out = torch.zeros_like(x)
        for corner in range(3):
            out = out.index_add(-2, index[:, corner], force / 3)
        return out

    def test_declares_itself(self) -> None:
        """It declares amplitudes with unit and size, and has one row of force per element."""
        effect = self._effect()
        kind = type(effect)
        for name, size in kind.amplitudes.items():
            require(hasattr(effect, name), f"the effect has no parameter {name!r} for its amplitude")
            require(bool(size.unit), f"the amplitude {name!r} has no unit")
            require(size.typical > 0 or size.signed, f"typical of {name!r} must be positive, or the amplitude signed")
            require(0 < size.smallest_fraction <= 1, f"smallest of {name!r} must lie in (0, typical]")
            require(all(isinstance(other, str) for other in size.confounded_with), "confounded_with must be names")
        require(kind.acts_on in ("vertices", "triangles"), f"acts_on must not be {kind.acts_on!r}")
        mesh = self.mesh()
        rows = len(mesh.vertices if kind.acts_on == "vertices" else mesh.faces)
        answers = self._answers()(effect, **self._state())
        require(len(answers) > 0, "the effect answers nothing")
        shape = tuple(answers["force"].shape) if "force" in answers else (rows, 3)
        require(shape == (rows, 3), f"force has shape {shape}; acts_on = {kind.acts_on!r} promises ({rows}, 3)")

    def test_amplitude_zero_is_bitwise_the_base_model(self) -> None:
        """Amplitude 0 changes nothing, not even the stable step: models are compared at equal steps."""
        runs = [self._run(effects) for effects in (self.base(), {"effect": self.make(0.0)})]
        require(torch.equal(runs[0].x, runs[1].x), "amplitude 0 changes the positions of the base model")
        require(torch.equal(runs[0].v, runs[1].v), "amplitude 0 changes the velocities of the base model")

    def test_amplitude_reaches_the_motion(self) -> None:
        """The typical amplitude changes the motion."""
        runs = [self._run({"effect": self.make(size)}) for size in (0.0, self._size(self.make(0.0)).typical)]
        require(torch.isfinite(runs[1].x).all(), "the typical amplitude gives no finite motion")
        require(not torch.equal(runs[0].x, runs[1].x), "the typical amplitude changes nothing")

    def _run(self, effects: dict[str, AbstractEffect]) -> ClothState:
        """Simulate a few substeps of the sample, with a moving gripper if the effect belongs to one."""
        grasp = next((effect.grasp for effect in effects.values()), self.make(0.0).grasp)
        with float64():
            boundaries = {} if grasp is None else {grasp: Grasp([0, 1])}
            parts = self.mesh(), AEP(1e5, 0.3), 0.2, effects, boundaries
            cloth = Cloth(*parts, contact=None, engine="reference").double()  # laws are compared, not roundings
        span = 6 * self._cloth({}).stable_step()
        pose = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
        pose[1, 2, 3] = 3.0 * span
        t = torch.tensor([0.0, span], dtype=torch.float64)
        motion = {name: Trajectory(t, pose, torch.tensor([True, True])) for name in boundaries}
        with torch.no_grad():
            return cloth(cloth.state(**self._state()), motion, t).state

    def test_gradients(self) -> None:
        """Gradients in positions, velocities and every parameter agree with finite differences."""
        effect = self._effect()
        parameters = detached_parameters(effect)
        answers = self._answers()

        for name in answers(effect, **self._state()):

            def evaluate(x: Tensor, v: Tensor, _name: str = name, **values: Tensor) -> Tensor:
                return call_with(effect, values, answers, x, v)[_name]

            check_gradients(evaluate, {**self._state(), **parameters}, 1e-7)

    def test_gradients_are_finite_at_rest(self) -> None:
        """Gradients are finite on the flat sheet at rest, with typical amplitude and with 0, where fits start."""
        for amplitude in (None, 0.0):
            effect = self._effect(amplitude)
            x = torch.as_tensor(self.mesh().vertices).clone().requires_grad_()
            v = torch.zeros_like(x).requires_grad_()
            leaves = {"x": x, "v": v, **dict(effect.named_parameters())}
            where = f"at rest with {'typical amplitude' if amplitude is None else 'amplitude 0'}"
            for name, answer in self._answers()(effect, x, v).items():
                require(torch.isfinite(answer).all(), f"{name} is not finite {where}")
                if answer.requires_grad:
                    require_finite_gradients(answer, leaves, where)

    def test_rates_bound_the_spectrum_at_rest(self) -> None:
        """``stability_bounds`` covers the spectrum; else the step that the layer chooses is not stable."""
        effect = self._effect()
        mass = self._cloth({}).build_model().mass.detach()
        bounds = effect.stability_bounds(effect.coefficients(), mass)
        pairs = zip(("omega^2", "damping rate"), bounds, (self._stiffness, self._damping), strict=True)
        for name, bound, jacobian in pairs:
            largest = float(torch.linalg.eigvals(self._rates(effect, jacobian)).real.max())
            allowed = float(bound.detach()) * (1 + 1e-9) + 1e-9
            require(largest <= allowed, f"stability_bounds() bounds the {name} by {allowed:.4g}, it is {largest:.4g}")

    def test_viscous_is_the_part_of_the_force_that_it_says(self) -> None:
        """``viscous`` is linear in velocity, symmetric, never driving and within its bound, as is the rest."""
        effect, state = self._effect(), self._state()
        x, v = state["x"], state["v"]
        once, twice = (self._viscous(effect, x, factor * v).detach() for factor in (1.0, 2.0))
        require_close(twice, 2 * once, 1e-12, "viscous() is not linear in velocity")
        mass, c = self._cloth({}).build_model().mass.detach(), effect.coefficients()
        whole, rate = (
            float(value.detach())
            for value in (effect.stability_bounds(c, mass)[1], effect.viscous_stability_bound(c, mass))
        )
        matrix = self._rates(effect, self._thickness)
        require_close(matrix, matrix.mT, 1e-9, "viscous() is not symmetric")
        slowest, fastest = torch.linalg.eigvalsh(matrix)[[0, -1]].tolist()
        require(slowest >= -1e-9 * max(1.0, fastest), "viscous() drives some motion")
        require(fastest <= rate * (1 + 1e-9) + 1e-9, f"viscous_stability_bound() says {rate:.4g}, it is {fastest:.4g}")
        largest = float(torch.linalg.eigvals(self._rates(effect, self._damping) - matrix).real.max())
        require(
            largest <= whole * (1 + 1e-9) - rate + 1e-9,
            "stability_bounds() must bound what is not viscous by the difference",
        )

    def _rates(self, effect: AbstractEffect, jacobian: Callable[..., Tensor]) -> Tensor:
        """Return minus a force's derivative at rest, over the roots of the masses on both sides."""
        x = torch.as_tensor(self.mesh().vertices)
        root = self._cloth({}).build_model().mass.detach().sqrt().expand_as(x).reshape(-1)
        return -jacobian(effect, x, torch.zeros_like(x)).reshape(len(root), -1) / root[:, None] / root

    def _stiffness(self, effect: AbstractEffect, x: Tensor, v: Tensor) -> Tensor:
        return torch.autograd.functional.jacobian(lambda moved: self._on_vertices(effect, moved, v), x)  # type: ignore[return-value]

    def _damping(self, effect: AbstractEffect, x: Tensor, v: Tensor) -> Tensor:
        return torch.autograd.functional.jacobian(lambda moved: self._on_vertices(effect, x, moved), v)  # type: ignore[return-value]

    def _thickness(self, effect: AbstractEffect, x: Tensor, v: Tensor) -> Tensor:
        return torch.autograd.functional.jacobian(lambda moved: self._viscous(effect, x, moved), v)  # type: ignore[return-value]

    def test_batches_equal_loops(self) -> None:
        """Batches of states and parameters give what a loop gives."""
        effect, answers = self._effect(), self._answers()
        parameters = detached_parameters(effect)
        many, state = batch_parameters(parameters, 3), self._state()
        x = torch.stack([state["x"], 1.1 * state["x"], 0.9 * state["x"]])
        v = torch.stack([state["v"], -state["v"], 2.0 * state["v"]])
        together = call_with(effect, many, answers, x, v)
        for k in range(3):
            alone = call_with(effect, unbatch_parameters(many, parameters, k), answers, x[k], v[k])
            for name, answer in alone.items():
                batch = together[name].detach()
                batch = batch.expand(3, *batch.shape[-answer.ndim :])
                require_close(batch[k], answer.detach(), 1e-12, f"{name} of batch entry {k} differs from the loop")

    def test_works_in_float32(self) -> None:
        """Results agree to single precision, without silent promotion."""
        state = self._state()
        exact = self._answers()(self._effect(), **state)
        single_state = {name: value.float() for name, value in state.items()}
        for name, got in self._answers()(self._effect().float(), **single_state).items():
            require(got.dtype == torch.float32, f"{name} answers float32 with {got.dtype}")
            require_close(got.detach().double(), exact[name].detach(), 1e-4, f"{name} in float32")


def _cast(geometry: Geometry, dtype: torch.dtype) -> Geometry:
    def cast(value: Tensor) -> Tensor:
        return value.to(dtype)

    return geometry._replace(
        warp=tuple(map(cast, geometry.warp)), weft=tuple(map(cast, geometry.weft)), area=cast(geometry.area)
    )
