"""Newton's SemiImplicit cloth as it is: explicit, neo-Hookean triangles, no director, no grid."""

import newton
import numpy as np
import warp as wp

from ..cases import AREAL_DENSITY_KG_PER_M2, MATERIAL, SUBSTEP_S
from ..contestant import Contestant, Outcome, Task, Unsupported
from .arrays import GRAVITY_Z_M_PER_S2, Arrays, arrays, law

CONTACT_RADIUS_M = 0.01  # m, of the particles' contact: below half an edge, so that neighbours do not push


class Newton(Contestant):
    """Forward with its contact; gradients without, as its manual asks."""

    def __init__(self, threads: int) -> None:
        wp.config.quiet = True
        wp.init()

    def prepare(self, task: Task):
        """Forward and gradient of one scene."""
        if task.quantity == "tangents8" or task.batch:
            raise Unsupported("Newton has no forward mode; batches of cloth are more of one scene")
        case, gradient = task.build_case(), task.quantity == "gradient"
        sheet = Sheet(arrays(case, task.substeps), task.substeps, gradient, case.contact is not None and not gradient)
        return sheet.gradient if gradient else sheet.forward


@wp.kernel
def lead(index: wp.array(dtype=int), velocity: wp.array(dtype=wp.vec3), k: int, v: wp.array(dtype=wp.vec3)):
    """Move the held particles. They have no inverse mass: they move as their velocity says."""
    v[index[wp.tid()]] = velocity[k]


@wp.kernel
def squares(x: wp.array(dtype=wp.vec3), origin: wp.vec3, share: float, loss: wp.array(dtype=float)):
    p = x[wp.tid()] - origin
    wp.atomic_add(loss, 0, share * wp.dot(p, p))


class Sheet:
    """Two states in turn, or all of them for a gradient."""

    def __init__(self, data: Arrays, substeps: int, grad: bool, contact: bool) -> None:
        self.data, self.substeps, self.grad, self.law = data, substeps, grad, law()
        self.model = self._build(grad)
        self.solver = newton.solvers.SolverSemiImplicit(self.model, enable_tri_contact=contact)
        if not contact:
            self.model.particle_grid = None
        self.states = [self.model.state() for _ in range(substeps + 1 if grad else 2)]
        self.control = self.model.control()
        self.start = self.states[0].particle_q.numpy().copy()
        self.index = wp.array(np.flatnonzero(data.gripped).astype(np.int32), dtype=int, device="cpu")
        self.velocity = wp.array(data.velocity, dtype=wp.vec3, device="cpu")
        self.loss = wp.zeros(1, dtype=float, device="cpu", requires_grad=grad)

    def _build(self, grad: bool):
        data, youngs = self.data, MATERIAL["youngs_modulus"]
        builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, GRAVITY_Z_M_PER_S2))
        builder.add_cloth_mesh(
            pos=wp.vec3(0.0, 0.0, 0.0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(0.0, 0.0, 0.0),
            vertices=[wp.vec3(*map(float, p)) for p in data.x],
            indices=data.faces.ravel().tolist(),
            density=AREAL_DENSITY_KG_PER_M2,
            tri_ke=self.law.mu * youngs,
            tri_ka=(self.law.lam + self.law.mu) * youngs,  # with tri_ke the same linear elasticity as ours
            tri_kd=0.0,
            edge_ke=0.0,
            edge_kd=0.0,
            particle_radius=CONTACT_RADIUS_M,
        )
        for i in np.flatnonzero(data.gripped):
            builder.particle_mass[i] = 0.0
        return builder.finalize(device="cpu", requires_grad=grad)

    def run(self) -> None:
        """Run from the start to the loss."""
        first, count = self.states[0], len(self.states)
        first.particle_q.assign(self.start)
        first.particle_qd.zero_()
        for k in range(self.substeps):
            before, after = self.states[k % count], self.states[(k + 1) % count]
            before.clear_forces()
            wp.launch(lead, len(self.index), [self.index, self.velocity, k, before.particle_qd], device="cpu")
            self.solver.step(before, after, self.control, None, SUBSTEP_S)

    def forward(self) -> Outcome:
        """Return the positions at the end."""
        self.run()
        return Outcome(self.end())

    def gradient(self) -> Outcome:
        """Forward on a tape, then backward."""
        self.loss.zero_()
        tape = wp.Tape()
        with tape:
            self.run()
            x, share = self.states[self.substeps].particle_q, 1.0 / (3.0 * len(self.start))
            wp.launch(squares, len(self.start), [x, wp.vec3(*self.data.shift.tolist()), share, self.loss], device="cpu")
        tape.backward(loss=self.loss)
        gradient_x = self.states[0].particle_q.grad.numpy().copy()
        by_law = self.model.tri_materials.grad.numpy().sum(0)
        gradient_youngs = float(by_law[0] * self.law.mu + by_law[1] * (self.law.lam + self.law.mu))
        result = Outcome(self.end(), float(self.loss.numpy()[0]), gradient_x, gradient_youngs)
        tape.zero()
        return result

    def end(self) -> np.ndarray:
        """Return the final positions [V, 3] m."""
        return self.states[self.substeps % len(self.states)].particle_q.numpy() - self.data.shift
