"""report.html: one file that says what was found and shows why."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from .._files import write_text
from . import pictures
from .cloud_pictures import over_cloud
from .glossary import GLOSSARY
from .screening import Row, screen
from .verdict import Diagnosis

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
        *(f"<p>{html.escape(line)}</p>" for line in answer.summary().splitlines()),
    ]
    parts = verdict if answer.searched is None else verdict + _evidence(answer)
    title = "What the simulation gets wrong"
    page = f"<!doctype html><html><head><meta charset='utf-8'><title>{title}</title><style>{STYLE}</style></head>"
    return write_text(folder / "report.html", f"{page}<body><h1>{title}</h1>{''.join(parts)}</body></html>\n")


def _evidence(answer: Diagnosis) -> list[str]:
    """Pictures and tables of a search."""
    found = answer.found
    before, after = found.held_out
    return [
        *_over_cloud(answer),
        "<h2>Where and when</h2>",
        "<p>Grey: not seen, or left out because it jumps between shapes of the cloth.</p>",
        _image(pictures.residual_maps(answer), "Neither points nor markers were seen."),
        "<h2>Motions held out</h2>",
        _image(pictures.courses(answer, before, after if found.steps else None)),
        _gained(answer.content["gain"]),
        "<h2>What the residuals of the base model ask for</h2>",
        "<p>A first guess by slopes, which decides what is fitted. The causes above are what fits ended with.</p>",
        _image(pictures.screening(screen(found.start))),
        "<h2>What is left</h2>" if found.steps else "<h2>All hypotheses</h2>",
        _table(found.screened),
        "<h2>Lack of fit</h2>",
        f"<p>{LACK}</p>",
        _left(answer.content["lack_of_fit"]),
        _drifts(answer.content["drifts"]),
        *_missing(answer),
        *_learned(answer.content["residual"]),
        "<h2>What these motions can tell apart</h2>",
        _image(pictures.isolability(answer), "Nothing that was asked about shows in them."),
        "<h2>Parameters of the model</h2>",
        _parameters(answer.content["parameters"]),
        "<h2>What the names mean</h2>",
        *(f"<p><b>{name}</b>: {html.escape(said)}</p>" for name, said in GLOSSARY.items()),
    ]


def _over_cloud(answer: Diagnosis) -> list[str]:
    """The moments that were kept, if any."""
    if not answer.overlays:
        return []
    faces = answer.found.setting.sheet.faces.numpy()
    told = (
        "Of each episode the moment in which the base model is farthest off, with the mean distance of all its points, "
        "also of those that count for nothing elsewhere because the cloth jumps."
    )
    return [
        "<h2>Measured points over the simulation</h2>",
        f"<p>{told}</p>",
        _image(over_cloud(answer.overlays, faces)),
    ]


def _gained(gain: dict[str, Any] | None) -> str:
    """What all causes gain, motion by motion."""
    if gain is None:
        return ""

    def told(row: dict[str, Any]) -> list[str]:
        rms = (row[key] for key in ("rms_before", "rms_after"))
        return [row["motion"], *("–" if r is None else f"{1e3 * r:.2f}" for r in rms), f"{row['log_density']:.1f}"]

    head = ("motion held out", "RMS before, mm", "after, mm", "log density gained")
    return _ruled(head, ((told(row), False) for row in gain["per_motion"]))


def _image(figure: Any, otherwise: str = "") -> str:
    if figure is None:
        return f"<p>{otherwise}</p>"
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return f'<img src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">'


COLUMNS = (
    "hypothesis", "unit", "amplitude", "std. error", "of numerics", "matters from", "shows from", "typical",
    "typical moves, mm", "decision",
)  # fmt: skip
LACK = (
    "What a right model leaves: the sensor's slow errors, what another mesh changes, and ripples, which another cloth "
    "has elsewhere. Where these are large, little can be called lacking."
)
DECISIONS = (
    "Amplitude: what the residuals ask for. Present: surely larger than what matters. Absent: surely smaller than that "
    "(not zero), or of a sign that makes no sense. Unresolvable: even a typical amplitude might not show; an amplitude "
    "shows, in one of two cases, from the value in its column on. Inconclusive: none of these. Typical moves: what a "
    "typical amplitude does to the cloth beyond what is fitted anyway."
)


def _table(rows: list[Row]) -> str:
    body = []
    for r in rows:
        h = r.hypothesis
        numbers = (r.amplitude, r.std, r.bias, abs(h.smallest), r.detectable, h.typical, 1e3 * r.size)
        cells = [h.name, h.unit, *(f"{x:.3g}" for x in numbers), r.decision]
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


def _left(rows: list[dict[str, Any]]) -> str:
    """What remains, by motion and kind of data, beside what a right model would leave; lacking rows in bold."""

    def told(r: dict[str, Any]) -> list[str]:
        scale, unit = {"m": (1e3, "mm"), "N": (1e3, "mN"), "N m": (1e3, "mN m")}[r["unit"]]
        numbers = [f"{scale * r[key]:.2f}" for key in ("left", "expected", "numerics")]
        return [r["motion"], r["kind"], *numbers, unit, f"{r['ratio']:.2f}", f"{r['p']:.2g}"]

    head = ("motion", "data", "left", "a right model leaves", "of which numerics", "", "ratio", "chance")
    return _ruled(head, ((told(r), r["lacking"]) for r in rows))


def _drifts(rows: list[dict[str, Any]]) -> str:
    """What forces drift by in all motions alike; lacking rows in bold."""

    def told(r: dict[str, Any]) -> list[str]:
        return [f"force, {r['axis']}", f"{1e3 * r['rate']:.1f}", f"{1e3 * r['std']:.1f}", "mN/s", f"{r['p']:.2g}"]

    head = ("in all motions alike", "grows by", "std. error", "", "chance")
    return _ruled(head, ((told(r), r["lacking"]) for r in rows)) if rows else ""


def _missing(answer: Diagnosis) -> list[str]:
    if answer.missing is None:
        return []
    return [
        "<h2>The force that is missing</h2>",
        "<p>Beside the model and its causes, where and when it is the surest in each motion. Names no cause.</p>",
        _image(pictures.missing_force(answer.missing)),
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
        f"<td>{p['unit']}</td></tr>"
        for name, p in found.items()
    )
    return f"<table><tr><th>parameter</th><th>value</th><th>95 %</th><th>unit</th></tr>{rows}</table>"
