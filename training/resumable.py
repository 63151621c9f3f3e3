"""Studies on disk: finished cases are files, so that a study can be stopped at any time, continued and extended."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import torch

from torchcloth._utils.files import check_output_folder, to_json, write_text
from torchcloth._utils.resume import source_fingerprint
from torchcloth.errors import InvalidInput, RecordingError, TorchclothError

Case = Callable[[], dict[str, Any]]


class Kept:
    """A folder of finished cases, one JSON file each; nothing is written before ``begin``, or the first is finished.

    Args:
        folder: new, or one that holds a study of the same settings.
        settings: what all cases depend on, besides the library's code; plain JSON.

    Raises:
        InvalidInput: the folder holds a study of other settings or by other code, or is a file.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder, self.settings = folder, dict(settings)
        check_settings(folder, self.settings)

    def begin(self) -> None:
        """Note the settings at once: where cases leave more than a result, also of a study stopped in its first one."""
        if not (self.folder / "study.json").exists():
            write_settings(self.folder, self.settings)

    def find(self, name: str) -> dict[str, Any] | None:
        """A finished case, or None.

        Raises:
            RecordingError: its file is damaged.
        """
        path = self._path(name)
        try:
            return json.loads(path.read_text())
        except FileNotFoundError:
            return None
        except ValueError:
            raise unreadable(path) from None

    def keep(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a finished case, with null for what is not a number; a crash leaves no half file."""
        self.begin()
        self._path(name).parent.mkdir(exist_ok=True)
        write_text(self._path(name), to_json(content))

    def run(self, cases: Mapping[str, Case], jobs: int = 1) -> dict[str, dict[str, Any]]:
        """All cases by name, the missing ones computed in turn, ``jobs`` at a time, with progress."""
        missing = [name for name in cases if self.find(name) is None]
        if missing:
            self._compute({name: cases[name] for name in missing}, len(cases), jobs)
        return {name: found for name in cases if (found := self.find(name)) is not None}

    def _compute(self, cases: Mapping[str, Case], total: int, jobs: int) -> None:
        from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        columns = (MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
        begun, terminal = time.monotonic(), sys.stdout.isatty()
        with Progress(*columns, refresh_per_second=2, disable=not terminal) as bar:
            shown = bar.add_task("", total=total, completed=total - len(cases))
            for done, name in enumerate(self._finished(cases, jobs, lambda n: bar.update(shown, description=n)), 1):
                bar.advance(shown)
                if not terminal:  # a log file gets lines, not a bar
                    left = (time.monotonic() - begun) / done * (len(cases) - done) / 60
                    print(f"{total - len(cases) + done}/{total} {name}, about {left:.1f} min left", flush=True)

    def _finished(self, cases: Mapping[str, Case], jobs: int, begins: Callable[[str], object]) -> Iterator[str]:
        """Names of cases as they are kept."""

        def work(name: str) -> str:
            begins(name)
            self.keep(name, cases[name]())
            return name

        if jobs == 1:
            yield from map(work, cases)
            return
        pool = ThreadPoolExecutor(jobs)
        try:
            yield from (done.result() for done in as_completed([pool.submit(work, name) for name in cases]))
        finally:
            pool.shutdown(cancel_futures=True)  # when stopped, what has begun ends and nothing else begins

    def _path(self, name: str) -> Path:
        return self.folder / "cases" / f"{name}.json"


def guarded(name: str, what: str, work: Callable[[], object]) -> int:
    """Do a study's work in one thread and float64; the command's exit code, errors said in one line.

    Args:
        name: of the command.
        what: it keeps when it is stopped, e.g. "finished cases".
        work: to be done.
    """
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)  # meshes of a thousand triangles: a second thread costs more than it gives
    try:
        work()
        return 0
    except (TorchclothError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{name}: stopped; the same command continues, {what} are kept", file=sys.stderr)
        return 130


def check_jobs(jobs: int) -> None:
    """Raises InvalidInput for cases at a time that are none."""
    if jobs < 1:
        raise InvalidInput("--jobs", got=jobs, expected="1 or more")


def check_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Raises InvalidInput where the folder cannot hold a study of these settings, or has one by other code."""
    check_output_folder(folder)
    try:
        found = json.loads((folder / "study.json").read_text())
    except FileNotFoundError:
        return
    except ValueError:
        raise unreadable(folder / "study.json") from None
    if not isinstance(found, dict):
        raise unreadable(folder / "study.json")
    remedy = "use the same settings, or another folder"
    if settings and not found.keys() & settings.keys():
        raise InvalidInput("--out", got=f"{folder}, which holds another study", expected="a folder", remedy=remedy)
    wanted = _of_this_code(settings)
    other = {key: found.get(key) for key in wanted if found.get(key) != wanted[key]}
    if not other:
        return
    holds = ", ".join(f"{key} {value}" if key in found else f"no {key}" for key, value in other.items())
    expected = ", ".join(f"{key} {wanted[key]}" for key in other)
    raise InvalidInput("--out", got=f"{folder}, which holds a study with {holds}", expected=expected, remedy=remedy)


def write_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Make the folder and note the settings."""
    folder.mkdir(parents=True, exist_ok=True)
    write_text(folder / "study.json", json.dumps(_of_this_code(settings), indent=1) + "\n")


def _of_this_code(settings: Mapping[str, Any]) -> dict[str, Any]:
    """With a fingerprint of the code that makes data and studies them: results of two versions are no study."""
    here = Path(__file__).resolve().parent
    code = source_fingerprint(here)
    return json.loads(json.dumps({**settings, "code": code}))  # as they are read again: a tuple is a list


def unreadable(path: Path) -> RecordingError:
    """The error for a damaged file of a study."""
    return RecordingError(f"{path}: unreadable", remedy="delete it; it is made again")
