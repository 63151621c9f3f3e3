"""Simulate recordings of the independent engine with torchcloth, and measure the distance from the truth."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchcloth import Cloth, effects, materials, meshes, recordings
from torchcloth.episodes.replay import Replay
from torchcloth.errors import RecordingError
from torchcloth.identification import Identification, build_cloth, build_episode, identify
from torchcloth.losses import find_closest_points

Array = np.ndarray
FITTED_PARAMETERS = ("youngs_modulus", "poisson_ratio", "bending.stiffness", "bending.damping_time")


@dataclass(frozen=True)
class FabricValues:
    """Parameters of the base model.

    Attributes:
        membrane_stiffness: N/m.
        poisson_ratio: -.
        bending_stiffness: N m.
        damping_time: s, of bending.
    """

    membrane_stiffness: float
    poisson_ratio: float
    bending_stiffness: float
    damping_time: float

    @classmethod
    def from_truth(cls, folder: Path) -> FabricValues:
        """Read the true values of an episode, which the generator wrote into another file."""
        scene = json.loads(folder.with_name(f"{folder.name}.hidden.json").read_text())["scene"]
        sheet, plate = scene["sheet"], scene["plate"]
        return cls(sheet["membrane_stiffness"], sheet["poisson_ratio"], plate["stiffness"], plate["damping_time"])

    @classmethod
    def from_fit(cls, fit: Identification) -> FabricValues:
        """Take the values of a fit."""
        names = ("membrane_stiffness", "poisson_ratio", "bending.stiffness", "bending.damping_time")
        return cls(*(fit.parameters[name].value for name in names))


def read_remeshed(folder: Path, nodes: int) -> recordings.Recording:
    """Read an episode, with a mesh of ``nodes`` vertices along each side instead of the recorded one.

    Raises:
        RecordingError: the episode has no mesh with first positions.
    """
    recording = recordings.read(folder, with_truth=True)
    cloth = recording.cloth
    if cloth.vertices is None or cloth.faces is None or cloth.uv is None or cloth.initial_vertices is None:
        raise RecordingError(f"{folder}: no mesh with first positions")
    recorded = meshes.Mesh.build(cloth.vertices, cloth.faces, cloth.uv)
    width, height = cloth.uv.max(0)
    mesh = meshes.rectangle(width, height, resolution=(nodes, nodes))
    first = interpolate(recorded, np.asarray(mesh.uv), cloth.initial_vertices[None])[0]
    remeshed = replace(cloth, vertices=mesh.vertices, faces=mesh.faces, uv=mesh.uv, initial_vertices=first)
    return replace(recording, cloth=remeshed)


def interpolate(mesh: meshes.Mesh, uv: Array, frames: Array) -> Array:
    """Return the positions [T, N, 3] m of pattern points [N, 2] m on frames [T, V, 3] m of a mesh."""
    points = torch.as_tensor(np.column_stack([uv, np.zeros(len(uv))]))
    flat = torch.as_tensor(np.column_stack([np.asarray(mesh.uv), np.zeros(len(mesh.vertices))]))
    return find_closest_points(points, flat, torch.as_tensor(mesh.faces)).interpolate(torch.as_tensor(frames)).numpy()


def build_base_model(recording: recordings.Recording, values: FabricValues) -> Cloth:
    """Return the base model: A-EP membrane, bending, gravity, and the recording's grasps and table."""
    thickness = recording.cloth.thickness or 1e-3
    law = materials.AEP(values.membrane_stiffness / thickness, values.poisson_ratio, thickness=thickness)
    parts = {
        "gravity": effects.Gravity(recording.gravity.tolist()),
        "bending": effects.Bending(values.bending_stiffness, values.damping_time),
    }
    return build_cloth(recording, law, parts)


def fit_base_model(folders: list[Path], nodes: int, start: FabricValues, on_progress: Any) -> Identification:
    """Fit the base parameters to several effect-free recordings together.

    It starts from the true values. The question is what the best fit leaves, not whether a bad start finds it.
    """
    episodes = [read_remeshed(folder, nodes) for folder in folders]
    return identify(
        build_base_model(episodes[0], start),
        episodes,
        FITTED_PARAMETERS,
        on_progress=on_progress,
        iterations=6,
        warm_start=True,
        exact_bench=True,
    )


@dataclass(frozen=True)
class Distance:
    """Distance of a simulated motion from the true one.

    Attributes:
        material_rms: m, root mean square over the same material points and all frames.
        surface_rms: m, root mean square distance of the true vertices from the simulated surface.
        rms_by_frame: [T] m, of material points.
        rms_by_vertex: [N] m, of material points, by vertex of the truth's grid.
    """

    material_rms: float
    surface_rms: float
    rms_by_frame: Array
    rms_by_vertex: Array


def measure_distance(recording: recordings.Recording, values: FabricValues) -> Distance:
    """Simulate a recording with given parameters and measure the distance from its truth."""
    truth, model = recording.require("truth"), build_base_model(recording, values)
    uv = true_pattern(recording)
    at_true_times = replace(
        recording,
        points=recordings.PointClouds(truth.t, truth.vertices.reshape(-1, 3), np.full(len(truth.t), len(uv))),
    )
    with torch.no_grad():
        x = Replay(model)(build_episode(model, at_true_times)).x
    error = np.linalg.norm(interpolate(model.mesh, uv, x.numpy()) - truth.vertices, axis=-1)
    faces, surface_error = torch.as_tensor(model.mesh.faces), []
    for frame, points in zip(x[::4], torch.as_tensor(truth.vertices[::4]), strict=True):
        closest = find_closest_points(points, frame, faces).interpolate(frame)
        surface_error.append((points - closest).norm(dim=-1))
    return Distance(
        float(np.sqrt((error**2).mean())),
        float((torch.cat(surface_error) ** 2).mean().sqrt()),
        np.sqrt((error**2).mean(1)),
        np.sqrt((error**2).mean(0)),
    )


def measure_truth_distance(first: recordings.Recording, second: recordings.Recording) -> float:
    """Return the root mean square distance [m] of the same material points in two truths on different meshes."""
    uv, truth = true_pattern(second), second.require("truth")
    mesh = meshes.Mesh.build(np.column_stack([uv, 0 * uv[:, 0]]), truth.faces, uv)
    difference = interpolate(mesh, true_pattern(first), truth.vertices) - first.require("truth").vertices
    return float(np.sqrt((difference**2).sum(-1).mean()))


def true_pattern(recording: recordings.Recording) -> Array:
    """Return the pattern coordinates [N, 2] m of the truth's vertices: a grid, v slowest."""
    nu, nv = (int(n) for n in recording.require("truth").extra["nodes"])
    width, height = np.asarray(recording.cloth.uv).max(0)
    v, u = np.meshgrid(np.linspace(0, height, nv), np.linspace(0, width, nu), indexing="ij")
    return np.stack([u.ravel(), v.ravel()], 1)
