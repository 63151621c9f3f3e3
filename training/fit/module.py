"""The fit as a LightningModule: simulate episodes, compare them with the data, make a step."""

from __future__ import annotations

from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor, nn

from torchcloth import Cloth
from torchcloth.episodes.observed_surface import ObservedSurface
from torchcloth.episodes.replay import Replay, frames_from_rollout
from torchcloth.errors import InvalidInput, SimulationDiverged
from torchcloth.identification import Episode
from torchcloth.identification.estimators.objective import Objective
from torchcloth.identification.residuals.rows import SimulatedEpisode, match_points
from torchcloth.parameters import call_with_parameters

from .checkpoints import read_checkpoint, report_damage
from .cloth_description import build_described_cloth, default_precision
from .config import from_dict
from .data import Episodes
from .learned_cloth import LearnedCloth, scalar_summary
from .losses import Loss, chamfer


class FitModule(pl.LightningModule):
    """LightningModule of a cloth with learned parameters.

    ``FitModule.load_from_checkpoint(FILE).cloth()`` returns the learned cloth; it needs no data. A network of one's own
    must be imported before, or be given: ``load_from_checkpoint(FILE, network_class=CLASS)``.

    Args:
        config: as in the YAML file.
        description: of the cloth, see ``describe_cloth``.
        problem: fingerprint of the data and of all settings that may not change when a run is resumed.
        network_class: of ``config``'s network; None: the class of that name, if it is imported already.
    """

    def __init__(
        self,
        config: dict[str, Any],
        description: dict[str, Any],
        problem: str = "",
        network_class: type[nn.Module] | None = None,
    ) -> None:
        super().__init__()
        self.save_hyperparameters("config", "description", "problem", logger=False)
        self.config, self.problem = from_dict(config), problem
        cloth = build_described_cloth(description, self.config.model)
        with default_precision(self.config.model.precision), torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.config.run.seed)  # a network's first weights
            self.learned = LearnedCloth(cloth, self.config.learn, network_class)
        self.loss = Loss(self.config.loss)
        self.values_before: dict[str, float] = {}  # before the present step
        self.history: dict[int, dict[str, float]] = {}
        self.sheet: ObservedSurface | None = None
        self.all_have_clouds = False  # every process must log the same keys

    @classmethod
    def load_from_checkpoint(cls, checkpoint_path: Any, *args: Any, **kwargs: Any) -> FitModule:
        """Load a checkpoint, as Lightning does; the file holds tensors, numbers and text, or it is refused.

        Raises:
            InvalidInput: the file holds other objects, or names a network that is not imported.
        """
        read_checkpoint(checkpoint_path)
        with report_damage(checkpoint_path):
            return super().load_from_checkpoint(checkpoint_path, *args, **kwargs)

    def now(self) -> dict[str, float]:
        """Return the present values by name; of a field, its mean."""
        return {name: scalar_summary(value) for name, value in self.learned.values().items()}

    def cloth(self) -> Cloth:
        """Return a copy of the cloth with the learned values."""
        return self.learned.bake_cloth()

    # -- simulation -----------------------------------------------------------------------------------------------

    def forward(self, episode: Episode) -> SimulatedEpisode:
        """Simulate an episode with the present values, for comparison with the data."""
        if self.sheet is None:
            raise InvalidInput("forward", got="a module without data", expected="a module in a run, or use cloth()")
        entries = {f"cloth.{key}": value for key, value in self.learned.entries().items()}
        model = Replay(self.learned.cloth)
        rollout = call_with_parameters(model, entries, (episode, self.config.model.dt or None))
        return match_points(frames_from_rollout(rollout), None, episode, self.sheet)

    def setup(self, stage: str) -> None:
        """Prepare the surface for the residuals of this run's episodes."""
        data = self.trainer.datamodule  # type: ignore[attr-defined]
        if self.sheet is None and isinstance(data, Episodes):
            self.sheet = Objective(self.learned.cloth, [], data.train).surface
            self.all_have_clouds = all(any(map(len, e.clouds[1:])) for e in (*data.train, *data.val))
            if data.per_step < self.trainer.world_size:
                raise InvalidInput(
                    "processes",
                    got=self.trainer.world_size,
                    expected=f"at most {data.per_step}, the episodes at a step",
                )

    # -- training -------------------------------------------------------------------------------------------------

    def training_step(self, episodes: list[Episode], index: int) -> Tensor:
        """Compute this process's part of the mean loss over all episodes of the step, one episode's graph at a time.

        Returns:
            A scalar with the gradient of the loss but not its value, which neither optimiser nor DDP needs.
        """
        self.values_before = self.now()
        learned = [p for p in self.learned.parameters() if p.requires_grad]
        data, world = self.trainer.datamodule, self.trainer.world_size  # type: ignore[attr-defined]
        summed, figures = [torch.zeros_like(p) for p in learned], []
        for k, episode in enumerate(episodes):
            # random numbers depend only on step and episode, so that resumed runs and other processes repeat them
            torch.manual_seed(hash((self.config.run.seed, self.global_step, self.global_rank + k * world)))
            loss, figures_of_episode = self._loss_and_figures(episode, "train")
            figures.append(figures_of_episode)
            if self.config.learn.roughness:
                loss = loss + self.config.learn.roughness * self.learned.roughness()
            parts = torch.autograd.grad(loss * (world / data.per_step), learned, allow_unused=True)
            summed = [s if g is None else s + g for s, g in zip(summed, parts, strict=True)]
        self._check_gradients(summed)
        self._log(figures)
        return torch.stack([(p * g).sum() for p, g in zip(learned, summed, strict=True)]).sum()

    def _check_gradients(self, gradients: list[Tensor]) -> None:
        """Refuse gradients that are not finite in any process; a step along them would spoil the checkpoint."""
        bad_count = torch.stack([(~g.isfinite()).sum() for g in gradients]).sum().double()
        if self.trainer.strategy.reduce(bad_count, reduce_op="sum") > 0:
            raise SimulationDiverged(
                f"gradient of step {self.global_step + 1}",
                got="numbers that are not finite",
                expected="finite ones",
                remedy="the checkpoint is from the step before; fewer frames, or a smaller optimizer.learning_rate",
            )

    def validation_step(self, episodes: list[Episode], index: int) -> None:
        """Log losses and distances of validation episodes."""
        self._log([self._loss_and_figures(episode, "val")[1] for episode in episodes])

    def _log(self, figures: list[dict[str, Tensor]]) -> None:
        """Log means over the episodes of all processes (``sync_dist`` would weigh unequal shares wrongly)."""
        local = [torch.stack([f[key] for f in figures]).sum() for key in figures[0]]
        total = torch.stack([*local, local[0].new_tensor(len(figures))])
        *sums, count = self.trainer.strategy.reduce(total, reduce_op="sum")
        means = {key: value / count for key, value in zip(figures[0], sums, strict=True)}
        self.log_dict(means, on_step=False, on_epoch=True, batch_size=1)

    def _loss_and_figures(self, episode: Episode, kind: str) -> tuple[Tensor, dict[str, Tensor]]:
        scene = self(episode)
        loss = self.loss(scene)
        figures, distance = {f"{kind}/loss": loss.detach()}, chamfer(scene) if self.all_have_clouds else None
        if distance is not None:
            figures[f"{kind}/chamfer"] = distance.detach()
        return loss, figures

    def on_train_epoch_end(self) -> None:
        """Store the values before the step and their losses in the history."""
        metrics = {key: float(value) for key, value in self.trainer.callback_metrics.items()}
        if "train/loss" in metrics:
            local = {key: metrics[key] for key in metrics if key.startswith("train/")}
            self.history[self.global_step - 1] = {**local, **self.values_before}
            if self.logger is not None:
                self.log_dict(self.values_before)

    def configure_optimizers(self) -> dict[str, Any]:
        """Configure Adam on the unconstrained values in their units; the rate is halved every ``half_life`` steps."""
        options = self.config.optimizer
        groups = [{"params": [p], "lr": options.learning_rate * unit} for p, unit in self.learned.iterate_with_units()]
        optimizer = torch.optim.Adam(groups, lr=options.learning_rate)
        decay = 0.5 ** (1 / options.half_life) if options.half_life else 1.0
        schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, decay)
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:
        """Make a step, then clip the values to their domains."""
        super().optimizer_step(*args, **kwargs)
        self.learned.clip()

    def transfer_batch_to_device(
        self, batch: list[Episode], device: torch.device, dataloader_idx: int
    ) -> list[Episode]:
        """Keep episodes on the CPU, where fits run."""
        return batch

    # -- checkpoints ----------------------------------------------------------------------------------------------

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add the history to the checkpoint."""
        checkpoint["history"] = self.history

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Load the history, and refuse a checkpoint of another problem."""
        self.history = dict(checkpoint["history"])
        if self._trainer is not None and checkpoint["hyper_parameters"]["problem"] != self.problem:
            raise InvalidInput(
                "--resume",
                got="a checkpoint of another run",
                expected="the same episodes and config, but for steps, processes and loggers",
                remedy="start again without --resume",
            )
        local = {key: tuple(value.shape) for key, value in self.state_dict().items()}
        stored = {key: tuple(value.shape) for key, value in checkpoint["state_dict"].items()}
        if local != stored:
            key = min(key for key in local.keys() | stored.keys() if local.get(key) != stored.get(key))
            raise InvalidInput(
                "checkpoint",
                got=f"{key} of shape {stored.get(key, 'none')}",
                expected=f"{local.get(key, 'none')}: the model and the network's class as they were",
            )
