"""Cloth in MuJoCo flex: the truth of synthetic episodes, by an engine that shares no code with torchcloth.

MuJoCo >= 4.0 (XML reference, flex/elasticity) computes linear triangles with the Saint Venant-Kirchhoff membrane. The
energy per unit area is ``t (mu tr(e^2) + lambda*/2 tr(e)^2)``, with the Green strain ``e``, ``mu = E / (2 (1 + nu))``
and the plane-stress ``lambda* = E nu / (1 - nu^2)``. Optionally it adds a discrete hinge bending energy of rigidity
``E t^3 / (12 (1 - nu^2))``. MuJoCo before 4.0 used a quarter of mu (its changelog, commit 7ba52b533) and is refused.

Integration is MuJoCo's semi-implicit Euler: symplectic, hence without numerical damping, with a step that the membrane
wave limits. MuJoCo's implicit "discrete" integrator would allow larger steps at the price of numerical damping. Air
drag and all force terms are computed here, in numpy; their linear damping is implicit. Vertices inside a grasp are
prescribed at every step. The force that this needs is the gripper's force.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.sparse import csc_matrix, csr_matrix, diags
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation, RotationSpline

from torchcloth.errors import InvalidInput, MissingDependency, SimulationDiverged

from .flex_sheet import SheetSpec, StillAir, flex_xml, max_stable_step, rest_positions, sheet_mesh, vertex_masses
from .force_terms import ForceTerm

mujoco: Any
try:
    import mujoco
except ImportError:  # other modules use this one's classes without it
    mujoco = None

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
    """Creep of a grip: under the cloth's pull F the patch moves along it at ``mobility (|F| - threshold)``.

    Attributes:
        mobility: m/(s N).
        threshold: N, pull below which the patch does not move.
    """

    mobility: float = 0.0
    threshold: float = 0.5


@dataclass(frozen=True)
class Grip:
    """The vertices that one gripper holds, and its motion.

    Attributes:
        vertices: [N] indices.
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
    """A simulated motion.

    Attributes:
        t: [T] s.
        x: [T, V, 3] m, world.
        v: [T, V, 3] m/s.
        force: [T, 3] N by gripper: what the cloth exerts on it, in world axes, as the mean over the interval that ends
            at the frame. Frame 0 has the first step's value.
        torque: [T, 3] N m by gripper, likewise, about the gripper's own origin.
        grasp_error: m, largest distance between a held vertex in MuJoCo and its place in the gripper.
    """

    t: Array
    x: Array
    v: Array
    force: dict[str, Array]
    torque: dict[str, Array]
    grasp_error: float


class _PrescribedPatch:
    """The prescribed vertices of one gripper, and the wrench that is accumulated from them."""

    def __init__(self, grip: Grip, x0: Array, step_times: Array, frames: int) -> None:
        t = np.clip(step_times, grip.t[0], grip.t[-1])
        self.vertices = grip.vertices
        self.origin = CubicSpline(grip.t, grip.pose[:, :3, 3])(t)
        self.rotation = RotationSpline(grip.t, Rotation.from_matrix(grip.pose[:, :3, :3]))(t).as_matrix()
        self.local = (x0[self.vertices] - self.origin[0]) @ self.rotation[0]
        self.slip = grip.slip
        self.wrench = np.zeros((frames, 6))
        self.sum, self.count = np.zeros(6), 0

    def positions(self, step: int) -> Array:
        """Return the positions [N, 3] m at a step."""
        return self.origin[step] + self.local @ self.rotation[step].T

    def apply_slip(self, step: int, pull: Array, dt: float) -> None:
        """Let the patch slip under the cloth's pull [N, 3] N, without the patch's own inertia."""
        if self.slip is None:
            return
        total = pull.sum(0)
        size = np.linalg.norm(total)
        if size > self.slip.threshold:
            move = self.slip.mobility * (size - self.slip.threshold) * dt / size * total
            self.local = self.local + move @ self.rotation[step]

    def accumulate_wrench(self, step: int, pull: Array) -> None:
        """Add the forces [N, 3] N of one step to the wrench."""
        arm = self.positions(step) - self.origin[step]
        m = arm.T @ pull
        torque = m[1, 2] - m[2, 1], m[2, 0] - m[0, 2], m[0, 1] - m[1, 0]  # sum of arm x pull
        self.sum += np.concatenate([pull.sum(0), torque])
        self.count += 1

    def store_mean_wrench(self, frame: int) -> None:
        """Store the mean since the last frame, and start the next."""
        self.wrench[frame] = self.sum / self.count
        self.sum, self.count = np.zeros(6), 0


