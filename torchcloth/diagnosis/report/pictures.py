"""Figures of a diagnosis: residuals over fabric and time, score tests, held-out errors, correlations, missing force."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from ..._utils.constants import Z_95
from ..data.binning import BIN_SECONDS, BLOCK_NAMES, BinnedResiduals
from ..decide.criteria import CRITERIA
from ..decide.verdict import Diagnosis
from ..inference.comparison import HeldOutPrediction
from ..inference.confounding import correlate_scores
from ..inference.linearise import Linearisation
from ..inference.screening import ScoreTest
from ..unknown.missing_force import MissingForce, MotionForce
from .figure_layout import grid_shape, hide_unused_axes
from .wording import FLOOR_SOURCES, label_episodes

DECISION_COLOURS = {"present": "#b0653a", "inconclusive": "#c9a227", "absent": "#1f6f8b", "unresolvable": "#bbbbbb"}
BEFORE_COLOUR, AFTER_COLOUR, REFERENCE_COLOUR, UNSEEN_COLOUR = "#b0653a", "#1f6f8b", "#888888", "#c4c4c4"
BinSelector = Callable[[BinnedResiduals], Tensor]
MAPPED_BINS: dict[str, BinSelector] = {  # what lies on the fabric, by the direction that is shown
    "along the normal": lambda bins: bins.block == BLOCK_NAMES.index("points"),
    "upwards": lambda bins: (bins.block == BLOCK_NAMES.index("markers")) & (bins.channel % 3 == 2),
}
MAX_SHOWN_AMPLITUDE = 2.2  # in typical amplitudes
MAX_TITLE_LETTERS = 26  # of a line of a title
SHOWN_QUANTILE = 0.98  # of the residuals at the end of the colour bar
TIME_LABEL = "time from the first frame, s"


def draw_residual_maps(answer: Diagnosis) -> Any:
    """Draw the mean residual [mm] by part of the fabric and time of every episode; None without positions.

    Rows are the parts from the pattern's top down. Points are shown along the normal, or markers upwards if there are
    no points.

    Args:
        answer: the diagnosis.

    Returns:
        A matplotlib figure.
    """
    from matplotlib.figure import Figure

    result = answer.search
    both = (result.start.linearisation, result.end.linearisation)
    observed = [
        direction
        for direction, select in MAPPED_BINS.items()
        if all(any(select(bins).any() for bins in linearisation.bins) for linearisation in both)
    ]
    if not observed:
        return None
    select = MAPPED_BINS[observed[0]]
    middles = _locate_parts(both, select)
    before, after = (_map_residuals(linearisation, list(middles), select) for linearisation in both)
    part_labels = [f"{100 * u:.0f}, {100 * v:.0f}" for u, v in middles.values()]
    titles, count = wrap_labels(answer.content), len(before)
    limit = max(float(np.nanquantile(np.abs(np.concatenate([m.ravel() for m in before])), SHOWN_QUANTILE)), 1e-6)
    rows = 2 if result.accepted else 1
    columns, lines = grid_shape(count)
    figure = Figure(figsize=(2.9 * columns + 1.8, (2.8 * rows + 0.3) * lines + 0.3), layout="constrained")
    axes = figure.subplots(rows * lines, columns, sharey=True, squeeze=False)
    for row, maps in enumerate((before, after)[:rows]):
        for k, field in enumerate(maps):
            axis = axes[k // columns * rows + row, k % columns]
            extent = (0, field.shape[1] * BIN_SECONDS, field.shape[0], 0)
            image = axis.imshow(field, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto", extent=extent)
            axis.set_facecolor(UNSEEN_COLOUR)
            axis.set_yticks(np.arange(len(part_labels)) + 0.5, part_labels, fontsize=6)
            axis.set_title(titles[k] if row == 0 else "", fontsize=9, parse_math=False)
            if row == rows - 1:
                axis.set_xlabel(TIME_LABEL)
        for axis in axes[row::rows, 0]:
            axis.set_ylabel(f"{('before', 'after')[row]}: part of the fabric,\nits middle u, v in cm", fontsize=9)
    hide_unused_axes(axes, count, rows)
    figure.colorbar(
        image,
        ax=axes,  # pyright: ignore[reportPossiblyUnbound]
        label=f"measured minus simulated, {observed[0]}, mm",
    )
    return figure


def wrap_labels(content: dict[str, Any]) -> list[str]:
    """Return the episodes' labels, wrapped for titles of figures."""
    return [textwrap.fill(text, MAX_TITLE_LETTERS) for text in label_episodes(content)]


