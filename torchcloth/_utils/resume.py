"""Resumable store: what a run has computed, on disk. A run that was stopped is started again and finds its answers.

The computation must be deterministic. The second run then takes the same path, bit by bit, and computes only what the
first did not. That works for every estimator, and there is no state of a search that could be forgotten.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor

from ..errors import InvalidInput
from .files import save_tensors, write_text

STORE_FORMAT_VERSION = 2
MAX_WRITE_ATTEMPTS = 3
STAMP_FILE_NAME = "problem"  # the file that makes a folder a store
T = TypeVar("T", bound=Sequence)


class ResumableStore:
    """Results in a folder, one file for each name and inputs, all of one problem.

    Several runs may use the folder at the same time.

    Args:
        folder: made when the first result is written. It must be a store or not exist.
        problem: what the results depend on besides their inputs: data, model, options.
        resume: True: continue with the results in the folder. False: empty it. None: neither; there must be no store.

    Attributes:
        folder: the folder.
        key: fingerprint of the problem and of the program.
        reused_count: how many results were read from the folder.

    Raises:
        InvalidInput: nothing to resume, a store of another problem or program, a folder with other content, or an
            interrupted run where ``resume`` is None.
    """

    def __init__(self, folder: str | Path, problem: Sequence[object], resume: bool | None) -> None:
        self.folder = Path(folder)
        self.key = digest([STORE_FORMAT_VERSION, torch.__version__, source_fingerprint(), *problem])
        self.reused_count = 0
        stamp = self.folder / STAMP_FILE_NAME
        if not resume:
            if resume is None and stamp.exists():
                is_same = stamp.read_text() == self.key
                raise InvalidInput(
                    "resume",
                    got=f"nothing, and in {self.folder} {'the same' if is_same else 'other'} work, stopped",
                    expected="--resume, to go on from there, or another folder" if is_same else "another folder",
                    remedy=f"to start over, delete {self.folder}",
                )
            clear_store(self.folder)
            return
        if not stamp.exists():
            raise InvalidInput(
                "resume",
                got=f"no {self.folder}",
                expected="what an interrupted run left",
                remedy="run it without --resume",
            )
        if stamp.read_text() != self.key:
            raise InvalidInput(
                "resume",
                got=f"{self.folder} of another fit, or of another version of torchcloth",
                expected="the same episodes, parameters, options, causes and program",
                remedy=f"to start over, delete {self.folder}",
            )

    def get_or_compute(self, name: str, inputs: Tensor, compute: Callable[[], T]) -> T:
        """Return the stored result for this name and these inputs, or compute and store it.

        Args:
            name: beginning of the file's name.
            inputs: tensor that the result depends on.
            compute: returns a tuple of tensors.
        """
        path = self.folder / f"{name}-{digest([self.key, inputs])}.pt"
        try:
            result = torch.load(path, weights_only=True)
            self.reused_count += 1
            return result
        except Exception:  # a missing or half-written file; torch raises anything
            result = compute()
        self._write(path, tuple(result))
        return result

    def _write(self, path: Path, result: tuple) -> None:
        for _ in range(MAX_WRITE_ATTEMPTS):  # another run that has ended may remove the folder meanwhile
            with suppress(FileNotFoundError):
                if not (self.folder / STAMP_FILE_NAME).exists():
                    write_text(self.folder / STAMP_FILE_NAME, self.key)  # several results may come at once
                save_tensors(result, path)
                return


@cache
def source_fingerprint(*more_folders: Path) -> str:
    """Return a fingerprint of the library's sources and of ``more_folders``; results of other code are not reused."""
    folders = [Path(str(files(name))) for name in ("torchcloth", "torchcloth.robots")]
    parts: list[object] = []
    for folder in (*folders, *more_folders):
        sources = sorted(p for p in folder.rglob("*") if p.suffix in (".py", ".h", ".cpp"))
        parts += [part for p in sources for part in (p.relative_to(folder).as_posix(), p.read_bytes())]
    return digest(parts)


def clear_store(folder: Path) -> None:
    """Remove a store, if there is one.

    Its stamp goes last, so that what an interruption leaves is still a store.

    Raises:
        InvalidInput: a folder with other content.
    """
    if not folder.exists():
        return
    stamp = folder / STAMP_FILE_NAME
    inside = [path for path in folder.iterdir() if path != stamp]
    unfinished_stamp = f".{STAMP_FILE_NAME}."
    if not stamp.exists() and any(not path.name.startswith(unfinished_stamp) for path in inside):
        raise InvalidInput("journal", got=f"{folder} with other content", expected="a new folder, or a journal")
    for path in (*inside, stamp):
        path.unlink(missing_ok=True)
    with suppress(OSError):  # another run has written there again, or has cleared it too
        folder.rmdir()


def digest(parts: Sequence[object]) -> str:
    """Return a fingerprint of tensors and of objects whose ``repr`` shows all of their content."""
    sha = hashlib.sha256()
    for part in parts:
        data = part.detach().contiguous().numpy().tobytes() if isinstance(part, Tensor) else repr(part).encode()
        sha.update(len(data).to_bytes(8, "little") + data)
    return sha.hexdigest()[:24]
