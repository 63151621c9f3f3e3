"""Pictures of a diagnosis: where and when the simulation is off, what the residuals ask for, what looks alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from .cells import STRETCH
from .classes import correlations
from .comparison import Predicted
from .evidence import Evidence
from .screening import Row
from .verdict import Diagnosis

COLOURS = {"present": "#b0653a", "inconclusive": "#c9a227", "absent": "#1f6f8b", "unresolvable": "#bbbbbb"}


def residual_maps(answer: Diagnosis) -> Any:
    """Mean misfit by part of the fabric (rows) and time (columns) of every episode, before and after; mm."""
    from matplotlib.figure import Figure

    found = answer.found
    before, after = (_maps(e) for e in (found.start.evidence, found.end.evidence))
    names, count = answer.content["motions"], len(before)
    limit = max(float(np.nanquantile(np.abs(np.concatenate([m.ravel() for m in before])), 0.98)), 1e-6)
    rows = 2 if found.steps else 1
    figure = Figure(figsize=(2.6 * count + 1.4, 2.4 * rows + 0.6), layout="constrained")
    axes = np.atleast_2d(figure.subplots(rows, count, sharey=True, squeeze=False))
    for row, maps in enumerate((before, after)[:rows]):
        for k, (axis, field) in enumerate(zip(axes[row], maps, strict=True)):
            extent = (0, field.shape[1] * STRETCH, field.shape[0], 0)
            image = axis.imshow(field, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto", extent=extent)
            axis.set_yticks([])
            axis.set_title(names[k] if row == 0 else "", fontsize=9)
            if row == rows - 1:
                axis.set_xlabel("time, s")
        axes[row, 0].set_ylabel(f"{('before', 'after')[row]}\npart of the fabric")
    figure.colorbar(
        image,
        ax=axes,  # pyright: ignore[reportPossiblyUnbound]
        label="mean misfit along the normal, mm",
    )
    return figure


def screening(rows: Sequence[Row]) -> Any:
    """Amplitudes that the residuals ask for, in units of the typical one, with 95 % intervals and what matters."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    shown = [r for r in rows if r.total < float("inf")]
    figure = Figure(figsize=(7.5, 0.24 * len(shown) + 1.2), layout="constrained")
    axis = figure.subplots()
    for k, r in enumerate(reversed(shown)):
        typical, share = abs(r.hypothesis.typical), r.hypothesis.share
        sign = 1.0 if r.hypothesis.typical > 0 else -1.0
        axis.plot([-share, share], [k, k], color="#e6e6e6", lw=9, solid_capstyle="butt", zorder=0)
        axis.errorbar(
            sign * r.amplitude / typical, k, xerr=1.96 * r.total / typical, fmt="o", ms=4, color=COLOURS[r.decision]
        )
    axis.set_yticks(range(len(shown)), [r.hypothesis.name for r in reversed(shown)], fontsize=8)
    axis.set_xlim(-2.2, 2.2)
    axis.axvline(0, color="k", lw=0.6)
    axis.set_xlabel("amplitude over its typical value; grey: too small to matter")
    handles = [Patch(color=colour, label=name) for name, colour in COLOURS.items()]
    axis.legend(handles=handles, fontsize=8, loc="lower right")
    return figure


def isolability(answer: Diagnosis) -> Any:
    """Absolute correlation of efficient scores: dark pairs cannot be told apart by these motions."""
    from matplotlib.figure import Figure

    start = answer.found.start
    visible = {r.hypothesis.name for r in answer.found.screened if r.decision != "unresolvable"}
    visible |= {c["effect"] for c in answer.content["causes"]}
    index = [k for k, h in enumerate(start.evidence.hypotheses) if h.name in visible]
    names = [start.evidence.hypotheses[k].name for k in index]
    rho = correlations(start).abs().numpy()[np.ix_(index, index)]
    figure = Figure(figsize=(0.28 * len(index) + 2.6, 0.28 * len(index) + 2.0), layout="constrained")
    axis = figure.subplots()
    shown = axis.imshow(rho, cmap="Blues", vmin=0, vmax=1)
    axis.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axis.set_yticks(range(len(names)), names, fontsize=7)
    figure.colorbar(shown, ax=axis, label="|correlation|", shrink=0.7)
    return figure


def courses(answer: Diagnosis, before: Predicted, after: Predicted | None) -> Any:
    """RMS of position cells over time, each motion predicted from the others; mm."""
    from matplotlib.figure import Figure

    names = answer.content["motions"]
    figure = Figure(figsize=(2.6 * len(names) + 0.8, 2.6), layout="constrained")
    axes = np.atleast_1d(figure.subplots(1, len(names), sharey=True))
    for k, axis in enumerate(axes):
        for label, p, colour in (("base model", before, "#b0653a"), ("with causes", after, "#1f6f8b")):
            if p is not None:
                time, rms = _course(p, k)
                axis.plot(time, 1e3 * rms, color=colour, label=label)
        axis.axhline(1e3 * answer.found.floor, color="#888888", ls=":", label="expected")
        axis.set_title(names[k], fontsize=9)
        axis.set_xlabel("time, s")
    axes[0].set_ylim(bottom=0)
    axes[0].set_ylabel("held out, mm RMS")
    axes[0].legend(fontsize=8)
    return figure


def _maps(evidence: Evidence) -> list[np.ndarray]:
    """Per episode [patches, windows] mm; NaN where nothing was seen."""
    out = []
    for cells in evidence.cells:
        own = cells.block == 0
        patch, window = cells.patch[own].numpy() // 3, cells.window[own].numpy()
        field = np.full((patch.max() + 1, window.max() + 1), np.nan)
        field[patch, window] = 1e3 * cells.value[own].numpy()
        out.append(field)
    return out


def _course(p: Predicted, episode: int) -> tuple[np.ndarray, np.ndarray]:
    own = (p.episode == episode) & p.seen
    window, squared = p.window[own].numpy(), p.value[own].square().numpy()
    total, count = np.bincount(window, squared), np.bincount(window)
    used = np.flatnonzero(count)
    return (used + 0.5) * STRETCH, np.sqrt(total[used] / count[used])