class _ImplicitDamping:
    """Damping forces -C v with the velocities v at the end of a step; those of the prescribed vertices are given.

    The masses are those of the first step. Where they change by a fraction, so does the damping.
    """

    def __init__(self, matrix: csr_matrix, mass: Array, prescribed: Array, dt: float) -> None:
        self.matrix, self.mass, self.prescribed = matrix, mass.copy(), prescribed
        self.free = np.setdiff1d(np.arange(len(mass)), prescribed)
        rows = (dt * matrix)[self.free]
        self.solve = splu(csc_matrix(diags(mass[self.free]) + rows[:, self.free])).solve
        self.from_prescribed = rows[:, prescribed]

    def apply(self, v: Array) -> Array:
        """Return velocities [V, 3] m/s with the damping, given those without it."""
        out = v.copy()
        undamped = self.mass[self.free, None] * v[self.free]
        out[self.free] = self.solve(undamped - self.from_prescribed @ v[self.prescribed])
        return out


class MujocoCloth:
    """A sheet in MuJoCo whose grasped vertices follow grippers.

    Args:
        spec: the cloth and the air.
        dt: s, time step; None takes :func:`flex_sheet.max_stable_step`.
        force_terms: further forces and masses; every run resets them.

    Raises:
        MissingDependency: a MuJoCo whose 2-D elasticity is not the documented one.
    """

    def __init__(self, spec: SheetSpec, dt: float | None = None, force_terms: Sequence[ForceTerm] = ()) -> None:
        mujoco_version()
        self.spec = spec
        self.dt = float(dt if dt is not None else max_stable_step(spec))
        self.uv, self.faces = sheet_mesh(spec)
        self.mass = vertex_masses(spec)
        self._load_flex(np.pad(rest_positions(spec), ((0, 0), (0, 1))))  # flat in the plane z = 0
        self.force_terms = list(force_terms)
        # implicit damping knows only the vertices' own inertia
        self.has_implicit_damping = not any(term.has_inertia for term in force_terms)
        self._air = StillAir(spec, self.faces, len(self.uv)) if spec.drag_normal > 0 else None

    def _load_flex(self, rest: Array) -> None:
        """Build MuJoCo's model of the vertices at rest [V, 3] m, with the cloth's own masses."""
        spec = self.spec
        xml = flex_xml(
            rest,
            self.faces,
            self.dt,
            membrane_stiffness=spec.membrane_stiffness,
            poisson_ratio=spec.poisson_ratio,
            bending_stiffness=spec.bending_stiffness,
            damping_time=spec.damping_time,
            gravity=spec.gravity,
        )
        self._rest, self.model = rest, mujoco.MjModel.from_xml_string(xml)
        if self.model.nv != 3 * len(rest):
            raise InvalidInput("the flex's degrees of freedom", got=self.model.nv, expected=str(3 * len(rest)))
        self.model.body_mass[1:] = self.mass  # flexcomp gives all points the same mass; the rim must have less
        self.data = mujoco.MjData(self.model)
        mujoco.mj_setConst(self.model, self.data)

    def run(
        self,
        x0: Array,
        times: Array,
        grips: Mapping[str, Grip],
        *,
        v0: Array | None = None,
        damping_rate: float = 0.0,
        load: Array | None = None,
    ) -> Result:
        """Simulate from ``times[0]`` to ``times[-1]``.

        Args:
            x0: [V, 3] m, positions at ``times[0]``.
            times: [T] s, frame times; rounded to multiples of the step.
            grips: the grippers by name; the held vertices keep the place in the gripper that they have at the start.
            v0: [V, 3] m/s, velocities at ``times[0]``; None: at rest.
            damping_rate: 1/s, drag on every vertex in proportion to its mass, to settle a cloth.
            load: [V, 3] N, constant additional force.

        Raises:
            SimulationDiverged: a state that is not finite or that MuJoCo warns of.
        """
        frames = np.rint((np.asarray(times) - times[0]) / self.dt).astype(int)
        step_times = times[0] + self.dt * np.arange(frames[-1] + 1)
        patches = {name: _PrescribedPatch(grip, x0, step_times, len(frames)) for name, grip in grips.items()}
        mujoco.mj_resetData(self.model, self.data)
        # views of MuJoCo's memory: slide joints, so that qpos is each vertex's displacement
        q, v = self.data.qpos.reshape(-1, 3), self.data.qvel.reshape(-1, 3)
        q[:] = x0 - self._rest
        v[:] = 0.0 if v0 is None else v0
        for term in self.force_terms:
            term.reset(self, x0)
        matrices = [term.damping_matrix for term in self.force_terms if term.damping_matrix is not None]
        prescribed = np.concatenate([np.zeros(0, int), *(grip.vertices for grip in grips.values())])
        self._damping = None
        if matrices:
            self._damping = _ImplicitDamping(csr_matrix(sum(matrices)), self.mass, prescribed, self.dt)

        xs, vs, error, frame = [x0], [v.copy()], 0.0, 1
        for step in range(frames[-1]):
            error = max(error, self._step(q, v, patches, step, step_times[step], damping_rate, load))
            if step == 0:
                for patch in patches.values():
                    patch.wrench[0] = patch.sum
            if step + 1 == frames[frame]:
                xs.append(q + self._rest)
                vs.append(v.copy())
                for patch in patches.values():
                    patch.store_mean_wrench(frame)
                self._check_finite(xs[-1], step_times[step + 1])
                frame += 1
        force = {name: patch.wrench[:, :3] for name, patch in patches.items()}
        torque = {name: patch.wrench[:, 3:] for name, patch in patches.items()}
        return Result(step_times[frames], np.stack(xs), np.stack(vs), force, torque, error)

    def _step(
        self,
        q: Array,
        v: Array,
        patches: dict[str, _PrescribedPatch],
        step: int,
        t: float,
        damping_rate: float,
        load: Array | None,
    ) -> float:
        """Advance the state by one step in place; returns the grasp error [m] at its start."""
        data, error = self.data, 0.0
        x = q + self._rest
        applied = np.zeros_like(x) if self._air is None else self._air.force(x, v)
        if load is not None:
            applied += load
        if damping_rate:
            applied -= damping_rate * self.mass[:, None] * v
        for term in self.force_terms:
            applied += term.force(t, x, v)
        v_before = v.copy()
        self._advance(x, applied)

        # prescribe the held vertices, at velocities that semi-implicit Euler would have needed to get there
        force = data.qfrc_passive.reshape(-1, 3) + applied
        gravity = np.array([0.0, 0.0, self.spec.gravity])
        damping = self._damping
        slips = any(patch.slip for patch in patches.values())
        pull = force - damping.matrix @ v_before if damping is not None and slips else force
        for patch in patches.values():
            i = patch.vertices
            error = max(error, float(np.linalg.norm(data.flexvert_xpos[i] - patch.positions(step), axis=1).max()))
            patch.apply_slip(step, pull[i] + self.mass[i, None] * gravity, self.dt)
            target = patch.positions(step + 1)
            q[i] = target - self._rest[i]
            v[i] = (target - x[i]) / self.dt

        if damping is not None:
            v[:] = damping.apply(v)
            q[damping.free] = (x + self.dt * v - self._rest)[damping.free]
            force = force - damping.matrix @ v
        for patch in patches.values():
            i = patch.vertices
            acceleration = (v[i] - v_before[i]) / self.dt - gravity
            patch.accumulate_wrench(step, force[i] - self.mass[i, None] * acceleration)
        return error

    def _advance(self, x: Array, applied: Array) -> None:
        """Take MuJoCo's step under the applied forces [V, 3] N; inertial forces are added to them in place."""
        inertial = [term for term in self.force_terms if term.has_inertia]
        if not inertial:
            self.data.qfrc_applied[:] = applied.ravel()
            mujoco.mj_step(self.model, self.data)
            return
        mujoco.mj_step1(self.model, self.data)
        total = self.data.qfrc_passive.reshape(-1, 3) + applied
        total[:, 2] += self.mass * self.spec.gravity
        for term in inertial:
            applied += term.inertial_force(x, total)
        self.data.qfrc_applied[:] = applied.ravel()
        mujoco.mj_step2(self.model, self.data)

    def set_masses(self, mass: Array) -> None:
        """Give the vertices the masses [V] kg from now on."""
        self.mass = mass
        self.model.body_mass[1:] = mass
        self.model.dof_M0[:] = np.repeat(mass, 3)  # what MuJoCo takes as the inertia of a lone slide joint

    def _check_finite(self, x: Array, t: float) -> None:
        if not np.isfinite(x).all() or any(w.number for w in self.data.warning):
            raise SimulationDiverged(
                "MuJoCo's cloth",
                got=f"a state that is not finite or huge by {t:.4f} s",
                remedy=f"use dt < {self.dt:.2g} s",
            )


def hold_grips(grips: Mapping[str, Grip]) -> dict[str, Grip]:
    """Return the grips with their grippers at their first poses, without slip."""
    return {
        name: replace(grip, t=np.array([0.0, 1.0]), pose=np.repeat(grip.pose[:1], 2, 0), slip=None)
        for name, grip in grips.items()
    }


def settle(spec: SheetSpec, x0: Array, grips: Mapping[str, Grip], seconds: float, damping_rate: float = 8.0) -> Array:
    """Return the positions [V, 3] m of the cloth after ``seconds`` of damped motion with grippers at rest.

    Args:
        spec: the cloth and the air.
        x0: [V, 3] m, positions to start from.
        grips: the grippers, which stay at their first poses.
        seconds: simulated time.
        damping_rate: 1/s, as for ``MujocoCloth.run``.
    """
    times = np.array([0.0, seconds])
    return MujocoCloth(spec).run(x0, times, hold_grips(grips), damping_rate=damping_rate).x[-1]
