"""Run a fit from its configuration to its result."""

from __future__ import annotations

import os
import time
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path

import lightning.pytorch as pl
import torch
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.fabric.plugins.environments.torchelastic import TorchElasticEnvironment
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.strategies import DDPStrategy
from torch import nn

from torchcloth import Cloth
from torchcloth._utils.resume import digest, source_fingerprint
from torchcloth.errors import InvalidInput, MissingDependency
from torchcloth.identification.estimators.objective import Objective

from ..lightning_output import quieten_lightning
from . import result
from .checkpoints import AtomicCheckpointIO, read_checkpoint
from .cloth_description import build_described_cloth, default_precision, describe_cloth
from .config import CHECKPOINT, Config, Network, Optimizer, Run
from .data import Episodes, read_episodes
from .learned_cloth import import_network
from .module import FitModule
from .progress import ProgressPrinter


def fit(config: Config, resume: bool = False) -> FitModule:
    """Train, write a checkpoint after each step, and write the result.

    Args:
        config: of the run.
        resume: continue from ``out/last.ckpt``; the result is the same, bit by bit, as without the interruption.

    Returns:
        The trained module.

    Raises:
        InvalidInput: configuration or data are inconsistent, there is nothing to resume, or more steps are done than
            requested.
        RecordingError: an episode is inconsistent.
        SimulationDiverged: the simulation is unstable after a step, whose checkpoint exists; or a gradient is not
            finite, and the checkpoint is from the step before.
    """
    torch.set_num_threads(1)  # on meshes of a thousand triangles processes pay off, threads do not
    folder = config.folder
    checkpoint = folder / CHECKPOINT
    if folder.exists() and not folder.is_dir():
        raise InvalidInput("out", got=f"{folder}, a file", expected="a folder, new or existing")
    if resume and not checkpoint.is_file():
        raise InvalidInput("--resume", got=f"no {checkpoint}", expected="what an interrupted run left")
    if resume:
        _check_checkpoint(checkpoint, config.optimizer.steps)
    with default_precision(config.model.precision):
        return _run(config, folder, checkpoint if resume else None)


def _check_checkpoint(checkpoint: Path, steps: int) -> None:
    done = len(read_checkpoint(checkpoint)["history"])
    if done > steps:
        raise InvalidInput("config: optimizer.steps", got=steps, expected=f"at least {done}, the steps already done")


def _run(config: Config, folder: Path, checkpoint: Path | None) -> FitModule:
    began = time.perf_counter()
    train, val = read_episodes(config.data)
    description = describe_cloth(train[0])
    cloth = build_described_cloth(description, config.model)
    data = Episodes(cloth, train, val, config.data.per_step, config.run.seed)
    if config.run.processes * config.run.nodes > data.per_step:
        got, expected = config.run.processes * config.run.nodes, f"at most {data.per_step}, the episodes at a step"
        raise InvalidInput("config: run.processes", got=got, expected=expected)
    _check_processes(config.run)
    network_class = None if config.learn.network is None else import_network(config.learn.network.module)
    module = FitModule(asdict(config), description, _problem(config, cloth, data), network_class)
    _check_statistics(module.learned.network, config.run)
    initial = module.now()
    trainer = _trainer(config, folder, [] if checkpoint else [folder / name for name in result.RESULT_FILES])
    trainer.fit(module, datamodule=data, ckpt_path=checkpoint)
    trainer.loggers = []  # the final figures belong to no step
    figures = {
        "train": {"episodes": len(train), **_final_figures(trainer, module, data, data.train)},
        "val": {"episodes": len(val), **(_final_figures(trainer, module, data, data.val) if val else {})},
        "steps": trainer.global_step,
        "seconds": time.perf_counter() - began,
        "processes": trainer.world_size,
        "warnings": [warning for e in (*data.train, *data.val) for warning in e.data_warnings()],
    }
    if data.per_step == len(train):  # otherwise the first step has the loss of a part of the episodes
        first = module.history[0]
        figures["train"] |= {"loss_before": first["train/loss"], "chamfer_before": first.get("train/chamfer")}
    if trainer.is_global_zero:
        episodes = [str(r.path) for r in train]
        result.print_result(result.write_result(folder, config, module, initial, figures, episodes), folder)
    return module


