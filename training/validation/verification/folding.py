"""A cloth of half a metre that is folded in half and in quarter on a table, by hands that turn its edge over."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth._utils.torch_modes import default_dtype
from torchcloth.dynamics.contact import FOLD_PATH_RATIO
from torchcloth.meshes import Mesh

from .case_figures import COLOUR_CYCLE, plot_mesh
from .registry import AT_LEAST_TRUTH, AT_MOST_TRUTH, FigureData, Outcome, Row, register_case
from .scenes import indices_where, smooth_step, translation_trajectory

TOWEL_SIDE_M, TOWEL_NODES, LAYER_GAP_M = 0.5, 57, 0.0035
FIRST_FOLD_S, SECOND_FOLD_S = (0.0, 0.73), (1.05, 1.3)  # start and duration
RELEASE_DELAY_S = 0.05  # after a fold
FRAME_TIMES_S = (0.0, 0.4, 0.6, 0.78, 1.05, 1.57, 1.96, 2.16, 2.25, 2.35, 2.55, 2.75)
# Gaps are not measured near a crease, which is a loop, nor near an edge of the cloth.
CREASE_MARGIN_M, EDGE_MARGIN_M = 0.05, 0.01
VERTICAL_SPACING_M = 6e-3  # of the lines on which gaps are measured
VERTICAL_OFFSET_M = (1.0e-5, 1.7e-5)  # so that no line meets an edge of the undeformed mesh
SECTION_X_M = 0.12  # of the drawn section


def make_towel() -> tc.Cloth:
    """Return a cloth on a table: Y = 300 N/m, k h = 60 N/m, 0.2 kg/m^2, B = 1e-5 N m."""
    mesh = tc.meshes.rectangle(TOWEL_SIDE_M, TOWEL_SIDE_M, resolution=(TOWEL_NODES, TOWEL_NODES))
    u, v = np.asarray(mesh.uv).T
    edges = {"left": u < 1e-9, "right": u > TOWEL_SIDE_M - 1e-9, "back": v > TOWEL_SIDE_M - 1e-9}
    grasps = {name: tc.boundaries.Grasp(indices_where(edge)) for name, edge in edges.items()}
    return tc.Cloth(
        mesh,
        tc.materials.AEP(3e5, 0.3, contact_stiffness=6e4, shear_stiffness=2e4, cone=0.3, thickness=1e-3),
        0.2,
        {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2), "bending": tc.effects.Bending(1e-5, 0.01)},
        grasps | {"table": tc.boundaries.Plane(friction=0.6)},
        tc.Contact.with_gap(LAYER_GAP_M),
    )


def fold_over_trajectory(
    t: Tensor,
    start: float,
    duration: float,
    direction: int,
    layers: int,
    slack: float,
    crease_allowance: float,
    stack_allowance: float = 0.0,
) -> tc.Trajectory:
    """Return the trajectory of a hand that turns the far edge over about the middle line, like a page.

    Args:
        t: [K] s, knots.
        start: s.
        duration: s.
        direction: axis along which the edge moves: 0 or 1.
        layers: that are turned over, and on which they come to rest.
        slack: fraction of the radius by which the arc is shorter at its top. A taut cloth would be dragged over the
            table.
        crease_allowance: m, of cloth that is left to the crease at the end.
        stack_allowance: m, by which the hand opens above the stack. The hand also holds the loop of the earlier crease,
            which is thicker than two layers and would be pressed through the ones below.
    """
    turn = math.pi * smooth_step((t - start) / duration)
    radius, progress = TOWEL_SIDE_M / 2 * (1 - slack * turn.sin()), turn / math.pi
    pose = torch.eye(4).repeat(len(t), 1, 1)
    pose[:, direction, direction] = pose[:, 2, 2] = turn.cos()
    pose[:, 2, direction], pose[:, direction, 2] = turn.sin(), -turn.sin()
    pose[:, direction, 3] = TOWEL_SIDE_M / 2 + (radius - TOWEL_SIDE_M) * turn.cos() + crease_allowance * progress
    stack = (2 * layers - 1) * LAYER_GAP_M + stack_allowance
    pose[:, 2, 3] = (radius - TOWEL_SIDE_M) * turn.sin() + stack * progress
    return tc.Trajectory(t, pose, (t >= start) & (t < start + duration + RELEASE_DELAY_S))


def intersect_verticals(x: np.ndarray, mesh: Mesh, places: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield where vertical lines at places [N, 2] m meet the cloth, from the lowest up.

    Yields:
        Heights [K] m and pattern coordinates [K, 2] m for each line.
    """
    uv = np.asarray(mesh.uv)
    a, b, c = (x[mesh.faces[:, k]] for k in range(3))
    e1, e2 = (b - a)[:, :2], (c - a)[:, :2]
    double_area = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    double_area[np.abs(double_area) < 1e-14] = np.nan  # a vertical triangle is never met
    for point in places:
        d = point - a[:, :2]
        s = (d[:, 0] * e2[:, 1] - d[:, 1] * e2[:, 0]) / double_area
        t = (e1[:, 0] * d[:, 1] - e1[:, 1] * d[:, 0]) / double_area
        hit = np.flatnonzero((s >= 0) & (t >= 0) & (s + t < 1))
        weights = np.stack([1 - s - t, s, t], -1)[hit, :, None]
        height = (weights[..., 0] * x[mesh.faces[hit], 2]).sum(1)
        order = np.argsort(height)
        yield height[order], (weights * uv[mesh.faces[hit]]).sum(1)[order]


