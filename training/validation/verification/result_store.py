"""Outcomes of finished cases on disk, so that a stopped run can resume."""

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

import torchcloth

from .registry import Case, Outcome, Row, Tolerance

VERIFICATION_FOLDER = Path(__file__).parent
LIBRARY_FOLDER = Path(torchcloth.__file__).parent
SHARED_SOURCES = ("registry.py", "scenes.py", "closed_forms.py")


class ResultStore:
    """Outcomes by case. A stored one is valid while the sources of the case and of the library are unchanged.

    Args:
        folder: of the results.
        fast: store outcomes of the coarse versions.
        resume: use stored outcomes even if the library has changed.
        fresh: use no stored outcome.
    """

    def __init__(self, folder: Path, fast: bool, resume: bool, fresh: bool) -> None:
        self.folder, self.fast, self.resume, self.fresh = folder, fast, resume, fresh
        self.store = folder / ("fast" if fast else "full")
        self.store.mkdir(parents=True, exist_ok=True)
        self._library_digest = _digest(sorted(LIBRARY_FOLDER.rglob("*.py")))

    def get_or_run(self, case: Case) -> tuple[Outcome, bool]:
        """Return the outcome of a case, and whether it was stored."""
        file = self.store / f"{case.name}.npz"
        case_digest = self._case_digest(case)
        stored = None if self.fresh or not file.is_file() else _read(file)
        if stored is not None:
            digests, outcome = stored
            if digests["case"] == case_digest and (self.resume or digests["library"] == self._library_digest):
                return outcome, True
        outcome = case.function(self.fast)
        _write(file, {"case": case_digest, "library": self._library_digest}, outcome)
        return outcome, False

    def _case_digest(self, case: Case) -> str:
        """Return a digest of the case's module without the other cases, and of the shared modules."""
        source = inspect.getsourcefile(case.function)
        total = hashlib.sha256(_digest([VERIFICATION_FOLDER / name for name in SHARED_SOURCES]).encode())
        for node in ast.parse(Path(source).read_text(encoding="utf-8")).body if source else ():
            if not _is_case(node) or getattr(node, "name", "") == case.function.__name__:
                total.update(ast.dump(node).encode())
        return total.hexdigest()[:16]


def _is_case(node: ast.stmt) -> bool:
    calls = [d.func for d in getattr(node, "decorator_list", ()) if isinstance(d, ast.Call)]
    return any(getattr(call, "id", None) == "register_case" for call in calls)


def _digest(files: list[Path]) -> str:
    total = hashlib.sha256()
    for file in files:
        total.update(file.name.encode())
        total.update(file.read_bytes())
    return total.hexdigest()[:16]


def _write(file: Path, digests: dict[str, str], outcome: Outcome) -> None:
    head = {"digests": digests, "rows": [asdict(row) for row in outcome.rows], "note": outcome.note}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, __head__=np.array(json.dumps(head)), **outcome.data)  # type: ignore[arg-type]
    temporary = file.with_suffix(".part")
    temporary.write_bytes(buffer.getvalue())
    os.replace(temporary, file)


def _read(file: Path) -> tuple[dict[str, str], Outcome] | None:
    try:
        with np.load(io.BytesIO(file.read_bytes())) as stored:  # by name, a damaged archive stays open
            head = json.loads(str(stored["__head__"]))
            data = {name: stored[name] for name in stored.files if name != "__head__"}
        rows = [
            Row(**{**row, "tolerance": Tolerance(**row["tolerance"]) if row["tolerance"] else None})
            for row in head["rows"]
        ]
        return head["digests"], Outcome(rows, data, head["note"])
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
        return None  # half a file, or one of an older layout: measure again
