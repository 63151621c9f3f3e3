"""Checks of the arguments that a user gives the layer. They raise with the argument's name and never change physics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from .._utils.vectors import check_is_not_half
from ..boundaries import AbstractBoundary, Grasp
from ..boundaries.motion import check_covers_times
from ..boundaries.motion import check_trajectory as check_motion
from ..dynamics.contact import Contact
from ..dynamics.model import Model, tree_map
from ..effects import AbstractEffect
from ..errors import InvalidInput, SimulationDiverged, UnstableStep
from ..materials import AbstractMaterial
from ..meshes import Mesh
from ..meshes.mesh import MAX_AREAL_DENSITY_KG_PER_M2, MAX_CLOTH_SPAN_M
from ..parameters import PhysicalParameter
from ..types import ClothState, Trajectory

EXPECTED_FRAME_TIMES = "at least two, increasing, finite seconds"
MAX_SUBSTEPS_PER_SIMULATION = 10_000_000  # a minute of the stiffest cloth; poses of more fill the memory
EXPECTED_PART_NAME = "a name without dots or a leading underscore that torch's ModuleDict has not"


def check_parts(
    mesh: Mesh,
    material: AbstractMaterial,
    effects: Mapping[str, AbstractEffect],
    boundaries: Mapping[str, AbstractBoundary],
    contact: Contact | Literal["auto"] | None,
) -> None:
    """Check that each part of a cloth is of its kind.

    Raises:
        InvalidInput: a part of another type, or a name that no part can have.
    """
    _check_kind("mesh", mesh, Mesh, "a Mesh, as torchcloth.meshes makes them")
    _check_kind("material", material, AbstractMaterial, "a material, of torchcloth.materials or derived from one")
    for what, parts in (("effects", effects), ("boundaries", boundaries)):
        _check_kind(what, parts, (Mapping, nn.ModuleDict), f"a dict of names and {what}")
        for name, part in parts.items():
            check_part(what, name, part)
    if contact is not None and contact != "auto":
        _check_kind("contact", contact, Contact, 'Contact(...), "auto" or None')


def is_name(name: object) -> bool:
    """Return whether an effect or boundary can have this name."""
    plain = isinstance(name, str) and bool(name) and "." not in name and not name.startswith("_")
    return plain and not hasattr(nn.ModuleDict(), str(name))


def check_part(what: str, name: object, part: object) -> None:
    """Check the name and type of one part; ``what`` is "effects" or "boundaries"."""
    if not is_name(name):
        raise InvalidInput("name of an effect or boundary", got=repr(name), expected=EXPECTED_PART_NAME)
    kind = {"effects": AbstractEffect, "boundaries": AbstractBoundary}[what]
    _check_kind(f"{what}: {name}", part, kind, f"an {kind.__name__}, as those of torchcloth.{what}")


def _check_kind(what: str, value: object, kind: type | tuple[type, ...], expected: str) -> None:
    if not isinstance(value, kind):
        got = f"the class {value.__name__}, not one of it" if isinstance(value, type) else type(value).__name__
        raise InvalidInput(what, got=got, expected=expected)


def check_field(name: str, raw: Tensor, triangles: int | None) -> None:
    """Check the shape of a parameter: a scalar, a batch [B, 1], or one value per triangle where that is allowed.

    Args:
        name: for messages.
        raw: the stored tensor.
        triangles: number of triangles; None: no field is allowed.
    """
    if raw.ndim and raw.shape[-1] not in (1, triangles):
        expected = (
            "a scalar or [B, 1]" if triangles is None else f"a scalar, [{triangles}] (one per triangle) or [B, 1]"
        )
        raise InvalidInput(name, got=f"shape {tuple(raw.shape)}", expected=expected)


def mesh_warnings(mesh: Mesh, density: Tensor) -> Iterator[str]:
    """Yield warnings about numbers that look like another unit, and about vertices that lie on each other."""
    span, heaviest = float(np.ptp(mesh.vertices, axis=0).max()), float(density.detach().max())
    if span > MAX_CLOTH_SPAN_M:
        yield f"the mesh spans {span:.4g} m: is it in millimetres? Lengths are in metres"
    if heaviest > MAX_AREAL_DENSITY_KG_PER_M2:
        yield f"areal_density is {heaviest:.4g} kg/m^2: is it in g/m^2? Fabrics weigh 0.02 to 1 kg/m^2"
    if torn := mesh.duplicated_vertex_count:
        yield (
            f"{torn} vertices of the mesh lie on others of another piece, so it falls apart there: if it is one cloth, "
            "weld them, and give pattern coordinates to the triangles' corners"
        )


def check_axes(mesh: Mesh, parts: Mapping[str, AbstractMaterial | AbstractEffect]) -> None:
    """Check that the mesh has a pattern if a part distinguishes warp and weft; else each triangle has its own axes."""
    name = next((name for name, part in parts.items() if part.has_axes), None)
    if mesh.pattern is None and name is not None:
        raise InvalidInput(
            "mesh",
            got="no pattern coordinates",
            expected=f"uv, so that warp and weft have directions for {name!r}",
            remedy="Mesh.build(vertices, faces, uv), or texture coordinates in the file",
        )


def check_fields(effects: Mapping[str, AbstractEffect], triangles: int) -> None:
    """Check the shapes of the effects' parameters, for effects that declare which may be fields."""
    for name, effect in effects.items():
        for path, part in effect.named_modules():
            if isinstance(part, PhysicalParameter) and effect.per_triangle is not None:
                check_field(f"effects.{name}.{path}", part.raw, triangles if path in effect.per_triangle else None)


