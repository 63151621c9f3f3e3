"""The fit as a LightningModule: simulate an episode, compare, step."""

from __future__ import annotations

from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from torchcloth import Cloth
from torchcloth.episodes.observed_surface import ObservedSurface
from torchcloth.episodes.replay import Replay, frames_from_rollout
from torchcloth.errors import InvalidInput, SimulationDiverged
from torchcloth.identification import Episode
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.residuals.rows import Scene, scene_of
from torchcloth.parameters import call_with_parameters

from .cloth_description import built, precision
from .config import from_dict
from .data import Episodes
from .learned_cloth import Learned, summary
from .losses import Loss, chamfer


class FitModule(pl.LightningModule):
    """A cloth that learns; ``FitModule.load_from_checkpoint(FILE).cloth()`` is what was learned, without the data.

    Args:
        config: as in the YAML file.
        description: of the cloth, see ``described``.
        problem: fingerprint of the data and of what may not change when a run is resumed.
    """

    def __init__(self, config: dict[str, Any], description: dict[str, Any], problem: str = "") -> None:
        super().__init__()
        self.save_hyperparameters(logger=False)
        self.config, self.problem = from_dict(config), problem
        cloth = built(description, self.config.model)
        with precision(self.config.model.precision), torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.run.seed)  # a network's first weights
            self.learned = Learned(cloth, self.config.learn)
        self.loss = Loss(self.config.loss)
        self.begun: dict[str, float] = {}  # values before the present step
        self.history: dict[int, dict[str, float]] = {}
        self.sheet: ObservedSurface | None = None
        self.clouded = False  # every process must log the same

    def now(self) -> dict[str, float]:
        """Values by name, of fields the mean."""
        return {name: summary(value) for name, value in self.learned.values().items()}

    def cloth(self) -> Cloth:
        """A copy of the cloth with everything that was learned in it."""
        return self.learned.baked()

    # -- simulation -----------------------------------------------------------------------------------------------

    def forward(self, episode: Episode) -> Scene:
        """An episode as it is simulated now, beside what was measured."""
        if self.sheet is None:
            raise InvalidInput("forward", got="a module without data", expected="a module in a run, or use cloth()")
        entries = {f"cloth.{key}": value for key, value in self.learned.entries().items()}
        model = Replay(self.learned.cloth)
        rollout = call_with_parameters(model, entries, (episode, self.config.model.dt or None))
        return scene_of(frames_from_rollout(rollout), None, episode, self.sheet)

    def setup(self, stage: str) -> None:
        """The surface, in the pieces that the residuals of this run's episodes need."""
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if self.sheet is None and isinstance(data, Episodes):
            self.sheet = Objective(self.learned.cloth, [], data.train).sheet
            self.clouded = all(any(map(len, e.clouds[1:])) for e in (*data.train, *data.val))
            if data.per_step < self.trainer.world_size:
                raise InvalidInput(
                    "processes",
                    got=self.trainer.world_size,
                    expected=f"at most {data.per_step}, the episodes at a step",
                )

    # -- training -------------------------------------------------------------------------------------------------

    def training_step(self, episodes: list[Episode], index: int) -> Tensor:
        """This process's part of the mean over all episodes of the step, one simulation's graph at a time.

        Returns:
            What has the gradient of the loss, not its value: all that optimiser and DistributedDataParallel need.
        """
        self.begun = self.now()
        learned = [p for p in self.learned.parameters() if p.requires_grad]
        data, world = self.trainer.datamodule, self.trainer.world_size  # type: ignore[attr-defined]
        summed, figures = [torch.zeros_like(p) for p in learned], []
        for k, episode in enumerate(episodes):
            # what is random depends on step and episode alone: a resumed run repeats it, other processes too
            torch.manual_seed(hash((self.config.run.seed, self.global_step, self.global_rank + k * world)))
            loss, found = self._compared(episode, "train")
            figures.append(found)
            if self.config.learn.roughness:
                loss = loss + self.config.learn.roughness * self.learned.roughness()
            parts = torch.autograd.grad(loss * (world / data.per_step), learned, allow_unused=True)
            summed = [s if g is None else s + g for s, g in zip(summed, parts, strict=True)]
        self._finite(summed)
        self._log(figures)
        return torch.stack([(p * g).sum() for p, g in zip(learned, summed, strict=True)]).sum()

    def _finite(self, gradients: list[Tensor]) -> None:
        """Of all processes: a step along what is not would leave a checkpoint that nobody can go on from."""
        wrong = torch.stack([(~g.isfinite()).sum() for g in gradients]).sum().double()
        if self.trainer.strategy.reduce(wrong, reduce_op="sum") > 0:
            raise SimulationDiverged(
                f"gradient of step {self.global_step + 1}",
                got="numbers that are not finite",
                expected="finite ones",
                remedy="the checkpoint is from the step before; fewer frames, or a smaller optimizer.rate",
            )

    def validation_step(self, episodes: list[Episode], index: int) -> None:
        """Losses and distances of episodes that are only looked at."""
        self._log([self._compared(episode, "val")[1] for episode in episodes])

    def _log(self, figures: list[dict[str, Tensor]]) -> None:
        """Means over the episodes of all processes (``sync_dist`` would weigh unequal shares wrongly)."""
        own = [torch.stack([f[key] for f in figures]).sum() for key in figures[0]]
        total = torch.stack([*own, own[0].new_tensor(len(figures))])
        *sums, count = self.trainer.strategy.reduce(total, reduce_op="sum")
        means = {key: value / count for key, value in zip(figures[0], sums, strict=True)}
        self.log_dict(means, on_step=False, on_epoch=True, batch_size=1)

    def _compared(self, episode: Episode, kind: str) -> tuple[Tensor, dict[str, Tensor]]:
        scene = self(episode)
        loss = self.loss(scene)
        figures, distance = {f"{kind}/loss": loss.detach()}, chamfer(scene) if self.clouded else None
        if distance is not None:
            figures[f"{kind}/chamfer"] = distance.detach()
        return loss, figures

    def on_train_epoch_end(self) -> None:
        """Remember the step: the values that it began with, and how far they were off."""
        metrics = {key: float(value) for key, value in self.trainer.callback_metrics.items()}
        if "train/loss" in metrics:
            own = {key: metrics[key] for key in metrics if key.startswith("train/")}
            self.history[self.global_step - 1] = {**own, **self.begun}
            if self.logger is not None:
                self.log_dict(self.begun)

    def configure_optimizers(self) -> dict[str, Any]:
        """Adam on the unconstrained values, each in its own unit; the rate is halved every ``half_life`` steps."""
        kind = self.config.optimizer
        groups = [{"params": [p], "lr": kind.rate * unit} for p, unit in self.learned.with_units()]
        optimizer = torch.optim.Adam(groups, lr=kind.rate)
        decay = 0.5 ** (1 / kind.half_life) if kind.half_life else 1.0
        schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, decay)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """A step, then back into what is legal."""
        super().optimizer_step(*args, **kwargs)
        self.learned.clip()

    def transfer_batch_to_device(
        self, batch: list[Episode], device: torch.device, dataloader_idx: int
    ) -> list[Episode]:
        """Episodes stay on the CPU, where fits run."""
        return batch

    # -- checkpoints ----------------------------------------------------------------------------------------------

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """The history belongs to the run."""
        checkpoint["history"] = self.history

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Refuse to go on with another problem."""
        self.history = dict(checkpoint["history"])
        if self._trainer is not None and checkpoint["hyper_parameters"]["problem"] != self.problem:
            raise InvalidInput(
                "--resume",
                got="a checkpoint of another run",
                expected="the same episodes and config, but for steps, processes and loggers",
                remedy="start again without --resume",
            )
        own = {key: tuple(value.shape) for key, value in self.state_dict().items()}
        kept = {key: tuple(value.shape) for key, value in checkpoint["state_dict"].items()}
        if own != kept:
            key = min(key for key in own.keys() | kept.keys() if own.get(key) != kept.get(key))
            raise InvalidInput(
                "checkpoint",
                got=f"{key} of shape {kept.get(key, 'none')}",
                expected=f"{own.get(key, 'none')}: the model and the network's class as they were",
            )
