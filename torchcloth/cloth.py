"""The layer: a cloth as an nn.Module."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from ._utils.torch_modes import disable_autocast
from .boundaries import AbstractBoundary
from .dynamics import substep
from .dynamics.contact import Contact, Grid
from .dynamics.elasticity import MATERIAL_MEMORY_KEY, inverse_rest_deformation
from .dynamics.kinematics import Geometry, vertex_mass
from .dynamics.model import Model
from .dynamics.stability import check_precision, stability_limits
from .effects import AbstractEffect
from .engine.cuda_graphs import Graphs
from .engine.dispatch import TRIED, Choice, Setting, Trial, check_setting, choose, still_drives
from .errors import TorchclothError
from .materials import AbstractMaterial
from .meshes import Mesh
from .parameters import PhysicalParameter
from .simulation.argument_checks import (
    as_positions,
    check_axes,
    check_field,
    check_fields,
    check_grasps,
    check_motions,
    check_parameters,
    check_parts,
    check_rate,
    check_state,
    check_step,
    check_substeps,
    check_times,
    mesh_warnings,
    expand_state,
)
from .simulation.bound_modules import BoundModuleDict, check_not_bound_elsewhere
from .simulation.initial_state import with_mass_damping, initial_state, stationary_motion, template_state, random_contact_state, require_at_rest
from .simulation.rollout import RolloutSchedule, subdivide_intervals, run_schedule
from .simulation.sensitivities import Directions, compute_sensitivities
from .types import ClothState, Rollout, Trajectory


class Cloth(nn.Module):
    """A sheet of cloth that is simulated, and differentiated, by calling it.

    Args:
        mesh: the triangles and their rest shape.
        material: the constitutive law.
        areal_density: rho_A [kg/m^2]; scalar or one value per triangle; learnable.
        effects: forces by name, e.g. ``{"gravity": Gravity(), "air": AirDrag()}``. None: none, not even weight.
        boundaries: grasps and colliders by name, applied in order.
        contact: discretisation of contact between layers; None leaves contact out, and with it the parameters k, gamma
            and c_F of the material.
        engine: what computes the substeps. "auto": the fused engine (C++, CUDA C++; in float32 or float64) where it
            knows the parts, else the torch reference, on CUDA in graphs; ``print`` of the cloth tells which and why.
            "fused": an error where it cannot. "reference": always torch, on CUDA launched one by one. The attribute of
            the same name may be set at any time.

    Raises:
        InvalidInput: a part that does not fit.
    """

    _corners: Tensor
    _gradient: Tensor
    _area: Tensor
    _vertex_area: Tensor
    _points: Tensor
    _vertices: Tensor
    _non_adjacent: Tensor | None

    def __init__(
        self,
        mesh: Mesh,
        material: AbstractMaterial,
        areal_density: float | Tensor,
        effects: Mapping[str, AbstractEffect] | None = None,
        boundaries: Mapping[str, AbstractBoundary] | None = None,
        contact: Contact | None = Contact(),  # noqa: B008 - frozen, carries no state
        engine: Setting = "auto",
    ) -> None:
        super().__init__()
        effects, boundaries = {} if effects is None else effects, {} if boundaries is None else boundaries
        check_parts(mesh, material, effects, boundaries, contact)
        self.engine = engine
        self.mesh, self.material = mesh, material
        for path, part in material.named_modules():
            if isinstance(part, PhysicalParameter):
                check_field(path, part.raw, len(mesh.faces))
        self.areal_density = PhysicalParameter(areal_density, "kg/m^2", name="areal_density")
        check_field("areal_density", self.areal_density.raw, len(mesh.faces))
        check_fields(effects, len(mesh.faces))
        check_axes(mesh, {"material": material, **{f"effects.{name}": effect for name, effect in effects.items()}})
        check_not_bound_elsewhere(mesh, [*effects.items(), *boundaries.items()])
        self.effects, self.boundaries = BoundModuleDict("effects", mesh), BoundModuleDict("boundaries", mesh)
        self.effects.update(effects)
        self.boundaries.update(boundaries)
        check_grasps(dict(self._parts()), self.boundaries)
        self._contact, self._grid = contact, None if contact is None else contact.build_grid(mesh)
        of_contact = () if self._grid is None else self._grid.contact_warnings(mesh)
        for doubt in (*mesh_warnings(mesh, self.areal_density.value), *of_contact):
            warnings.warn(doubt, stacklevel=2)
        self._store_geometry()
        for own in (*self.parameters(), *self.buffers()):  # tensors keep their precision until a cloth has one
            if own.is_floating_point():
                own.data = own.data.to(self._area.dtype)

    def _store_geometry(self) -> None:
        gradient, area = self.mesh.shape_gradient, self.mesh.area
        dtype = torch.get_default_dtype()
        arrays = {
            "_corners": torch.as_tensor(self.mesh.faces.T.ravel().copy()),
            "_gradient": torch.as_tensor(gradient, dtype=dtype),
            "_area": torch.as_tensor(area, dtype=dtype).unsqueeze(-1),
            "_vertex_area": torch.as_tensor(self.mesh.vertex_area, dtype=dtype).unsqueeze(-1),
            "_vertices": torch.tensor(self.mesh.vertices, dtype=dtype),
            "_points": torch.zeros(0, 3, dtype=dtype) if self._grid is None else self._grid.points,
            "_non_adjacent": None if self._grid is None else self._grid.non_adjacent,
        }
        for name, tensor in arrays.items():
            self.register_buffer(name, tensor, persistent=False)

    @property
    def contact(self) -> Contact | None:
        """Between layers; None: they pass through each other. A cloth keeps what it was made with."""
        return self._contact

    @property
    def engine(self) -> Setting:
        """What computes the substeps: "auto", "reference" or "fused"."""
        return self._engine

    @engine.setter
    def engine(self, setting: Setting) -> None:
        self._engine: Setting = check_setting(setting)

    @property
    def engine_in_use(self) -> str:
        """What computes the substeps: "fused", "fused, with effects.NAME in torch", or "reference (and why)".

        A device is tried at the first call, after which this may say that the reference serves.
        """
        with torch.no_grad(), disable_autocast():
            model, _ = self._stepping()
            return str(self._choice(model, template_state(model, self._vertices)))

    # -- states ---------------------------------------------------------------------------------------------------

    @disable_autocast()
    def rest_state(self) -> ClothState:
        """The mesh as it was given, at rest."""
        return self.state(self._vertices.clone())  # what a caller does to it is not done to the cloth

    @disable_autocast()
    def state(self, x: Tensor, v: Tensor | None = None) -> ClothState:
        """A state from vertex positions [..., V, 3] m and velocities (None: at rest), directors along the normals."""
        check_precision(self._area.dtype)
        x = as_positions("x", x, self._area)
        v = torch.zeros_like(x) if v is None else as_positions("v", v, x)
        return initial_state(self.build_model(), x, v)

    # -- simulation -----------------------------------------------------------------------------------------------

    @disable_autocast()
    def forward(
        self,
        state: ClothState,
        motion: Mapping[str, Trajectory] | None = None,
        times: Tensor | Sequence[float] = (0.0, 1.0),
        *,
        dt: float | None = None,
        checkpoint: bool = True,
    ) -> Rollout:
        """Simulate from ``state`` at ``times[0]`` to the last time.

        Args:
            state: initial state, with or without leading batch dimensions.
            motion: a trajectory for every driven boundary, by the boundary's name; poses may be batched.
            times: [T] s, frame times, increasing; substeps are laid between them so that frames are met exactly.
            dt: largest substep [s]; None chooses the stable one.
            checkpoint: store only frames and recompute substeps in the backward pass.

        Raises:
            InvalidInput: motion that does not fit the boundaries or the times.
            UnstableStep: ``dt`` beyond the stability limit, or a limit so low that the simulation would never end.
            SimulationDiverged: the state lost finiteness.
        """
        return run_schedule(self.schedule(state, motion or {}, times, dt), checkpoint)

    @disable_autocast()
    def settle(
        self,
        state: ClothState,
        motion: Mapping[str, Trajectory] | None = None,
        *,
        start: float = 0.0,
        duration: float = 0.3,
        rate: float = 30.0,
    ) -> ClothState:
        """Let the cloth come to rest with every driven body held where it is at ``start`` [s].

        Measured initial positions carry noise, which would ring through an undamped simulation: this damps it. Cloth
        that has far to go is slowed down and stopped on its way, with a warning: simulate it instead, or settle it for
        seconds at a smaller rate.

        Args:
            state: measured or guessed state.
            motion: as for ``forward``.
            start: time at which the bodies stand.
            duration: simulated time [s].
            rate: of the mass damping that is added meanwhile [1/s].
        """
        settled = run_schedule(self.schedule_settling(state, motion or {}, start, duration, rate), checkpoint=True).state
        return require_at_rest(settled, duration, level=3)

    def sensitivities(
        self,
        state: ClothState,
        motion: Mapping[str, Trajectory] | None = None,
        times: Tensor | Sequence[float] = (0.0, 1.0),
        *,
        along: Directions,
        dt: float | None = None,
        settle: float = 0.0,
    ) -> tuple[Rollout, Rollout]:
        """Simulate, and differentiate in K directions at once, by forward mode: exact, for the price of a few runs.

        Memory does not grow with the number of substeps. Neither result is part of an autograd graph.

        Args:
            state: as for ``forward``, like motion, times and dt.
            motion: likewise.
            times: likewise.
            dt: likewise.
            along: the directions.
            settle: first let the cloth come to rest for so long [s], as ``settle`` does; 0: not.

        Returns:
            The rollout, and its derivatives, which have K in front of every shape but that of ``t``.

        Raises:
            InvalidInput: directions that do not fit, and as ``forward``.
        """
        return compute_sensitivities(self, state, motion or {}, times, along, dt, settle)

    def clip_(self) -> None:
        """Take amplitudes that an optimiser's step has made negative back to zero; call it after every step."""
        for part in self.modules():
            if isinstance(part, PhysicalParameter):
                part.clip_()

    @disable_autocast()
    def stable_step(self) -> float:
        """The substep [s] that is used by default, from the stiffest element and the present parameters."""
        return self._stepping()[1]

    def build_model(self) -> Model:
        """The parts with their parameters resolved to tensors, as ``functional`` takes them."""
        geometry = Geometry.from_shape_gradients(self._corners, self._gradient, self._area)
        mass = vertex_mass(geometry, self.areal_density.value, self._vertex_area)
        effects = {name: (effect, effect.coefficients()) for name, effect in self._parts()}
        for effect, c in effects.values():
            extra = effect.mass(c)
            mass = mass if extra is None else mass + extra
        return Model(
            geometry=geometry,
            mass=mass,
            areal_density=self.areal_density.field,
            material=self.material,
            coefficients=self.material.coefficients(),
            effects=effects,
            boundaries=dict(self.boundaries.items()),  # type: ignore[arg-type]
            grid=self.contact_grid(),
            inverse_rest_deformation=inverse_rest_deformation(effect.rest_deformation(c) for effect, c in effects.values()),
        )

    @disable_autocast()
    def energy(self, state: ClothState) -> dict[str, Tensor]:
        """Energies by name, each [...] J."""
        model = self.build_model()
        check_state(state, template_state(model, self._vertices), finite=False)
        return substep.energy(model, state)

    def schedule(
        self, state: ClothState, motion: Mapping[str, Trajectory], times: Tensor | Sequence[float], dt: float | None
    ) -> RolloutSchedule:
        """What ``forward`` does, checked."""
        frames = check_times(times)
        motion = check_motions(motion, self.boundaries, frames, self._area)
        model, limit = self._stepping(dt)
        check_substeps(frames[-1] - frames[0], limit, dt)
        counts = [max(1, int(np.ceil((end - start) / limit - 1e-9))) for start, end in pairwise(frames)]
        return self._ready(model, state, motion, frames, counts, dt=dt)

    def schedule_settling(
        self, state: ClothState, motion: Mapping[str, Trajectory], start: float, duration: float, rate: float
    ) -> RolloutSchedule:
        """What ``settle`` does, checked."""
        frames = [start, start + duration]
        motion = check_motions(stationary_motion(motion, *frames), self.boundaries, frames, self._area)
        model, step = self._stepping()
        check_rate(rate)
        check_substeps(duration, 1 / (1 / step + rate))
        count = int(np.ceil(duration * (1 / step + rate)))
        return self._ready(model, state, motion, frames, [count], rate)

    # -- parts of the above ---------------------------------------------------------------------------------------

    def _parts(self) -> Iterable[tuple[str, AbstractEffect]]:
        return cast("Iterable[tuple[str, AbstractEffect]]", self.effects.items())

    def contact_grid(self) -> Grid | None:
        """The contact grid; None without contact."""
        return None if self._grid is None else self._grid._replace(points=self._points, non_adjacent=self._non_adjacent)

    def _stepping(self, dt: float | None = None) -> tuple[Model, float]:
        """The parts, with the stages that the step needs, and the step [s]: the stable one, or the user's."""
        check_parameters(self)
        model = self.build_model()
        limits = stability_limits(model, self._gradient)
        step = check_step(dt, limits.cheapest_step)
        return model._replace(stages=limits.stages_for(step)), step

    def _ready(
        self,
        model: Model,
        state: ClothState,
        motion: Mapping[str, Trajectory],
        frames: list[float],
        counts: list[int],
        settling: float | None = None,
        dt: float | None = None,
    ) -> RolloutSchedule:
        check_state(state, template_state(model, self._vertices))
        if settling is not None:
            model = with_mass_damping(model, settling)
        state = expand_state(state, model, motion)
        longest = float("inf") if self._grid is None else self._grid.max_extent
        steps = [(end - start) / count for (start, end), count in zip(pairwise(frames), counts, strict=True)]
        choice, step_for, asked = self._choice(model, state, min(steps, default=None)), None, None
        if MATERIAL_MEMORY_KEY in state.memory:
            frames, counts, asked = subdivide_intervals(frames, counts)
            step_for = self._step_for(model, dt)
        graphs = Graphs(model, sum(counts)) if choice.captured else None
        plan = RolloutSchedule(model, motion, frames, counts, state, choice, longest, step_for, asked, graphs)
        plan.check_extent(state)
        return plan

    def _step_for(self, model: Model, dt: float | None) -> Callable[[ClothState], float]:
        """The longest substep [s] for a state, as what has set shortens it; the user's is held to it."""

        def longest(state: ClothState) -> float:
            limit = stability_limits(model, self._gradient, state.memory[MATERIAL_MEMORY_KEY].detach()).stable_step(model.stages)
            return check_step(dt, limit)

        return longest

    def _choice(self, model: Model, state: ClothState, dt: float | None = None) -> Choice:
        """``dt``: of the substeps [s]; None: there will be none."""
        trial = None
        if dt is not None:
            trial = Trial(partial(random_contact_state, model, self._vertices, TRIED * dt / 2), dt / 2)
        return choose(self.engine, model, state, still_drives(model), trial)

    def extra_repr(self) -> str:
        """Data sheet: size, contact, step."""
        size = f"{len(self.mesh.vertices)} vertices, {len(self.mesh.faces)} triangles, {self.mesh.area.sum():.4g} m^2"
        if (pieces := self.mesh.piece_count) > 1:
            size += f", {pieces} pieces that nothing joins"
        grid = "none" if self._grid is None else self._grid.summary
        try:
            step, engine = f"{self.stable_step():.3g} s", self.engine_in_use
        except TorchclothError as error:  # of a cloth that cannot be simulated, which one prints to see why
            step, engine = str(error), "none"
        return f"{size}\ncontact: {grid}\nstable step: {step}\nengine: {engine}"
