"""The exported JSON file in Newton on the CPU, with the gripped vertices on the grippers' path."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from .swing import Array, Swing, make_still_air

newton: Any
wp: Any
try:
    import newton  # pyright: ignore[reportMissingImports] - of the extra "bench"
    import warp as wp  # pyright: ignore[reportMissingImports]
except ImportError:
    newton = wp = None

VBD_ITERATIONS = 10


def build_model(content: dict, solver: str, gripped: Array) -> Any:
    """Return Newton's model of an exported cloth on the CPU, with the gripped vertices without inverse mass."""
    wp.config.quiet = True
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=tuple(content["gravity"]))
    builder.add_cloth_mesh(
        pos=wp.vec3(0.0, 0.0, 0.0),
        rot=wp.quat_identity(),
        scale=1.0,
        vel=wp.vec3(0.0, 0.0, 0.0),
        vertices=[wp.vec3(*p) for p in content["vertices"]],
        indices=content["indices"],
        **content["arguments"][solver],
    )
    builder.particle_mass = list(content["particle_mass"])
    for i in gripped:
        builder.particle_mass[i] = 0.0
    if solver == "SolverVBD":
        builder.color(include_bending=True)
    return builder.finalize(device="cpu")


def replay_in_newton(text: str, swing: Swing, solver: str, step: float, has_drag: bool = True) -> Array:
    """Simulate the swing with an exported file.

    Args:
        text: JSON of ``torchcloth.export``.
        swing: what to follow.
        solver: "SolverSemiImplicit" or "SolverVBD".
        step: s.
        has_drag: SolverVBD, which has none, gets the drag of every triangle as forces on particles, computed here; of
            SolverSemiImplicit it is the file's.

    Returns:
        [T, V, 3] m.
    """
    content = json.loads(text)
    if not has_drag:
        content["arguments"][solver]["tri_drag"] = 0.0
    air = make_still_air(swing) if has_drag and solver == "SolverVBD" else None
    model = build_model(content, solver, swing.gripped)
    model.particle_grid = None  # no contact
    if solver == "SolverVBD":
        solve = newton.solvers.SolverVBD(model, iterations=VBD_ITERATIONS, particle_enable_self_contact=False)
    else:
        solve = newton.solvers.SolverSemiImplicit(model, enable_tri_contact=False)
    now, after, control = model.state(), model.state(), model.control()
    now.particle_q.assign(swing.x[0].astype(np.float32))
    frames, t = [swing.x[0]], swing.t[0]
    for end in swing.t[1:]:
        steps = int(np.ceil((end - t) / step - 1e-9))
        dt = (end - t) / steps
        path = swing.path(t + dt * np.arange(steps + 1)).astype(np.float32)
        for k in range(steps):
            now.particle_q.numpy()[swing.gripped] = path[k]  # views of memory on the CPU
            now.particle_qd.numpy()[swing.gripped] = (path[k + 1] - path[k]) / dt
            now.clear_forces()
            if air is not None:
                now.particle_f.assign(air.force(now.particle_q.numpy(), now.particle_qd.numpy()).astype(np.float32))
            solve.step(now, after, control, None, dt)
            now, after = after, now
        t = end
        frames.append(now.particle_q.numpy().astype(float))
        frames[-1][swing.gripped] = path[-1]
    return np.stack(frames)


def semi_implicit_forces(text: str, x: Array, membrane: bool = True) -> Array:
    """Return the forces [V, 3] N of SolverSemiImplicit's triangles, if wanted, and hinges at positions [V, 3] m."""
    from newton._src.solvers.semi_implicit import kernels_particle  # pyright: ignore[reportMissingImports]

    model = build_model(json.loads(text), "SolverSemiImplicit", np.zeros(0, int))
    state = model.state()
    state.particle_q.assign(x.astype(np.float32))
    state.clear_forces()
    if membrane:
        kernels_particle.eval_triangle_forces(model, state, model.control(), state.particle_f)
    kernels_particle.eval_bending_forces(model, state, state.particle_f)
    return state.particle_f.numpy().astype(float)