def measure_gaps(x: np.ndarray, mesh: Mesh, quarter: bool) -> tuple[np.ndarray, int]:
    """Measure the gaps between layers on vertical lines away from the creases.

    Returns:
        Gaps [N, layers - 1] m on the lines with all layers in order, and the number of the other lines.
    """
    across_fold = np.arange(EDGE_MARGIN_M, TOWEL_SIDE_M / 2 - CREASE_MARGIN_M, VERTICAL_SPACING_M)
    along_fold = np.arange(EDGE_MARGIN_M, TOWEL_SIDE_M - EDGE_MARGIN_M, VERTICAL_SPACING_M)
    places = np.stack(np.meshgrid(across_fold, across_fold if quarter else along_fold), -1).reshape(-1, 2)
    order = np.array([0, 1, 3, 2] if quarter else [0, 1])  # quadrants u > half + 2 (v > half), upwards
    gaps, wrong = [], 0
    for height, uv in intersect_verticals(x, mesh, places + VERTICAL_OFFSET_M):
        quadrant = (uv[:, 0] > TOWEL_SIDE_M / 2) + 2 * (quarter & (uv[:, 1] > TOWEL_SIDE_M / 2))
        if np.array_equal(quadrant, order):
            gaps.append(np.diff(height))
        else:
            wrong += 1
    return np.array(gaps).reshape(-1, len(order) - 1), wrong


