"""The exported MJCF file in MuJoCo, with the gripped vertices on the grippers' path."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from torchcloth.errors import SimulationDiverged

from .swing import Array, Swing, make_still_air

mujoco: Any
try:
    import mujoco
except ImportError:
    mujoco = None


def replay_in_mujoco(
    text: str, swing: Swing, drag: Literal["file", "none", "triangles"] = "file", damping: float | None = None
) -> Array:
    """Simulate the swing with an exported file.

    Args:
        text: MJCF of ``torchcloth.export``.
        swing: what to follow.
        drag: "file": as the file says; "none"; "triangles": along the normal of every triangle, computed here.
        damping: s, in place of the file's.

    Returns:
        [T, V, 3] m.

    Raises:
        SimulationDiverged: MuJoCo warns of its state.
    """
    model = mujoco.MjModel.from_xml_string(text)
    if drag != "file":
        model.opt.density = 0.0
    if damping is not None:
        model.flex_damping[:] = damping
    data = mujoco.MjData(model)
    rest = model.body_pos[1:].copy()
    air = make_still_air(swing) if drag == "triangles" else None
    q, v = data.qpos.reshape(-1, 3), data.qvel.reshape(-1, 3)
    q[:] = swing.x[0] - rest
    frames = [swing.x[0]]
    t = swing.t[0]
    for end in swing.t[1:]:
        steps = int(np.ceil((end - t) / model.opt.timestep - 1e-9))
        model.opt.timestep = dt = (end - t) / steps
        path = swing.path(t + dt * np.arange(1, steps + 1)) - rest[swing.gripped]
        for target in path:
            v[swing.gripped] = (target - q[swing.gripped]) / dt
            if air is not None:
                data.qfrc_applied[:] = air.force(q + rest, v).ravel()
            mujoco.mj_step(model, data)
            q[swing.gripped] = target
        if not np.isfinite(q).all() or any(warning.number for warning in data.warning):
            raise SimulationDiverged("MuJoCo's cloth", got=f"a state that is not finite by {end:.3f} s")
        t = end
        frames.append(q + rest)
    return np.stack(frames)
