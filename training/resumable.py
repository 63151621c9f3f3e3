"""Resumable studies: each finished case is a file, so that a study can be stopped at any time, resumed and extended."""

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
SETTINGS_FILE = "study.json"


class ResumableStudy:
    """A folder of finished cases, one JSON file for each.

    Nothing is written before ``start`` or before the first case is finished.

    Args:
        folder: new, or a folder of a study with the same settings.
        settings: plain JSON, all that the cases depend on besides the code.

    Raises:
        InvalidInput: the folder is a file, or contains a study with other settings or by other code.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any]) -> None:
        self.folder, self.settings = folder, dict(settings)
        _check_settings(folder, self.settings)

    def start(self) -> None:
        """Write the settings, if they are not there yet.

        Needed at once by studies whose cases leave more than a result, in case the first one is interrupted.
        """
        if not (self.folder / SETTINGS_FILE).exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            text = json.dumps(_with_fingerprint(self.settings), indent=1) + "\n"
            write_text(self.folder / SETTINGS_FILE, text)

    def load_case(self, name: str) -> dict[str, Any] | None:
        """Return a finished case, or None.

        Raises:
            RecordingError: the file is damaged.
        """
        path = self._path(name)
        try:
            return json.loads(path.read_text())
        except FileNotFoundError:
            return None
        except ValueError:
            raise damaged_file_error(path) from None

    def save_case(self, name: str, content: Mapping[str, Any]) -> None:
        """Write a finished case atomically, with null for numbers that are not finite."""
        self.start()
        self._path(name).parent.mkdir(exist_ok=True)
        write_text(self._path(name), to_json(content))

    def run(self, cases: Mapping[str, Case], jobs: int = 1) -> dict[str, dict[str, Any]]:
        """Return all cases by name; compute the missing ones, ``jobs`` at a time, and show the progress."""
        missing = [name for name in cases if self.load_case(name) is None]
        if missing:
            self._compute({name: cases[name] for name in missing}, len(cases), jobs)
        return {name: case for name in cases if (case := self.load_case(name)) is not None}

    def _compute(self, cases: Mapping[str, Case], total: int, jobs: int) -> None:
        from rich.progress import MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

        columns = (MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
        started, is_terminal = time.monotonic(), sys.stdout.isatty()
        with Progress(*columns, refresh_per_second=2, disable=not is_terminal) as bar:
            task = bar.add_task("", total=total, completed=total - len(cases))
            names = self._compute_and_save(cases, jobs, lambda name: bar.update(task, description=name))
            for done, name in enumerate(names, 1):
                bar.advance(task)
                if not is_terminal:  # a log file gets lines instead of a bar
                    minutes_left = (time.monotonic() - started) / done * (len(cases) - done) / 60
                    count = total - len(cases) + done
                    print(f"{count}/{total} {name}, about {minutes_left:.1f} min left", flush=True)

    def _compute_and_save(
        self, cases: Mapping[str, Case], jobs: int, on_start: Callable[[str], object]
    ) -> Iterator[str]:
        """Yield the names of cases as they are saved."""

        def work(name: str) -> str:
            on_start(name)
            self.save_case(name, cases[name]())
            return name

        if jobs == 1:
            yield from map(work, cases)
            return
        pool = ThreadPoolExecutor(jobs)
        try:
            yield from (done.result() for done in as_completed([pool.submit(work, name) for name in cases]))
        finally:
            pool.shutdown(cancel_futures=True)  # after a stop, running cases end and no other case starts

    def _path(self, name: str) -> Path:
        return self.folder / "cases" / f"{name}.json"


def run_study_command(name: str, stored: str, work: Callable[[], object]) -> int:
    """Run a study in one thread and float64, and print errors in one line.

    Args:
        name: of the command.
        stored: what remains after a stop, e.g. "finished cases".
        work: the study.

    Returns:
        Exit code: 0 done, 2 wrong input, 130 interrupted.
    """
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)  # on meshes of a thousand triangles a second thread costs more than it gains
    try:
        work()
        return 0
    except (TorchclothError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{name}: stopped; the same command continues, {stored} remain", file=sys.stderr)
        return 130


def write_result(path: Path, study: str, result: Mapping[str, Any]) -> Path:
    """Write the result of a study as JSON with its ``schema``; numbers that are not finite become null."""
    return write_text(path, to_json({"schema": f"torchcloth.study.{study}/1", **result}))


def check_jobs(jobs: int) -> None:
    """Check the option ``--jobs``.

    Raises:
        InvalidInput: the number is below 1.
    """
    if jobs < 1:
        raise InvalidInput("--jobs", got=jobs, expected="1 or more")


def damaged_file_error(path: Path) -> RecordingError:
    """Return the error for a damaged file of a study."""
    return RecordingError(f"{path}: unreadable", remedy="delete it; it is made again")


def _check_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    check_output_folder(folder)
    try:
        stored = json.loads((folder / SETTINGS_FILE).read_text())
    except FileNotFoundError:
        return
    except ValueError:
        raise damaged_file_error(folder / SETTINGS_FILE) from None
    if not isinstance(stored, dict):
        raise damaged_file_error(folder / SETTINGS_FILE)
    remedy = "use the same settings, or another folder"
    if settings and not stored.keys() & settings.keys():
        raise InvalidInput("--out", got=f"{folder}, which holds another study", expected="a folder", remedy=remedy)
    wanted = _with_fingerprint(settings)
    differences = {key: stored.get(key) for key in wanted if stored.get(key) != wanted[key]}
    if not differences:
        return
    got = ", ".join(f"{key} {value}" if key in stored else f"no {key}" for key, value in differences.items())
    expected = ", ".join(f"{key} {wanted[key]}" for key in differences)
    raise InvalidInput("--out", got=f"{folder}, which holds a study with {got}", expected=expected, remedy=remedy)


def _with_fingerprint(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Add a fingerprint of the code that generates and studies the data, because two versions make no common study."""
    code = source_fingerprint(Path(__file__).resolve().parent)
    content = {"schema": "torchcloth.study/1", **settings, "code": code}
    return json.loads(json.dumps(content))  # as they are read again: a tuple becomes a list
