"""A contestant in a process of its own, so that compiled code, thread pools and memory are separate.

Each line in either direction is one JSON object: {"prepare": task, "run": flag}, {"sample": task, "shortest": seconds},
{"result": task} and {"forget": {}} are answered in turn. A process that is not asked is stopped, because thread pools
poll for work long after their last piece, at the expense of others.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import IO, Any

import numpy as np

from . import measure
from .contestant import Outcome, Task, Unsupported


class ContestantFailed(Exception):
    """A contestant failed or ended; the text says why."""


class Worker:
    """The benchmark's end of a contestant's process; use it as a context."""

    def __init__(self, name: str, threads: int) -> None:
        self.name = name
        start = time.perf_counter()
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed with the process
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
        self._process = subprocess.Popen(
            [sys.executable, "-m", __spec__.name, name, str(threads)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=environment,
        )
        self.threads = self._answer()["threads"]
        self.ready = time.perf_counter() - start  # s
        self._signal("SIGSTOP")

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def prepare(self, task: Task) -> float:
        """Build, compile and run a task once; return the seconds it took."""
        return self._ask({"prepare": asdict(task), "run": True})["seconds"]

    def build(self, task: Task) -> float:
        """Build and compile a task; return the memory of the process after it [MiB]."""
        return self._ask({"prepare": asdict(task), "run": False})["mebibytes"]

    def sample(self, task: Task, shortest: float = measure.MIN_SAMPLE_S) -> float:
        """Return the seconds per run of a prepared task."""
        return self._ask({"sample": asdict(task), "shortest": shortest})["seconds"]

    def result(self, task: Task) -> tuple[Outcome, float]:
        """Return the outcome of the last run, and the peak memory of the process [MiB]."""
        answer = self._ask({"result": asdict(task)})
        fields = {name: _array(value) for name, value in answer["outcome"].items()}
        return Outcome(**fields), answer["mebibytes"]

    def forget(self) -> None:
        """Drop all prepared tasks and their memory."""
        self._ask({"forget": {}})

    def close(self) -> None:
        """End the process of the worker."""
        self._signal("SIGCONT")
        with contextlib.suppress(OSError):
            self._process.stdin.close()  # type: ignore[union-attr]
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        self._signal("SIGCONT")
        try:
            self._process.stdin.write(json.dumps(request) + "\n")  # type: ignore[union-attr]
            self._process.stdin.flush()  # type: ignore[union-attr]
        except OSError:
            pass  # the process ended; the answer says why
        try:
            return self._answer()
        finally:
            self._signal("SIGSTOP")

    def _signal(self, name: str) -> None:
        if hasattr(signal, name):  # not on every system
            self._process.send_signal(getattr(signal, name))

    def _answer(self) -> dict[str, Any]:
        line = self._process.stdout.readline()  # type: ignore[union-attr]
        if not line:
            self._errors.seek(0)
            last = self._errors.read().decode(errors="replace").strip().splitlines()[-1:]
            raise ContestantFailed(f"{self.name} ended: {' '.join(last) or 'no message'}")
        answer = json.loads(line)
        if "unsupported" in answer:
            raise Unsupported(answer["unsupported"])
        if "error" in answer:
            raise ContestantFailed(f"{self.name}: {answer['error']}")
        return answer


def _serve(name: str, threads: int) -> None:
    """The contestant's end: answer requests until stdin closes."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # what simulators print must not mix with the answers
    from .contestants import build_contestant

    contestant = build_contestant(name, threads)
    _write_answer(answers, {"threads": contestant.threads})
    runs: dict[Task, Callable[[], Outcome]] = {}
    outcomes: dict[Task, Outcome] = {}
    for line in sys.stdin:
        request = json.loads(line)
        try:
            if "prepare" in request:
                start, task = time.perf_counter(), Task(**request["prepare"])
                runs[task] = contestant.prepare(task)
                if request["run"]:
                    outcomes[task] = runs[task]()
                _write_answer(
                    answers, {"seconds": time.perf_counter() - start, "mebibytes": measure.resident_mebibytes()}
                )
            elif "sample" in request:
                task = Task(**request["sample"])
                seconds, outcomes[task] = measure.sample(runs[task], request["shortest"])
                _write_answer(answers, {"seconds": seconds})
            elif "result" in request:
                outcome = outcomes[Task(**request["result"])]
                fields = {key: _plain(value) for key, value in outcome._asdict().items()}
                _write_answer(answers, {"outcome": fields, "mebibytes": measure.peak()})
            else:
                runs.clear()
                outcomes.clear()
                _write_answer(answers, {})
        except Unsupported as error:
            _write_answer(answers, {"unsupported": str(error)})
        except Exception as error:
            _write_answer(answers, {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"})


def _write_answer(answers: IO[str], answer: dict[str, Any]) -> None:
    answers.write(json.dumps(answer) + "\n")


def _plain(value: Any) -> Any:
    """A value for JSON; of the other derivatives only what the checks need."""
    if isinstance(value, tuple):
        return [[float(np.abs(part).max()) if np.isfinite(part).all() else float("nan")] for part in value]
    return value.tolist() if isinstance(value, np.ndarray) else value


def _array(value: Any) -> Any:
    return np.array(value) if isinstance(value, list) else value


if __name__ == "__main__":
    _serve(sys.argv[1], int(sys.argv[2]))
