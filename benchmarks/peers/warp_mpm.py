"""A-EP by the usual material point method in Warp: APIC, dense grid, quadratic B-splines (torchcloth's "apic").

Every substep of a gradient has arrays of its own, the grid's too, so that one tape holds all: nothing is recomputed.
On the CPU Warp runs one thread.
"""

import numpy as np
import warp as wp

from ..cases import MATERIAL
from ..contestant import Contestant, Outcome, Task, Unsupported
from . import warp_kernels as kernels
from .arrays import GRID_NODES_PER_AXIS, VERTEX_SHARE, Arrays, arrays

MAX_GRADIENT_SUBSTEPS = 500  # 3 MB of tape each


class Warp(Contestant):
    """Kernels are compiled in ``prepare``."""

    def __init__(self, threads: int) -> None:
        wp.config.quiet = True
        wp.init()

    def prepare(self, task: Task):
        """Forward and gradient of one scene."""
        if task.quantity == "tangents8" or task.batch:
            raise Unsupported("our Warp version has neither forward mode nor batches")
        gradient = task.quantity == "gradient"
        if gradient and task.substeps > MAX_GRADIENT_SUBSTEPS:
            raise Unsupported(f"a tape of more than {MAX_GRADIENT_SUBSTEPS} substeps")
        sheet = Sheet(arrays(task.build_case(), task.substeps), task.substeps, gradient)
        if not gradient:
            wp.load_module(kernels, device="cpu")
            return sheet.forward
        tape = wp.Tape()
        with tape:
            sheet.run()
        return lambda: sheet.gradient(tape)


class State:
    """Particles at one time, and the scratch of the substep that starts there."""

    def __init__(self, vertices: int, elements: int, grad: bool) -> None:
        def zeros(shape, dtype=wp.vec3):
            return wp.zeros(shape, dtype=dtype, device="cpu", requires_grad=grad)

        self.x, self.v, self.force = zeros(vertices), zeros(vertices), zeros(vertices)
        self.d3, self.pull = zeros(elements), zeros(elements)
        self.C, self.C_element = zeros(vertices, wp.mat33), zeros(elements, wp.mat33)
        self.grid = zeros((GRID_NODES_PER_AXIS, GRID_NODES_PER_AXIS, GRID_NODES_PER_AXIS), wp.vec4)


class Sheet:
    """Two states in turn, or all of them for a gradient."""

    def __init__(self, data: Arrays, substeps: int, grad: bool) -> None:
        self.data, self.substeps, self.grad = data, substeps, grad
        self.V, self.E = len(data.x), len(data.faces)

        def array(values: np.ndarray, dtype, needs_grad: bool = False):
            return wp.array(values, dtype=dtype, device="cpu", requires_grad=needs_grad)

        self.faces, self.frame, self.area = (
            array(values, dtype)
            for values, dtype in ((data.faces, wp.vec3i), (data.frame, wp.vec4), (data.area, float))
        )
        self.m_vertex = array((VERTEX_SHARE * data.vertex_mass).astype(np.float32), float)
        self.m_element, self.gripped = array(data.element_mass, float), array(data.gripped, int)
        self.driven = array(data.velocity, wp.vec3)
        self.start = array(data.x, wp.vec3, grad)
        self.youngs = array(np.array([MATERIAL["youngs_modulus"]], np.float32), float, grad)
        self.loss = array(np.zeros(1, np.float32), float, grad)
        self.origin = wp.vec3(*data.shift.tolist())
        self.states = [State(self.V, self.E, grad) for _ in range(substeps + 1 if grad else 2)]

    def substep(self, k: int, s: State, after: State) -> None:
        """Run one substep, on scratch that starts at zero."""

        def launch(kernel, size: int, inputs: list, outputs: list) -> None:
            wp.launch(kernel, dim=size, inputs=inputs, outputs=outputs, device="cpu")

        mesh, grid = (self.faces, self.frame, self.area), [s.grid]
        s.force.zero_()
        s.grid.zero_()
        launch(kernels.forces, self.E, [s.x, s.d3, *mesh, self.youngs], [s.force, s.pull])
        launch(kernels.vertices_to_grid, self.V, [s.x, s.v, s.C, self.m_vertex, s.force], grid)
        launch(
            kernels.elements_to_grid,
            self.E,
            [s.x, s.v, s.C_element, s.d3, s.pull, self.faces, self.m_element],
            grid,
        )
        launch(
            kernels.grid_to_vertices,
            self.V,
            [s.x, s.grid, self.gripped, self.driven, k],
            [after.x, after.v, after.C],
        )
        launch(
            kernels.grid_to_elements,
            self.E,
            [s.x, s.d3, self.faces, s.grid, after.x],
            [after.C_element, after.d3],
        )

    def run(self) -> None:
        """Run from the start to the loss."""
        first, count = self.states[0], len(self.states)
        for field in (first.v, first.C, first.C_element, self.loss):
            field.zero_()
        wp.launch(kernels.begin_vertices, self.V, inputs=[self.start], outputs=[first.x], device="cpu")
        wp.launch(kernels.begin_elements, self.E, inputs=[self.start, self.faces], outputs=[first.d3], device="cpu")
        for k in range(self.substeps):
            self.substep(k, self.states[k % count], self.states[(k + 1) % count])
        share = 1.0 / (3.0 * self.V)
        last = self.states[self.substeps % count]
        wp.launch(kernels.squares, self.V, inputs=[last.x, self.origin, share], outputs=[self.loss], device="cpu")

    def forward(self) -> Outcome:
        """Return the positions at the end."""
        self.run()
        return Outcome(self.end())

    def gradient(self, tape: wp.Tape) -> Outcome:
        """Forward on the tape's arrays, then backward through its launches."""
        tape.zero()
        self.run()
        tape.backward(loss=self.loss)
        gradient_x, gradient_youngs = self.start.grad.numpy(), float(self.youngs.grad.numpy()[0])
        return Outcome(self.end(), float(self.loss.numpy()[0]), gradient_x.copy(), gradient_youngs)

    def end(self) -> np.ndarray:
        """Return the final positions [V, 3] m."""
        return self.states[self.substeps % len(self.states)].x.numpy() - self.data.shift
