"""torchcloth as a contestant, with one of its engines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import cast

import torch
from torch import Tensor

import torchcloth as tc

from .cases import SUBSTEP_S, Scene, build_scene
from .contestant import TANGENT_DIRECTIONS, Contestant, Outcome, Task

MAX_SUBSTEP_S = SUBSTEP_S * (1 + 1e-6)  # because frame times are rounded


class TorchclothContestant(Contestant):
    """A cloth in float32."""

    def __init__(self, engine: str, threads: int) -> None:
        self.engine = engine
        self.threads = 1 if engine == "reference" else threads  # small torch operations: a second thread only waits
        torch.set_num_threads(self.threads)

    def prepare(self, task: Task) -> Callable[[], Outcome]:
        """Build the cloth; there are 25 frames a second, as a user may ask for."""
        scene = build_scene(task.build_case(), self.engine, task.substeps, task.batch)
        return {"forward": _forward, "gradient": _gradient, "tangents8": _tangents}[task.quantity](scene)


def _forward(scene: Scene) -> Callable[[], Outcome]:
    def run() -> Outcome:
        with torch.no_grad():
            return _outcome(end_positions(scene, scene.x, scene.motion))

    return run


def _gradient(scene: Scene) -> Callable[[], Outcome]:
    def run() -> Outcome:
        x = scene.x.clone().requires_grad_()
        poses = {name: path.pose.clone().requires_grad_() for name, path in scene.motion.items()}
        motion = {name: path._replace(pose=poses[name]) for name, path in scene.motion.items()}
        youngs = cast("tc.PhysicalParameter", scene.cloth.material.youngs_modulus)
        end = end_positions(scene, x, motion)
        loss = (end**2).mean()
        gradient_x, by_raw, *by_pose = torch.autograd.grad(loss, [x, youngs.raw, *poses.values()])
        gradient_youngs = float(by_raw / youngs.value.detach())  # raw is the logarithm
        extra = tuple(g.numpy() for g in by_pose)
        return _outcome(end.detach())._replace(
            loss=float(loss.detach()), gradient_x=_first(gradient_x), gradient_youngs=gradient_youngs, extra=extra
        )

    return run


def _tangents(scene: Scene) -> Callable[[], Outcome]:
    raws = {name: raw for name, raw in scene.cloth.named_parameters() if _counts(scene.cloth, name, raw)}
    mixing = torch.randn(TANGENT_DIRECTIONS, len(raws), generator=torch.Generator().manual_seed(0), dtype=scene.x.dtype)

    def run() -> Outcome:
        x, tangent = tangents(scene, raws, mixing)
        return _outcome(x)._replace(extra=(tangent.numpy(),))

    return run


def tangents(scene: Scene, raws: Mapping[str, Tensor], directions: Tensor) -> tuple[Tensor, Tensor]:
    """End [V, 3] m, and the frames' derivatives [K, T, V, 3] along ``directions`` [K, unconstrained parameters]."""
    along = tc.Directions({name: column.contiguous() for name, column in zip(raws, directions.T, strict=True)})
    state = scene.cloth.state(scene.x)
    rollout, moved = scene.cloth.sensitivities(state, scene.motion, scene.times, along=along, dt=MAX_SUBSTEP_S)
    return rollout.x[-1].clone(), moved.x


def _counts(cloth: tc.Cloth, name: str, raw: Tensor) -> bool:
    """Scalar parameters that the model feels."""
    director = name.split(".")[1:2] in (["contact_stiffness"], ["shear_stiffness"], ["cone"])
    return raw.ndim == 0 and not (director and cloth.contact is None)


def end_positions(scene: Scene, x: Tensor, motion: dict[str, tc.Trajectory]) -> Tensor:
    """Return the positions [..., V, 3] m at the end of a simulation from ``x``."""
    return scene.cloth(scene.cloth.state(x), motion, scene.times, dt=MAX_SUBSTEP_S).x.select(-3, -1)


def _outcome(end: Tensor) -> Outcome:
    return Outcome(_first(end))


def _first(field: Tensor):
    return field.reshape(-1, *field.shape[-2:])[0].numpy()
