"""``python -m torchcloth.training.pose``: options, messages, exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from torchcloth.errors import InvalidInput, MissingDependency, TorchclothError

MODULE_NAME = "torchcloth.training.pose"
HELD_OUT_SHARE = 0.05  # motions for calibration and report, over those of the training


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code (0 done, 2 wrong input, 130 interrupted)."""
    options = _parser().parse_args(arguments)
    try:
        if find_spec("lightning") is None:
            raise MissingDependency("lightning is not installed", remedy='run: pip install "torchcloth[training]"')
        _train(options)
        return 0
    except (TorchclothError, OSError) as error:
        print(f"pose network: {error}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the first into the second
        print("pose network: stopped; the same command with --resume continues", file=sys.stderr)
        return 130


def _train(options: argparse.Namespace) -> None:
    import torch
    from lightning.pytorch.utilities import rank_zero_only

    from torchcloth import recordings
    from torchcloth.pose import PoseEstimator, PoseNetworkConfig, load_network

    from .motions import make_data
    from .train import NETWORK_FILE, TrainingPlan, train
    from .unlabelled import write_unlabelled

    for name in ("steps", "physics_steps"):
        if getattr(options, name) < 0:
            raise InvalidInput(f"--{name.replace('_', '-')}", got=getattr(options, name), expected="0 or more")
    if not 0 < options.learning_rate < 1:
        raise InvalidInput("--learning-rate", got=options.learning_rate, expected="above 0, below 1")
    if options.processes < 1:
        raise InvalidInput("--processes", got=options.processes, expected="1 or more")
    if options.processes > 1 and options.steps and options.physics_steps:
        raise InvalidInput(
            "--processes",
            got="both --steps and --physics-steps",
            expected="one of them with several processes",
            remedy="train with --steps first, then go on with --start",
        )
    is_first = rank_zero_only.rank == 0
    if is_first and any(options.out.glob("*.ckpt")) and not options.resume:
        raise InvalidInput(
            "--out", got=f"{options.out} with checkpoints", expected="a new folder", remedy="or --resume"
        )
    data = options.out / "data" if options.data is None else options.data
    held_out = options.out / "held-out" if options.held_out is None else options.held_out
    if options.start is not None:
        network = load_network(options.start).train()
    else:
        torch.manual_seed(options.seed)
        network = PoseEstimator(PoseNetworkConfig(width=options.width))
    if options.data is None:
        make_data(data, options.motions, "train", options.jobs)
    if options.held_out is None:
        make_data(held_out, max(2, round(HELD_OUT_SHARE * options.motions)), "held-out", options.jobs)
    unlabelled = options.out / "unlabelled" if options.unlabelled else None
    if unlabelled is not None and is_first:
        write_unlabelled(unlabelled, [recordings.read(path) for path in options.unlabelled])
    plan = TrainingPlan(
        steps=options.steps,
        batch=options.batch,
        learning_rate=options.learning_rate,
        physics_steps=options.physics_steps,
        processes=options.processes,
        seed=options.seed,
    )
    report = train(network, plan, options.out, data, held_out, unlabelled, options.resume)
    if report is None:
        return
    _print(report)
    print(f"result: {options.out / NETWORK_FILE}")


def _print(report: dict[str, Any]) -> None:
    print("held out: root mean square error of a scene, and how often 95 % intervals hold the truth")
    for name, row in report["held_out"].items():
        print(
            f"  {name:<24} {row['samples']:>6} frames  median {row['median_rms_mm']:6.1f} mm  "
            f"coverage {100 * row['coverage']:3.0f} %"
        )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m {MODULE_NAME}",
        description="Train a network that estimates a cloth's vertices from one cloud: simulate motions, train on "
        "them, and write weights for `torchcloth pose --network`.",
    )
    add = parser.add_argument
    add("--out", type=Path, required=True, metavar="DIR", help="folder for data, checkpoints, weights and report")
    add("--data", type=Path, metavar="DIR", help="folder of training motions (default: made in --out)")
    add("--held-out", type=Path, metavar="DIR", help="folder of motions for the report (default: made in --out)")
    add(
        "--unlabelled",
        nargs="+",
        default=[],
        metavar="EPISODE",
        help="recordings without truth, whose clouds alone enter the steps with physics",
    )
    add("--motions", type=int, default=3000, metavar="N", help="simulated motions of the training (default: 3000)")
    add("--steps", type=int, default=8000, metavar="N", help="supervised steps (default: 8000)")
    add("--physics-steps", type=int, default=0, metavar="N", help="steps with the simulation in the loss (default: 0)")
    add("--learning-rate", type=float, default=1e-3, metavar="X", help="largest of supervised steps (default: 0.001)")
    add("--batch", type=int, default=16, metavar="N", help="samples in a step (default: 16)")
    add("--width", type=int, default=96, metavar="N", help="of the network's tokens (default: 96)")
    add("--start", type=Path, metavar="FILE", help="weights to begin with")
    add("--seed", type=int, default=0, metavar="N", help="default: 0")
    add("--jobs", type=int, default=1, metavar="N", help="processes that make data (default: 1)")
    add("--processes", type=int, default=1, metavar="N", help="processes of Lightning's DDP (default: 1)")
    add("--resume", action="store_true", help="continue where --out was stopped")
    return parser