def check_numbers(what: str, values: object, finite: bool = True) -> None:
    """Check that ``values`` is a tensor of real numbers, and by default of finite ones."""
    if not isinstance(values, Tensor) or not values.is_floating_point():
        got = values.dtype if isinstance(values, Tensor) else type(values).__name__
        raise InvalidInput(what, got=str(got).removeprefix("torch."), expected="a tensor of real numbers")
    if finite and not bool(torch.isfinite(values.detach()).all()):
        raise InvalidInput(what, got="NaN or infinite entries", expected="finite numbers")


def check_duration(seconds: float) -> None:
    """Check that the duration of settling is positive."""
    if not 0 < seconds < float("inf"):
        raise InvalidInput("duration of settling", got=f"{seconds:g} s", expected="a time > 0")


def check_rate(rate: float) -> None:
    """Check that the damping rate of settling is not negative."""
    if not 0 <= rate < float("inf"):
        raise InvalidInput("rate of settling", got=f"{rate:g} 1/s", expected="a finite rate >= 0")


def check_times(times: Tensor | Sequence[float]) -> list[float]:
    """Return frame times as a list of increasing seconds.

    Raises:
        InvalidInput: fewer than two, not increasing, not finite, or a tensor that requires gradients.
    """
    if isinstance(times, Tensor) and times.requires_grad and torch.is_grad_enabled():
        remedy = "times.detach(); gradients by when a motion happens are those by its Trajectory.t"
        raise InvalidInput("times", got="a tensor that wants gradients", expected="frame times, fixed", remedy=remedy)
    check_is_not_half("times", times)
    try:
        flat = torch.as_tensor(times, dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidInput("times", got=f"{times!r:.40}", expected=EXPECTED_FRAME_TIMES) from error
    frames = flat.tolist() if flat.ndim == 1 else []
    if len(frames) < 2 or not np.all(np.isfinite(frames)) or not np.all(np.diff(frames) > 0):
        got = f"shape {tuple(flat.shape)}, first {frames[:3]}"
        raise InvalidInput("times", got=got, expected=EXPECTED_FRAME_TIMES)
    return frames


def check_parameters(cloth: nn.Module) -> None:
    """Check what an optimiser step, or a part that was added later, may have broken.

    NaN is refused: comparisons with NaN are false, so a threshold of NaN would act as an absent effect. Negative
    amplitudes are refused: they would drive what they should brake.
    """
    effects: dict[str, AbstractEffect] = dict(cloth.effects.items())  # type: ignore[arg-type, operator, union-attr]
    check_fields(effects, len(cloth.mesh.faces))  # type: ignore[arg-type, union-attr]
    check_axes(cloth.mesh, {"material": cloth.material, **effects})  # type: ignore[arg-type, dict-item]
    check_grasps(effects, cloth.boundaries)  # type: ignore[arg-type]
    for name, parameter in cloth.named_parameters():
        check_is_not_half(name, parameter)
        if bool(parameter.isnan().any()):
            raise InvalidInput(name, got="NaN", expected="a number", remedy="look at the optimiser's last step")
    for name, part in cloth.named_modules():
        if isinstance(part, PhysicalParameter):
            if name.startswith("material.") or name == "areal_density":  # a user may have replaced them
                check_field(name, part.raw, len(cloth.mesh.faces))  # type: ignore[arg-type]
            clips = part.domain == "nonnegative"
            part.check_in_domain(name, "call the cloth's clip_() after every step of an optimiser" if clips else "")


def check_step(dt: float | None, limit: float) -> float:
    """Return the substep to use [s]: the limit, or the user's ``dt`` if it is no larger.

    Raises:
        InvalidInput: ``dt`` is not a positive number.
        UnstableStep: ``dt`` is beyond the limit.
    """
    if dt is None:
        return limit
    if isinstance(dt, np.number | np.ndarray | Tensor) and dt.ndim == 0:
        dt = float(dt)
    if not isinstance(dt, int | float) or not dt > 0:
        raise InvalidInput("dt", got=repr(dt), expected="a step > 0 in seconds, or none: the stable one")
    if dt > limit * (1 + 1e-9):
        raise UnstableStep(
            "dt",
            got=f"{dt:.4g} s",
            expected=f"at most {limit:.4g} s for these parameters and this mesh",
            remedy="lower dt, or leave it out",
        )
    return float(dt)


def check_substeps(seconds: float, step: float, dt: float | None = None) -> None:
    """Check that a simulation has at most MAX_SUBSTEPS_PER_SIMULATION substeps.

    Args:
        seconds: simulated time [s].
        step: substep [s].
        dt: what the user asked for [s]; None: ``step`` is the stable one.
    """
    count = seconds / step if step > 0 else float("inf")  # a step that overflowed is NaN
    if count <= MAX_SUBSTEPS_PER_SIMULATION:
        return
    got, expected = f"{step:.3g} s, that is {count:.2g} substeps", f"at most {MAX_SUBSTEPS_PER_SIMULATION:g}"
    if dt is not None:
        raise InvalidInput("dt", got=got, expected=expected, remedy="raise dt, or leave it out")
    remedy = f"check the units of stiffnesses, densities and mesh, or simulate less than {seconds:.3g} s at once"
    raise UnstableStep("the stable substep", got=got, expected=expected, remedy=remedy)


def check_grasps(effects: Mapping[str, AbstractEffect], boundaries: nn.ModuleDict) -> None:
    """Check that the grasp of every effect on a grip is among the boundaries."""
    grasps = [name for name, boundary in boundaries.items() if isinstance(boundary, Grasp)]
    for name, effect in effects.items():
        if effect.grasp is not None and effect.grasp not in grasps:
            raise InvalidInput(
                f"grasp of effect {name!r}",
                got=repr(effect.grasp),
                expected=f"a Grasp among the boundaries {grasps}",
            )


def check_mapping(motion: object) -> None:
    """Check that ``motion`` is a mapping from boundary to trajectory."""
    if not isinstance(motion, Mapping):
        raise InvalidInput("motion", got=type(motion).__name__, expected="a dict of trajectories by boundary")


def check_motions(
    motion: Mapping[str, Trajectory], boundaries: nn.ModuleDict, frames: list[float], like: Tensor
) -> dict[str, Trajectory]:
    """Check that every driven boundary has a valid trajectory; return them in the precision and device of ``like``."""
    driven = {name for name, boundary in boundaries.items() if boundary.is_prescribed}
    check_mapping(motion)
    if set(motion) != driven:
        raise InvalidInput(
            "motion", got=f"trajectories for {sorted(motion, key=str)}", expected=f"one for each of {sorted(driven)}"
        )
    for name, trajectory in motion.items():
        check_motion(trajectory, name)
        check_covers_times(trajectory, name, frames[0], frames[-1])
    return {name: Trajectory(m.t, m.pose.to(like), m.closed) for name, m in motion.items()}


def as_positions(name: str, given: object, like: Tensor) -> Tensor:
    """Return positions or velocities [..., V, 3] as a tensor of the type and device of ``like``."""
    check_is_not_half(name, given)
    try:
        return torch.as_tensor(given, dtype=like.dtype, device=like.device)  # type: ignore[arg-type]
    except (TypeError, ValueError, RuntimeError) as error:
        got, expected = f"{given!r:.40}", "a tensor or an array [..., V, 3], SI units"
        raise InvalidInput(name, got=got, expected=expected) from error


def check_positions(x: Tensor, v: Tensor, vertices: int) -> None:
    """Check that positions and velocities [..., V, 3] are finite, and are of ``vertices`` vertices."""
    if x.shape[-2:] != (vertices, 3) or not x.numel():
        raise InvalidInput("x", got=f"shape {tuple(x.shape)}", expected=f"[..., {vertices}, 3] in metres")
    if v.shape != x.shape:
        raise InvalidInput("v", got=f"shape {tuple(v.shape)}", expected=f"x's, {tuple(x.shape)}")
    for name, field, kind in (("x", x, "positions in metres"), ("v", v, "velocities in m/s")):
        if not bool(torch.isfinite(field.detach()).all()):
            raise InvalidInput(name, got="NaN or infinite entries", expected=f"finite {kind}")


def check_state(state: ClothState, like: ClothState, finite: bool = True) -> None:
    """Check that a state has the names, shapes and types of ``like``, and by default that it is finite.

    Raises:
        InvalidInput: a state of another cloth, or numbers that are not finite.
    """
    remedy = "make states with this cloth's rest_state() or state()"
    if not isinstance(state, ClothState):
        raise InvalidInput("state", got=type(state).__name__, expected="a ClothState", remedy=remedy)
    for name, field in _state_tensors(state).items():
        check_numbers(f"state.{name}", field, finite)
        if field.dtype != like.x.dtype or field.device != like.x.device:
            got, expected = (f"{t.dtype} on {t.device}".removeprefix("torch.") for t in (field, like.x))
            raise InvalidInput(f"state.{name}", got=got, expected=f"{expected}, as the cloth's", remedy=remedy)
    got, expected = ({name: tuple(t.shape[-2:]) for name, t in _state_tensors(s).items()} for s in (state, like))
    if got != expected:
        raise InvalidInput("state", got=f"{got}", expected=f"{expected}", remedy=remedy)


def _state_tensors(state: ClothState) -> dict[str, Tensor]:
    return {"x": state.x, "v": state.v, "d3": state.d3, **state.memory}


def expand_state(state: ClothState, model: Model, motion: Mapping[str, Trajectory]) -> ClothState:
    """Expand the state to the batch dimensions of parameters and motion, so that one state serves a whole batch.

    Raises:
        InvalidInput: batch dimensions that do not broadcast, or an empty batch.
    """
    tensors: list[Tensor] = []
    coefficients = (model.coefficients, model.areal_density, model.mass, *(c for _, c in model.effects.values()))
    tree_map(coefficients, lambda t: tensors.append(t) or t)
    batches = {
        **{f"state.{name}": field.shape[:-2] for name, field in _state_tensors(state).items()},
        **{f"motion[{name!r}].pose": trajectory.pose.shape[:-3] for name, trajectory in motion.items()},
    }
    parameters = [t.shape[:-2] for t in tensors if t.ndim > 2]
    of_boundaries = (p for b in model.boundaries.values() for p in b.modules() if isinstance(p, PhysicalParameter))
    parameters += [p.raw.shape[:-1] for p in of_boundaries if p.raw.ndim]
    try:
        batch = torch.broadcast_shapes(*batches.values(), *parameters)
    except RuntimeError:
        batch = None
    if batch is None or batch.numel() == 0:
        nonempty = {name: tuple(shape) for name, shape in batches.items() if shape}
        got = f"{nonempty}, parameters {sorted({tuple(shape) for shape in parameters})}"
        raise InvalidInput("batch dimensions", got=got, expected="shapes that broadcast, to at least one scene")
    return state.map(lambda field: field.expand(*batch, *field.shape[-2:]))


def check_extent(x: Tensor, limit: float) -> None:
    """Check that the cloth fits into the contact grid, where a wider one would touch its own images.

    Raises:
        SimulationDiverged: an extent [m] beyond ``limit``.
    """
    x = x.detach()
    extent = float((x.amax(-2) - x.amin(-2)).max())
    if extent > limit:
        raise SimulationDiverged(
            "the cloth's extent",
            got=f"{extent:.3g} m",
            expected=f"below {limit:.3g} m",
            remedy="the sheet is stretched far beyond its rest shape, or pieces that are not joined have parted: check "
            "initial positions and motion; simulate such pieces apart",
        )
