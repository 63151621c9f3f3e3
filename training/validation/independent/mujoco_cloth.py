"""Cloth in MuJoCo flex: truth for synthetic episodes from an engine that shares no code with torchcloth.

What the engine computes (MuJoCo >= 4.0, XML reference, flex/elasticity): linear triangles with the Saint
Venant-Kirchhoff membrane, energy per unit area ``t (mu tr(e^2) + lambda*/2 tr(e)^2)``, ``e`` the Green strain, ``mu =
E / (2 (1 + nu))`` and the plane-stress ``lambda* = E nu / (1 - nu^2)``; optionally a discrete hinge bending energy of
rigidity ``E t^3 / (12 (1 - nu^2))``. MuJoCo before 4.0 used a quarter of mu (its changelog, commit 7ba52b533): such a
version is refused.

Integration is MuJoCo's semi-implicit Euler: symplectic, so without numerical damping, and with a step limited by the
membrane wave. MuJoCo's implicit "discrete" integrator would allow larger steps at the price of numerical damping. Air
drag is computed here, in numpy, and so is everything that `Hook`s add; what they damp linearly is implicit. Vertices
inside a grasp are prescribed at every step; what it takes to do so is the gripper's force.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

try:
    import mujoco
except ImportError:  # the package is importable without it
    mujoco: Any = None
from scipy.interpolate import CubicSpline
from scipy.sparse import csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation, RotationSpline

from torchcloth.errors import InvalidInput, MissingDependency, SimulationDiverged

from .flex_sheet import Air, SheetSpec, flex_xml, grid, largest_step, rest_points, vertex_masses
from .force_terms import Hook

Array = np.ndarray


def mujoco_version() -> str:
    """Return the version of MuJoCo.

    Raises:
        MissingDependency: it is not installed, or its 2-D elasticity is not the documented one.
    """
    version = "none" if mujoco is None else mujoco.__version__
    if mujoco is None or int(version.split(".")[0]) < 4:
        raise MissingDependency(
            "MuJoCo's 2-D flex elasticity", got=version, expected=">= 4.0", remedy='pip install "mujoco>=4"'
        )
    return version


@dataclass(frozen=True)
class Slip:
    """A grip that gives way: the patch creeps along the cloth's pull F at ``mobility (|F| - hold)`` m/s, F > hold.

    Attributes:
        mobility: m/(s N).
        hold: N.
    """

    mobility: float = 0.0
    hold: float = 0.5


@dataclass(frozen=True)
class Grip:
    """One gripper: the vertices that it holds and its motion.

    Attributes:
        vertices: [N] indices of the held vertices.
        t: [K] s, increasing.
        pose: [K, 4, 4] body to world, m; splines (C2) between the knots, constant outside them.
        slip: how the patch leaves the gripper; None: it does not.
    """

    vertices: Array
    t: Array
    pose: Array
    slip: Slip | None = None


@dataclass(frozen=True)
class Result:
    """What a run returns.

    Attributes:
        t: [T] s.
        x, v: [T, V, 3] m and m/s, world.
        force, torque: name -> [T, 3] N and N m: what the cloth exerts on the gripper, about the gripper's own origin,
            world axes, mean over the interval that ends at the frame (frame 0: the first step).
        grasp_error: m, largest distance between a held vertex, where MuJoCo has it, and its place in the gripper.
    """

    t: Array
    x: Array
    v: Array
    force: dict[str, Array]
    torque: dict[str, Array]
    grasp_error: float


class _Held:
    """The prescribed vertices of one gripper, and the wrench gathered from them."""

    def __init__(self, grip: Grip, x0: Array, clock: Array, frames: int) -> None:
        t = np.clip(clock, grip.t[0], grip.t[-1])
        self.index = grip.vertices
        self.origin = CubicSpline(grip.t, grip.pose[:, :3, 3])(t)
        self.turn = RotationSpline(grip.t, Rotation.from_matrix(grip.pose[:, :3, :3]))(t).as_matrix()
        self.local = (x0[self.index] - self.origin[0]) @ self.turn[0]
        self.slip = grip.slip
        self.wrench = np.zeros((frames, 6))
        self.sum, self.count = np.zeros(6), 0

    def place(self, step: int) -> Array:
        """Positions [N, 3] m at a step."""
        return self.origin[step] + self.local @ self.turn[step].T

    def creep(self, step: int, pull: Array, dt: float) -> None:
        """Let the patch slip under the cloth's pull [N, 3] N, in which its own inertia does not count."""
        if self.slip is None:
            return
        total = pull.sum(0)
        size = np.linalg.norm(total)
        if size > self.slip.hold:
            move = self.slip.mobility * (size - self.slip.hold) * dt / size * total
            self.local = self.local + move @ self.turn[step]

    def gather(self, step: int, pull: Array) -> None:
        """Add the forces [N, 3] N of one step."""
        arm = self.place(step) - self.origin[step]
        m = arm.T @ pull
        turning = m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]  # sum of arm x pull
        self.sum += np.concatenate([pull.sum(0), turning])
        self.count += 1

    def close(self, frame: int) -> None:
        """Store the mean since the last frame."""
        self.wrench[frame] = self.sum / self.count
        self.sum, self.count = np.zeros(6), 0


