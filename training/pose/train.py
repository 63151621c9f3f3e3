"""Train a pose network from nothing to a file of weights, and continue where it was stopped."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import Callback, ModelCheckpoint
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor

from torchcloth._utils.constants import Z_95
from torchcloth._utils.durations import describe_time
from torchcloth._utils.files import write_text
from torchcloth.pose.first_shape import save_network
from torchcloth.pose.network import PoseEstimator, masked_mean

from ..fit.checkpoints import AtomicCheckpointIO
from ..lightning_output import quieten_lightning
from .data import PoseDataModule, PoseDataset, collate
from .module import PoseLossWeights, PoseTraining
from .scenes import MOTIONS_PER_CLOTH

NETWORK_FILE, REPORT_FILE = "pose_network.safetensors", "training.json"
CHECKPOINT_PERIOD_STEPS, PROGRESS_PERIOD_S = 100, 20.0
EVALUATION_BATCH = 32
MIN_STD_FACTOR, MAX_STD_FACTOR = 0.2, 5.0


@dataclass(frozen=True)
class TrainingPlan:
    """How long, and with what, a network is trained.

    Attributes:
        steps: supervised ones.
        batch: samples in a step.
        learning_rate: largest of the supervised steps.
        physics_steps: steps with the simulated continuation in the loss, after the supervised ones.
        physics_weight: of that part.
        physics_learning_rate: largest of these steps.
        processes: of Lightning's DDP.
        seed: of weights, order and augmentation.
    """

    steps: int = 8000
    batch: int = 16
    learning_rate: float = 1e-3
    physics_steps: int = 0
    physics_weight: float = 0.5
    physics_learning_rate: float = 1e-4
    processes: int = 1
    seed: int = 0


def train(
    network: PoseEstimator,
    plan: TrainingPlan,
    out: Path,
    data: Path,
    held_out: Path,
    unlabelled: Path | None = None,
    resume: bool = False,
) -> dict[str, Any] | None:
    """Train, calibrate the standard deviations on held-out scenes, and write weights and a report.

    Args:
        network: that is trained.
        plan: steps and sizes.
        out: folder for checkpoints, ``pose_network.safetensors`` and ``training.json``.
        data: folder of labelled training motions.
        held_out: folder of motions for the report and the calibration.
        unlabelled: folder of motions without truth, whose clouds alone enter the steps with physics.
        resume: go on from the checkpoints in ``out``.

    Returns:
        The report; None in all processes but the first.

    Raises:
        InvalidInput: data that are no folder of motions, or nothing to resume.
    """
    torch.manual_seed(plan.seed)
    quieten_lightning()
    began = time.monotonic()
    supervised = PoseTraining(network, PoseLossWeights(), plan.learning_rate, max(plan.steps, 1))
    seconds = {}
    if plan.steps:
        seconds["supervised"] = _run_stage("supervised", supervised, plan, plan.steps, out, data, None, resume)
        if rank_zero_only.rank == 0:
            save_network(network, out / "supervised.safetensors")
    if plan.physics_steps:
        weights = replace(PoseLossWeights(), physics=plan.physics_weight)
        module = PoseTraining(network, weights, plan.physics_learning_rate, plan.physics_steps, warm_up=50)
        seconds["physics"] = _run_stage("physics", module, plan, plan.physics_steps, out, data, unlabelled, resume)
    if rank_zero_only.rank:
        return None
    report = evaluate(network, held_out)
    report = {**report, "plan": plan.__dict__, "seconds": {**seconds, "all": time.monotonic() - began}}
    save_network(network, out / NETWORK_FILE)
    write_text(out / REPORT_FILE, json.dumps(report, indent=1) + "\n")
    return report


def _run_stage(
    name: str,
    module: PoseTraining,
    plan: TrainingPlan,
    steps: int,
    out: Path,
    data: Path,
    unlabelled: Path | None,
    resume: bool,
) -> float:
    """Seconds that the steps took."""
    checkpoint = out / f"{name}.ckpt"
    batches = PoseDataModule(data, plan.batch, seed=plan.seed, unlabelled_folder=unlabelled)
    saver = ModelCheckpoint(out, name, every_n_train_steps=CHECKPOINT_PERIOD_STEPS, enable_version_counter=False)
    trainer = pl.Trainer(
        accelerator="cpu",
        devices=plan.processes,
        strategy="ddp_find_unused_parameters_true" if plan.processes > 1 else "auto",
        max_steps=steps,
        gradient_clip_val=1.0,
        callbacks=[saver, _ProgressLines(name)],
        plugins=[AtomicCheckpointIO()],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
    )
    began = time.monotonic()
    path = checkpoint if resume and checkpoint.is_file() else None
    trainer.fit(module, batches, ckpt_path=path, weights_only=True)
    if trainer.global_step < steps:
        raise KeyboardInterrupt
    return time.monotonic() - began


class _ProgressLines(Callback):
    """A line every 20 seconds: share, time left, mean error of the last lines' steps."""

    def __init__(self, stage: str) -> None:
        self.stage, self.began, self.last, self.first_step = stage, 0.0, 0.0, 0
        self.errors: list[float] = []

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        self.began = self.last = time.monotonic()
        self.first_step = trainer.global_step

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if "train/error_mm" in trainer.callback_metrics:
            self.errors.append(float(trainer.callback_metrics["train/error_mm"]))
        now, done, steps = time.monotonic(), trainer.global_step, int(trainer.max_steps)
        if not trainer.is_global_zero or (now - self.last < PROGRESS_PERIOD_S and done < steps):
            return
        self.last = now
        rate = (done - self.first_step) / (now - self.began)
        error = sum(self.errors) / max(len(self.errors), 1)
        left = describe_time((steps - done) / max(rate, 1e-9))
        print(f"{self.stage}: {done}/{steps} steps ({done / steps:.0%}), error {error:.1f} mm, {left} left", flush=True)
        self.errors.clear()


