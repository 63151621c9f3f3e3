"""report.html: one file that says what was found and shows why."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..._utils.files import write_text
from ..causes.glossary import ALIKE, GLOSSARY
from ..decide.verdict import Diagnosis
from ..inference.screening import ScoreTest, screen
from . import pictures
from .cloud_pictures import draw_cloud_overlays

REPORT = "report.html"
ASIDE = (
    "Not there, or too small to matter",
    "Would have to be",
    "Undecided",
    "Cannot be seen",
    "Does nothing here",
)  # lists of names
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2rem } img { max-width: 100% }
table { border-collapse: collapse; font-size: 0.9rem } td, th { padding: 0.15rem 0.7rem; text-align: right }
th { border-bottom: 1px solid #999 } td:first-child, th:first-child { text-align: left } .verdict { font-size: 1.3rem }
"""


def write_report(answer: Diagnosis, folder: Path) -> Path:
    """Write report.html into ``folder``; returns its path."""
    verdict = [
        f'<p class="verdict">Verdict: <b>{answer.verdict}</b></p>',
        *_told(answer),
    ]
    parts = verdict if answer.optional_search is None else verdict + _evidence(answer)
    title = "What the simulation gets wrong"
    page = f"<!doctype html><html><head><meta charset='utf-8'><title>{title}</title><style>{STYLE}</style></head>"
    return write_text(folder / REPORT, f"{page}<body><h1>{title}</h1>{''.join(parts)}</body></html>\n")


def _told(answer: Diagnosis) -> list[str]:
    """The answer in words; what else was asked about is folded away."""
    lines = answer.summary().splitlines()
    aside = [line for line in lines if line.startswith(ASIDE)]
    out = [f"<p>{html.escape(line)}</p>" for line in lines if line not in aside]
    if aside:
        lists = "".join(f"<p>{html.escape(line)}</p>" for line in aside)
        out.append(f"<details><summary>What else was asked about</summary>{lists}</details>")
    return out


def _evidence(answer: Diagnosis) -> list[str]:
    """Pictures and tables of a search."""
    found, content = answer.search, answer.content
    before, after = found.held_out
    first = screen(found.start)
    rows = [*first, *found.scores]
    named = _named(content, rows)
    own = {r.hypothesis.effect: r.hypothesis.description for r in rows} | {c["effect"]: c["says"] for c in content["causes"]}
    meanings = {name: said for name, said in own.items() if said} | GLOSSARY | ALIKE
    instead = {n: c["effect"] for c in content["causes"] for n in (*c["class"], *(r["effect"] for r in c["rivals"]))}
    return [
        *_causes(content["causes"]),
        *_over_cloud(answer),
        "<h2>Where and when</h2>",
        "<p>Means over parts of the fabric and 0.2 s, as a fit to all motions leaves them. Grey: not seen, or left out "
        "because it jumps between shapes of the cloth.</p>",
        _image(pictures.draw_residual_maps(answer), "Neither points nor markers were seen."),
        "<h2>Motions held out</h2>",
        "<p>Each motion is predicted from the others. Small errors of clock, camera and grip that differ between "
        "episodes are taken out, so that a camera that stands elsewhere hardly shows here.</p>",
        _image(pictures.draw_held_out_rms(answer, before, after if found.accepted else None)),
        _gained(answer.content["gain"]),
        "<h2>What the residuals of the base model ask for</h2>",
        "<p>A first guess by slopes, which decides what is fitted, with 95 % intervals. The causes above are what fits "
        "ended with.</p>",
        _image(pictures.draw_scores(first)),
        "<h2>What is left</h2>" if found.accepted else "<h2>All hypotheses</h2>",
        _table(found.scores, instead),
        "<h2>Lack of fit</h2>",
        f"<p>{LACK}</p>",
        _left(content["lack_of_fit"], pictures.wrap_labels(content)),
        _drifts(answer.content["drifts"]),
        *_missing(answer),
        *_learned(answer.content["residual"]),
        "<h2>What these motions can tell apart</h2>",
        "<p>Dark: the two look alike in these data, by slopes. Which cannot be told apart by fits is said above.</p>",
        _image(pictures.draw_correlations(answer), "Nothing that was asked about shows in them."),
        "<h2>Parameters of the model</h2>",
        _parameters(answer.content["parameters"]),
        "<h2>What the names mean</h2>",
        *(f"<p><b>{n}</b>: {html.escape(said)}</p>" for n, said in meanings.items() if n in named),
    ]


