"""The search for inputs that reach new branches, by atheris (libFuzzer for Python)."""

from __future__ import annotations

import hashlib
import inspect
import os
import shutil
import sys
import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any, NoReturn

from torchcloth.errors import MissingDependency

from .formats import FuzzedFormat, is_accepted, strict_arithmetic
from .targets import scratch_folder

MAX_INPUT_GROWTH = 3  # of the largest seed: longer inputs are rarely new, and always slow
MIN_INPUT_BYTES = 4096
MAX_SECONDS_PER_INPUT, MAX_MEMORY_MIB = 20, 4096
FRESH_SHARE = 0.4  # of inputs that are changed seeds: most of the corpus is refused early, at many places
REPORT_INTERVAL_S = 60.0
FAULTS_FOLDER = "faults"


@dataclass
class Search:
    """The search in one format.

    Attributes:
        fuzzed: the format.
        corpus: folder of the inputs; ``faults`` below it takes the inputs that showed a fault.
        seeds: folders of further inputs, which stay as they are.
        inputs: number of inputs after which the search ends.
        seconds: time after which it ends.
        count: number of inputs that were read.
        accepted: number of those that were accepted.
        faults: kinds of faults and the file of the first input that showed each.
    """

    fuzzed: FuzzedFormat
    corpus: Path
    seeds: list[Path]
    inputs: int
    seconds: float
    count: int = 0
    accepted: int = 0
    faults: dict[str, Path] = field(default_factory=dict)

    def run(self) -> NoReturn:
        """Search until the end, print the result, and end the process: 0 without faults, else 1.

        A crash of native code, an input that takes 20 s and one that takes 4 GiB end the process at once, with another
        code; libFuzzer writes the input into the corpus folder.

        Raises:
            MissingDependency: atheris is not installed.
        """
        atheris = import_atheris()
        instrument(self.fuzzed.instrumented, atheris)
        folders = [self.corpus, *self.seeds]
        for folder in (self.corpus, self.corpus / FAULTS_FOLDER):
            folder.mkdir(parents=True, exist_ok=True)
        sizes = [path.stat().st_size for folder in folders for path in folder.iterdir() if path.is_file()]
        limit = max(MIN_INPUT_BYTES, MAX_INPUT_GROWTH * max(sizes, default=0))
        options = {
            "max_len": limit,
            "timeout": MAX_SECONDS_PER_INPUT,
            "rss_limit_mb": MAX_MEMORY_MIB,
            "artifact_prefix": f"{self.corpus / FAULTS_FOLDER}/",
            "cross_over": 0,
            "len_control": 0,
            "verbosity": 0,
        }
        self._started = self._reported = time.monotonic()

        sound = [path.read_bytes() for folder in self.seeds for path in sorted(folder.iterdir())]

        def mutate(data: bytes, max_size: int, seed: int) -> bytes:
            rng = Random(seed)
            start = rng.choice(sound) if rng.random() < FRESH_SHARE else bytes(data)
            return self.fuzzed.mutate(rng, start, max_size, lambda b, n: bytes(atheris.Mutate(b, n)))[:max_size]

        arguments = [sys.argv[0], *map(str, folders), *(f"-{name}={value}" for name, value in options.items())]
        atheris.Setup(arguments, self.read, custom_mutator=mutate)
        with strict_arithmetic():
            atheris.Fuzz()
        raise RuntimeError("libFuzzer returned")

    def read(self, data: bytes) -> None:
        """Read one input, and store it if it shows a fault of a new kind."""
        try:
            self.accepted += is_accepted(self.fuzzed, data)
        except Exception as error:  # every fault is wanted
            self._store(data, error)
        self.count += 1
        now = time.monotonic()
        if now - self._reported > REPORT_INTERVAL_S:
            self._reported = now
            print(self.describe(), flush=True)
        if self.count >= self.inputs or now - self._started > self.seconds:
            print(self.describe(), flush=True)
            shutil.rmtree(scratch_folder(), ignore_errors=True)
            sys.stdout.flush()
            os._exit(1 if self.faults else 0)  # libFuzzer cannot be left otherwise

    def describe(self) -> str:
        """Return the present state in one line."""
        seconds = time.monotonic() - self._started
        return (
            f"{self.fuzzed.name}: {self.count} inputs in {seconds:.0f} s ({self.count / seconds:.0f}/s), "
            f"{self.accepted} accepted, {len(list(self.corpus.iterdir())) - 1} in the corpus, {len(self.faults)} faults"
        )

    def _store(self, data: bytes, error: Exception) -> None:
        kind = describe_fault(error)
        if kind in self.faults:
            return
        path = self.corpus / FAULTS_FOLDER / f"{self.fuzzed.name}-{hashlib.sha256(data).hexdigest()[:12]}"
        path.write_bytes(data)
        self.faults[kind] = path
        print(f"{self.fuzzed.name}: {kind}: {path}", flush=True)


def describe_fault(error: Exception) -> str:
    """Return type, text and place of an error, by which faults of one kind are recognised."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "site-packages" not in f.filename and "invariants" not in f.filename] or list(frames)
    text = str(error).partition(":")[0] if isinstance(error, AssertionError) else ""
    places = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(ours[-2:]))
    return f"{type(error).__name__} {text} at {places}"


def import_atheris() -> Any:
    """Import atheris.

    Raises:
        MissingDependency: it is not installed.
    """
    try:
        import atheris  # pyright: ignore[reportMissingImports]  (optional)
    except ImportError as error:
        remedy = 'pip install "torchcloth[fuzz]", on Linux with an x86-64 processor'
        raise MissingDependency("fuzzing needs atheris", remedy=remedy) from error
    return atheris


def instrument(prefixes: tuple[str, ...], atheris: Any) -> None:
    """Make the functions of the modules with these prefixes report their branches."""
    for name, module in sorted(sys.modules.items()):
        if module is not None and name.startswith(prefixes):
            for function in _functions(module, name):
                atheris.instrument_func(function)


def _functions(owner: object, module: str) -> list:
    """Functions and methods that a module or class defines."""
    functions = []
    for value in list(vars(owner).values()):
        value = inspect.unwrap(getattr(value, "__func__", getattr(value, "fget", None) or value))
        if getattr(value, "__module__", None) != module:
            continue
        if inspect.isfunction(value):
            functions.append(value)
        elif inspect.isclass(value) and value is not owner:
            functions += _functions(value, module)
    return functions
