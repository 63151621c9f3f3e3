"""A cloth of half a metre folded in half and in quarter on a table, by hands that turn its edge over."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

import torchcloth as tc
from torchcloth.meshes import Mesh

from .case_figures import CYCLE, sheet
from .registry import AT_LEAST, AT_MOST, Outcome, Row, case
from .scenes import path, smooth, where

SIZE, N, GAP = 0.5, 57, 0.0035  # m, vertices per side, m
HALF, QUARTER = (0.0, 0.73), (1.05, 1.3)  # s, when an edge is turned over, and how long that takes
RELEASED = 0.05  # s after the turn
FRAMES = (0.0, 0.4, 0.6, 0.78, 1.05, 1.57, 1.96, 2.16, 2.25, 2.35, 2.55, 2.75)
NEAR_CREASE, NEAR_EDGE = 0.05, 0.01  # m, where no spacing is taken: the loop of a crease, the last millimetres
ASIDE = (1.0e-5, 1.7e-5)  # m, so that no vertical meets an edge of a mesh that lies as it was made


@contextmanager
def single_precision() -> Iterator[None]:
    """Half the time; the layers do not notice."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def towel() -> tc.Cloth:
    """Y = 300 N/m, k h = 60 N/m, 0.2 kg/m^2, B = 1e-5 N m on a table."""
    mesh = tc.meshes.rectangle(SIZE, SIZE, resolution=(N, N))
    u, v = mesh.uv.T
    edges = {"left": u < 1e-9, "right": u > SIZE - 1e-9, "back": v > SIZE - 1e-9}
    return tc.Cloth(
        mesh,
        tc.materials.AEP(3e5, 0.3, 6e4, 2e4, 0.3, 1e-3),
        0.2,
        {"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2), "bending": tc.effects.Bending(1e-5, 0.01)},
        {name: tc.boundaries.Grasp(where(edge)) for name, edge in edges.items()}
        | {"table": tc.boundaries.Plane(friction=0.6)},
        tc.Contact.with_gap(GAP),
    )


def turned_over(
    t: Tensor, when: tuple[float, float], direction: int, layers: int, slack: float, short: float, above: float = 0.0
) -> tc.Trajectory:
    """The far edge of so many layers carried about the middle line like a page, to rest on as many.

    ``slack`` shortens the arc at its top, as a share of the radius: a taut cloth would be dragged over the table.
    ``short`` [m] is left to the crease at the end. ``above`` [m] the stack the hand opens: the loop of an earlier
    crease, which it holds too, is thicker than two layers and would be pressed through the ones below.
    """
    start, duration = when
    turn = math.pi * smooth((t - start) / duration)
    radius, done = SIZE / 2 * (1 - slack * turn.sin()), turn / math.pi
    pose = torch.eye(4).repeat(len(t), 1, 1)
    pose[:, direction, direction] = pose[:, 2, 2] = turn.cos()
    pose[:, 2, direction], pose[:, direction, 2] = turn.sin(), -turn.sin()
    pose[:, direction, 3] = SIZE / 2 + (radius - SIZE) * turn.cos() + short * done
    pose[:, 2, 3] = (radius - SIZE) * turn.sin() + ((2 * layers - 1) * GAP + above) * done
    return tc.Trajectory(t, pose, (t >= start) & (t < start + duration + RELEASED))


def on_verticals(x: np.ndarray, mesh: Mesh, at: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Where the verticals at ``at`` [N, 2] m meet the cloth: (heights [K], pattern coordinates [K, 2]), upwards."""
    a, b, c = (x[mesh.faces[:, k]] for k in range(3))
    e1, e2 = (b - a)[:, :2], (c - a)[:, :2]
    twice = e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]
    twice[np.abs(twice) < 1e-14] = np.nan  # a triangle on edge is never met
    for point in at:
        d = point - a[:, :2]
        s = (d[:, 0] * e2[:, 1] - d[:, 1] * e2[:, 0]) / twice
        t = (e1[:, 0] * d[:, 1] - e1[:, 1] * d[:, 0]) / twice
        met = np.flatnonzero((s >= 0) & (t >= 0) & (s + t < 1))
        share = np.stack([1 - s - t, s, t], -1)[met, :, None]
        height = (share[..., 0] * x[mesh.faces[met], 2]).sum(1)
        order = np.argsort(height)
        yield height[order], (share * mesh.uv[mesh.faces[met]]).sum(1)[order]


def spacings(x: np.ndarray, mesh: Mesh, quarter: bool) -> tuple[np.ndarray, int]:
    """(spacings [N, layers - 1] m on verticals every 6 mm away from the creases, number of those out of order)."""
    within = [np.arange(NEAR_EDGE, SIZE / 2 - NEAR_CREASE, 6e-3)] * 2
    if not quarter:
        within[1] = np.arange(NEAR_EDGE, SIZE - NEAR_EDGE, 6e-3)
    order = np.array([0, 1, 3, 2] if quarter else [0, 1])  # quadrants u > half + 2 (v > half), upwards
    found, wrong = [], 0
    for height, uv in on_verticals(x, mesh, np.stack(np.meshgrid(*within), -1).reshape(-1, 2) + ASIDE):
        quadrant = (uv[:, 0] > SIZE / 2) + 2 * (quarter & (uv[:, 1] > SIZE / 2))
        if np.array_equal(quadrant, order):
            found.append(np.diff(height))
        else:
            wrong += 1
    return np.array(found).reshape(-1, len(order) - 1), wrong


def crossings(x: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Ways along the cloth [m] between edges and triangles that they go through: matter would have none."""
    from scipy.spatial import cKDTree

    sides = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    edges = np.unique(np.sort(sides, axis=1), axis=0)
    corners, ends = x[mesh.faces], x[edges]
    centre, middle = corners.mean(1), ends.mean(1)
    reach = sum(np.linalg.norm(part, axis=-1).max() for part in (corners - centre[:, None], ends[:, 0] - middle))
    near = cKDTree(middle).query_ball_point(centre, reach)
    f, e = np.repeat(np.arange(len(near)), [len(k) for k in near]), np.concatenate(near).astype(int)
    apart = (mesh.faces[f][:, :, None] != edges[e][:, None]).all((1, 2))
    f, e = f[apart], e[apart]
    origin, along = ends[e, 0], ends[e, 1] - ends[e, 0]
    first, second = corners[f, 1] - corners[f, 0], corners[f, 2] - corners[f, 0]
    aside, off = np.cross(along, second), origin - corners[f, 0]
    volume = (first * aside).sum(-1)
    volume[np.abs(volume) < 1e-18] = np.nan  # parallel (Moeller and Trumbore 1997)
    s, turned = (off * aside).sum(-1) / volume, np.cross(off, first)
    t, way = (along * turned).sum(-1) / volume, (second * turned).sum(-1) / volume
    hit = (s >= 0) & (t >= 0) & (s + t <= 1) & (way >= 0) & (way <= 1)
    return np.linalg.norm(mesh.uv[edges[e[hit]]].mean(1) - mesh.uv[mesh.faces[f[hit]]].mean(1), axis=-1)


def cut(x: np.ndarray, mesh: Mesh, direction: int, at: float) -> Iterator[tuple[np.ndarray, int]]:
    """The cloth cut by a vertical plane: (segment [2, 2] m of way and height, quadrant) of every triangle met."""
    for face in mesh.faces:
        side = x[face, 1 - direction] - at
        crossed = [(i, j) for i, j in ((0, 1), (1, 2), (2, 0)) if (side[i] > 0) != (side[j] > 0)]
        if crossed:
            p = [x[face[i]] + (x[face[j]] - x[face[i]]) * side[i] / (side[i] - side[j]) for i, j in crossed]
            u, v = mesh.uv[face].mean(0) > SIZE / 2
            yield np.array(p)[:, [direction, 2]], int(u) + 2 * int(v)


def draw_folds(figure, data) -> None:
    """Four moments; below, the cut through the four layers."""
    top, bottom = figure.subfigures(2, 1, height_ratios=(2, 1))
    for k, name in enumerate(name for name in data if name.endswith(" s")):
        axis = top.add_subplot(1, 4, k + 1, projection="3d")
        axis.view_init(elev=22, azim=-60)
        sheet(axis, data[name], data["faces"], name)
    axis = bottom.subplots()
    for (way, height), quadrant in zip(1e3 * data["cut"].transpose(0, 2, 1), data["quadrant"], strict=True):
        axis.plot(way, height, color=CYCLE[quadrant], lw=1)
    axis.set(xlabel="across the second crease, y [mm]", ylabel="z [mm]", ylim=(-1, None))


def judged(name: str, x: np.ndarray, mesh: Mesh) -> list[Row]:
    """Rows of one stack."""
    gap, wrong = spacings(x, mesh, name == "quarter")
    gap = 1e3 * gap
    return [
        Row(f"{name}: verticals on which layers are missing or out of order", wrong, 0.0, mark=AT_MOST),
        Row(f"{name}: gap per layer, mean", float(gap.mean()), 5.0, "mm", AT_MOST),
        Row(f"{name}: gap per layer, least", float(gap.min()), 0.0, "mm", AT_LEAST),
        Row(f"{name}: gap per layer, exceeded on 5 %", float(np.percentile(gap, 95)), unit="mm", finding=True),
        Row(f"{name}: gap per layer, largest", float(gap.max()), unit="mm", finding=True),
    ]


def folded() -> tuple[tc.Cloth, Sequence[np.ndarray], float]:
    """(cloth, vertices at FRAMES, the hands' top speed [m/s])."""
    with single_precision(), torch.no_grad():
        cloth = towel()
        t = torch.linspace(0, FRAMES[-1], 4 * round(100 * FRAMES[-1]) + 1)
        motion = {
            "left": path(t, torch.zeros(len(t), 3), t < HALF[0] + HALF[1] + RELEASED),
            "right": turned_over(t, HALF, 0, 1, slack=0.05, short=0.004),
            "back": turned_over(t, QUARTER, 1, 2, slack=0.15, short=0.004, above=0.004),
        }
        out = cloth(cloth.rest_state(), motion, times=FRAMES)
        edge = motion["right"].pose[:, :3, 3] + SIZE * motion["right"].pose[:, :3, 0]
        speed = float((edge.diff(dim=0).norm(dim=-1) / t.diff()).max())
    return cloth, out.x.double().numpy(), speed


@case(
    "fold-half-a-metre",
    "Cloth of 0.5 m folded in half and in quarter on a table",
    truth="matter: layers rest on each other in order, at the stated gap, and never go through each other",
    draw=draw_folds,
    fast=False,
)
def fold_half_a_metre(fast: bool) -> Outcome:
    """The right edge is turned over onto the left one, which is held meanwhile; then both layers' back edge."""
    cloth, x, speed = folded()
    mesh, grid = cloth.mesh, cloth.grid()
    unseen = tc.dynamics.contact.TURNED * grid.reach + mesh.mean_edge  # contact acts between points of triangles
    ways = [crossings(frame, mesh) for frame in x]
    rows = [
        *judged("half", x[FRAMES.index(QUARTER[0])], mesh),
        *judged("quarter", x[-1], mesh),
        Row(
            "layers that cross, edges through triangles in any frame",
            max(int((w > unseen).sum()) for w in ways),
            0.0,
            mark=AT_MOST,
        ),
        Row(
            "the same within a crease, where contact does not look",
            max(int((w <= unseen).sum()) for w in ways),
            finding=True,
        ),
        Row("top speed of the hands", speed, unit="m/s", finding=True),
    ]
    segments, quadrants = zip(*cut(x[-1], mesh, 1, 0.12), strict=True)
    shown = {f"{FRAMES[k]:.2f} s": x[k] for k in (2, 4, 6, -1)}
    note = (
        f"Contact gap {1e3 * GAP:g} mm, {len(mesh.faces)} triangles, k h = 60 N/m, Y = 300 N/m, 0.2 kg/m², "
        f"B = 1e-5 N m, in single precision. Gaps on verticals every 6 mm, {1e3 * NEAR_CREASE:g} mm off the creases; "
        f"contact does not look within {1e3 * unseen:.0f} mm along the cloth. Below: cut at x = 120 mm."
    )
    return Outcome(
        rows, {**shown, "faces": mesh.faces, "cut": np.array(segments), "quadrant": np.array(quadrants)}, note
    )
