"""Archives of hidden rounds: the answers of one round in one compressed file.

An archive is JSON lines, compressed with xz. Its first line describes the round: ``schema`` (of its keys), ``round``
(the commit that answered), ``date`` (of that commit) and the settings of the study (``secret``, ``fast``). Each further
line is one case: its ``name``, and what ``studies hidden`` wrote to ``cases/NAME.json``.

Old files keep the keys of their time. ``RENAMED_KEYS`` is the only place that knows them.

    # DIR: --out of the study
    python -m torchcloth.training.studies.hidden_archive DIR COMMIT docs/validation/blind-rounds/answers
"""

from __future__ import annotations

import argparse
import json
import lzma
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchcloth._utils.files import write_atomically
from torchcloth.errors import InvalidInput

SUFFIX = ".jsonl.xz"
CURRENT_SCHEMA = 3  # of the keys that cases are written with today

# By schema of the file: old key -> new key, to come from this schema to the next one. A key is given with its path from
# the case's root, joined by dots; lists in between are not counted, so "answer.causes.rivals" is a key of each cause.
# What is said of "answer" holds for the two answers under "next" as well.
RENAMED_KEYS: dict[int, dict[str, str]] = {
    1: {
        "truth.effects.beside": "is_enabling",
        "truth.effects.share": "typical_fraction",
        "truth.said": "data_sheet_ratio",
        "truth.confounded.like": "causes",
        "truth.confounded.soft": "may_be_separable",
        "sizes.moves": "displacement_rms_m",
        "sizes.pulls": "force_rms_n",
        "sizes.left_moves": "unexplained_displacement_rms_m",
        "sizes.left_pulls": "unexplained_force_rms_n",
    },
    2: {
        "answer.causes.class": "equivalence_class",
        "answer.causes.gain_mm": "rms_removed_mm",
        "answer.causes.placebo": "permutation_test",
        "answer.causes.placebo.chance": "quantile_95",
        "answer.causes.says": "description",
        "answer.causes.share_of_explainable": "explained_fraction",
        "answer.causes.told_by": "effective_motions",
        "answer.common_error": "common_relative_error",
        "answer.drifts": "force_drifts",
        "answer.floor": "noise_floor",
        "answer.gain.ci95": "explained_fraction_ci95",
        "answer.gain.floor": "noise_floor",
        "answer.gain.per_motion.ci95": "explained_fraction_ci95",
        "answer.given": "initial_causes",
        "answer.residual": "residual_force",
    },
}
ANSWER_PATHS: dict[tuple[str, ...], tuple[str, ...]] = {
    ("next", "proposed"): ("answer",),
    ("next", "random"): ("answer",),
}

# Statistics of each motion's residuals are two fifths of an answer, and no score uses them.
ROUNDED_KEY = "lack_of_fit"
ROUNDED_DIGITS = 9  # significant digits

Case = dict[str, Any]


class Round(NamedTuple):
    """The answered cases of one round.

    Attributes:
        name: commit of the code that answered, or the folder's name.
        date: of that commit, in ISO format; "" where it is not known.
        cases: by name, with today's keys.
    """

    name: str
    date: str
    cases: dict[str, Case]


