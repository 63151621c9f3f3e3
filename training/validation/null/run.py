"""How far torchcloth is from the independent engine when nothing is hidden: the null of every diagnosis.

    python -m torchcloth.training.validation.null.run --out DIR            # about an hour of one core; --fast: minutes; stopped runs continue

Another process (``independent.generate``) makes an effect-free, noise-free episode of every motion. torchcloth
follows each with the true parameters and with those that a fit to two of the motions finds, on a coarse and on a finer
mesh. What is left is discretisation, and the two engines' different laws.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from rich.progress import Progress

from torchcloth import recordings
from torchcloth._utils.files import write_text
from torchcloth.errors import TorchclothError

from . import report_page
from .comparison import FITTED, Values, between, compare, fit, load

GENERATE = "torchcloth.training.validation.independent.generate"
TRUTH = 25  # vertices along each side of the truth's mesh
MESHES = (17, 33)  # of the model; on all three the grippers hold the same 37.5 mm of both edges
MOTIONS = ("hang", "drape", "swing", "swing-fast", "turn", "shake", "stretch", "drag", "drag-fast", "lift", "fold")
FAST = ("swing", "swing-fast", "stretch", "drag")
FIT_TO = ("swing", "stretch")
REFINED = ("swing", "swing-fast")  # of which the truth, too, is computed on the model's meshes

Task = tuple[str, Callable[[], Any]]


class Study:
    """What has been computed, by name, in DIR/null.json; every step is kept as soon as it is there."""

    def __init__(self, folder: Path, motions: tuple[str, ...], finest: int) -> None:
        self.folder, self.motions = folder, motions
        self.meshes = [nodes for nodes in MESHES if nodes <= finest]
        self.file = folder / "null.json"
        self.found: dict[str, Any] = json.loads(self.file.read_text()) if self.file.exists() else {}

    def tasks(self) -> Iterator[Task]:
        """Names and what computes them, in order."""
        for name in FIT_TO:
            yield f"episode {name}", lambda name=name: self._generate(name, TRUTH)
        yield "fit", self._fit
        for name in self.motions:
            yield f"episode {name}", lambda name=name: self._generate(name, TRUTH)
            for nodes in self.meshes:
                yield f"true {name} {nodes}", lambda name=name, nodes=nodes: self._distance(name, nodes, "true")
            yield f"fitted {name} {MESHES[0]}", lambda name=name: self._distance(name, MESHES[0], "fitted")
        for name in REFINED:
            for nodes in self.meshes:
                yield f"episode {name} {nodes}", lambda name=name, nodes=nodes: self._generate(name, nodes)
                yield f"truth {name} {nodes}", lambda name=name, nodes=nodes: self._other(name, nodes)

    def run(self, progress: Progress) -> None:
        """All that is not there yet."""
        tasks = list(self.tasks())
        bar = progress.add_task("", total=len(tasks))
        for name, compute in tasks:
            progress.update(bar, description=name)
            if name not in self.found:
                self.found[name] = compute()
                write_text(self.file, json.dumps(self.found, indent=1) + "\n")
                if not progress.console.is_terminal:
                    print(name, flush=True)
            progress.advance(bar)

    def _episode(self, name: str, nodes: int) -> Path:
        return self.folder / "episodes" / (name if nodes == TRUTH else f"{name}-{nodes}")

    def _generate(self, name: str, nodes: int) -> float:
        folder = self._episode(name, nodes)
        folder.parent.mkdir(parents=True, exist_ok=True)
        size = ["--nodes", str(nodes), "--fit-nodes", str(nodes)]
        command = [sys.executable, "-m", GENERATE, "--motion", name, "--exact", *size, "--out", str(folder)]
        done = subprocess.run([*command, "--overwrite"], capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr}")
        truth = recordings.read(folder, with_truth=True).truth
        speed = torch.as_tensor(truth.vertices).diff(dim=0).norm(dim=-1) / float(truth.t[1] - truth.t[0])
        return float(speed.max())

    def _distance(self, name: str, nodes: int, which: str) -> dict[str, Any]:
        folder = self._episode(name, TRUTH)
        values = Values.true(folder) if which == "true" else Values(**self.found["fit"]["values"])
        found = compare(load(folder, nodes), values)
        return {key: value if isinstance(value, float) else value.tolist() for key, value in vars(found).items()}

    def _fit(self) -> dict[str, Any]:
        folders = [self._episode(name, TRUTH) for name in FIT_TO]
        print(f"fitting {', '.join(FITTED)} to {' and '.join(FIT_TO)}", flush=True)
        start = Values.true(folders[0])
        found = fit(folders, MESHES[0], start, lambda k, d, v, share: print(f"  {k}: {1e3 * d:.2f} mm", flush=True))
        errors = {name: estimate.std for name, estimate in found.parameters.items()}
        return {"values": vars(Values.of(found)), "true": vars(start), "errors": errors, "rms": found.fit["rms_after"]}

    def _other(self, name: str, nodes: int) -> float:
        other, first = (recordings.read(self._episode(name, n), with_truth=True) for n in (nodes, TRUTH))
        return between(first, other)


def main(arguments: list[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="episodes, null.json, table and picture")
    parser.add_argument("--fast", action="store_true", help=f"only {', '.join(FAST)}, on the coarse mesh")
    options = parser.parse_args(arguments)
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    study = Study(options.out, FAST if options.fast else MOTIONS, MESHES[0] if options.fast else MESHES[-1])
    try:
        with Progress(disable=not sys.stdout.isatty()) as progress:
            study.run(progress)
    except TorchclothError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; the same command continues", file=sys.stderr)
        return 130
    print(report_page.table(study.found, study.motions, study.meshes))
    print(report_page.write(study.found, study.motions, study.meshes, options.out))
    print(report_page.draw(study.found, study.motions, study.meshes, options.out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