def _check_statistics(network: nn.Module | None, run: Run) -> None:
    """Refuse running statistics on several processes, each of which would see only its share of the episodes."""
    modules = () if network is None else network.modules()
    if run.processes * run.nodes > 1 and any(getattr(m, "track_running_stats", False) for m in modules):
        raise InvalidInput(
            "config: learn.network",
            got="layers with running statistics, on several processes",
            expected="one process, or layers without (track_running_stats=False, GroupNorm, LayerNorm)",
        )


def _check_processes(run: Run) -> None:
    """Refuse a launcher that starts another number of processes than the config says."""
    variable = "WORLD_SIZE" if "WORLD_SIZE" in os.environ else "SLURM_NTASKS"  # torchrun has priority, as in Lightning
    if variable == "SLURM_NTASKS" and os.environ.get("SLURM_JOB_NAME") in ("bash", "interactive"):
        return
    started = os.environ.get(variable, "")
    if started.isdigit() and int(started) != run.processes * run.nodes:
        raise InvalidInput(
            "config: run.processes x run.nodes",
            got=f"{run.processes * run.nodes}, started as one of {started} processes ({variable})",
            expected="as many as torchrun or the cluster starts",
        )
    if variable == "SLURM_NTASKS" and started not in ("", "1") and "SLURM_NTASKS_PER_NODE" not in os.environ:
        raise InvalidInput("srun", got=f"--ntasks={started} alone", expected=f"--ntasks-per-node={run.processes}")


def _trainer(config: Config, folder: Path, outdated: list[Path]) -> pl.Trainer:
    quieten_lightning()
    world = config.run.processes * config.run.nodes
    return pl.Trainer(
        accelerator="cpu",
        devices=config.run.processes,
        num_nodes=config.run.nodes,
        strategy=DDPStrategy(broadcast_buffers=False) if world > 1 else "auto",
        max_epochs=config.optimizer.steps,  # an epoch is a step
        check_val_every_n_epoch=config.run.validate_every,
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
        log_every_n_steps=1,
        logger=_loggers(config.run.loggers, folder),
        callbacks=[
            ModelCheckpoint(folder, Path(CHECKPOINT).stem, save_on_train_epoch_end=True, enable_version_counter=False),
            ProgressPrinter(),
        ],
        plugins=[AtomicCheckpointIO(outdated), *_cluster_plugins()],
        default_root_dir=folder,
        enable_progress_bar=False,
        enable_model_summary=False,
    )


def _cluster_plugins() -> list[SLURMEnvironment]:
    """Return SLURM's plugin without requeueing, whose checkpoints would be loaded without --resume."""
    is_slurm_only = SLURMEnvironment.detect() and not TorchElasticEnvironment.detect()
    return [SLURMEnvironment(auto_requeue=False)] if is_slurm_only else []


def _loggers(names: list[str], folder: Path) -> list[Logger]:
    out: list[Logger] = []
    for name in names:
        try:
            out.append((CSVLogger if name == "csv" else TensorBoardLogger)(folder, name="log"))
        except ModuleNotFoundError:
            raise MissingDependency("tensorboard is not installed", remedy="run: pip install tensorboard") from None
    return out


def _final_figures(trainer: pl.Trainer, module: FitModule, data: Episodes, episodes: list) -> dict[str, float]:
    """Return losses and distances with the final values."""
    read_episodes = trainer.validate(module, data.shared_loader(episodes), verbose=False)[0]
    return {f"{key.removeprefix('val/')}_after": value for key, value in read_episodes.items()}


def _source(network: Network | None) -> bytes:
    """Return the source of a network's class; empty if there is none, which is reported when it is built."""
    try:
        spec = None if network is None else find_spec(network.module.rpartition(".")[0])
        return b"" if spec is None or not spec.has_location else Path(str(spec.origin)).read_bytes()
    except (ImportError, ValueError, OSError):
        return b""


def _problem(config: Config, cloth: Cloth, data: Episodes) -> str:
    """Return a fingerprint of data, model, options and code, without settings that may change before a resumption."""
    fixed = replace(config, out="", run=Run(seed=config.run.seed), data=replace(config.data, train=[], val=[]))
    fixed = replace(fixed, optimizer=replace(config.optimizer, steps=Optimizer.steps))
    code = source_fingerprint(Path(__file__).resolve().parent), _source(config.learn.network)
    return digest([*code, fixed, len(data.train), *Objective(cloth, [], [*data.train, *data.val]).fingerprint_parts()])
