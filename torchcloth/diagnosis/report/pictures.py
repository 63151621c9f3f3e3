"""Pictures of a diagnosis: where and when the simulation is off, what the residuals ask for, what looks alike."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from ..data.binning import BLOCK_NAMES, BIN_SECONDS, BinnedResiduals
from ..decide.verdict import Diagnosis
from ..inference.comparison import HeldOutPrediction
from ..inference.confounding import correlate_scores
from ..inference.linearise import Linearisation
from ..inference.screening import ScoreTest
from ..unknown.missing_force import SURE, MotionForce, MissingForce
from .figure_layout import grid_shape, hide_unused_axes
from .wording import FLOORS, label_episodes

COLOURS = {"present": "#b0653a", "inconclusive": "#c9a227", "absent": "#1f6f8b", "unresolvable": "#bbbbbb"}
Own = Callable[[BinnedResiduals], Tensor]  # [C] bool, of the cells of an episode
MAPPED: dict[str, Own] = {  # what lies on the fabric, by what is shown of it
    "along the normal": lambda c: c.block == BLOCK_NAMES.index("points"),
    "upwards": lambda c: (c.block == BLOCK_NAMES.index("markers")) & (c.channel % 3 == 2),
}
FARTHEST = 2.2  # typical amplitudes that are shown
WIDE = 26  # letters of a title's line
UNSEEN = "#c4c4c4"


def draw_residual_maps(answer: Diagnosis) -> Any:
    """Mean misfit by part of the fabric (rows, from the pattern's top down) and time of every episode; mm, or grey.

    Of the points, along the normal; upwards of markers where there are none, and None where there are neither.
    """
    from matplotlib.figure import Figure

    found = answer.search
    both = (found.start.linearisation, found.end.linearisation)
    seen = [way for way, own in MAPPED.items() if all(any(own(c).any() for c in e.bins) for e in both)]
    if not seen:
        return None
    own = MAPPED[seen[0]]
    middles = _middles(both, own)
    before, after = (_maps(e, list(middles), own) for e in both)
    told = [f"{100 * u:.0f}, {100 * v:.0f}" for u, v in middles.values()]
    names, count = wrap_labels(answer.content), len(before)
    limit = max(float(np.nanquantile(np.abs(np.concatenate([m.ravel() for m in before])), 0.98)), 1e-6)
    rows = 2 if found.accepted else 1
    across, down = grid_shape(count)
    figure = Figure(figsize=(2.9 * across + 1.8, (2.8 * rows + 0.3) * down + 0.3), layout="constrained")
    axes = figure.subplots(rows * down, across, sharey=True, squeeze=False)
    for row, maps in enumerate((before, after)[:rows]):
        for k, field in enumerate(maps):
            axis = axes[k // across * rows + row, k % across]
            extent = (0, field.shape[1] * BIN_SECONDS, field.shape[0], 0)
            image = axis.imshow(field, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto", extent=extent)
            axis.set_facecolor(UNSEEN)
            axis.set_yticks(np.arange(len(told)) + 0.5, told, fontsize=6)
            axis.set_title(names[k] if row == 0 else "", fontsize=9, parse_math=False)
            if row == rows - 1:
                axis.set_xlabel("time, s")
        for axis in axes[row::rows, 0]:
            axis.set_ylabel(f"{('before', 'after')[row]}: part of the fabric,\nits middle u, v in cm", fontsize=9)
    hide_unused_axes(axes, count, rows)
    figure.colorbar(
        image,
        ax=axes,  # pyright: ignore[reportPossiblyUnbound]
        label=f"measured minus simulated, {seen[0]}, mm",
    )
    return figure


def wrap_labels(content: dict[str, Any]) -> list[str]:
    """What each episode's motion is called, with the episode's name where another has the same; folded."""
    return [textwrap.fill(text, WIDE) for text in label_episodes(content)]


def draw_scores(rows: Sequence[ScoreTest]) -> Any:
    """Amplitudes that the residuals ask for, in units of the typical one, with 95 % intervals and what matters."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    shown = [r for r in rows if r.total_std < float("inf")]
    figure = Figure(figsize=(7.5, 0.24 * len(shown) + 1.5), layout="constrained")
    axis = figure.subplots()
    for k, r in enumerate(reversed(shown)):
        typical, share = abs(r.hypothesis.typical), r.hypothesis.smallest_fraction
        sign = 1.0 if r.hypothesis.typical > 0 else -1.0
        axis.plot([-share, share], [k, k], color="#e6e6e6", lw=9, solid_capstyle="butt", zorder=0)
        asked = sign * r.amplitude / typical
        if abs(asked) > FARTHEST:  # beyond the picture
            axis.plot(np.copysign(FARTHEST - 0.05, asked), k, ">" if asked > 0 else "<", color=COLOURS[r.decision])
        axis.errorbar(asked, k, xerr=1.96 * r.total_std / typical, fmt="o", ms=4, color=COLOURS[r.decision])
    axis.set_yticks(range(len(shown)), [r.hypothesis.name for r in reversed(shown)], fontsize=8, parse_math=False)
    axis.set_xlim(-FARTHEST, FARTHEST)
    axis.set_ylim(-1, len(shown))
    axis.axvline(0, color="k", lw=0.6)
    axis.set_xlabel("amplitude over its typical value; grey band: too small to matter; arrows: beyond")
    handles = [Patch(color=colour, label=name) for name, colour in COLOURS.items()]
    figure.legend(handles=handles, fontsize=8, loc="outside upper center", ncols=len(handles), frameon=False)
    return figure


def draw_correlations(answer: Diagnosis) -> Any:
    """Absolute correlation of efficient scores: dark pairs cannot be told apart by these motions. None of nothing."""
    from matplotlib.figure import Figure

    start = answer.search.start
    visible = {r.hypothesis.name for r in answer.search.scores if r.decision != "unresolvable"}
    for cause in answer.content["causes"]:
        visible |= {cause["effect"], *cause["class"], *(r["effect"] for r in cause["rivals"])}
    index = [k for k, h in enumerate(start.linearisation.hypotheses) if h.name in visible]
    if not index:
        return None
    names = [start.linearisation.hypotheses[k].name for k in index]
    rho = correlate_scores(start).abs().numpy()[np.ix_(index, index)]
    figure = Figure(figsize=(0.28 * len(index) + 2.6, 0.28 * len(index) + 2.0), layout="constrained")
    axis = figure.subplots()
    shown = axis.imshow(rho, cmap="Blues", vmin=0, vmax=1)
    axis.set_xticks(range(len(names)), names, rotation=90, fontsize=7, parse_math=False)
    axis.set_yticks(range(len(names)), names, fontsize=7, parse_math=False)
    figure.colorbar(shown, ax=axis, label="|correlation|", shrink=0.7)
    return figure


def draw_held_out_rms(answer: Diagnosis, before: HeldOutPrediction, after: HeldOutPrediction | None) -> Any:
    """RMS of position cells over time, each motion predicted from the others; mm."""
    from matplotlib.figure import Figure

    names, source = wrap_labels(answer.content), answer.content["floor"]["source"]
    across, down = grid_shape(len(names))
    figure = Figure(figsize=(2.9 * across + 0.8, 2.5 * down), layout="constrained")
    grid = figure.subplots(down, across, sharey=True, squeeze=False)
    axes = grid.ravel()[: len(names)]
    for k, axis in enumerate(axes):
        for label, p, colour in (("base model", before, "#b0653a"), ("with causes", after, "#1f6f8b")):
            if p is not None:
                time, rms = _course(p, k)
                axis.plot(time, 1e3 * rms, color=colour, label=label)
        axis.axhline(1e3 * answer.search.noise_floor, color="#888888", ls=":", label=f"what {FLOORS[source]}")
        axis.set_title(names[k], fontsize=9, parse_math=False)
        axis.set_xlabel("time, s")
    axes[0].set_ylim(bottom=0)
    for row in grid:
        row[0].set_ylabel("held out, mm RMS")
    axes[0].legend(fontsize=8)
    hide_unused_axes(grid, len(names), 1)
    return figure


def draw_missing_force(found: MissingForce) -> Any:
    """Per motion, the missing force of its most certain stretch on the pattern, and how certain it is over time.

    Colour: along the cloth's normal, in share of its weight; arrows: along the cloth, where they are certain.
    """
    from matplotlib.figure import Figure

    count = len(found.motions)
    across_page, down = grid_shape(count)
    figure = Figure(figsize=(3.0 * across_page + 1.2, 4.6 * down), layout="constrained")
    grid = figure.subplots(2 * down, across_page, squeeze=False, height_ratios=(3, 1) * down)
    axes = np.array([[grid[k // across_page * 2 + row, k % across_page] for k in range(count)] for row in (0, 1)])
    split = [_local(found, m) for m in found.motions]
    limit = max(*(float(np.abs(across).max()) for across, _ in split), 1e-3)
    for k, (m, (across, along)) in enumerate(zip(found.motions, split, strict=True)):
        image = _pressed(axes[0, k], found, m, across, along, limit)
        axis, certain = axes[1, k], m.certainty.amax(1).numpy()
        axis.stairs(certain, [*m.windows[:, 0].tolist(), float(m.windows[-1, 1])], color="#1f6f8b")
        axis.axhline(SURE, color="#888888", ls=":")
        axis.set_ylim(0, 1.15 * max(SURE, *(float(q.certainty.max()) for q in found.motions)))
        axis.set_xlabel("time, s")
    axes[1, 0].set_ylabel("standard errors")
    axes[0, 0].set_xlabel("u, m", fontsize=8)
    axes[0, 0].set_ylabel("v, m", fontsize=8)
    hide_unused_axes(grid, count, 2)
    figure.colorbar(image, ax=axes[0], label="along the normal, share of the weight")  # pyright: ignore[reportPossiblyUnbound]
    return figure


def _pressed(axis: Any, found: MissingForce, m: MotionForce, across: np.ndarray, along: np.ndarray, limit: float) -> Any:
    window, _ = m.strongest
    u, v = found.uv.numpy().T
    shown = axis.tripcolor(u, v, found.faces.numpy(), across, cmap="RdBu_r", vmin=-limit, vmax=limit, shading="gouraud")
    sure = (m.certainty[window].numpy() > 0.5 * SURE) & (np.linalg.norm(along, axis=1) > 0.1 * limit)
    length = max(float(np.ptp(u)), float(np.ptp(v))) / 6
    arrows = along[sure] * length / limit
    axis.quiver(u[sure], v[sure], *arrows.T, angles="xy", scale_units="xy", scale=1, width=0.006)
    begin, end = m.windows[window].tolist()
    axis.set_title(f"{m.motion}\n{begin:.2f} to {end:.2f} s", fontsize=9, parse_math=False)
    axis.set_aspect("equal")
    axis.tick_params(labelsize=7)
    return shown


def _local(found: MissingForce, m: MotionForce) -> tuple[np.ndarray, np.ndarray]:
    """(along the normal [V], along warp and weft [V, 2]) of the most certain stretch, in share of the weight."""
    window, _ = m.strongest
    x, uv = m.x[window].numpy(), found.uv.numpy()
    corners, place = x[found.faces.numpy()], uv[found.faces.numpy()]
    sides = np.stack([place[:, 1] - place[:, 0], place[:, 2] - place[:, 0]], -1)  # columns in the pattern
    along = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)
    gradient = along @ np.linalg.pinv(sides)  # a triangle that is seen edge-on spans nothing
    tangent = np.zeros((len(x), 3, 2))
    np.add.at(tangent, found.faces.numpy().ravel(), np.repeat(gradient, 3, axis=0))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.cross(tangent[..., 0], tangent[..., 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    force = m.force[window].numpy() / found.weight
    return np.einsum("vc,vc->v", force, normal), np.einsum("vc,vck->vk", force, tangent)


def _middles(found: Sequence[Linearisation], mapped: Own) -> dict[int, tuple[float, float]]:
    """(u, v) m of every part of the fabric that was seen, from the pattern's top down."""
    out = {}
    for cells in (c for evidence in found for c in evidence.bins):
        own = mapped(cells)
        places = cells.rest_position[own, :2].tolist()
        out.update(zip((cells.channel[own] // 3).tolist(), map(tuple, places), strict=True))
    return dict(sorted(out.items(), key=lambda part: (-round(part[1][1], 3), part[1][0])))


def _maps(evidence: Linearisation, parts: Sequence[int], mapped: Own) -> list[np.ndarray]:
    """Per episode [parts, windows] mm; NaN where nothing was seen."""
    out, row = [], {part: k for k, part in enumerate(parts)}
    for cells in evidence.bins:
        own = mapped(cells)
        patch, window = (cells.channel[own] // 3).tolist(), cells.window[own].numpy()
        field = np.full((len(parts), 1 + max(cells.window.tolist(), default=0)), np.nan)
        field[[row[p] for p in patch], window] = 1e3 * cells.value[own].numpy()
        out.append(field)
    return out


def _course(p: HeldOutPrediction, episode: int) -> tuple[np.ndarray, np.ndarray]:
    own = (p.episode == episode) & p.is_position
    window, squared = p.window[own].numpy(), p.residual[own].square().numpy()
    total, count = np.bincount(window, squared), np.bincount(window)
    used = np.flatnonzero(count)
    return (used + 0.5) * BIN_SECONDS, np.sqrt(total[used] / count[used])
