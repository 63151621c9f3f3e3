"""report.html: one file that says what a diagnosis concludes and shows why."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Mapping, Sequence
from datetime import date
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined

from ..._utils.files import write_text
from ..causes.glossary import CAUSE_TITLES, EQUIVALENT_CAUSES, GLOSSARY
from ..decide.criteria import CRITERIA
from ..decide.verdict import Diagnosis
from ..inference.screening import ScoreTest, screen
from . import pictures
from .cloud_pictures import draw_cloud_overlays
from .wording import SECONDARY_LINES, VERDICTS, describe_next_step

REPORT_FILE = "report.html"
TEMPLATE_FILE = "report.html.j2"
FIGURE_DPI = 110
NO_VALUE = "–"
DISPLAY_UNITS = {"m": (1e3, "mm"), "N": (1e3, "mN"), "N m": (1e3, "mN m")}


class Table(NamedTuple):
    """A table of the report.

    Attributes:
        head: headings of the columns.
        rows: (cells, whether the row is in bold) of each row.
    """

    head: Sequence[str]
    rows: Sequence[tuple[Sequence[str], bool]]


def write_report(answer: Diagnosis, folder: Path) -> Path:
    """Write report.html into a folder, and return its path.

    Args:
        answer: the diagnosis.
        folder: an existing folder.
    """
    environment = Environment(
        loader=PackageLoader("torchcloth.diagnosis.report", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    lines = answer.summary().splitlines()
    secondary = [line for line in lines if line.startswith(SECONDARY_LINES)]
    context: dict[str, Any] = {
        "verdict": answer.verdict,
        "verdict_sentence": VERDICTS.get(answer.verdict, ""),
        "next_step": describe_next_step(answer.verdict, answer.content),
        "base_model": answer.content.get("base"),
        "episodes": [e["name"] for e in answer.content.get("episodes", [])],
        "version": metadata.version("torchcloth"),
        "date": date.today().isoformat(),
        "lines": [line for line in lines if line not in secondary and line not in VERDICTS.values()],
        "secondary_lines": secondary,
        "evidence": None if answer.optional_search is None else _collect_evidence(answer),
    }
    return write_text(folder / REPORT_FILE, environment.get_template(TEMPLATE_FILE).render(context) + "\n")


def _collect_evidence(answer: Diagnosis) -> dict[str, Any]:
    """Return the figures and tables of a search."""
    result, content = answer.search, answer.content
    before, after = result.held_out
    start_scores = screen(result.start)
    scores = [*start_scores, *result.scores]
    descriptions = {h.effect: h.description for h in (s.hypothesis for s in scores) if h.effect not in GLOSSARY}
    descriptions |= {c["effect"]: c["description"] for c in content["causes"]}
    meanings = {name: text for name, text in descriptions.items() if text} | GLOSSARY | EQUIVALENT_CAUSES
    listed = _list_effects(content, scores)
    overlays = None
    if answer.overlays:
        overlays = _encode_figure(draw_cloud_overlays(answer.overlays, result.data.surface.faces.numpy()))
    residual_maps = pictures.draw_residual_maps(answer)
    correlations = pictures.draw_correlations(answer)
    missing = answer.missing_force
    return {
        "causes": _tabulate_causes(content["causes"]) if content["causes"] else None,
        "overlays": overlays,
        "residual_maps": None if residual_maps is None else _encode_figure(residual_maps),
        "is_single_motion": not result.has_held_out_motions,
        "held_out_rms": _encode_figure(pictures.draw_held_out_rms(answer, before, after if result.accepted else None)),
        "gain": None if content["gain"] is None else _tabulate_gain(content["gain"]),
        "start_scores": _encode_figure(pictures.draw_scores(start_scores)),
        "has_causes": bool(result.accepted),
        "scores": _tabulate_scores(result.scores, content),
        "min_displacement_mm": 1e3 * CRITERIA.screening.min_visible_displacement_m,
        "max_rms_ratio": CRITERIA.adequacy.max_rms_ratio,
        "max_p_value": CRITERIA.adequacy.max_p_value,
        "lack_of_fit": _tabulate_lack_of_fit(content["lack_of_fit"], pictures.wrap_labels(content)),
        "force_drifts": _tabulate_drifts(content["force_drifts"]) if content["force_drifts"] else None,
        "missing_force": None if missing is None else _encode_figure(pictures.draw_missing_force(missing)),
        "residual_force": _tabulate_laws(content["residual_force"]),
        "correlations": None if correlations is None else _encode_figure(correlations),
        "parameters": _tabulate_parameters(content["parameters"]),
        "glossary": [(name, text) for name, text in meanings.items() if name in listed],
    }


def _list_effects(content: Mapping[str, Any], scores: Sequence[ScoreTest]) -> set[str]:
    """Return the effects that the report mentions, without axes."""
    names = {s.hypothesis.name for s in scores}
    for c in content["causes"]:
        names |= {c["effect"], *c["equivalence_class"], *(r["effect"] for r in c["rivals"])}
    return {name.partition("[")[0] for name in names}


def _encode_figure(figure: Any) -> str:
    """Return a figure as a data URI."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=FIGURE_DPI)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def _title(effect: str) -> str:
    """Return the title and symbol of an effect, with its axis, and its name in the catalogue."""
    name, _, axis = effect.partition("[")
    if name not in CAUSE_TITLES:
        return effect
    along = f", {axis.rstrip(']')}" if axis else ""
    return f"{CAUSE_TITLES[name]}{along} – {effect}"