def _named(content: Mapping[str, Any], screened: Sequence[ScoreTest]) -> set[str]:
    """Effects that the report speaks of, without axes."""
    names = {r.hypothesis.name for r in screened}
    names |= {n for c in content["causes"] for n in (c["effect"], *c["class"], *(r["effect"] for r in c["rivals"]))}
    return {name.partition("[")[0] for name in names}


def _causes(rows: list[dict[str, Any]]) -> list[str]:
    """What is named: how large, how much it mends and how sure that is."""
    if not rows:
        return []

    def told(c: dict[str, Any]) -> list[str]:
        unit, (low, high), placebo = "" if c["unit"] == "-" else c["unit"], c["ci95"], c["placebo"]
        chance = "–" if placebo["chance"] is None else f"{placebo['chance']:.1f}"
        share = "–" if c["share_of_explainable"] is None else f"{100 * c['share_of_explainable']:.0f} %"
        others = [n for n in c["class"] if n != c["effect"]] + [r["effect"] for r in c["rivals"]]
        return [
            c["effect"],
            f"{c['amplitude']:.4g} {unit}",
            f"{low:.4g} to {high:.4g}",
            f"{c['amplitude'] / c['typical']:.2g}",
            f"{c['gain_mm']:.2f}",
            share,
            f"{placebo['log_density']:.0f}",
            chance,
            ", ".join(dict.fromkeys(others)) or "nothing",
        ]

    head = (
        "cause", "amplitude", "95 %", "of typical", "mends, mm", "of what is explainable", "log density",
        "by chance", "cannot be told from",
    )  # fmt: skip
    return [
        "<h2>Causes</h2>",
        f"<p>{CAUSES}</p>",
        _ruled(head, ((told(c), False) for c in rows)),
    ]


def _over_cloud(answer: Diagnosis) -> list[str]:
    """The moments that were kept, if any."""
    if not answer.overlays:
        return []
    faces = answer.search.data.sheet.faces.numpy()
    told = (
        "Of each episode the moment in which the base model is farthest off, with the mean distance of all its points, "
        "also of those that count for nothing elsewhere because the cloth jumps."
    )
    return [
        "<h2>Measured points over the simulation</h2>",
        f"<p>{told}</p>",
        _image(draw_cloud_overlays(answer.overlays, faces), alt="Measured points over the simulated cloth"),
    ]


def _gained(gain: dict[str, Any] | None) -> str:
    """What all causes gain, motion by motion."""
    if gain is None:
        return ""

    def told(row: dict[str, Any]) -> list[str]:
        rms = ("–" if row[key] is None else f"{1e3 * row[key]:.2f}" for key in ("rms_before", "rms_after"))
        share = _within(row["explained_fraction"], row["ci95"], 100.0)
        return [row["motion"], *rms, share, _within(row["log_density"], row["log_density_ci95"])]

    head = ("motion held out", "RMS before, mm", "after, mm", "% explained (95 %)", "log density gained (95 %)")
    return _ruled(head, ((told(row), False) for row in gain["per_motion"]))


def _within(value: float | None, ends: list[float] | None, factor: float = 1.0) -> str:
    """A number with its interval, as far as they are known."""
    if value is None:
        return "–"
    return f"{factor * value:.0f}" + ("" if ends is None else " ({:.0f} to {:.0f})".format(*(factor * e for e in ends)))


def _image(figure: Any, otherwise: str = "", alt: str = "As the heading says") -> str:
    if figure is None:
        return f"<p>{otherwise}</p>"
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return f'<img alt="{alt}" src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">'


COLUMNS = (
    "hypothesis", "unit", "amplitude", "std. error", "shift by the mesh", "matters from", "shows from", "typical",
    "typical moves, mm", "decision",
)  # fmt: skip
CAUSES = (
    "Mends and log density: gained on motions that were held out; each unit of log density makes them e times "
    "likelier. Log density is here by slopes, from the fit with all causes, so that it can be held against chance: "
    "its own slopes, put in wrong places, would rarely gain more than the number beside it. By fits, as above, it is "
    "another number."
)
LACK = (
    "What a right model leaves: the sensor's slow errors, what another mesh changes, and ripples, which another cloth "
    "has elsewhere. Where these are large, little can be called lacking."
)
DECISIONS = (
    "Amplitude: what the residuals ask for. Present: surely larger than what matters. Absent: surely smaller than that "
    "(not zero), or of a sign that makes no sense. Unresolvable: even a typical amplitude might not show, or would "
    "move the cloth by less than 0.3 mm; an amplitude shows, in one of two cases, from the value in its column on. "
    "Inconclusive: none of these. Typical moves: what a typical amplitude does to the cloth beyond what is fitted "
    "anyway."
)


