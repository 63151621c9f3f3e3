"""torchcloth follows a recording with a cloth on a mesh of its own; distances from the truth."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth import Cloth, effects, materials, meshes, recordings
from torchcloth.episodes.replay import Replay
from torchcloth.identification import Identification, build_cloth, build_episode, identify
from torchcloth.losses import closest

Array = np.ndarray
FITTED = ("youngs_modulus", "poisson_ratio", "bending.stiffness", "bending.damping_time")


@dataclass(frozen=True)
class Values:
    """Parameters of the base model, as a fit or the truth has them: N/m, -, N m, s."""

    membrane_stiffness: float
    poisson_ratio: float
    bending_stiffness: float
    damping_time: float

    @classmethod
    def true(cls, folder: Path) -> Values:
        """Those that the generator wrote beside an episode."""
        scene = json.loads(folder.with_name(f"{folder.name}.hidden.json").read_text())["scene"]
        sheet, plate = scene["sheet"], scene["plate"]
        return cls(sheet["membrane_stiffness"], sheet["poisson_ratio"], plate["stiffness"], plate["damping_time"])

    @classmethod
    def of(cls, fit: Identification) -> Values:
        """Those that a fit found."""
        names = ("membrane_stiffness", "poisson_ratio", "bending.stiffness", "bending.damping_time")
        return cls(*(fit.parameters[name].value for name in names))


def load(folder: Path, nodes: int) -> recordings.Recording:
    """An episode whose cloth is meshed with ``nodes`` vertices along each side, instead of with the recorded mesh."""
    recording = recordings.read(folder, with_truth=True)
    cloth = recording.cloth
    recorded = meshes.Mesh.build(cloth.vertices, cloth.faces, cloth.uv)
    width, height = cloth.uv.max(0)
    mesh = meshes.rectangle(width, height, resolution=(nodes, nodes))
    first = carry(recorded, mesh.uv, cloth.initial_vertices[None])[0]
    changed = replace(cloth, vertices=mesh.vertices, faces=mesh.faces, uv=mesh.uv, initial_vertices=first)
    return replace(recording, cloth=changed)


def carry(mesh: meshes.Mesh, uv: Array, frames: Array) -> Array:
    """Positions [T, N, 3] m of the pattern points [N, 2] on frames [T, V, 3] of a mesh that is flat in its pattern."""
    at = torch.as_tensor(np.column_stack([uv, np.zeros(len(uv))]))
    flat = torch.as_tensor(np.column_stack([mesh.uv, np.zeros(len(mesh.uv))]))
    return closest(at, flat, torch.as_tensor(mesh.faces)).on(torch.as_tensor(frames)).numpy()


def cloth(recording: recordings.Recording, values: Values) -> Cloth:
    """The base model: A-EP membrane, bending, gravity, and what the recording says of grasps and table."""
    thickness = recording.cloth.thickness or 1e-3
    law = materials.AEP(values.membrane_stiffness / thickness, values.poisson_ratio, thickness=thickness)
    parts = {
        "gravity": effects.Gravity(recording.gravity.tolist()),
        "bending": effects.Bending(values.bending_stiffness, values.damping_time),
    }
    return build_cloth(recording, law, parts)


def fit(folders: list[Path], nodes: int, start: Values, on_progress: Any) -> Identification:
    """Base parameters from several effect-free recordings together."""
    found = [load(folder, nodes) for folder in folders]
    # from the true values: the question is what the best fit leaves, not whether a bad start finds it
    return identify(cloth(found[0], start), found, FITTED, on_progress=on_progress, iterations=6, warm_start=True)


@dataclass(frozen=True)
class Distance:
    """Of a simulated motion from the true one.

    Attributes:
        material: m, root mean square over the same material points and all frames.
        surface: m, root mean square distance of the true vertices from the simulated surface.
        frames: [T] m, the first, frame by frame.
        places: [N] m, the first, vertex by vertex of the truth's grid.
    """

    material: float
    surface: float
    frames: Array
    places: Array


def compare(recording: recordings.Recording, values: Values) -> Distance:
    """Simulate a recording with given parameters and measure the distance from its truth."""
    truth, model = recording.truth, cloth(recording, values)
    uv = pattern(recording)
    seen = replace(
        recording,
        points=recordings.PointClouds(truth.t, truth.vertices.reshape(-1, 3), np.full(len(truth.t), len(uv))),
    )
    with torch.no_grad():
        x = Replay(model)(build_episode(model, seen)).x
    error = np.linalg.norm(carry(model.mesh, uv, x.numpy()) - truth.vertices, axis=-1)
    faces, off = torch.as_tensor(model.mesh.faces), []
    for at, points in zip(x[::4], torch.as_tensor(truth.vertices[::4]), strict=True):
        off.append((points - closest(points, at, faces).on(at)).norm(dim=-1))
    return Distance(
        float(np.sqrt((error**2).mean())),
        float((torch.cat(off) ** 2).mean().sqrt()),
        np.sqrt((error**2).mean(1)),
        np.sqrt((error**2).mean(0)),
    )


def between(first: recordings.Recording, second: recordings.Recording) -> float:
    """Root mean square distance [m] of the same material points in two truths on different meshes."""
    uv = pattern(second)
    mesh = meshes.Mesh.build(np.column_stack([uv, 0 * uv[:, 0]]), second.truth.faces, uv)
    moved = carry(mesh, pattern(first), second.truth.vertices) - first.truth.vertices
    return float(np.sqrt((moved**2).sum(-1).mean()))


def pattern(recording: recordings.Recording) -> Array:
    """Pattern coordinates [N, 2] m of the truth's vertices: a grid, v slowest."""
    nu, nv = (int(n) for n in recording.truth.extra["nodes"])
    width, height = recording.cloth.uv.max(0)
    v, u = np.meshgrid(np.linspace(0, height, nv), np.linspace(0, width, nu), indexing="ij")
    return np.stack([u.ravel(), v.ravel()], 1)
