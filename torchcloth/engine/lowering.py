"""A model turned into a program of the engine: the page ``dynamics.substep.step`` in the engine's words.

Each part (material, effect, boundary) has a lowering in ``lowerings`` that says which kernels compute it. Only exact
types count, because a subclass may have changed its law. Materials and effects without kernels are left to torch; see
``torch_parts``.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

from ..boundaries import PrescribedMotion
from ..dynamics.elasticity import MATERIAL_MEMORY_KEY
from ..dynamics.model import Model
from ..types import ClothState
from . import devices
from .builder import SubstepBuilder, UnsupportedPart, VelocityStage, lowering_of
from .lowerings import lower_boundaries, lower_material, lower_viscous_stages
from .lowerings.contact import ContactLowering


def lower(
    model: Model, state: ClothState, prescribed: Mapping[str, PrescribedMotion], in_torch: Collection[str] = ()
) -> SubstepBuilder:
    """Return the finished program of a substep, without the parts ``in_torch``.

    Args:
        model: the parts.
        state: of the simulation; only shapes, precision and device count.
        prescribed: motions by boundary; only names count.
        in_torch: names of parts that torch computes.

    Raises:
        UnsupportedPart: a part has no kernels.
    """
    if model.custom_substep is not None:
        raise UnsupportedPart(f"substep {model.custom_substep.name!r}")
    for key in state.memory:
        if key not in (MATERIAL_MEMORY_KEY, "contact") and key.removeprefix("effects.") not in model.effects:
            raise UnsupportedPart(f"memory {key!r} that no part owns")
    builder = SubstepBuilder(model, state, prescribed, in_torch)

    # forces
    if MATERIAL_MEMORY_KEY not in in_torch:
        _lower_part(MATERIAL_MEMORY_KEY, lambda: lower_material(builder))
    for name, (effect, c) in model.effects.items():
        if f"effects.{name}" not in in_torch:
            _lower_part(f"effects.{name}", lambda args=(name, effect, c): _lower_effect(builder, *args))
    builder.close_force_loops()
    contact = None if model.grid is None else ContactLowering(builder, model.grid)
    if contact is not None:
        contact.add_forces()

    # velocities, boundaries, positions, directors
    velocity = _append_kick(builder)
    lower_boundaries(builder, velocity)
    velocity.drift()
    if contact is not None:
        contact.update_directors()
    builder.program = builder.program.finish(keep_calls=devices.is_on_device(state.x))
    return builder


def _lower_part(name: str, lower_it: Callable[[], None]) -> None:
    try:
        lower_it()
    except UnsupportedPart as error:
        error.part = name
        raise


def _lower_effect(builder: SubstepBuilder, name: str, effect, c) -> None:
    lower_it = lowering_of(effect)
    if lower_it is None:
        raise UnsupportedPart(f"effect {name!r} ({type(effect).__name__})")
    lower_it(builder, name, effect, c)


def _append_kick(builder: SubstepBuilder) -> VelocityStage:
    loop, v = lower_viscous_stages(builder)
    dt, force, mass = (loop.load(field) for field in (builder.dt, builder.force, builder.mass))
    for kernel, fields in builder.vertex_forces:
        loop.call(kernel, *(loop.load(field) for field in fields), into=force)
    if builder.added_mass is None:
        return VelocityStage(builder, loop, loop.call("kick", dt, v, force, mass))
    velocities = loop.call("kick_added_mass", dt, v, force, mass, loop.load(builder.added_mass))
    return VelocityStage(builder, loop, velocities)
