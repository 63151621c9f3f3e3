"""Progress display of a run."""

from __future__ import annotations

import sys
from typing import Any

import lightning.pytorch as pl
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .module import FitModule


class ProgressPrinter(pl.Callback):
    """Callback that shows a bar on a terminal, or one line for each step in a log file; first process only."""

    def __init__(self) -> None:
        columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
        self.bar = Progress(
            *columns, TextColumn("{task.description}"), refresh_per_second=2, disable=not sys.stdout.isatty()
        )
        self.task: Any = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the progress bar."""
        if trainer.is_global_zero:
            self.bar.start()
            self.task = self.bar.add_task("first step", total=trainer.max_epochs, completed=trainer.global_step)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Advance by one step."""
        metrics = trainer.callback_metrics
        if self.task is None or "train/loss" not in metrics:
            return
        parts = [f"loss {float(metrics['train/loss']):.4g}"]
        fresh = trainer.global_step % (trainer.check_val_every_n_epoch or 1) == 0
        for kind, when in (("train", ""), *([("val", " after it")] if fresh else [])):
            if (key := f"{kind}/chamfer") in metrics:
                parts.append(f"{kind}{when} {1e3 * float(metrics[key]):.2f} mm")
        values = pl_module.values_before if isinstance(pl_module, FitModule) else {}
        parts += [f"{name} {value:.4g}" for name, value in list(values.items())[:3]]
        text = ", ".join(parts)
        self.bar.update(self.task, completed=trainer.global_step, description=text)
        if not self.bar.console.is_terminal:
            print(f"step {trainer.global_step}/{trainer.max_epochs}: {text}", flush=True)

    def teardown(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Stop the progress bar and restore the terminal."""
        self.bar.stop()
