"""Pictures of the measured data and of fits to them. Dots are measured, lines are computed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from torchcloth.identification import TensionFit, Trellis, Uniaxial, fit_tension
from torchcloth.recordings import ForceDisplacement, Recording

from . import bias_extension as glass_adapter
from . import knits as knit_adapter

MEASURED_BLUE, COMPUTED_BROWN, GUIDE_GREY = "#1f6f8b", "#b0653a", "#888888"
MAX_FITTED_KNIT_FORCE_N = 5.0


def _make_figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, np.ndarray]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False)


def draw_swings(episodes: dict[str, Recording], path: Path) -> None:
    """Draw the upper edge and the tool of three runs, without lag, and side views of frames of one run."""
    figure, axes = _make_figure(2, 3, (15, 8))
    for axis, run in zip(axes[0], ("range30_rep3", "range60_rep5", "range90_rep8"), strict=True):
        e = episodes[run]
        markers = e.require("markers")
        accepted, mesh = markers.extra["accepted"], markers.xyz.reshape(-1, 8, 8, 3)
        t, edge, low = markers.t + e.clock_offset, mesh[:, 1:-1, -1, 1], mesh[:, 1:-1, 0, 1]
        tool = e.grippers["hanger"]
        axis.plot(tool.t, tool.position[:, 1], color=GUIDE_GREY, label="tool")
        axis.plot(t[accepted], np.nanmedian(edge, 1)[accepted], ".", color=MEASURED_BLUE, label="upper edge")
        axis.plot(t[accepted], np.nanmedian(low, 1)[accepted], ".", color=COMPUTED_BROWN, ms=4, label="lower edge")
        axis.plot(
            t[~accepted], np.nanmedian(edge, 1)[~accepted], "x", color="k", ms=4, label="rejected frames, upper edge"
        )
        axis.set(
            title=f"{run}: lag {-e.clock_offset:.3f} s, {(~accepted).sum()} of {len(accepted)} rejected", xlabel="s"
        )
        axis.set_ylabel("y, along the stroke, m")
    axes[0, 0].legend(fontsize=8)
    e = episodes["range60_rep5"]
    markers = e.require("markers")
    accepted, mesh, t = markers.extra["accepted"], markers.xyz.reshape(-1, 8, 8, 3), markers.t + e.clock_offset
    for axis, begin in zip(axes[1], (0.0, 4.0, 9.9), strict=True):
        for i in np.flatnonzero(accepted & (t > begin))[:8]:
            side = np.nanmedian(mesh[i], axis=0)
            axis.plot(side[:, 1], side[:, 2], ".-", ms=4, label=f"{t[i]:.1f} s")
        corners = np.asarray(e.cloth.initial_vertices).mean(0)
        if begin == 0:
            axis.plot(corners[:, 1], corners[:, 2], color="k", label="flat sheet of the episode")
        middle = np.mean(axis.get_xlim())
        axis.set(title=f"side view from {begin:.1f} s, rows' medians", xlabel="y, m", ylabel="z, m", aspect="equal")
        axis.set_xlim(middle - 0.22, middle + 0.22)
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=90)


def draw_lifts(episodes: dict[str, Recording], path: Path) -> None:
    """Draw three frames of every lift along x with the path; removed points are red."""
    figure, axes = _make_figure(3, len(episodes), (20, 9))
    for column, (trial, e) in zip(axes.T, episodes.items(), strict=True):
        gripper, points = e.grippers["gripper"], e.require("points")
        ends = np.cumsum(points.counts)
        for axis, i in zip(column, (8, 16, 24), strict=True):
            cloud, cloth = points.frame(i), points.extra["cloth"][ends[i] - points.counts[i] : ends[i]]
            axis.plot(*cloud[cloth][:, 1:].T, ",", color=MEASURED_BLUE)
            axis.plot(*cloud[~cloth][:, 1:].T, ".", color="red", ms=3)
            axis.plot(gripper.position[: i + 1, 1], gripper.position[: i + 1, 2], color="k", lw=1)
            axis.plot(gripper.position[i, 1], gripper.position[i, 2], "k*")
            axis.set(title=f"{trial}, {0.1 * i:.1f} s", aspect="equal", xlim=(-0.12, 0.32), ylim=(0.06, 0.44))
    figure.suptitle("y and z, m. Blue: cloth; red: removed; star: gripper, its command in the clouds' frame")
    figure.savefig(path, dpi=80)


def draw_nylon(tables: dict[int, ForceDisplacement], fit: TensionFit, path: Path) -> None:
    """Draw the four curves, their fit and the errors."""
    figure, axes = _make_figure(1, 2, (13, 5))
    for (angle, table), curve, tint in zip(
        tables.items(), fit.curves, (MEASURED_BLUE, COMPUTED_BROWN, "#6a8d3a", "#7a4f8b"), strict=True
    ):
        u = 1e3 * table.displacement
        axes[0, 0].plot(u, table.force, ".", color=tint, ms=4)
        axes[0, 0].plot(u, curve.force, color=tint, label=f"{angle} degrees to the warp")
        axes[0, 1].plot(u, 100 * (curve.force.numpy() - table.force) / table.force.max(), color=tint)
    axes[0, 0].set(xlabel="mm", ylabel="N", title="nylon, 97 mm x 27 mm: one law, four numbers")
    axes[0, 0].legend()
    axes[0, 1].set(xlabel="mm", ylabel="% of each curve's largest force", title="computed minus measured", ylim=(-6, 6))
    axes[0, 1].axhline(0, color=GUIDE_GREY, lw=0.5)
    figure.savefig(path, dpi=90)


def draw_knits(fabrics: dict[str, tuple[ForceDisplacement, ForceDisplacement]], path: Path) -> list[float]:
    """Draw force and lateral strain of repeat 3 with predictions from repeats 1 and 2; return Poisson's ratios."""
    figure, axes = _make_figure(2, len(fabrics), (24, 8))
    ratios = []
    for column, (name, pair) in zip(axes.T, fabrics.items(), strict=True):
        fitted_ranges = [table.select_rows(table.force < MAX_FITTED_KNIT_FORCE_N) for table in pair]
        fit = fit_tension(
            knit_adapter.initial_cloth(),
            [table.select_repeats(1, 2) for table in fitted_ranges],
            knit_adapter.KNIT_PARAMETERS,
        )
        cloth = knit_adapter.initial_cloth()
        for key, place in fit.keys.items():
            cloth.get_submodule(place).set(fit.parameters[key].value)  # type: ignore[operator]
        ratios.append(fit.parameters["poisson_ratio"].value)
        for label, tint, table, full_range in zip(
            "XY", (MEASURED_BLUE, COMPUTED_BROWN), fitted_ranges, pair, strict=True
        ):
            predicted, third = table.select_repeats(3), full_range.select_repeats(3)
            curve = Uniaxial().curve(cloth.material, predicted)
            column[0].plot(third.strain, third.force, ".", color=tint, ms=4)
            column[0].plot(predicted.strain, curve.force.detach(), color=tint, label=f"pulled along {label}")
            column[1].plot(third.strain, third.lateral_strain, ".", color=tint, ms=4)
            column[1].plot(predicted.strain, curve.lateral_strain.detach(), color=tint)
        column[0].set(title=name.replace("_Yarn", ""), ylim=(0, 15))
        column[1].set(xlabel="strain")
    axes[0, 0].legend(fontsize=8)
    axes[0, 0].set_ylabel("N")
    axes[1, 0].set_ylabel("lateral strain")
    figure.suptitle(
        "Knits, third repeat: measured (dots), predicted from the first two up to "
        f"{MAX_FITTED_KNIT_FORCE_N:g} N (lines)"
    )
    figure.savefig(path, dpi=80)
    return ratios


