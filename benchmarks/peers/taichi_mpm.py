"""A-EP by the usual material point method in Taichi: APIC, dense grid, quadratic B-splines (torchcloth's "apic").

The reverse pass goes as in DiffTaichi: the state of every substep is stored, the grid is made again.
"""

import numpy as np
import taichi as ti

from ..cases import CELL_SIZE_M, MATERIAL, SUBSTEP_S
from ..contestant import Contestant, Outcome, Task, Unsupported
from .arrays import GRAVITY_Z_M_PER_S2, GRID_NODES_PER_AXIS, VERTEX_SHARE, Arrays, arrays, law

LAW = law()
INVERSE = 1.0 / CELL_SIZE_M


class Taichi(Contestant):
    """All kernels are compiled in ``prepare``."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        ti.init(arch=ti.cpu, default_fp=ti.f32, cpu_max_num_threads=threads, fast_math=True, log_level=ti.ERROR)

    def prepare(self, task: Task):
        """Forward and gradient of one scene."""
        if task.quantity == "tangents8" or task.batch:
            raise Unsupported("our Taichi version has neither forward mode nor batches")
        data = arrays(task.build_case(), task.substeps)
        sheet = Sheet(data, task.substeps, task.quantity == "gradient")
        sheet.warm_up()
        return sheet.gradient if task.quantity == "gradient" else sheet.forward


@ti.func
def gradient_of(w: ti.template(), d: ti.template(), i: ti.template(), j: ti.template(), k: ti.template()):
    """Return the gradient of a node's weight."""
    return ti.Vector([d[i][0] * w[j][1] * w[k][2], w[i][0] * d[j][1] * w[k][2], w[i][0] * w[j][1] * d[k][2]])