def read_round(path: Path) -> Round:
    """Read a round from an archive, or from the folder in which the study has answered it.

    Raises:
        InvalidInput: it is neither.
    """
    try:
        return _read_archive(path) if path.is_file() else _read_folder(path)
    except (OSError, EOFError, lzma.LZMAError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InvalidInput(
            "--answers", got=f"{path}: {error!r}", expected=f"an archive of a hidden round (*{SUFFIX}) or its folder"
        ) from None


def write_archive(folder: Path, path: Path, name: str, date: str) -> None:
    """Write the finished cases of a study's folder as an archive.

    Args:
        folder: of the study, with ``study.json`` and ``cases/``.
        path: of the archive, a name that ends with .jsonl.xz.
        name: commit of the code that answered.
        date: of that commit, in ISO format.

    Raises:
        InvalidInput: the folder holds no finished round, or another schema than today's.
    """
    cases = {file.stem: json.loads(file.read_text()) for file in sorted(folder.glob("cases/*.json"))}
    schemas = {case.get("schema", 1) for case in cases.values()}
    if len(schemas) != 1:
        raise InvalidInput("folder", got=f"{folder} with schemas {sorted(schemas)}", expected="cases of one schema")
    settings = json.loads((folder / "study.json").read_text())
    lines = [settings | {"schema": schemas.pop(), "round": name, "date": date}]
    lines += [{"name": key, **{k: _round_statistics(k, v) for k, v in case.items()}} for key, case in cases.items()]
    preset = 9 | lzma.PRESET_EXTREME
    with write_atomically(path) as part, lzma.open(part, "wt", preset=preset, encoding="utf-8") as file:
        file.writelines(json.dumps(line, ensure_ascii=False, separators=(",", ":")) + "\n" for line in lines)


def upgrade(case: Case, schema: int) -> Case:
    """Return a case with today's keys.

    Raises:
        ValueError: the schema is none that this version knows.
    """
    if schema != CURRENT_SCHEMA and schema not in RENAMED_KEYS:
        raise ValueError(f"schema {schema} is not known, up to {CURRENT_SCHEMA} are")
    for step in range(schema, CURRENT_SCHEMA):
        table = {tuple(old.split(".")): new for old, new in RENAMED_KEYS[step].items()}
        if table:
            case = _rename(case, (), table)
    return case


def _rename(value: Any, path: tuple[str, ...], table: Mapping[tuple[str, ...], str]) -> Any:
    if isinstance(value, list):
        return [_rename(item, path, table) for item in value]
    if not isinstance(value, dict):
        return value
    path = ANSWER_PATHS.get(path, path)
    return {table.get((*path, key), key): _rename(item, (*path, key), table) for key, item in value.items()}


def _read_archive(path: Path) -> Round:
    with lzma.open(path, "rt", encoding="utf-8") as file:
        header, *cases = (json.loads(line) for line in file)
    if not cases:
        raise ValueError("no case")
    upgraded = {case.pop("name"): upgrade(case, header["schema"]) for case in cases}
    return Round(header["round"], header["date"], upgraded)


def _read_folder(folder: Path) -> Round:
    paths = sorted(folder.glob("cases/*.json"))
    if not paths:
        raise ValueError("no cases/*.json")
    cases = {path.stem: json.loads(path.read_text()) for path in paths}
    return Round(folder.resolve().name, "", {name: upgrade(c, c.get("schema", 1)) for name, c in cases.items()})


def _round_statistics(key: str, value: Any, inside: bool = False) -> Any:
    inside = inside or key == ROUNDED_KEY
    if isinstance(value, dict):
        return {k: _round_statistics(k, v, inside) for k, v in value.items()}
    if isinstance(value, list):
        return [_round_statistics(key, item, inside) for item in value]
    return float(f"{value:.{ROUNDED_DIGITS}g}") if inside and isinstance(value, float) else value


def main(arguments: Sequence[str] | None = None) -> int:
    """Archive the finished round in a folder; return the exit code."""
    parser = argparse.ArgumentParser(prog="hidden_archive", description="Archive the finished round in a folder.")
    parser.add_argument("folder", type=Path, metavar="DIR", help="of the study: study.json and cases/")
    parser.add_argument("commit", help="of the code that answered")
    parser.add_argument("archives", type=Path, metavar="FOLDER", help="that the archive is written to")
    options = parser.parse_args(arguments)
    command = ["git", "log", "-1", "--format=%cI", options.commit, "--"]
    date = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    path = options.archives / f"{date[:10]}-{options.commit}{SUFFIX}"
    write_archive(options.folder, path, options.commit, date)
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