def draw_scores(scores: Sequence[ScoreTest]) -> Any:
    """Draw the amplitudes that the residuals ask for, in typical amplitudes, with 95 % intervals.

    Args:
        scores: score tests.

    Returns:
        A matplotlib figure. A grey band marks what is too small to be relevant.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    shown = [s for s in scores if s.total_std < float("inf")]
    figure = Figure(figsize=(7.5, 0.24 * len(shown) + 1.5), layout="constrained")
    axis, limit = figure.subplots(), MAX_SHOWN_AMPLITUDE
    for k, s in enumerate(reversed(shown)):
        typical, smallest = abs(s.hypothesis.typical), s.hypothesis.smallest_fraction
        sign, colour = 1.0 if s.hypothesis.typical > 0 else -1.0, DECISION_COLOURS[s.decision]
        axis.plot([-smallest, smallest], [k, k], color="#e6e6e6", lw=9, solid_capstyle="butt", zorder=0)
        amplitude = sign * s.amplitude / typical
        if abs(amplitude) > limit:  # beyond the axis
            axis.plot(np.copysign(limit - 0.05, amplitude), k, ">" if amplitude > 0 else "<", color=colour)
        axis.errorbar(amplitude, k, xerr=Z_95 * s.total_std / typical, fmt="o", ms=4, color=colour)
    axis.set_yticks(range(len(shown)), [s.hypothesis.name for s in reversed(shown)], fontsize=8, parse_math=False)
    axis.set_xlim(-limit, limit)
    axis.set_ylim(-1, len(shown))
    axis.axvline(0, color="k", lw=0.6)
    axis.set_xlabel("amplitude over its typical value; grey: below the smallest effect of interest; arrows: beyond")
    handles = [Patch(color=colour, label=name) for name, colour in DECISION_COLOURS.items()]
    figure.legend(handles=handles, fontsize=8, loc="outside upper center", ncols=len(handles), frameon=False)
    return figure


def draw_correlations(answer: Diagnosis) -> Any:
    """Draw the absolute correlation of scores; None if no hypothesis is detectable.

    Args:
        answer: the diagnosis.

    Returns:
        A matplotlib figure. These motions do not distinguish dark pairs.
    """
    from matplotlib.figure import Figure

    start = answer.search.start
    shown = {s.hypothesis.name for s in answer.search.scores if s.decision != "unresolvable"}
    for cause in answer.content["causes"]:
        shown |= {cause["effect"], *cause["equivalence_class"], *(r["effect"] for r in cause["rivals"])}
    index = [k for k, h in enumerate(start.linearisation.hypotheses) if h.name in shown]
    if not index:
        return None
    names = [start.linearisation.hypotheses[k].name for k in index]
    correlation = correlate_scores(start).abs().numpy()[np.ix_(index, index)]
    figure = Figure(figsize=(0.28 * len(index) + 2.6, 0.28 * len(index) + 2.0), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(correlation, cmap="Blues", vmin=0, vmax=1)
    axis.set_xticks(range(len(names)), names, rotation=90, fontsize=7, parse_math=False)
    axis.set_yticks(range(len(names)), names, fontsize=7, parse_math=False)
    figure.colorbar(image, ax=axis, label="|correlation|", shrink=0.7)
    return figure


def draw_held_out_rms(answer: Diagnosis, before: HeldOutPrediction, after: HeldOutPrediction | None) -> Any:
    """Draw the RMS [mm] of positions over time, each motion predicted from the others.

    Args:
        answer: the diagnosis.
        before: prediction of the base model.
        after: prediction of the model with its causes; None without causes.

    Returns:
        A matplotlib figure.
    """
    from matplotlib.figure import Figure

    titles, source = wrap_labels(answer.content), answer.content["noise_floor"]["source"]
    columns, lines = grid_shape(len(titles))
    figure = Figure(figsize=(2.9 * columns + 0.8, 2.5 * lines), layout="constrained")
    grid = figure.subplots(lines, columns, sharey=True, squeeze=False)
    axes = grid.ravel()[: len(titles)]
    curves = (("base model", before, BEFORE_COLOUR), ("with causes", after, AFTER_COLOUR))
    for k, axis in enumerate(axes):
        for label, prediction, colour in curves:
            if prediction is not None:
                time, rms = _rms_over_time(prediction, k)
                axis.plot(time, 1e3 * rms, color=colour, label=label)
        floor = 1e3 * answer.search.noise_floor
        axis.axhline(floor, color=REFERENCE_COLOUR, ls=":", label=FLOOR_SOURCES[source])
        axis.set_title(titles[k], fontsize=9, parse_math=False)
        axis.set_xlabel(TIME_LABEL)
    axes[0].set_ylim(bottom=0)
    for row in grid:
        row[0].set_ylabel("held out, mm RMS")
    axes[0].legend(fontsize=8)
    hide_unused_axes(grid, len(titles), 1)
    return figure


def draw_missing_force(force: MissingForce) -> Any:
    """Draw, for each motion, the missing force in its most significant window, and its significance over time.

    Args:
        force: the missing force.

    Returns:
        A matplotlib figure. Colour: along the cloth's normal, as a fraction of its weight. Arrows: along the cloth,
        where significant.
    """
    from matplotlib.figure import Figure

    count, min_z = len(force.motions), CRITERIA.residual_law.min_force_z
    columns, lines = grid_shape(count)
    figure = Figure(figsize=(3.0 * columns + 1.2, 4.6 * lines), layout="constrained")
    grid = figure.subplots(2 * lines, columns, squeeze=False, height_ratios=(3, 1) * lines)
    axes = np.array([[grid[k // columns * 2 + row, k % columns] for k in range(count)] for row in (0, 1)])
    components = [_split_force(force, m) for m in force.motions]
    limit = max(*(float(np.abs(normal).max()) for normal, _ in components), 1e-3)
    for k, (m, (normal, tangential)) in enumerate(zip(force.motions, components, strict=True)):
        image = _draw_force(axes[0, k], force, m, normal, tangential, limit)
        axis, z = axes[1, k], m.certainty.amax(1).numpy()
        axis.stairs(z, [*m.windows[:, 0].tolist(), float(m.windows[-1, 1])], color=AFTER_COLOUR)
        axis.axhline(min_z, color=REFERENCE_COLOUR, ls=":")
        axis.set_ylim(0, 1.15 * max(min_z, *(float(other.certainty.max()) for other in force.motions)))
        axis.set_xlabel(TIME_LABEL)
    axes[1, 0].set_ylabel("standard errors")
    axes[0, 0].set_xlabel("u, m", fontsize=8)
    axes[0, 0].set_ylabel("v, m", fontsize=8)
    hide_unused_axes(grid, count, 2)
    figure.colorbar(image, ax=axes[0], label="along the normal, fraction of the weight")  # pyright: ignore[reportPossiblyUnbound]
    return figure


def _draw_force(
    axis: Any, force: MissingForce, m: MotionForce, normal: np.ndarray, tangential: np.ndarray, limit: float
) -> Any:
    window, _ = m.strongest
    u, v = force.uv.numpy().T
    image = axis.tripcolor(u, v, force.faces.numpy(), normal, cmap="RdBu_r", vmin=-limit, vmax=limit, shading="gouraud")
    is_shown = m.certainty[window].numpy() > 0.5 * CRITERIA.residual_law.min_force_z
    is_shown &= np.linalg.norm(tangential, axis=1) > 0.1 * limit
    length = max(float(np.ptp(u)), float(np.ptp(v))) / 6
    arrows = tangential[is_shown] * length / limit
    axis.quiver(u[is_shown], v[is_shown], *arrows.T, angles="xy", scale_units="xy", scale=1, width=0.006)
    begin, end = m.windows[window].tolist()
    axis.set_title(f"{m.motion}\n{begin:.2f} to {end:.2f} s", fontsize=9, parse_math=False)
    axis.set_aspect("equal")
    axis.tick_params(labelsize=7)
    return image


def _split_force(force: MissingForce, m: MotionForce) -> tuple[np.ndarray, np.ndarray]:
    """Return (along the normal [V], along warp and weft [V, 2]) of the strongest window, as fractions of the weight."""
    window, _ = m.strongest
    x, uv, faces = m.x[window].numpy(), force.uv.numpy(), force.faces.numpy()
    corners, pattern = x[faces], uv[faces]
    pattern_sides = np.stack([pattern[:, 1] - pattern[:, 0], pattern[:, 2] - pattern[:, 0]], -1)
    sides = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], -1)
    gradient = sides @ np.linalg.pinv(pattern_sides)  # a triangle that is seen edge-on has no area
    tangents = np.zeros((len(x), 3, 2))
    np.add.at(tangents, faces.ravel(), np.repeat(gradient, 3, axis=0))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    normal = np.cross(tangents[..., 0], tangents[..., 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    fraction = m.force[window].numpy() / force.weight
    return np.einsum("vc,vc->v", fraction, normal), np.einsum("vc,vck->vk", fraction, tangents)


def _locate_parts(linearisations: Sequence[Linearisation], select: BinSelector) -> dict[int, tuple[float, float]]:
    """Return (u, v) [m] of every part of the fabric that was seen, from the pattern's top down."""
    middles = {}
    for bins in (b for linearisation in linearisations for b in linearisation.bins):
        index = select(bins)
        positions = bins.rest_position[index, :2].tolist()
        middles.update(zip((bins.channel[index] // 3).tolist(), map(tuple, positions), strict=True))
    return dict(sorted(middles.items(), key=lambda part: (-round(part[1][1], 3), part[1][0])))


def _map_residuals(linearisation: Linearisation, parts: Sequence[int], select: BinSelector) -> list[np.ndarray]:
    """Return per episode [parts, windows] the residuals [mm]; NaN where nothing was seen."""
    maps, row_of_part = [], {part: k for k, part in enumerate(parts)}
    for bins in linearisation.bins:
        index = select(bins)
        part, window = (bins.channel[index] // 3).tolist(), bins.window[index].numpy()
        field = np.full((len(parts), 1 + max(bins.window.tolist(), default=0)), np.nan)
        field[[row_of_part[p] for p in part], window] = 1e3 * bins.value[index].numpy()
        maps.append(field)
    return maps


def _rms_over_time(prediction: HeldOutPrediction, episode: int) -> tuple[np.ndarray, np.ndarray]:
    index = (prediction.episode == episode) & prediction.is_position
    window, square = prediction.window[index].numpy(), prediction.residual[index].square().numpy()
    total, count = np.bincount(window, square), np.bincount(window)
    used = np.flatnonzero(count)
    return (used + 0.5) * BIN_SECONDS, np.sqrt(total[used] / count[used])
