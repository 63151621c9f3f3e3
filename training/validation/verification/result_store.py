"""Finished cases on disk, so that a stopped run resumes."""

from __future__ import annotations

import ast
import hashlib
import inspect
import io
import json
import os
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from .registry import Case, Mark, Outcome, Row

HERE = Path(__file__).parent
LIBRARY = HERE.parents[2] / "torchcloth"
SHARED = ("registry.py", "scenes.py", "closed_forms.py")


class Results:
    """Outcomes by case; a finished one is valid while the case's sources and the library are as they were."""

    def __init__(self, folder: Path, fast: bool, resume: bool, fresh: bool) -> None:
        self.folder, self.fast, self.resume, self.fresh = folder, fast, resume, fresh
        self.store = folder / ("fast" if fast else "full")
        self.store.mkdir(parents=True, exist_ok=True)
        self._library = _digest(sorted(LIBRARY.rglob("*.py")))

    def get(self, case: Case) -> tuple[Outcome, bool]:
        """(outcome, whether it was found finished)."""
        file = self.store / f"{case.name}.npz"
        own = self._key(case)
        if not self.fresh and file.is_file():
            found = _read(file)
            if found and found[0]["case"] == own and (self.resume or found[0]["library"] == self._library):
                return found[1], True
        outcome = case.function(self.fast)
        _write(file, {"case": own, "library": self._library}, outcome)
        return outcome, False

    def _key(self, case: Case) -> str:
        """Of what the case computes with: its module without the other cases, and what all share."""
        own = inspect.getsourcefile(case.function)
        total = hashlib.sha256(_digest([HERE / name for name in SHARED]).encode())
        for node in ast.parse(Path(own).read_text(encoding="utf-8")).body if own else ():
            if not _is_case(node) or getattr(node, "name", "") == case.function.__name__:
                total.update(ast.dump(node).encode())
        return total.hexdigest()[:16]


def _is_case(node: ast.stmt) -> bool:
    calls = [d.func for d in getattr(node, "decorator_list", ()) if isinstance(d, ast.Call)]
    return any(getattr(call, "id", None) == "case" for call in calls)


def _digest(files: list[Path]) -> str:
    total = hashlib.sha256()
    for file in files:
        total.update(file.name.encode())
        total.update(file.read_bytes())
    return total.hexdigest()[:16]


def _write(file: Path, keys: dict[str, str], outcome: Outcome) -> None:
    head = {"keys": keys, "rows": [asdict(row) for row in outcome.rows], "note": outcome.note}
    part = io.BytesIO()
    np.savez_compressed(part, __head__=np.array(json.dumps(head)), **outcome.data)  # type: ignore[arg-type]
    temporary = file.with_suffix(".part")
    temporary.write_bytes(part.getvalue())
    os.replace(temporary, file)


def _read(file: Path) -> tuple[dict[str, str], Outcome] | None:
    try:
        with np.load(file) as stored:
            head = json.loads(str(stored["__head__"]))
            data = {name: stored[name] for name in stored.files if name != "__head__"}
        rows = [Row(**{**row, "mark": Mark(**row["mark"]) if row["mark"] else None}) for row in head["rows"]]
        return head["keys"], Outcome(rows, data, head["note"])
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return None  # half a file, or one of an older layout: measure again