def _table(rows: list[ScoreTest], instead: dict[str, str]) -> str:
    """``instead``: by name, the cause that is named for it as well."""
    body = []
    for r in rows:
        h = r.hypothesis
        numbers = (r.amplitude, r.std, r.mesh_bias, abs(h.smallest), r.smallest_detectable, h.typical, 1e3 * r.position_rms)
        decision = f"not told from {instead[h.name]}" if h.name in instead else r.decision
        cells = [h.name, h.unit, *(f"{x:.3g}" if math.isfinite(x) else "–" for x in numbers), decision]
        if not math.isfinite(r.std):  # it could not be asked about
            cells[2] = cells[4] = "–"
        body.append("".join(f"<td>{html.escape(c)}</td>" for c in cells))
    heads = "".join(f"<th>{name}</th>" for name in COLUMNS)
    return f"<p>{DECISIONS}</p><table><tr>{heads}</tr>{''.join(f'<tr>{row}</tr>' for row in body)}</table>"


def _ruled(head: Sequence[str], rows: Iterable[tuple[Sequence[str], bool]]) -> str:
    """A table of cells; rows that are marked stand in bold."""
    body = ""
    for cells, bold in rows:
        tag = "th" if bold else "td"
        body += f"<tr>{''.join(f'<{tag}>{html.escape(c)}</{tag}>' for c in cells)}</tr>"
    return f"<table><tr>{''.join(f'<th>{h}</th>' for h in head)}</tr>{body}</table>"


def _left(rows: list[dict[str, Any]], titles: list[str]) -> str:
    """What remains, by episode and kind of data, beside what a right model would leave; lacking rows in bold."""

    def told(r: dict[str, Any]) -> list[str]:
        scale, unit = {"m": (1e3, "mm"), "N": (1e3, "mN"), "N m": (1e3, "mN m")}[r["unit"]]
        numbers = [f"{scale * r[key]:.2f}" for key in ("left", "expected", "numerics")]
        return [titles[r["episode"]], r["kind"], *numbers, unit, f"{r['ratio']:.2f}", f"{r['p']:.2g}"]

    head = ("motion", "data", "left", "a right model leaves", "of which numerics", "", "ratio", "chance")
    return _ruled(head, ((told(r), r["lacking"]) for r in rows))


def _drifts(rows: list[dict[str, Any]]) -> str:
    """What forces drift by in all motions alike; lacking rows in bold."""

    def told(r: dict[str, Any]) -> list[str]:
        return [f"force, {r['axis']}", f"{1e3 * r['rate']:.1f}", f"{1e3 * r['std']:.1f}", "mN/s", f"{r['p']:.2g}"]

    head = ("in all motions alike", "grows by", "std. error", "", "chance")
    return _ruled(head, ((told(r), r["lacking"]) for r in rows)) if rows else ""


def _missing(answer: Diagnosis) -> list[str]:
    if answer.missing_force is None:
        return []
    return [
        "<h2>The force that is missing</h2>",
        "<p>Beside the model and its causes, where and when it is the surest in each motion. Red: along the normal "
        "u × v; arrows: along the cloth, where sure. Names no cause.</p>",
        _image(pictures.draw_missing_force(answer.missing_force)),
    ]


def _learned(found: dict[str, Any] | None) -> list[str]:
    """The laws of a residual force, if any was looked for."""
    if found is None:
        return []
    title = "<h2>Laws without a cause</h2>"
    if not found["terms"]:
        return [title, "<p>No local law was found that would predict motions held out better.</p>"]
    gain, head = found["gain"], ("law", "coefficient", "unit", "what it does")
    terms = (([t["law"], f"{t['coefficient']:.3g}", t["unit"], t["told"]], False) for t in found["terms"])
    return [
        title,
        f"<p>Local laws that were learned: {1e3 * gain['rms_before']:.2f} to {1e3 * gain['rms_after']:.2f} mm "
        "on motions held out. They are part of the extended model and can be left out.</p>",
        _ruled(head, terms),
    ]


def _parameters(found: dict[str, Any]) -> str:
    rows = "".join(
        f"<tr><td>{name}</td><td>{p['value']:.4g}</td><td>{p['ci95'][0]:.4g} to {p['ci95'][1]:.4g}</td>"
        f"<td>{p['data_sheet']:.4g}</td><td>{p['unit']}</td></tr>"
        for name, p in found.items()
    )
    return (
        f"<table><tr><th>parameter</th><th>value</th><th>95 %</th><th>data sheet</th><th>unit</th></tr>{rows}</table>"
    )
