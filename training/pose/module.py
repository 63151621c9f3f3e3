"""The training of a pose network as a LightningModule: supervised, and by what the simulation makes of its answer."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from torchcloth._utils.constants import Z_95
from torchcloth.pose.network import (
    MEAN_LOG_FABRIC,
    STD_LOG_FABRIC,
    PoseEstimator,
    StageOutputs,
    masked_mean,
)

from .data import PoseBatch
from .physics_loss import PhysicsLoss

SHAPE_NEIGHBOURS = 6  # vertices near each other on the fabric whose distance vectors are compared


@dataclass(frozen=True)
class PoseLossWeights:
    """Weights of the parts of the loss, which are lengths in the scene's unit where nothing else is said.

    Attributes:
        others: of the hypotheses that are not the nearest to the truth, so that none is forgotten.
        choice: of the cross-entropy of the hypotheses' weights.
        shape: of differences between neighbours, which is the local shape.
        std: of the likelihood of the standard deviations.
        velocity: of the velocity, in units of length per second.
        fabric: of the likelihood of the fabric's parameters.
        physics: of the distance between the simulated continuation and the next clouds.
    """

    others: float = 0.05
    choice: float = 0.01
    shape: float = 0.5
    std: float = 0.01
    velocity: float = 0.02
    fabric: float = 0.003
    physics: float = 0.0


class PoseTraining(pl.LightningModule):
    """Trains a `PoseEstimator`.

    Args:
        network: what is trained; None: a new one.
        weights: of the loss.
        learning_rate: at its highest, after the warm-up; it then falls to nothing as a half cosine.
        steps: of the whole training.
        warm_up: steps in which the learning rate rises.
    """

    def __init__(
        self,
        network: PoseEstimator | None = None,
        weights: PoseLossWeights | None = None,
        learning_rate: float = 1e-3,
        steps: int = 10_000,
        warm_up: int = 200,
    ) -> None:
        super().__init__()
        self.network = network or PoseEstimator()
        self.weights = weights or PoseLossWeights()
        self.learning_rate, self.steps, self.warm_up = learning_rate, steps, warm_up
        self.physics = PhysicsLoss()
        self.save_hyperparameters(
            {
                "network": self.network.description,
                "weights": asdict(self.weights),
                "learning_rate": learning_rate,
                "steps": steps,
                "warm_up": warm_up,
            }
        )

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the numbers of the module in plain types."""
        checkpoint["hyper_parameters"] = dict(self.hparams)

    def training_step(self, batch: PoseBatch, index: int) -> Tensor:
        """Return the loss of a batch."""
        terms = self.loss_terms(batch)
        for name, value in terms.items():
            self.log(f"train/{name}", value.detach(), prog_bar=name == "error_mm")
        return terms["loss"]

    def validation_step(self, batch: PoseBatch, index: int) -> None:
        """Log root mean square errors, and how often the intervals hold the truth."""
        prediction = self.network(batch.inputs)
        exists, error = batch.inputs.exists, prediction.x - batch.x
        rms = masked_mean(error.square().sum(-1), exists).sqrt()
        inside = (error.abs() < Z_95 * prediction.std[..., None]).to(error).mean(-1)
        self.log("val/median_rms_mm", 1e3 * rms.median(), batch_size=len(rms), sync_dist=True)
        self.log("val/rms_mm", 1e3 * rms.mean(), batch_size=len(rms), sync_dist=True)
        self.log("val/coverage", masked_mean(inside, exists).mean(), batch_size=len(rms), sync_dist=True)

    def configure_optimizers(self) -> dict[str, Any]:
        """Return AdamW with a warm-up and a half cosine."""
        optimizer = torch.optim.AdamW(self.network.parameters(), self.learning_rate, weight_decay=1e-4)

        def rate(step: int) -> float:
            rise = min(1.0, (step + 1) / self.warm_up)
            return rise * 0.5 * (1 + math.cos(math.pi * min(1.0, step / self.steps)))

        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def loss_terms(self, batch: PoseBatch) -> dict[str, Tensor]:
        """Return the loss and its parts, and the mean error [mm]."""
        outputs, w = self.network.compute_stages(batch.inputs, batch.x), self.weights
        has_truth = batch.x.isfinite().all(-1).all(-1)
        # scenes without truth count as right here, and enter the part of the physics alone
        answer = outputs.frame.to_world(outputs.stages[-1]).detach()
        labelled = has_truth[:, None, None]
        batch = batch._replace(x=batch.x.where(labelled, answer), v=batch.v.where(labelled, 0.0))
        exists, share = batch.inputs.exists & has_truth[:, None], has_truth.float().mean().clamp_min(1e-6)
        truth = outputs.frame.to_scene(batch.x)
        per_hypothesis = masked_mean((outputs.hypotheses - truth[:, None]).norm(dim=-1), exists[:, None])
        nearest = per_hypothesis.gather(1, outputs.chosen[:, None]).mean()
        errors = [masked_mean((x - truth).norm(dim=-1), exists) for x in outputs.stages]
        stage_weights = torch.linspace(0.5, 1.0, len(errors)).tolist()
        choice = torch.nn.functional.cross_entropy(outputs.logits, outputs.chosen, reduction="none")
        terms = {
            "hypotheses": nearest + w.others * per_hypothesis.mean(),
            "position": torch.stack([s * e.mean() for s, e in zip(stage_weights, errors, strict=True)]).sum(),
            "choice": w.choice * (choice * has_truth).mean(),
            "shape": w.shape * self._shape_error(outputs, truth, batch, exists),
            "std": w.std * self._std_likelihood(outputs, truth, exists),
            "velocity": w.velocity * self._velocity_error(outputs, batch, exists),
            "fabric": w.fabric * _fabric_likelihood(outputs, batch.fabric, has_truth),
        }
        terms = {name: value / share for name, value in terms.items()}
        if w.physics:
            terms["physics"] = w.physics * self._physics_distance(outputs, batch)
        terms["loss"] = torch.stack(list(terms.values())).sum()
        terms["error_mm"] = 1e3 * (errors[-1] * outputs.frame.scale[:, 0]).mean() / share
        return terms

    def _shape_error(self, outputs: StageOutputs, truth: Tensor, batch: PoseBatch, exists: Tensor) -> Tensor:
        """Mean error of the vectors between vertices that are near on the fabric."""
        rest = batch.inputs.rest
        apart = torch.cdist(rest, rest).masked_fill(~batch.inputs.exists[:, None], math.inf)
        near = apart.topk(SHAPE_NEIGHBOURS + 1, largest=False).indices[..., 1:]
        scene = torch.arange(len(rest))[:, None, None]
        error = outputs.stages[-1] - truth
        return masked_mean((error[scene, near] - error[:, :, None]).norm(dim=-1).mean(-1), exists).mean()

    def _std_likelihood(self, outputs: StageOutputs, truth: Tensor, exists: Tensor) -> Tensor:
        """Negative log likelihood of the errors; it teaches the standard deviations alone."""
        squared = (outputs.stages[-1] - truth).detach().square().mean(-1)
        return masked_mean(outputs.log_std + 0.5 * squared / (2 * outputs.log_std).exp(), exists).mean()

    def _physics_distance(self, outputs: StageOutputs, batch: PoseBatch) -> Tensor:
        """Mean distance of the next clouds from the simulated continuation, in mean units of length."""
        frame = outputs.frame
        x, v = frame.to_world(outputs.stages[-1]), frame.turn_to_world(outputs.v * frame.scale[:, None])
        mean, spread = x.new_tensor(MEAN_LOG_FABRIC), x.new_tensor(STD_LOG_FABRIC)
        return self.physics(x, v, mean + spread * outputs.log_fabric, batch) / frame.scale.mean()

    def _velocity_error(self, outputs: StageOutputs, batch: PoseBatch, exists: Tensor) -> Tensor:
        truth = outputs.frame.turn_to_scene(batch.v) / outputs.frame.scale[:, None]
        return masked_mean((outputs.v - truth).norm(dim=-1), exists).mean()


def _fabric_likelihood(outputs: StageOutputs, log_fabric: Tensor, has_truth: Tensor) -> Tensor:
    mean, spread = log_fabric.new_tensor(MEAN_LOG_FABRIC), log_fabric.new_tensor(STD_LOG_FABRIC)
    squared = (outputs.log_fabric - (log_fabric - mean) / spread).square()
    likelihood = outputs.log_fabric_log_std + 0.5 * squared * (-2 * outputs.log_fabric_log_std).exp()
    return (likelihood.mean(-1) * has_truth).mean()