class _Viscous:
    """Damping forces -C v with the velocities v at the end of a step, of which those of the held vertices are given.

    Masses are those of the first step: where they change by a share, so does the damping.
    """

    def __init__(self, matrix: csr_matrix, mass: Array, held: Array, dt: float) -> None:
        self.matrix, self.mass, self.held = matrix, mass.copy(), held
        self.free = np.setdiff1d(np.arange(len(mass)), held)
        rows = (dt * matrix)[self.free]
        self.solve = splu(csc_matrix(diags([mass[self.free]], [0]) + rows[:, self.free])).solve
        self.from_held = rows[:, held]

    def damped(self, v: Array) -> Array:
        """Velocities [V, 3] of the free vertices after what acts besides, with the damping; of the others as given."""
        out = v.copy()
        out[self.free] = self.solve(self.mass[self.free, None] * v[self.free] - self.from_held @ v[self.held])
        return out


class MujocoCloth:
    """A sheet in MuJoCo whose grasped vertices follow grippers.

    Args:
        spec: the cloth and the air.
        dt: s, time step; None takes :func:`flex_sheet.largest_step`.
        hooks: further forces and masses; started anew with every run.

    Raises:
        MissingDependency: a MuJoCo whose 2-D elasticity is not the documented one.
    """

    def __init__(self, spec: SheetSpec, dt: float | None = None, hooks: Sequence[Hook] = ()) -> None:
        mujoco_version()
        self.spec = spec
        self.dt = float(dt if dt is not None else largest_step(spec))
        self.uv, self.faces = grid(spec)
        self.mass = vertex_masses(spec)
        self.model = mujoco.MjModel.from_xml_string(flex_xml(spec, self.dt))
        if self.model.nv != 3 * len(self.uv):
            raise InvalidInput("the flex's degrees of freedom", got=self.model.nv, expected=str(3 * len(self.uv)))
        self.model.body_mass[1:] = self.mass  # flexcomp gives all points the same mass; the rim must have less
        self.data = mujoco.MjData(self.model)
        mujoco.mj_setConst(self.model, self.data)
        self._rest = np.column_stack([rest_points(spec), np.zeros(len(self.uv))])
        self.hooks = list(hooks)
        self.implicit = not any(hook.reacts for hook in hooks)  # to damping; inertia besides the vertices' is not known
        self._air = Air(spec, self.faces, len(self.uv)) if spec.drag_normal > 0 else None

    def run(
        self,
        x0: Array,
        times: Array,
        grips: Mapping[str, Grip],
        *,
        v0: Array | None = None,
        brake: float = 0.0,
        load: Array | None = None,
    ) -> Result:
        """Simulate from ``times[0]`` to ``times[-1]``.

        Args:
            x0, v0: [V, 3] m and m/s at ``times[0]``.
            times: [T] s, frame times; rounded to multiples of the step.
            grips: the grippers by name; the held vertices keep the place in the gripper that they have at the start.
            brake: 1/s, drag on every vertex in proportion to its mass, to settle a cloth.
            load: [V, 3] N, constant additional force.

        Raises:
            SimulationDiverged: a state that is not finite or that MuJoCo warns of.
        """
        frames = np.rint((np.asarray(times) - times[0]) / self.dt).astype(int)
        clock = times[0] + self.dt * np.arange(frames[-1] + 1)
        held = {name: _Held(grip, x0, clock, len(frames)) for name, grip in grips.items()}
        mujoco.mj_resetData(self.model, self.data)
        # views of MuJoCo's memory: slide joints, so that qpos is each vertex's displacement
        q, v = self.data.qpos.reshape(-1, 3), self.data.qvel.reshape(-1, 3)
        q[:] = x0 - self._rest
        v[:] = 0.0 if v0 is None else v0
        for hook in self.hooks:
            hook.start(self, x0)
        matrices = [hook.viscous for hook in self.hooks if hook.viscous is not None]
        every = np.concatenate([np.zeros(0, int), *(grip.vertices for grip in grips.values())])
        self._viscous = _Viscous(sum(matrices), self.mass, every, self.dt) if matrices else None
        xs, vs, error, frame = [x0], [v.copy()], 0.0, 1
        for step in range(frames[-1]):
            error = max(error, self._step(q, v, held, step, clock[step], brake, load))
            if step == 0:
                for grip in held.values():
                    grip.wrench[0] = grip.sum
            if step + 1 == frames[frame]:
                xs.append(q + self._rest)
                vs.append(v.copy())
                for grip in held.values():
                    grip.close(frame)
                self._check(xs[-1], clock[step + 1])
                frame += 1
        force = {name: grip.wrench[:, :3] for name, grip in held.items()}
        torque = {name: grip.wrench[:, 3:] for name, grip in held.items()}
        return Result(clock[frames], np.stack(xs), np.stack(vs), force, torque, error)

    def _step(
        self, q: Array, v: Array, held: dict[str, _Held], step: int, t: float, brake: float, load: Array | None
    ) -> float:
        """Advance the state by one step in place; returns the grasp error in m at its start."""
        data, error = self.data, 0.0
        x = q + self._rest
        applied = np.zeros_like(x) if self._air is None else self._air.force(x, v)
        if load is not None:
            applied += load
        if brake:
            applied -= brake * self.mass[:, None] * v
        for hook in self.hooks:
            applied += hook.force(t, x, v)
        before = v.copy()
        self._advance(x, applied)
        push = data.qfrc_passive.reshape(-1, 3) + applied
        weight = np.array([0.0, 0.0, self.spec.gravity])
        viscous = self._viscous
        slips = any(grip.slip for grip in held.values())
        pull = push - viscous.matrix @ before if viscous is not None and slips else push
        for grip in held.values():
            i = grip.index
            error = max(error, float(np.linalg.norm(data.flexvert_xpos[i] - grip.place(step), axis=1).max()))
            grip.creep(step, pull[i] + self.mass[i, None] * weight, self.dt)
            target = grip.place(step + 1)
            q[i] = target - self._rest[i]
            v[i] = (target - x[i]) / self.dt  # what semi-implicit Euler would have needed to get there
        if viscous is not None:
            v[:] = viscous.damped(v)
            q[viscous.free] = (x + self.dt * v - self._rest)[viscous.free]
            push = push - viscous.matrix @ v
        for grip in held.values():
            i = grip.index
            gained = (v[i] - before[i]) / self.dt - weight
            grip.gather(step, push[i] - self.mass[i, None] * gained)
        return error

    def _advance(self, x: Array, applied: Array) -> None:
        """MuJoCo's step under the applied forces [V, 3] N, to which inertial reactions are added in place."""
        reacting = [hook for hook in self.hooks if hook.reacts]
        if not reacting:
            self.data.qfrc_applied[:] = applied.ravel()
            mujoco.mj_step(self.model, self.data)
            return
        mujoco.mj_step1(self.model, self.data)
        total = self.data.qfrc_passive.reshape(-1, 3) + applied
        total[:, 2] += self.mass * self.spec.gravity
        for hook in reacting:
            applied += hook.reaction(x, total)
        self.data.qfrc_applied[:] = applied.ravel()
        mujoco.mj_step2(self.model, self.data)

    def weigh(self, mass: Array) -> None:
        """Give the vertices the masses [V] kg from now on."""
        self.mass = mass
        self.model.body_mass[1:] = mass
        self.model.dof_M0[:] = np.repeat(mass, 3)  # what MuJoCo takes as the inertia of a lone slide joint

    def _check(self, x: Array, t: float) -> None:
        if not np.isfinite(x).all() or any(w.number for w in self.data.warning):
            raise SimulationDiverged(
                "MuJoCo's cloth",
                got=f"a state that is not finite or huge by {t:.4f} s",
                remedy=f"use dt < {self.dt:.2g} s",
            )


def settle(spec: SheetSpec, x0: Array, grips: Mapping[str, Grip], seconds: float, brake: float = 8.0) -> Array:
    """Positions [V, 3] m of the cloth at rest with the grippers at their first pose, reached with a temporary brake
    in 1/s.
    """
    still = {
        name: replace(grip, t=np.array([0.0, 1.0]), pose=np.repeat(grip.pose[:1], 2, 0)) for name, grip in grips.items()
    }
    return MujocoCloth(spec).run(x0, np.array([0.0, seconds]), still, brake=brake).x[-1]
