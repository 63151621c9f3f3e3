"""Measured cloth: fits to some measurements predict the others, each compared with its null and its interval.

The study predicts nylon at angles that were not fitted, the third pull of knits from the first two, 10 swings in air
from 20 others, carries of the same cloth from the swings, and the sample that the paper's authors released. The data
are not shipped: name their folder by --source.
"""

from __future__ import annotations

import argparse
import os
from functools import partial
from pathlib import Path
from typing import Any

from torchcloth._utils.resume import clear_store
from torchcloth.errors import InvalidInput

from ...resumable import ResumableStudy, write_result
from ...validation.realdata import carries
from . import (
    free_swings,
    measured_figures,
    measured_tables,
    rig,
    sample,
    swing_predictions,
    swings,
    tension,
    timed,
    timed_report,
)

DATA_VARIABLE = "TORCHCLOTH_REALDATA"
SOURCE_NAMES = (
    tension.NYLON_SOURCE,
    tension.KNIT_SOURCE,
    swings.SOURCE_NAME,
    sample.SOURCE_NAME,
    carries.SOURCE_NAME,
)


def add(parser: argparse.ArgumentParser) -> None:
    """Add the study's options."""
    parser.add_argument("--source", type=Path, metavar="DIR", help=f"folder of measured data (${DATA_VARIABLE})")


def run(options: argparse.Namespace) -> None:
    """Compute the missing cases, then print and draw the results."""
    source = find_data_folder(options.source)
    study = ResumableStudy(options.out, {"study": "measured", "fast": options.fast, "source": str(source.resolve())})
    available = [name for name in SOURCE_NAMES if (source / name).is_dir()]
    result: dict[str, Any] = {}
    if tension.NYLON_SOURCE in available:
        result["nylon"] = _nylon(study, source / tension.NYLON_SOURCE, options)
    if tension.KNIT_SOURCE in available:
        result["knits"] = _knits(study, source / tension.KNIT_SOURCE, options)
    if swings.SOURCE_NAME in available:
        result["swings"] = _swings(study, source / swings.SOURCE_NAME, options)
        result |= _timed(study, source, options)
    if sample.SOURCE_NAME in available:
        result["sample"] = _sample(study, source / sample.SOURCE_NAME, options)
    for name in set(SOURCE_NAMES) - set(available):
        print(f"{source / name} does not exist and is left out")
    path = write_result(options.out / "measured.json", "measured", result)
    drawn = ", ".join(str(p) for p in sorted(options.out.glob("*.png")))
    print(f"result:   {path}\npictures: {drawn}")


def find_data_folder(given: Path | None) -> Path:
    """Return the folder of measured data.

    Raises:
        InvalidInput: no folder is named, or it contains none of the sources.
    """
    expected = f"a folder with some of {', '.join(SOURCE_NAMES)}"
    if given is None and not os.environ.get(DATA_VARIABLE):
        raise InvalidInput("--source", got="none", expected=expected, remedy=f"name it, or set {DATA_VARIABLE}")
    source = Path(os.environ[DATA_VARIABLE]) if given is None else given
    if not any((source / name).is_dir() for name in SOURCE_NAMES):
        raise InvalidInput("--source", got=source, expected=expected)
    return source


def _nylon(study: ResumableStudy, source: Path, options: argparse.Namespace) -> dict[str, Any]:
    cases = {"nylon": partial(tension.nylon, source, options.out / "nylon", options.fast)}
    result = study.run(cases)["nylon"]
    measured_tables.nylon(result, options.out / "nylon")
    measured_figures.nylon(result, source, options.out / "nylon.png")
    return result


def _knits(study: ResumableStudy, source: Path, options: argparse.Namespace) -> dict[str, Any]:
    names = tension.fabrics(source, options.fast)
    cases = {f"knit-{name}": partial(tension.knit, source, options.out / "knits" / name, name) for name in names}
    result = dict(zip(names, study.run(cases).values(), strict=True))
    measured_tables.knits(result)
    measured_figures.knits(result, source, options.out / "knits.png")
    return result


def _swings(study: ResumableStudy, source: Path, options: argparse.Namespace) -> dict[str, Any]:
    fitted, predicted = swings.split(source, options.fast)
    result = study.run(
        {
            "swings-whole": partial(_fit, source, fitted, options.out, options.fast),
            "swings-free": partial(free_swings.match, source, fitted, options.fast),
        }
    )
    clear_store(_journal(options.out))
    fits = {part.removeprefix("swings-"): content for part, content in result.items()}
    models = {"vacuum": dict.fromkeys(swings.FITTED_NAMES, 0.0), "textbook": swings.START_VALUES}
    models |= {part: content["values"] for part, content in fits.items()}
    cases = study.run({f"swing-{name}": partial(swing_predictions.predict, source, name, models) for name in predicted})
    runs = dict(zip(predicted, cases.values(), strict=True))
    result = {
        "fitted_runs": fitted,
        "predicted_runs": predicted,
        "fits": fits,
        "predicted": swing_predictions.summary(runs, list(models)),
    }
    measured_tables.swings(result)
    measured_figures.swings(result, runs, options.out / "swings.png")
    return result


def _timed(study: ResumableStudy, source: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Fit swings with the times of single frames, and predict other swings and the carries."""
    folder, carry_folder = source / swings.SOURCE_NAME, source / carries.SOURCE_NAME
    fitted, predicted = swings.split(folder, options.fast)
    rounds = timed.FAST_ROUNDS if options.fast else timed.FIT_ROUNDS
    cases = {
        f"timed-fit-{label.replace(' ', '-')}": partial(_timed_fit, folder, fitted, start, rounds)
        for label, start in timed.TIMED_STARTS.items()
    }
    fits = dict(zip(timed.TIMED_STARTS, study.run(cases).values(), strict=True))
    [swing_case] = study.run({"timed-swings": partial(timed.predict_swings, folder, predicted, fits)}).values()
    result = {"timed": {"fits": fits, "fitted_runs": fitted, "predicted_runs": predicted, **swing_case}}
    if carry_folder.is_dir():
        names = sorted(carries.read_runs(carry_folder))[4:5] if options.fast else None
        [result["carries"]] = study.run(
            {"timed-carries": partial(timed.predict_carries, carry_folder, fits, names)}
        ).values()
    timed_report.print_tables(result)
    timed_report.draw(result, options.out / "timed.png")
    return result


def _timed_fit(folder: Path, names: list[str], start: rig.Values, rounds: int) -> dict[str, Any]:
    return timed.fit(timed.read_swings(folder, names), start, rounds)


def _fit(source: Path, names: list[str], out: Path, fast: bool) -> dict[str, Any]:
    """Fit many runs as a case; its journal exists until the case is saved."""
    fit = swings.fit(source, names, _journal(out), fast)
    fit.save(out / "swings")
    content = fit.as_dict()
    return {
        "ratios": swings.ratios(content["parameters"]),
        "values": {name: fit.parameters[name].value for name in swings.FITTED_NAMES},
        "fit": content["fit"],
        "warnings": fit.warnings,
    }


def _journal(out: Path) -> Path:
    return out / "progress" / "whole"


def _sample(study: ResumableStudy, source: Path, options: argparse.Namespace) -> dict[str, Any]:
    journal = options.out / "progress" / "sample"
    work = partial(sample.run, source, options.out / "sample", journal, options.fast)
    result = study.run({"sample": work})["sample"]
    clear_store(journal)
    measured_tables.sample(result)
    return result
