"""Measured cloth: fits of some measurements predict the others, each with its null and its interval.

Nylon at angles that were not fitted; the third pull of knits from the first two; 10 swings in air from 20 others; the
sample that the paper's authors released. The data are not shipped: name their folder with --source.
"""

from __future__ import annotations

import argparse
import json
import os
from functools import partial
from pathlib import Path
from typing import Any

from torchcloth._utils.files import write_text
from torchcloth._utils.resume import clear_store
from torchcloth.errors import InvalidInput

from ...resumable import ResumableStudy
from . import free_swings, measured_figures, measured_tables, sample, swing_predictions, swings, tension

VARIABLE = "TORCHCLOTH_REALDATA"
SOURCES = (tension.NYLON, tension.KNITS, swings.SOURCE, sample.SOURCE)


def add(parser: argparse.ArgumentParser) -> None:
    """Options."""
    parser.add_argument("--source", type=Path, metavar="DIR", help=f"folder of measured data (${VARIABLE})")


def run(options: argparse.Namespace) -> None:
    """Compute what is missing, then print and draw everything."""
    source = find(options.source)
    study = ResumableStudy(options.out, {"study": "measured", "fast": options.fast, "source": str(source.resolve())})
    there = [name for name in SOURCES if (source / name).is_dir()]
    result: dict[str, Any] = {}
    if tension.NYLON in there:
        result["nylon"] = _nylon(study, source / tension.NYLON, options)
    if tension.KNITS in there:
        result["knits"] = _knits(study, source / tension.KNITS, options)
    if swings.SOURCE in there:
        result["swings"] = _swings(study, source / swings.SOURCE, options)
    if sample.SOURCE in there:
        result["sample"] = _sample(study, source / sample.SOURCE, options)
    for name in set(SOURCES) - set(there):
        print(f"{source / name} is absent: left out")
    path = write_text(options.out / "measured.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
    drawn = ", ".join(str(p) for p in sorted(options.out.glob("*.png")))
    print(f"result:   {path}\npictures: {drawn}")


def find(given: Path | None) -> Path:
    """The folder of measured data.

    Raises:
        InvalidInput: none was named, or it holds none of the sources.
    """
    expected = f"a folder with some of {', '.join(SOURCES)}"
    if given is None and not os.environ.get(VARIABLE):
        raise InvalidInput("--source", got="none", expected=expected, remedy=f"name it, or set {VARIABLE}")
    source = Path(os.environ[VARIABLE]) if given is None else given
    if not any((source / name).is_dir() for name in SOURCES):
        raise InvalidInput("--source", got=source, expected=expected)
    return source


def _nylon(study: ResumableStudy, source: Path, options: argparse.Namespace) -> dict[str, Any]:
    cases = {"nylon": partial(tension.nylon, source, options.out / "nylon", options.fast)}
    found = study.run(cases)["nylon"]
    measured_tables.nylon(found, options.out / "nylon")
    measured_figures.nylon(found, source, options.out / "nylon.png")
    return found


def _knits(study: ResumableStudy, source: Path, options: argparse.Namespace) -> dict[str, Any]:
    names = tension.fabrics(source, options.fast)
    cases = {f"knit-{name}": partial(tension.knit, source, options.out / "knits" / name, name) for name in names}
    found = dict(zip(names, study.run(cases).values(), strict=True))
    measured_tables.knits(found)
    measured_figures.knits(found, source, options.out / "knits.png")
    return found


def _swings(study: ResumableStudy, source: Path, options: argparse.Namespace) -> dict[str, Any]:
    fitted, held = swings.split(source, options.fast)
    found = study.run(
        {
            "swings-whole": partial(_fit, source, fitted, options.out, options.fast),
            "swings-free": partial(free_swings.match, source, fitted, options.fast),
        }
    )
    clear_store(_journal(options.out))
    fits = {part.removeprefix("swings-"): content for part, content in found.items()}
    models = {"vacuum": dict.fromkeys(swings.NAMES, 0.0), "textbook": swings.START}
    models |= {part: content["values"] for part, content in fits.items()}
    cases = study.run({f"swing-{name}": partial(swing_predictions.predict, source, name, models) for name in held})
    runs = dict(zip(held, cases.values(), strict=True))
    found = {
        "fitted_runs": fitted,
        "predicted_runs": held,
        "fits": fits,
        "predicted": swing_predictions.summary(runs, list(models)),
    }
    measured_tables.swings(found)
    measured_figures.swings(found, runs, options.out / "swings.png")
    return found


def _fit(source: Path, names: list[str], out: Path, fast: bool) -> dict[str, Any]:
    """A fit of many runs as a case; its journal lasts until that is kept."""
    fit = swings.fit(source, names, _journal(out), fast)
    fit.save(out / "swings")
    content = fit.as_dict()
    return {
        "ratios": swings.ratios(content["parameters"]),
        "values": {name: fit.parameters[name].value for name in swings.NAMES},
        "fit": content["fit"],
        "warnings": fit.warnings,
    }


def _journal(out: Path) -> Path:
    return out / "progress" / "whole"


def _sample(study: ResumableStudy, source: Path, options: argparse.Namespace) -> dict[str, Any]:
    journal = options.out / "progress" / "sample"
    work = partial(sample.run, source, options.out / "sample", journal, options.fast)
    found = study.run({"sample": work})["sample"]
    clear_store(journal)
    measured_tables.sample(found)
    return found