def _tabulate_causes(causes: Sequence[Mapping[str, Any]]) -> Table:
    head = (
        "cause", "amplitude [95 %]", "of typical", "improves, mm", "explained fraction", "log density gain",
        "95 % quantile of permutations", "confounded with",
    )  # fmt: skip
    rows = []
    for c in causes:
        unit, (low, high), test = "" if c["unit"] == "-" else f" {c['unit']}", c["ci95"], c["permutation_test"]
        fraction = c["explained_fraction"]
        others = [n for n in c["equivalence_class"] if n != c["effect"]] + [r["effect"] for r in c["rivals"]]
        cells = (
            _title(c["effect"]),
            f"{c['amplitude']:.4g} [{low:.4g}, {high:.4g}]{unit}",
            f"{c['amplitude'] / c['typical']:.2g}",
            f"{c['rms_removed_mm']:.2f}",
            NO_VALUE if fraction is None else f"{100 * fraction:.0f} %",
            f"{test['log_density']:.0f}",
            NO_VALUE if test["quantile_95"] is None else f"{test['quantile_95']:.1f}",
            ", ".join(dict.fromkeys(others)) or "nothing",
        )
        rows.append((cells, False))
    return Table(head, rows)


def _tabulate_gain(gain: Mapping[str, Any]) -> Table:
    head = ("held-out motion", "RMS before, mm", "after, mm", "% explained [95 %]", "log density gain [95 %]")
    rows = []
    for row in gain["per_motion"]:
        rms = [NO_VALUE if row[key] is None else f"{1e3 * row[key]:.2f}" for key in ("rms_before", "rms_after")]
        # where the base model is at the noise floor there is nothing to explain
        has_misfit = row["rms_before"] is not None and row["rms_before"] > gain["noise_floor"]
        fraction = row["explained_fraction"] if has_misfit else None
        explained = _format_interval(fraction, row["explained_fraction_ci95"], 100.0)
        rows.append(
            ([row["motion"], *rms, explained, _format_interval(row["log_density"], row["log_density_ci95"])], False)
        )
    return Table(head, rows)


def _format_interval(value: float | None, ends: Sequence[float] | None, factor: float = 1.0) -> str:
    """Return a number with its interval, as far as they are known."""
    if value is None:
        return NO_VALUE
    interval = "" if ends is None else " [{:.0f}, {:.0f}]".format(*(factor * end for end in ends))
    return f"{factor * value:.0f}{interval}"


def _tabulate_scores(scores: Sequence[ScoreTest], content: Mapping[str, Any]) -> Table:
    head = (
        "hypothesis", "unit", "amplitude", "standard error", "mesh error", "smallest effect of interest",
        "detectable from", "typical", "a typical one moves, mm", "decision",
    )  # fmt: skip
    named_for = {
        name: c["effect"]
        for c in content["causes"]
        for name in (*c["equivalence_class"], *(r["effect"] for r in c["rivals"]))
    }
    rows = []
    for s in scores:
        h = s.hypothesis
        numbers = (
            s.amplitude, s.std, s.mesh_bias, abs(h.smallest_of_interest), s.smallest_detectable, h.typical,
            1e3 * s.position_rms,
        )  # fmt: skip
        decision = f"confounded with {named_for[h.name]}" if h.name in named_for else s.decision
        cells = [h.name, h.unit, *(f"{x:.3g}" if math.isfinite(x) else NO_VALUE for x in numbers), decision]
        if not math.isfinite(s.std):  # the hypothesis could not be tested
            cells[2] = cells[4] = NO_VALUE
        rows.append((cells, False))
    return Table(head, rows)


def _tabulate_lack_of_fit(rows: Sequence[Mapping[str, Any]], labels: Sequence[str]) -> Table:
    """Return residuals by episode and kind of data, with those of a correct model; significant misfits in bold."""
    head = ("motion", "data", "RMS", "expected", "of which mesh error", "", "ratio", "p-value")
    out = []
    for r in rows:
        factor, unit = DISPLAY_UNITS[r["unit"]]
        numbers = [f"{factor * r[key]:.2f}" for key in ("rms", "expected_rms", "mesh_rms")]
        cells = [labels[r["episode"]], r["kind"], *numbers, unit, f"{r['rms_ratio']:.2f}", f"{r['p_value']:.2g}"]
        out.append((cells, r["is_significant"]))
    return Table(head, out)


def _tabulate_drifts(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return drifts of forces that are common to all motions; significant ones in bold."""
    head = ("in all motions", "drift", "standard error", "", "p-value")
    return Table(
        head,
        [
            (
                [
                    f"force, {r['axis']}",
                    f"{1e3 * r['rate']:.1f}",
                    f"{1e3 * r['std']:.1f}",
                    "mN/s",
                    f"{r['p_value']:.2g}",
                ],
                r["is_significant"],
            )
            for r in rows
        ],
    )


def _tabulate_laws(residual: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """Return the gain and the laws of a residual force; None if no laws were searched for."""
    if residual is None:
        return None
    if not residual["terms"]:
        return {"table": None}
    head = ("law", "coefficient", "unit", "what it does")
    rows = [([t["law"], f"{t['coefficient']:.3g}", t["unit"], t["description"]], False) for t in residual["terms"]]
    gain = residual["gain"]
    return {
        "table": Table(head, rows),
        "before_mm": f"{1e3 * gain['rms_before']:.2f}",
        "after_mm": f"{1e3 * gain['rms_after']:.2f}",
    }


def _tabulate_parameters(parameters: Mapping[str, Any]) -> Table:
    head = ("parameter", "value [95 %]", "data sheet", "unit")
    return Table(
        head,
        [
            (
                [
                    name,
                    f"{p['value']:.4g} [{p['ci95'][0]:.4g}, {p['ci95'][1]:.4g}]",
                    f"{p['data_sheet']:.4g}",
                    p["unit"],
                ],
                False,
            )
            for name, p in parameters.items()
        ],
    )
