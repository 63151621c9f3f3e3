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

MODULE_NAME = "torchcloth.training.fit"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit code (0 done, 2 wrong input, 130 interrupted)."""
    options, config, started = _parser().parse_intermixed_args(arguments), None, time.time()
    try:
        if find_spec("lightning") is None:  # the YAML reader comes with it
            raise MissingDependency("lightning is not installed", remedy='run: pip install "torchcloth[training]"')
        config = load(options.config, options.overrides)
        from .run import fit

        fit(config, options.resume)
        return 0
    except (TorchclothError, OSError) as error:
        print(f"fit: {error}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        if not _is_lost_connection(error):
            raise
        print("fit: another process ended; see its message", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, SystemExit):  # Lightning turns the first into the second
        has_checkpoint = config is not None and _has_checkpoint(
            config.folder / CHECKPOINT, since=0.0 if options.resume else started
        )
        hint = "; the same command with --resume continues after the last finished step" if has_checkpoint else ""
        print(f"fit: stopped{hint}", file=sys.stderr)
        return 130


def _has_checkpoint(checkpoint: Path, since: float) -> bool:
    """Whether this run has written a checkpoint."""
    return checkpoint.is_file() and checkpoint.stat().st_mtime >= since


def _is_lost_connection(error: RuntimeError) -> bool:
    """Whether the connection to other processes was lost, one of which has printed the reason."""
    import torch.distributed as distributed

    running = distributed.is_available() and distributed.is_initialized()
    return running and any(word in str(error).lower() for word in ("gloo", "connection", "nccl"))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"python -m {MODULE_NAME}",
        description="Fit the parameters that a config names to episodes, by gradient descent through the simulation.",
        epilog="Several processes: run.processes=N, torchrun or srun; see docs/how-to/train-with-lightning.md.",
    )
    add = parser.add_argument
    add("--config", required=True, metavar="FILE", help="YAML file, or the name of a shipped one: demo")
    add("--resume", action="store_true", help="resume the run in the config's `out` that was stopped")
    add("overrides", nargs="*", metavar="KEY=VALUE", help="replace values of the config, e.g. optimizer.steps=10 out=b")
    return parser
