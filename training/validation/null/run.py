"""Measure how far torchcloth is from the independent engine when nothing is hidden: the null of every diagnosis.

    python -m torchcloth.training.validation.null.run --out DIR    # an hour of one core; --fast: minutes

Another process (``independent.generate``) makes an effect-free, noise-free episode of every motion. torchcloth
simulates each with the true parameters and with those of a fit to two of the motions, on a coarse and on a finer mesh.
The remaining distance is due to discretisation and to the two engines' different laws. A stopped run continues.
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
from .comparison import (
    FITTED_PARAMETERS,
    FabricValues,
    fit_base_model,
    measure_distance,
    measure_truth_distance,
    read_remeshed,
)

GENERATE_MODULE = "torchcloth.training.validation.independent.generate"
TRUTH_NODES = 25  # along each side of the truth's mesh
MODEL_NODES = (17, 33)  # likewise of the model; on all three meshes the grippers hold the same 37.5 mm of both edges
ALL_MOTIONS = ("hang", "drape", "swing", "swing-fast", "turn", "shake", "stretch", "drag", "drag-fast", "lift", "fold")
FAST_MOTIONS = ("swing", "swing-fast", "stretch", "drag")
FITTED_MOTIONS = ("swing", "stretch")
REFINED_MOTIONS = ("swing", "swing-fast")  # their truth is also computed on the model's meshes

Task = tuple[str, Callable[[], Any]]


class NullStudy:
    """Results by task in DIR/null.json; every result is stored as soon as it is computed.

    Args:
        folder: DIR.
        motions: names of the motions.
        max_nodes: of the model's meshes, along each side.
    """

    def __init__(self, folder: Path, motions: tuple[str, ...], max_nodes: int) -> None:
        self.folder, self.motions = folder, motions
        self.meshes = [nodes for nodes in MODEL_NODES if nodes <= max_nodes]
        self.file = folder / "null.json"
        self.results: dict[str, Any] = json.loads(self.file.read_text()) if self.file.exists() else {}

    def tasks(self) -> Iterator[Task]:
        """Yield the names of the tasks and the functions that compute them, in order."""
        for name in FITTED_MOTIONS:
            yield f"episode {name}", lambda name=name: self._generate(name, TRUTH_NODES)
        yield "fit", self._fit
        for name in self.motions:
            yield f"episode {name}", lambda name=name: self._generate(name, TRUTH_NODES)
            for nodes in self.meshes:
                yield f"true {name} {nodes}", lambda name=name, nodes=nodes: self._measure(name, nodes, "true")
            yield f"fitted {name} {MODEL_NODES[0]}", lambda name=name: self._measure(name, MODEL_NODES[0], "fitted")
        for name in REFINED_MOTIONS:
            for nodes in self.meshes:
                yield f"episode {name} {nodes}", lambda name=name, nodes=nodes: self._generate(name, nodes)
                yield f"truth {name} {nodes}", lambda name=name, nodes=nodes: self._measure_truth(name, nodes)

    def run(self, progress: Progress) -> None:
        """Compute what is not stored yet."""
        tasks = list(self.tasks())
        bar = progress.add_task("", total=len(tasks))
        for name, compute in tasks:
            progress.update(bar, description=name)
            if name not in self.results:
                self.results[name] = compute()
                write_text(self.file, json.dumps(self.results, indent=1) + "\n")
                if not progress.console.is_terminal:
                    print(name, flush=True)
            progress.advance(bar)

    def _episode(self, name: str, nodes: int) -> Path:
        return self.folder / "episodes" / (name if nodes == TRUTH_NODES else f"{name}-{nodes}")

    def _generate(self, name: str, nodes: int) -> float:
        folder = self._episode(name, nodes)
        folder.parent.mkdir(parents=True, exist_ok=True)
        size = ["--nodes", str(nodes), "--fit-nodes", str(nodes)]
        command = [sys.executable, "-m", GENERATE_MODULE, "--motion", name, "--exact", *size, "--out", str(folder)]
        process = subprocess.run([*command, "--overwrite"], capture_output=True, text=True, check=False)
        if process.returncode:
            raise RuntimeError(f"{' '.join(command)} failed:\n{process.stderr}")
        truth = recordings.read(folder, with_truth=True).require("truth")
        speed = torch.as_tensor(truth.vertices).diff(dim=0).norm(dim=-1) / float(truth.t[1] - truth.t[0])
        return float(speed.max())

    def _measure(self, name: str, nodes: int, which: str) -> dict[str, Any]:
        folder = self._episode(name, TRUTH_NODES)
        values = FabricValues.from_truth(folder) if which == "true" else FabricValues(**self.results["fit"]["values"])
        distance = measure_distance(read_remeshed(folder, nodes), values)
        return {key: value if isinstance(value, float) else value.tolist() for key, value in vars(distance).items()}

    def _fit(self) -> dict[str, Any]:
        folders = [self._episode(name, TRUTH_NODES) for name in FITTED_MOTIONS]
        print(f"fitting {', '.join(FITTED_PARAMETERS)} to {' and '.join(FITTED_MOTIONS)}", flush=True)
        start = FabricValues.from_truth(folders[0])
        fit = fit_base_model(
            folders, MODEL_NODES[0], start, lambda k, d, v, fraction: print(f"  {k}: {1e3 * d:.2f} mm", flush=True)
        )
        errors = {name: estimate.std for name, estimate in fit.parameters.items()}
        values = vars(FabricValues.from_fit(fit))
        return {"values": values, "true": vars(start), "errors": errors, "rms": fit.fit["rms_after"]}

    def _measure_truth(self, name: str, nodes: int) -> float:
        other, first = (recordings.read(self._episode(name, n), with_truth=True) for n in (nodes, TRUTH_NODES))
        return measure_truth_distance(first, other)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="episodes, null.json, table and picture")
    parser.add_argument("--fast", action="store_true", help=f"only {', '.join(FAST_MOTIONS)}, on the coarse mesh")
    options = parser.parse_args(arguments)
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    study = NullStudy(
        options.out, FAST_MOTIONS if options.fast else ALL_MOTIONS, MODEL_NODES[0] if options.fast else MODEL_NODES[-1]
    )
    try:
        with Progress(disable=not sys.stdout.isatty()) as progress:
            study.run(progress)
    except TorchclothError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped; the same command continues", file=sys.stderr)
        return 130
    print(report_page.format_table(study.results, study.motions, study.meshes))
    print(report_page.write_page(study.results, study.motions, study.meshes, options.out))
    print(report_page.draw_figure(study.results, study.motions, study.meshes, options.out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
