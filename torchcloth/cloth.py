"""The layer: a cloth as an ``nn.Module``."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Literal, Self, cast

import numpy as np
import torch
from torch import Tensor, nn

from ._utils.torch_modes import disable_autocast
from .boundaries import AbstractBoundary, PrescribedMotion
from .dynamics import substep
from .dynamics.contact import Contact, Grid
from .dynamics.elasticity import MATERIAL_MEMORY_KEY, inverse_rest_deformation
from .dynamics.kinematics import Geometry, vertex_mass
from .dynamics.model import Model
from .dynamics.stability import check_precision, stability_limits
from .effects import AbstractEffect
from .engine.cuda_graphs import GraphedRollout
from .engine.dispatch import (
    SELF_TEST_SUBSTEPS,
    EngineChoice,
    SelfTest,
    Setting,
    check_setting,
    choose_engine,
    stationary_prescribed,
)
from .errors import TorchclothError
from .materials import AbstractMaterial
from .meshes import Mesh
from .parameters import PhysicalParameter, require_default_gradients
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
    expand_state,
    mesh_warnings,
)
from .simulation.bound_modules import BoundModuleDict, check_not_bound_elsewhere
from .simulation.initial_state import (
    initial_state,
    random_contact_state,
    require_at_rest,
    stationary_motion,
    template_state,
    with_mass_damping,
)
from .simulation.rollout import RolloutSchedule, run_schedule, subdivide_intervals
from .simulation.sensitivities import Directions, compute_sensitivities
from .types import ClothState, Rollout, Trajectory


class Cloth(nn.Module):
    """A sheet of cloth that is simulated, and differentiated, by calling it.

    Args:
        mesh: the triangles and their rest shape.
        material: the constitutive law.
        areal_density: rho_A [kg/m^2]; scalar or one value per triangle; learnable.
        effects: by name, e.g. ``{"gravity": Gravity(), "air": AirDrag()}``. None: no effects, not even weight.
        boundaries: grasps and colliders by name, applied in order.
        contact: discretisation of contact between layers. "auto": ``Contact()`` if at least a fifth of all pairs of
            triangles can meet, else none, as on a coarse mesh; ``print(cloth)`` says which.
            None: no contact. The parameters k, gamma and c_F of the material then have no effect and require no
            gradients.
        engine: what computes the substeps. "auto": the fused engine (C++, CUDA C++; float32 or float64) if it knows
            all parts, else the torch reference, on CUDA in graphs; ``print(cloth)`` says which and why. "fused": raise
            an error if the engine cannot. "reference": always torch, on CUDA launched one by one. The attribute of the
            same name may be set at any time.

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
    _warp_sign: Tensor | None

    def __init__(
        self,
        mesh: Mesh,
        material: AbstractMaterial,
        areal_density: float | Tensor,
        effects: Mapping[str, AbstractEffect] | None = None,
        boundaries: Mapping[str, AbstractBoundary] | None = None,
        contact: Contact | Literal["auto"] | None = "auto",
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
        check_grasps(dict(self._named_effects()), self.boundaries)
        self._contact, self._grid, self._no_contact_reason = _resolve_contact(contact, mesh)
        for text in (*mesh_warnings(mesh, self.areal_density.value), *self._contact_warnings()):
            warnings.warn(text, stacklevel=2)
        self._freeze_inert_parameters()
        self._store_geometry()
        for tensor in (*self.parameters(), *self.buffers()):  # parts take the precision of the cloth
            if tensor.is_floating_point():
                tensor.data = tensor.data.to(self._area.dtype)

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
            "_warp_sign": _warp_sign(self.mesh.is_pattern_from_behind, dtype),
        }
        for name, tensor in arrays.items():
            self.register_buffer(name, tensor, persistent=False)

    @property
    def contact(self) -> Contact | None:
        """Discretisation of the contact between layers, fixed at construction; None: layers pass through each other."""
        return self._contact

    @property
    def engine(self) -> Setting:
        """Engine setting: "auto", "reference" or "fused"."""
        return self._engine

    @engine.setter
    def engine(self, setting: Setting) -> None:
        self._engine: Setting = check_setting(setting)

    @property
    def engine_in_use(self) -> str:
        """Engine that computes the substeps: "fused", "fused, with effects.NAME in torch", or "reference (reason)".

        A device is tested at the first call; after a failed test this says that the reference is used.
        """
        with torch.no_grad(), disable_autocast():
            model, _ = self._model_and_step()
            return str(self._choose_engine(model, template_state(model, self._vertices)))

    # -- states ---------------------------------------------------------------------------------------------------

    @disable_autocast()
    def rest_state(self) -> ClothState:
        """Return the state of the mesh as it was given, at rest."""
        return self.state(self._vertices.clone())  # a caller may write to the state

    @disable_autocast()
    def state(self, x: Tensor, v: Tensor | None = None) -> ClothState:
        """Build a state with directors along the normals and no memory.

        Args:
            x: [..., V, 3] m, vertex positions.
            v: [..., V, 3] m/s, vertex velocities; None: at rest.

        Raises:
            InvalidInput: shapes that do not fit, or numbers that are not finite.
        """
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
        """Simulate from ``state`` at ``times[0]`` to the last of ``times``.

        Args:
            state: initial state, with or without leading batch dimensions.
            motion: a trajectory for every driven boundary, by the boundary's name; poses may be batched.
            times: [T] s, frame times, increasing. Substeps divide the intervals between them, so frames are exact.
            dt: largest substep [s]; None: ``stable_step()``.
            checkpoint: store only frames, and recompute substeps in the backward pass.

        Returns:
            Positions, velocities and wrenches at the frames, and the last state.

        Raises:
            InvalidInput: motion that does not fit the boundaries or the times.
            UnstableStep: ``dt`` beyond the stability limit, or a limit so low that the simulation would never end.
            SimulationDiverged: the state is no longer finite.
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
        """Let the cloth come to rest while every driven body stands where it is at ``start`` [s].

        Measured initial positions carry noise, which would ring through an undamped simulation. Cloth that has far to
        move is stopped on its way, with a warning: simulate it instead, or settle it for seconds at a smaller rate.

        Args:
            state: measured or guessed state.
            motion: as for ``forward``.
            start: time at which the bodies stand.
            duration: simulated time [s].
            rate: rate of the mass damping that is added meanwhile [1/s].

        Returns:
            The settled state, with all velocities zero.
        """
        schedule = self.schedule_settling(state, motion or {}, start, duration, rate)
        return require_at_rest(run_schedule(schedule, checkpoint=True).state, duration, level=3)

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
        """Simulate, and differentiate along K directions at once by forward mode: exact, at the cost of a few runs.

        Memory does not grow with the number of substeps. Neither result is part of an autograd graph.

        Args:
            state: as for ``forward``.
            motion: as for ``forward``.
            times: as for ``forward``.
            dt: as for ``forward``.
            along: the directions.
            settle: time [s] for which the cloth first comes to rest, as ``settle`` does; 0: it does not.

        Returns:
            The rollout; and its derivatives, whose tensors have K in front of every shape but that of ``t``.

        Raises:
            InvalidInput: directions that do not fit, and as ``forward``.
        """
        return compute_sensitivities(self, state, motion or {}, times, along, dt, settle)

    def clip_(self) -> None:
        """Set negative values of nonnegative parameters to zero; call this after every step of an optimiser."""
        for part in self.modules():
            if isinstance(part, PhysicalParameter):
                part.clip_()

    def require_default_gradients_(self) -> Self:
        """Let every parameter require gradients but facts about the world (gravity, wind, sizes) and what cannot act.

        So it is in a new cloth. A fact is learned after ``requires_grad_()`` on its parameter.
        """
        require_default_gradients(self)
        self._freeze_inert_parameters()
        return self

    @disable_autocast()
    def stable_step(self) -> float:
        """Compute the default substep [s] from the stiffest element and the present parameters.

        Motions may take longer ones: what grippers hold all the time does not vibrate.
        """
        return self._model_and_step()[1]

    def build_model(self) -> Model:
        """Build the model that ``dynamics.substep`` advances: the parts, with their parameters resolved to tensors."""
        geometry = Geometry.from_shape_gradients(self._corners, self._gradient, self._area)
        mass = vertex_mass(geometry, self.areal_density.value, self._vertex_area)
        effects = {name: (effect, effect.coefficients()) for name, effect in self._named_effects()}
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
            inverse_rest_deformation=inverse_rest_deformation(
                (effect.rest_deformation(c) for effect, c in effects.values()), self._warp_sign
            ),
        )

    @disable_autocast()
    def energy(self, state: ClothState) -> dict[str, Tensor]:
        """Compute the energies by name, each [...] J: kinetic, membrane, and director where there is contact."""
        model = self.build_model()
        check_state(state, template_state(model, self._vertices), finite=False)
        return substep.energy(model, state)

    def schedule(
        self, state: ClothState, motion: Mapping[str, Trajectory], times: Tensor | Sequence[float], dt: float | None
    ) -> RolloutSchedule:
        """Check the arguments of ``forward``, and return the schedule that it runs."""
        frames = check_times(times)
        motion = check_motions(motion, self.boundaries, frames, self._area)
        model, limit = self._model_and_step(dt, self._find_gripped_corners(motion))
        check_substeps(frames[-1] - frames[0], limit, dt)
        counts = [max(1, int(np.ceil((end - start) / limit - 1e-9))) for start, end in pairwise(frames)]
        return self._build_schedule(model, state, motion, frames, counts, dt=dt)

    def schedule_settling(
        self, state: ClothState, motion: Mapping[str, Trajectory], start: float, duration: float, rate: float
    ) -> RolloutSchedule:
        """Check the arguments of ``settle``, and return the schedule that it runs."""
        frames = [start, start + duration]
        motion = check_motions(stationary_motion(motion, *frames), self.boundaries, frames, self._area)
        model, step = self._model_and_step(is_gripped=self._find_gripped_corners(motion))
        check_rate(rate)
        check_substeps(duration, 1 / (1 / step + rate))
        count = int(np.ceil(duration * (1 / step + rate)))
        return self._build_schedule(model, state, motion, frames, [count], rate)

    def contact_grid(self) -> Grid | None:
        """Return the contact grid on the cloth's device, or None without contact."""
        return None if self._grid is None else self._grid._replace(points=self._points, non_adjacent=self._non_adjacent)

    # -- parts of the above ---------------------------------------------------------------------------------------

    def _contact_warnings(self) -> Iterable[str]:
        if self._grid is None:
            return ()
        stiffness = self.material.stiffness(self.material.coefficients()).normal.detach()
        return self._grid.contact_warnings(self.mesh, stiffness, self.areal_density.value.detach())

    def _freeze_inert_parameters(self) -> None:
        """Let parameters of contact require no gradients without it, as DistributedDataParallel waits for gradients."""
        if self._contact is None:
            for name in self.material.contact_parameters:
                getattr(self.material, name).requires_grad_(False)

    def _named_effects(self) -> Iterable[tuple[str, AbstractEffect]]:
        return cast("Iterable[tuple[str, AbstractEffect]]", self.effects.items())

    def _model_and_step(self, dt: float | None = None, is_gripped: Tensor | None = None) -> tuple[Model, float]:
        """Return the model with the stages that the step needs, and the step [s]: the stable one, or the user's.

        Corners of triangles that are gripped, [E, 3], shorten no step; None: none is.
        """
        check_parameters(self)
        model = self.build_model()
        limits = stability_limits(model, self._gradient, is_gripped=is_gripped)
        step = check_step(dt, limits.cheapest_step)
        return model._replace(stages=limits.stages_for(step)), step

    def _find_gripped_corners(self, motion: Mapping[str, Trajectory]) -> Tensor:
        """Return which corners of the triangles, [E, 3], are gripped during the whole motion."""
        is_gripped = torch.zeros(len(self.mesh.vertices), dtype=torch.bool, device=self._corners.device)
        for name, boundary in self.boundaries.items():
            if name in motion and bool(motion[name].closed.all()):
                closed = PrescribedMotion(motion[name].pose, motion[name].pose, (True,))
                index = cast("AbstractBoundary", boundary).prescribed_vertices(closed, 0)
                if index is not None:
                    is_gripped[index] = True
        return is_gripped[self._corners].view(3, -1).T

    def _build_schedule(
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
        max_extent = float("inf") if self._grid is None else self._grid.max_extent
        steps = [(end - start) / count for (start, end), count in zip(pairwise(frames), counts, strict=True)]
        choice, step_for, requested_frames = self._choose_engine(model, state, min(steps, default=None)), None, None
        if MATERIAL_MEMORY_KEY in state.memory:
            frames, counts, requested_frames = subdivide_intervals(frames, counts)
            step_for = self._step_for(model, motion, dt)
        graphs = GraphedRollout(model, sum(counts)) if choice.uses_cuda_graphs else None
        schedule = RolloutSchedule(
            model, motion, frames, counts, state, choice, max_extent, step_for, requested_frames, graphs
        )
        schedule.check_extent(state)
        return schedule

    def _step_for(
        self, model: Model, motion: Mapping[str, Trajectory], dt: float | None
    ) -> Callable[[ClothState], float]:
        """Return a function that gives the longest substep [s] for a state, which plastic set shortens."""

        is_gripped = self._find_gripped_corners(motion)

        def longest_step(state: ClothState) -> float:
            plastic = state.memory[MATERIAL_MEMORY_KEY].detach()
            limits = stability_limits(model, self._gradient, plastic, is_gripped)
            return check_step(dt, limits.stable_step(model.stages))

        return longest_step

    def _choose_engine(self, model: Model, state: ClothState, dt: float | None = None) -> EngineChoice:
        """Choose the engine; ``dt`` is the substep [s], or None if no substep will be run."""
        self_test = None
        if dt is not None:
            self_test = SelfTest(
                partial(random_contact_state, model, self._vertices, SELF_TEST_SUBSTEPS * dt / 2), dt / 2
            )
        return choose_engine(self.engine, model, state, stationary_prescribed(model), self_test)

    def extra_repr(self) -> str:
        """Return the data sheet: size, contact, stable step and engine."""
        size = f"{len(self.mesh.vertices)} vertices, {len(self.mesh.faces)} triangles, {self.mesh.area.sum():.4g} m^2"
        if (pieces := self.mesh.piece_count) > 1:
            size += f", {pieces} pieces that nothing joins"
        grid = f"none{self._no_contact_reason}" if self._grid is None else self._grid.summary
        try:
            step, engine = f"{self.stable_step():.3g} s", self.engine_in_use
        except TorchclothError as error:  # a cloth that cannot be simulated is printed to see why
            step, engine = str(error), "none"
        return f"{size}\ncontact: {grid}\nstable step: {step}\nengine: {engine}"


def _resolve_contact(contact: Contact | Literal["auto"] | None, mesh: Mesh) -> tuple[Contact | None, Grid | None, str]:
    """Return the contact to use, its grid, and why there is none although it was left to us."""
    chosen = Contact() if contact == "auto" else contact
    grid = None if chosen is None else chosen.build_grid(mesh)
    if contact == "auto" and grid is not None and not grid.can_act:
        reason = f", as the mesh is too coarse ({grid.summary}); contact=Contact.with_gap(...) asks for it"
        if len(grid.find_layers(mesh)):
            warnings.warn(f"contact: layers pass through each other{reason}", stacklevel=3)
        return None, None, reason
    return chosen, grid, ""


def _warp_sign(is_from_behind: np.ndarray, dtype: torch.dtype) -> Tensor | None:
    """Return -1 where the material axes mirror the pattern, else 1: [E, 1], or [1, 1] if all do; None if none does."""
    if not is_from_behind.any():
        return None
    sign = torch.as_tensor(np.where(is_from_behind, -1.0, 1.0), dtype=dtype).unsqueeze(-1)
    return sign[:1] if is_from_behind.all() else sign
