"""``python -m torchcloth.training.fit``: options, messages, exit codes."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from torchcloth.errors import MissingDependency, TorchclothError

from .config import CHECKPOINT, load

NAME = "torchcloth.training.fit"


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code (0 done, 2 wrong input, 130 interrupted)."""
    options, config, began = _parser().parse_intermixed_args(arguments), None, time.time()
    try:
        if find_spec("lightning") is None:  # which brings YAML
            raise MissingDependency("lightning is not installed", remedy='run: pip install "torchcloth[training]"')
        config = load(options.config, options.overrides)
        from .run import fit

        fit(config, options.resume)
        return 0
    except (TorchclothError, OSError) as error:
        print(f"fit: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        if not _left_alone(error):
            raise
        print("fit: another process ended; see its own line", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the first into the second
        kept = config is not None and _kept(config.folder / CHECKPOINT, since=0.0 if options.resume else began)
        further = "; the same command with --resume goes on after the last whole step" if kept else ""
        print(f"fit: stopped{further}", file=sys.stderr)
        return 130


def _kept(checkpoint: Path, since: float) -> bool:
    """Whether a checkpoint is there, and not of an earlier run."""
    return checkpoint.is_file() and checkpoint.stat().st_mtime >= since


def _left_alone(error: RuntimeError) -> bool:
    """By the other processes, one of which has said why."""
    import torch.distributed as distributed

    running = distributed.is_available() and distributed.is_initialized()
    return running and any(word in str(error).lower() for word in ("gloo", "connection", "nccl"))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m {NAME}",
        description="Fit what a config names to episodes, by gradient descent through the simulation.",
        epilog="On several processes: run.processes=N, or under torchrun or srun; see docs/how-to/train-with-lightning.md.",
    )
    add = parser.add_argument
    add("--config", required=True, metavar="FILE", help="YAML file, or the name of a shipped one: demo")
    add("--resume", action="store_true", help="go on where the run into the config's `out` was stopped")
    add("overrides", nargs="*", metavar="KEY=VALUE", help="instead of the config's, e.g. optimizer.steps=10 out=out/2")
    return parser