@ti.data_oriented
class Sheet:
    """Fields and kernels; with ``grad`` every substep's state is stored."""

    def __init__(self, data: Arrays, substeps: int, grad: bool) -> None:
        self.data, self.substeps, self.grad = data, substeps, grad
        self.V, self.E = len(data.x), len(data.faces)
        V, E, stored = self.V, self.E, substeps + 1 if grad else 2

        def vectors(*shape: int):
            return ti.Vector.field(3, ti.f32, shape=shape, needs_grad=grad)

        self.x, self.v, self.d3, self.moved = (
            vectors(stored, V),
            vectors(stored, V),
            vectors(stored, E),
            vectors(stored, E),
        )
        self.C = ti.Matrix.field(3, 3, ti.f32, shape=(stored, V + E), needs_grad=grad)
        self.force, self.pull = vectors(V), vectors(E)
        self.momentum = ti.Vector.field(3, ti.f32, needs_grad=grad)
        self.mass = ti.field(ti.f32, needs_grad=grad)
        ti.root.dense(ti.ijk, GRID_NODES_PER_AXIS).place(self.momentum, self.mass)
        if grad:
            ti.root.dense(ti.ijk, GRID_NODES_PER_AXIS).place(self.momentum.grad, self.mass.grad)
        self.youngs = ti.field(ti.f32, shape=(), needs_grad=grad)
        self.loss = ti.field(ti.f32, shape=(), needs_grad=grad)
        self.faces = ti.Vector.field(3, ti.i32, shape=E)
        self.frame = ti.Vector.field(4, ti.f32, shape=E)
        self.area, self.m_element = ti.field(ti.f32, shape=E), ti.field(ti.f32, shape=E)
        self.m_vertex, self.gripped = ti.field(ti.f32, shape=V), ti.field(ti.i32, shape=V)
        self.driven = ti.Vector.field(3, ti.f32, shape=substeps)
        fields = (
            (self.faces, data.faces),
            (self.frame, data.frame),
            (self.area, data.area),
            (self.gripped, data.gripped),
        )
        for field, values in (*fields, (self.m_element, data.element_mass), (self.driven, data.velocity)):
            field.from_numpy(values)
        self.m_vertex.from_numpy(VERTEX_SHARE * data.vertex_mass)
        self.start, self.origin = vectors(V), ti.Vector(data.shift.tolist())
        self.start.from_numpy(data.x)
        self.youngs[None] = MATERIAL["youngs_modulus"]

    @ti.func
    def heavy(self, node):
        """Return the mass on a node that a particle sees; its weight may be exactly 0."""
        m = self.mass[node]
        return ti.select(m > 0.0, m, 1.0)

    # -- kernels --------------------------------------------------------------------------------------------------

    @ti.kernel
    def begin(self):
        for i in range(self.V):
            self.x[0, i] = self.start[i]
            self.v[0, i] = ti.Vector.zero(ti.f32, 3)
        for i in range(self.V + self.E):
            self.C[0, i] = ti.Matrix.zero(ti.f32, 3, 3)
        for e in range(self.E):
            f = self.faces[e]
            a, b, c = self.start[f[0]], self.start[f[1]], self.start[f[2]]
            self.d3[0, e] = (b - a).cross(c - a).normalized()

    @ti.kernel
    def clear(self):
        for i in range(self.V):
            self.force[i] = ti.Vector.zero(ti.f32, 3)
        for node in ti.grouped(self.mass):
            self.momentum[node] = ti.Vector.zero(ti.f32, 3)
            self.mass[node] = 0.0

    @ti.kernel
    def clear_grad(self):
        for i in range(self.V):
            self.force.grad[i] = ti.Vector.zero(ti.f32, 3)
        for e in range(self.E):
            self.pull.grad[e] = ti.Vector.zero(ti.f32, 3)
        for node in ti.grouped(self.mass.grad):
            self.momentum.grad[node] = ti.Vector.zero(ti.f32, 3)
            self.mass.grad[node] = 0.0

    @ti.kernel
    def forces(self, s: ti.i32):
        """Compute the forces on vertices, and store what the director does through the grid."""
        for e in range(self.E):
            t = self.faces[e]
            g = self.frame[e]
            x0 = self.x[s, t[0]]
            d1, d2 = self.x[s, t[1]] - x0, self.x[s, t[2]] - x0
            f1, f2 = g[0] * d1 + g[1] * d2, g[2] * d1 + g[3] * d2
            normal = f1.cross(f2)
            J = ti.sqrt(normal.dot(normal))
            n = normal / J
            c1, c2 = f2.cross(n), n.cross(f1)
            mu, lam = LAW.mu * self.youngs[None], LAW.lam * self.youngs[None]
            bend = 2.0 * mu / ti.sqrt(f1.dot(f1) + f2.dot(f2) + 2.0 * J)
            along, across = 2.0 * mu - bend, lam * (J - 1.0) - bend
            d3 = self.d3[s, e]
            height = n.dot(d3)
            gap = ti.max(0.0, 1.0 - height)
            slope = LAW.shear * height + LAW.contact * gap * gap
            turn = -slope * d3
            turn = (turn - turn.dot(n) * n) / J
            p1 = along * f1 + across * c1 + f2.cross(turn)
            p2 = along * f2 + across * c2 + turn.cross(f1)
            self.pull[e] = self.area[e] * (LAW.shear * d3 - slope * n)
            second = -self.area[e] * (g[0] * p1 + g[2] * p2)
            third = -self.area[e] * (g[1] * p1 + g[3] * p2)
            self.force[t[0]] += -(second + third)
            self.force[t[1]] += second
            self.force[t[2]] += third

    @ti.kernel
    def to_grid(self, s: ti.i32):
        for i in range(self.V):
            place = self.x[s, i] * INVERSE
            base = ti.cast(place - 0.5, ti.i32)
            offset = place - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1.0) ** 2, 0.5 * (offset - 0.5) ** 2]
            m = self.m_vertex[i]
            C = m * self.C[s, i]
            given = (
                m * (self.v[s, i] + SUBSTEP_S * ti.Vector([0.0, 0.0, GRAVITY_Z_M_PER_S2])) + SUBSTEP_S * self.force[i]
            )
            for a, b, c in ti.static(ti.ndrange(3, 3, 3)):
                node = ti.Vector([a, b, c])
                weight = w[a][0] * w[b][1] * w[c][2]
                self.momentum[base + node] += weight * (given + C @ ((ti.cast(node, ti.f32) - offset) * CELL_SIZE_M))
                self.mass[base + node] += weight * m
        for e in range(self.E):
            t = self.faces[e]
            place = (self.x[s, t[0]] + self.x[s, t[1]] + self.x[s, t[2]]) * (INVERSE / 3.0)
            mean = (self.v[s, t[0]] + self.v[s, t[1]] + self.v[s, t[2]]) / 3.0
            base = ti.cast(place - 0.5, ti.i32)
            offset = place - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1.0) ** 2, 0.5 * (offset - 0.5) ** 2]
            d = [(offset - 1.5) * INVERSE, (2.0 - 2.0 * offset) * INVERSE, (offset - 0.5) * INVERSE]
            m = self.m_element[e]
            C = m * self.C[s, self.V + e]
            given = m * (mean + SUBSTEP_S * ti.Vector([0.0, 0.0, GRAVITY_Z_M_PER_S2]))
            d3, pull = self.d3[s, e], SUBSTEP_S * self.pull[e]
            for a, b, c in ti.static(ti.ndrange(3, 3, 3)):
                node = ti.Vector([a, b, c])
                weight = w[a][0] * w[b][1] * w[c][2]
                push = gradient_of(w, d, a, b, c).dot(d3)
                carried = given + C @ ((ti.cast(node, ti.f32) - offset) * CELL_SIZE_M)
                self.momentum[base + node] += weight * carried - push * pull
                self.mass[base + node] += weight * m

    @ti.kernel
    def to_particles(self, k: ti.i32, s: ti.i32, after: ti.i32):
        for i in range(self.V):
            place = self.x[s, i] * INVERSE
            base = ti.cast(place - 0.5, ti.i32)
            offset = place - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1.0) ** 2, 0.5 * (offset - 0.5) ** 2]
            v = ti.Vector.zero(ti.f32, 3)
            C = ti.Matrix.zero(ti.f32, 3, 3)
            for a, b, c in ti.static(ti.ndrange(3, 3, 3)):
                node = ti.Vector([a, b, c])
                given = w[a][0] * w[b][1] * w[c][2] / self.heavy(base + node) * self.momentum[base + node]
                v += given
                C += given.outer_product(ti.cast(node, ti.f32) - offset)
            if self.gripped[i] == 1:
                v = self.driven[k]
            self.C[after, i] = 4.0 * INVERSE * C
            self.v[after, i] = v
            self.x[after, i] = self.x[s, i] + SUBSTEP_S * v
        for e in range(self.E):
            t = self.faces[e]
            place = (self.x[s, t[0]] + self.x[s, t[1]] + self.x[s, t[2]]) * (INVERSE / 3.0)
            base = ti.cast(place - 0.5, ti.i32)
            offset = place - ti.cast(base, ti.f32)
            w = [0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1.0) ** 2, 0.5 * (offset - 0.5) ** 2]
            d = [(offset - 1.5) * INVERSE, (2.0 - 2.0 * offset) * INVERSE, (offset - 0.5) * INVERSE]
            C = ti.Matrix.zero(ti.f32, 3, 3)
            change = ti.Vector.zero(ti.f32, 3)
            for a, b, c in ti.static(ti.ndrange(3, 3, 3)):
                node = ti.Vector([a, b, c])
                given = self.momentum[base + node] / self.heavy(base + node)
                C += (w[a][0] * w[b][1] * w[c][2] * given).outer_product(ti.cast(node, ti.f32) - offset)
                change += gradient_of(w, d, a, b, c).dot(self.d3[s, e]) * given
            self.C[after, self.V + e] = 4.0 * INVERSE * C
            self.moved[after, e] = self.d3[s, e] + SUBSTEP_S * change

    @ti.kernel
    def map_back(self, after: ti.i32):
        """Map the directors back after friction and separation."""
        for e in range(self.E):
            t = self.faces[e]
            x0 = self.x[after, t[0]]
            normal = (self.x[after, t[1]] - x0).cross(self.x[after, t[2]] - x0)
            n = normal / ti.sqrt(normal.dot(normal))
            d3 = self.moved[after, e]
            height = n.dot(d3)
            r = d3 - height * n
            gap = ti.max(0.0, 1.0 - height)
            limit = LAW.cone * LAW.contact * gap * gap
            squared = LAW.shear * LAW.shear * r.dot(r)
            if height > 1.0:
                self.d3[after, e] = n
            elif squared > limit * limit:
                self.d3[after, e] = limit / ti.sqrt(squared) * r + height * n
            else:
                self.d3[after, e] = d3

    @ti.kernel
    def measure(self, s: ti.i32):
        for i in range(self.V):
            p = self.x[s, i] - self.origin
            self.loss[None] += p.dot(p) / (3.0 * self.V)

    # -- runs -----------------------------------------------------------------------------------------------------

    def substep(self, k: int) -> None:
        """Forward; two states in turn, or all of them."""
        s, after = (k, k + 1) if self.grad else (k % 2, (k + 1) % 2)
        self.clear()
        self.forces(s)
        self.to_grid(s)
        self.to_particles(k, s, after)
        self.map_back(after)

    def substep_back(self, k: int) -> None:
        """Run the adjoint of the substep, on a grid that is made again."""
        self.clear()
        self.clear_grad()
        self.forces(k)
        self.to_grid(k)
        self.map_back.grad(k + 1)
        self.to_particles.grad(k, k, k + 1)
        self.to_grid.grad(k)
        self.forces.grad(k)

    def forward(self) -> Outcome:
        """Return the positions at the end."""
        self.begin()
        for k in range(self.substeps):
            self.substep(k)
        ti.sync()
        return Outcome(self.end())

    def gradient(self) -> Outcome:
        """Forward, then backward through every substep."""
        for field in (self.start, self.x, self.v, self.d3, self.moved, self.C, self.youngs, self.loss):
            field.grad.fill(0.0)
        self.begin()
        for k in range(self.substeps):
            self.substep(k)
        self.loss[None], self.loss.grad[None] = 0.0, 1.0
        self.measure(self.substeps)
        self.measure.grad(self.substeps)
        for k in reversed(range(self.substeps)):
            self.substep_back(k)
        self.begin.grad()
        ti.sync()
        return Outcome(self.end(), self.loss[None], self.start.grad.to_numpy(), self.youngs.grad[None])

    def warm_up(self) -> None:
        """Compile the kernels before they are timed."""
        whole, self.substeps = self.substeps, 2
        (self.gradient if self.grad else self.forward)()
        self.substeps = whole

    def end(self) -> np.ndarray:
        """Return the final positions [V, 3] m."""
        last = self.substeps if self.grad else self.substeps % 2
        return self.x.to_numpy()[last] - self.data.shift
