"""The contracts of boundaries."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from ..boundaries import AbstractBoundary, PrescribedMotion, sample_trajectory
from ..meshes import Mesh, rectangle
from ..types import Trajectory
from . import samples
from .contract import (
    Contract,
    batch_parameters,
    call_with,
    detached_parameters,
    float64,
    require,
    require_close,
    require_finite_gradients,
    unbatch_parameters,
)
from .finite_differences import check_gradients


class BoundaryContract(Contract):
    """What the layer relies on in a boundary. Override ``make``, and ``sample`` if it does not act near z = 0.

    Attributes:
        dt: substep of the trials [s].
        substeps: of a travelling body.
    """

    dt = 1e-3
    substeps = 200

    @abstractmethod
    def make(self) -> AbstractBoundary:
        """Make the boundary, not yet bound to a mesh."""

    def mesh(self) -> Mesh:
        """Build the sheet on which the boundary is tested."""
        return rectangle(0.3, 0.2, resolution=(4, 4))

    def sample(self) -> tuple[Tensor, Tensor]:
        """Draw positions and velocities [V, 3], of which some feel the boundary and some do not, none at the limit."""
        rest = torch.as_tensor(self.mesh().vertices)
        lift = torch.tensor([0.0, 0.0, 0.001], dtype=rest.dtype)  # a step of dt at 1 m/s: some arrive, some do not
        return rest + lift * samples.normal((len(rest), 1), 1), samples.normal(tuple(rest.shape), 2)

    def rest(self) -> tuple[Tensor, Tensor]:
        """Return a state exactly on the boundary and at rest, where square roots and switches lose derivatives."""
        x = torch.as_tensor(self.mesh().vertices)
        return x, torch.zeros_like(x)

    def _boundary(self) -> AbstractBoundary:
        with float64():
            return self.make().double().bind(self.mesh()).double().requires_grad_()

    def _travel(self) -> Tensor:
        """[K, 4, 4]: from the origin, a turn about a tilted axis while the body travels."""
        angle = torch.linspace(0.0, 1.2, 5, dtype=torch.float64)[:, None, None]
        a, b, c = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
        o = torch.zeros((), dtype=torch.float64)
        axis = torch.stack([o, -c, b, c, o, -a, -b, a, o]).reshape(3, 3)
        pose = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
        pose[:, :3, :3] = torch.linalg.matrix_exp(angle * axis)
        pose[:, :3, 3] = 0.1 * angle[:, 0] ** 2 * pose.new_tensor([1.0, -0.5, 0.7])
        return pose

    def _prescribe(self, pose: Tensor, closed: bool = True) -> PrescribedMotion:
        """Sample the motion of a body that passes the poses at equal times."""
        t = torch.linspace(0.0, self.substeps * self.dt, pose.shape[-3], dtype=pose.dtype)
        substeps = torch.linspace(0.0, float(t[-1]), self.substeps + 1, dtype=pose.dtype)
        return sample_trajectory(Trajectory(t, pose, torch.full((len(t),), closed)), substeps)

    def _pose(self) -> Tensor | None:
        """[K, 4, 4] of a body that moves; None: the boundary stands still."""
        return None

    def _apply(self, boundary: AbstractBoundary, x: Tensor, v: Tensor, pose: Tensor | None = None) -> Tensor:
        return boundary.constrain(x, v, self.dt, None if pose is None else self._prescribe(pose), 1)

    def _inputs(self) -> dict[str, Tensor]:
        x, v = self.sample()
        pose = self._pose()
        return {"x": x, "v": v} if pose is None else {"x": x, "v": v, "pose": pose}

    def test_acts(self) -> None:
        """The boundary changes some velocities of the sample; else the other tests prove nothing."""
        inputs = self._inputs()
        changed = (self._apply(self._boundary(), **inputs).detach() != inputs["v"]).any(-1)
        require(changed.any(), "the boundary changes nothing on sample(); override sample()")

    def test_applying_twice_changes_nothing(self) -> None:
        """Velocities that obey the boundary pass it unchanged."""
        boundary, inputs = self._boundary(), self._inputs()
        once = self._apply(boundary, **inputs).detach()
        twice = self._apply(boundary, **{**inputs, "v": once}).detach()
        require_close(twice, once, 1e-11, "applying the boundary twice differs from once")

    def test_gradients(self) -> None:
        """Gradients in positions, velocities, poses and every parameter agree with finite differences."""
        boundary = self._boundary()
        names = detached_parameters(boundary)

        def evaluate(**values: Tensor) -> Tensor:
            parameters = {name: values.pop(name) for name in names}
            return call_with(boundary, parameters, self._apply, values["x"], values["v"], values.get("pose"))

        # steps small enough that no vertex changes between touching and free
        check_gradients(evaluate, {**self._inputs(), **names}, 1e-7, steps=[10.0 ** (-2 - k / 2) for k in range(11)])

    def test_gradients_are_finite_at_rest(self) -> None:
        """Gradients are finite exactly on the boundary, at rest."""
        boundary = self._boundary()
        x, v = self.rest()
        pose = self._pose()
        state = {"x": x, "v": v} if pose is None else {"x": x, "v": v, "pose": pose}
        leaves = {name: value.clone().requires_grad_() for name, value in state.items()}
        result = self._apply(boundary, **leaves)
        require(torch.isfinite(result).all(), "velocities are not finite at rest on the boundary")
        require_finite_gradients(result, {**leaves, **dict(boundary.named_parameters())}, "at rest on the boundary")

    def test_batches_equal_loops(self) -> None:
        """Batches of states, poses and parameters give what a loop gives."""
        boundary = self._boundary()
        parameters = detached_parameters(boundary)
        many = batch_parameters(parameters, 3)
        stacks = {name: torch.stack([value] * 3) for name, value in self._inputs().items()}
        stacks["v"] = stacks["v"] * torch.tensor([1.0, -1.0, 0.5], dtype=torch.float64)[:, None, None]
        if "pose" in stacks:
            shift = torch.zeros_like(stacks["pose"])
            shift[..., :3, 3] = 0.01 * samples.normal((*shift.shape[:-2], 3), 8)
            stacks["pose"] = stacks["pose"] + shift
        together = call_with(boundary, many, self._apply, *stacks.values()).detach()
        for k in range(3):
            one = [value[k] for value in stacks.values()]
            alone = call_with(boundary, unbatch_parameters(many, parameters, k), self._apply, *one).detach()
            require_close(together[k], alone, 1e-12, f"batch entry {k} differs from the loop")

    def test_works_in_float32(self) -> None:
        """Velocities agree to single precision, without silent promotion."""
        inputs = self._inputs()
        exact = self._apply(self._boundary(), **inputs).detach()
        got = self._apply(self._boundary().float(), **{k: value.float() for k, value in inputs.items()}).detach()
        require(got.dtype == torch.float32, f"apply answers float32 with {got.dtype}")
        # positions of 0.3 m in float32 over a step of 1 ms: 2e-8 m / 1e-3 s = 2e-5 m/s
        require_close(got.double(), exact, 1e-4, "velocities in float32")


class GraspContract(BoundaryContract):
    """What the layer relies on in a boundary that carries vertices along a trajectory. Override ``make``, ``held``."""

    @abstractmethod
    def gripped_vertices(self) -> list[int]:
        """Return the vertices that the grasp carries."""

    def _pose(self) -> Tensor:
        return self._travel()

    def test_is_driven(self) -> None:
        """The layer refuses to run without a trajectory."""
        require(type(self._boundary()).is_prescribed, "a grasp must declare is_prescribed = True")

    def test_held_vertices_follow_the_pose_exactly(self) -> None:
        """Gripped vertices do not drift over many substeps, whatever the rest of the cloth does."""
        boundary = self._boundary()
        pose, gripped = self._pose(), self.gripped_vertices()
        motion = self._prescribe(pose)
        x, v = self.sample()
        start, wild = x[gripped], v
        for k in range(self.substeps):
            v = boundary.constrain(x, v + 0.1 * wild, self.dt, motion, k)
            x = x + self.dt * v
        turn = pose[-1, :3, :3] @ pose[0, :3, :3].mT
        expected = (start - pose[0, :3, 3]) @ turn.mT + pose[-1, :3, 3]
        require_close(x[gripped], expected, 1e-12, "held vertices do not follow the pose")

    def test_says_what_it_holds(self) -> None:
        """It names the gripped vertices while it is closed, and none while it is open."""
        boundary, pose = self._boundary(), self._pose()
        index = boundary.prescribed_vertices(self._prescribe(pose), 0)
        require(
            index is not None and sorted(index.tolist()) == sorted(self.gripped_vertices()),
            "prescribed_vertices() names other vertices",
        )
        require(
            boundary.prescribed_vertices(self._prescribe(pose, False), 0) is None, "an open gripper says that it holds"
        )

    def test_an_open_gripper_lets_go(self) -> None:
        """An open gripper leaves velocities unchanged."""
        x, v = self.sample()
        after = self._boundary().constrain(x, v, self.dt, self._prescribe(self._pose(), False), 0)
        require(torch.equal(after, v), "an open gripper changes the cloth")