def crossing_distances(x: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Return the distances in the pattern [N] m between edges and the triangles that they penetrate.

    Matter would have none (Moeller and Trumbore 1997).
    """
    from scipy.spatial import KDTree

    sides = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges = np.unique(np.sort(sides, axis=1), axis=0)
    corners, ends = x[mesh.faces], x[edges]
    centre, middle = corners.mean(1), ends.mean(1)
    reach = sum(np.linalg.norm(part, axis=-1).max() for part in (corners - centre[:, None], ends[:, 0] - middle))
    near = KDTree(middle).query_ball_point(centre, reach)
    f, e = np.repeat(np.arange(len(near)), [len(k) for k in near]), np.concatenate(near).astype(int)
    is_disjoint = (mesh.faces[f][:, :, None] != edges[e][:, None]).all((1, 2))
    f, e = f[is_disjoint], e[is_disjoint]
    origin, along = ends[e, 0], ends[e, 1] - ends[e, 0]
    first, second = corners[f, 1] - corners[f, 0], corners[f, 2] - corners[f, 0]
    p, offset = np.cross(along, second), origin - corners[f, 0]
    volume = (first * p).sum(-1)
    volume[np.abs(volume) < 1e-18] = np.nan  # parallel
    s, q = (offset * p).sum(-1) / volume, np.cross(offset, first)
    t, along_edge = (along * q).sum(-1) / volume, (second * q).sum(-1) / volume
    hit = (s >= 0) & (t >= 0) & (s + t <= 1) & (along_edge >= 0) & (along_edge <= 1)
    uv = np.asarray(mesh.uv)
    return np.linalg.norm(uv[edges[e[hit]]].mean(1) - uv[mesh.faces[f[hit]]].mean(1), axis=-1)


def section(x: np.ndarray, mesh: Mesh, direction: int, position: float) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the section of the cloth with a vertical plane, triangle by triangle.

    Yields:
        Segment [2, 2] m (along ``direction`` and height), and quadrant of the pattern.
    """
    for face in mesh.faces:
        side = x[face, 1 - direction] - position
        crossed = [(i, j) for i, j in ((0, 1), (1, 2), (2, 0)) if (side[i] > 0) != (side[j] > 0)]
        if crossed:
            p = [x[face[i]] + (x[face[j]] - x[face[i]]) * side[i] / (side[i] - side[j]) for i, j in crossed]
            u, v = np.asarray(mesh.uv)[face].mean(0) > TOWEL_SIDE_M / 2
            yield np.array(p)[:, [direction, 2]], int(u) + 2 * int(v)


def draw_folds(figure: Any, data: FigureData) -> None:
    """Draw four frames, and below them a section through the four layers."""
    top, bottom = figure.subfigures(2, 1, height_ratios=(2, 1))
    for k, name in enumerate(name for name in data if name.endswith(" s")):
        axis = top.add_subplot(1, 4, k + 1, projection="3d")
        axis.view_init(elev=22, azim=-60)
        plot_mesh(axis, data[name], data["faces"], name)
    axis = bottom.subplots()
    for (along, height), quadrant in zip(1e3 * data["section"].transpose(0, 2, 1), data["quadrant"], strict=True):
        axis.plot(along, height, color=COLOUR_CYCLE[quadrant], lw=1)
    axis.set(xlabel="across the second crease, y [mm]", ylabel="z [mm]", ylim=(-1, None))


def gap_rows(name: str, x: np.ndarray, mesh: Mesh) -> list[Row]:
    """Return the rows of one stack: "half" or "quarter"."""
    gap, wrong = measure_gaps(x, mesh, name == "quarter")
    gap = 1e3 * gap
    return [
        Row(f"{name}: vertical lines on which layers are missing or out of order", wrong, 0.0, tolerance=AT_MOST_TRUTH),
        Row(f"{name}: gap per layer, mean", float(gap.mean()), 5.0, "mm", AT_MOST_TRUTH),
        Row(f"{name}: gap per layer, smallest", float(gap.min()), 0.0, "mm", AT_LEAST_TRUTH),
        Row(f"{name}: gap per layer, 95th percentile", float(np.percentile(gap, 95)), unit="mm", finding=True),
        Row(f"{name}: gap per layer, largest", float(gap.max()), unit="mm", finding=True),
    ]


def simulate_folding() -> tuple[tc.Cloth, Sequence[np.ndarray], float]:
    """Return the cloth, its positions [V, 3] m at ``FRAME_TIMES_S``, and the hands' top speed [m/s]."""
    with default_dtype(torch.float32), torch.no_grad():  # half the time, the same layers
        cloth, end = make_towel(), FRAME_TIMES_S[-1]
        t = torch.linspace(0, end, 4 * round(100 * end) + 1)
        motion = {
            "left": translation_trajectory(t, torch.zeros(len(t), 3), t < sum(FIRST_FOLD_S) + RELEASE_DELAY_S),
            "right": fold_over_trajectory(t, *FIRST_FOLD_S, 0, 1, slack=0.05, crease_allowance=0.004),
            "back": fold_over_trajectory(
                t, *SECOND_FOLD_S, 1, 2, slack=0.15, crease_allowance=0.004, stack_allowance=0.004
            ),
        }
        out = cloth(cloth.rest_state(), motion, times=FRAME_TIMES_S)
        edge = motion["right"].pose[:, :3, 3] + TOWEL_SIDE_M * motion["right"].pose[:, :3, 0]
        speed = float((edge.diff(dim=0).norm(dim=-1) / t.diff()).max())
    return cloth, out.x.double().numpy(), speed


@register_case(
    "fold-half-a-metre",
    "Cloth of 0.5 m folded in half and in quarter on a table",
    truth="impenetrability: layers rest on each other in order, at the stated gap, and never go through each other",
    draw=draw_folds,
    fast=False,
)
def fold_half_a_metre(fast: bool) -> Outcome:
    """Fold the right edge onto the left one, then the back edge of both layers, and measure gaps and crossings."""
    cloth, x, speed = simulate_folding()
    mesh, grid = cloth.mesh, cloth.contact_grid()
    assert grid is not None
    # contact acts between points of triangles that are farther apart in the pattern
    blind_range = FOLD_PATH_RATIO * grid.reach + mesh.mean_edge
    distances = [crossing_distances(frame, mesh) for frame in x]
    rows = [
        *gap_rows("half", x[FRAME_TIMES_S.index(SECOND_FOLD_S[0])], mesh),
        *gap_rows("quarter", x[-1], mesh),
        Row(
            "crossings of layers, edges through triangles in any frame",
            max(int((d > blind_range).sum()) for d in distances),
            0.0,
            tolerance=AT_MOST_TRUTH,
        ),
        Row(
            "the same within a crease, where contact does not act",
            max(int((d <= blind_range).sum()) for d in distances),
            finding=True,
        ),
        Row("top speed of the hands", speed, unit="m/s", finding=True),
    ]
    segments, quadrants = zip(*section(x[-1], mesh, 1, SECTION_X_M), strict=True)
    frames = {f"{FRAME_TIMES_S[k]:.2f} s": x[k] for k in (2, 4, 6, -1)}
    note = (
        f"Contact gap {1e3 * LAYER_GAP_M:g} mm, {len(mesh.faces)} triangles, k h = 60 N/m, Y = 300 N/m, 0.2 kg/m², "
        f"B = 1e-5 N m, in single precision. Gaps are measured on vertical lines every 6 mm, at least "
        f"{1e3 * CREASE_MARGIN_M:g} mm from the creases. Contact does not act within {1e3 * blind_range:.0f} mm along "
        "the cloth. Below: section at x = 120 mm."
    )
    return Outcome(
        rows, {**frames, "faces": mesh.faces, "section": np.array(segments), "quadrant": np.array(quadrants)}, note
    )