def draw_bias_extension(table: ForceDisplacement, fit: TensionFit, path: Path) -> None:
    """Draw the force over the shear angle, with the one modulus that was fitted below 40 degrees."""
    figure, axes = _make_figure(1, 2, (13, 5))
    law = fit.apply(glass_adapter.initial_cloth()).material
    angle, force = np.degrees(Trellis().angle(table).numpy()), Trellis().curve(law, table).force.detach().numpy()
    for axis in axes[0]:
        axis.plot(angle, table.force, ".", color=MEASURED_BLUE, label="measured")
        axis.plot(angle, force, color=COMPUTED_BROWN, label="one shear modulus, fitted below 40 degrees")
        axis.axvline(40, color=GUIDE_GREY, lw=0.5)
        axis.set(xlabel="shear angle of the middle, as a trellis, degrees", ylabel="N")
    axes[0, 0].set(ylim=(0, 60), title="glass plain weave, 115 x 230 mm")
    axes[0, 1].set(xlim=(0, 50), ylim=(0, 8), title="small angles: an offset of about 1 N, as from friction")
    axes[0, 0].legend()
    figure.savefig(path, dpi=90)


def draw_cantilever(line: np.ndarray, table: np.ndarray, path: Path) -> None:
    """Draw the profile, and the authors' table of moments."""
    figure, axes = _make_figure(1, 2, (13, 5))
    axes[0, 0].plot(1e3 * line[:, 0], 1e3 * line[:, 1], ".-", color=MEASURED_BLUE)
    axes[0, 0].set(xlabel="mm", ylabel="mm", aspect="equal", title="glass strip as a cantilever, midline")
    axes[0, 1].plot(*table.T, ".-", color=MEASURED_BLUE)
    axes[0, 1].set(xlabel="curvature, 1/m", ylabel="moment per width, N", title="the authors' table: it saturates")
    figure.savefig(path, dpi=90)