# -- held out ---------------------------------------------------------------------------------------------------------


@torch.no_grad()
def evaluate(network: PoseEstimator, folder: Path, motions: int | None = None) -> dict[str, Any]:
    """Calibrate the standard deviations on every other cloth of a folder, and report errors of the rest.

    Args:
        network: its ``std_factor`` is set.
        folder: of motions that it was not trained with.
        motions: how many to read at most; None: all.

    Returns:
        Median and mean of the root mean square errors [mm] and the coverage of 95 % intervals, by novelty and kind.
    """
    network.eval()
    dataset = PoseDataset(folder, motions)
    rows = []
    for first in range(0, len(dataset), EVALUATION_BATCH):
        samples = [dataset[k] for k in range(first, min(first + EVALUATION_BATCH, len(dataset)))]
        batch = collate(samples)
        prediction = network(batch.inputs)
        error, exists = prediction.x - batch.x, batch.inputs.exists
        rms = masked_mean(error.square().sum(-1), exists).sqrt()
        z = error.abs() / prediction.std[..., None]
        for k, sample in enumerate(samples):
            labels = {name: str(sample.motion[name]) for name in ("novelty", "kind", "grip_kind", "motion_kind")}
            number = int(sample.motion["seed"]) // MOTIONS_PER_CLOTH
            rows.append((number, labels, float(rms[k]), z[k][exists[k]], sample.visible))
    calibration = [z for number, _, _, z, _ in rows if number % 2 == 0] or [row[3] for row in rows]
    factor = min(max(_factor(calibration), MIN_STD_FACTOR), MAX_STD_FACTOR)
    network.std_factor.mul_(factor)
    tested = [row for row in rows if row[0] % 2 == 1] or rows
    groups: dict[str, Callable[[dict[str, str]], bool]] = {"all": lambda _: True}
    for name in ("novelty", "kind", "grip_kind", "motion_kind"):
        for value in sorted({row[1][name] for row in tested}):
            groups[f"{name} {value}"] = lambda labels, name=name, value=value: labels[name] == value
    table = {}
    for title, belongs in groups.items():
        part = [row for row in tested if belongs(row[1])]
        errors = torch.tensor([row[2] for row in part])
        inside = torch.tensor([float((row[3] < Z_95 * factor).double().mean()) for row in part])
        table[title] = {
            "samples": len(part),
            "median_rms_mm": 1e3 * float(errors.median()),
            "mean_rms_mm": 1e3 * float(errors.mean()),
            "coverage": float(inside.mean()),
        }
    return {"std_factor": float(network.std_factor), "held_out": table}


def _factor(z: list[Tensor]) -> float:
    """By which standard deviations must grow so that 95 % of the errors lie in their intervals."""
    values = torch.cat([part.flatten() for part in z]).sort().values
    return float(values[math.ceil(0.95 * len(values)) - 1]) / Z_95
