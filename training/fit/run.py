"""One run from config to result."""

from __future__ import annotations

import logging
import os
import time
import warnings
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
from torchcloth._utils.resume import DAMAGED_FILE_ERRORS, digest, source_fingerprint
from torchcloth.errors import InvalidInput, MissingDependency
from torchcloth.identification.estimators.objective import Objective

from . import result
from .checkpoints import Whole
from .cloth_description import built, described, precision
from .config import CHECKPOINT, Config, Network, Optimizer, Run
from .data import Episodes, found
from .module import FitModule
from .progress import Told

QUIET = (
    "does not have many workers",
    "irectory .* exists and is not empty",
    "treespec, LeafSpec",
    "Total length of `list`",
    "overridden `transfer_batch_to_device`",
)


def fit(config: Config, resume: bool = False) -> FitModule:
    """Train, write checkpoints after every step, and the result; returns the module.

    Args:
        config: see ``config``.
        resume: go on from ``out/last.ckpt``; the result is what it would have been, bit by bit.

    Raises:
        InvalidInput: a config or data that make no run; nothing to resume, or more steps done than asked for.
        RecordingError: an episode that cannot be trusted.
        SimulationDiverged: a step led where nothing can be simulated, and the checkpoint is from there; or a gradient
            that is not finite, before it is followed: the checkpoint is from the step before.
    """
    torch.set_num_threads(1)  # meshes of a thousand triangles: processes pay, threads do not
    folder = config.folder
    checkpoint = folder / CHECKPOINT
    if folder.exists() and not folder.is_dir():
        raise InvalidInput("out", got=f"{folder}, a file", expected="a folder, new or existing")
    if resume and not checkpoint.is_file():
        raise InvalidInput("--resume", got=f"no {checkpoint}", expected="what an interrupted run left")
    if resume:
        _check_checkpoint(checkpoint, config.optimizer.steps)
    with precision(config.model.precision):
        return _run(config, folder, checkpoint if resume else None)


def _check_checkpoint(checkpoint: Path, steps: int) -> None:
    try:
        found = torch.load(checkpoint, weights_only=True)
        whole = {"state_dict", "hyper_parameters", "history"} <= found.keys()
    except (*DAMAGED_FILE_ERRORS, AttributeError):
        found, whole = {}, False
    if not whole:
        raise InvalidInput(
            "--resume",
            got=f"{checkpoint}, which is damaged",
            expected="what an interrupted run left",
            remedy="start again without --resume",
        )
    done = len(found["history"])
    if done > steps:
        raise InvalidInput("config: optimizer.steps", got=steps, expected=f"at least {done}, the steps already done")


def _run(config: Config, folder: Path, checkpoint: Path | None) -> FitModule:
    began = time.perf_counter()
    train, val = found(config.data)
    description = described(train[0])
    cloth = built(description, config.model)
    data = Episodes(cloth, train, val, config.data.per_step, config.run.seed)
    if config.run.processes * config.run.nodes > data.per_step:
        got, expected = config.run.processes * config.run.nodes, f"at most {data.per_step}, the episodes at a step"
        raise InvalidInput("config: run.processes", got=got, expected=expected)
    _check_processes(config.run)
    module = FitModule(asdict(config), description, _problem(config, cloth, data))
    _check_statistics(module.learned.network, config.run)
    initial = module.now()
    trainer = _trainer(config, folder, [] if checkpoint else [folder / name for name in result.RESULTS])
    trainer.fit(module, datamodule=data, ckpt_path=checkpoint)
    trainer.loggers = []  # what is left is no step's validation, least of all of what was fitted
    figures = {
        "train": {"episodes": len(train), **_after(trainer, module, data, data.train)},
        "val": {"episodes": len(val), **(_after(trainer, module, data, data.val) if val else {})},
        "steps": trainer.global_step,
        "seconds": time.perf_counter() - began,
        "processes": trainer.world_size,
        "warnings": [doubt for e in (*data.train, *data.val) for doubt in e.data_warnings()],
    }
    if data.per_step == len(train):  # else the first step told of a part of them
        first = module.history[0]
        figures["train"] |= {"loss_before": first["train/loss"], "chamfer_before": first.get("train/chamfer")}
    if trainer.is_global_zero:
        episodes = [str(r.path) for r in train]
        result.show(result.save(folder, config, module, initial, figures, episodes), folder)
    return module


def _check_statistics(network: nn.Module | None, run: Run) -> None:
    """Of a network that remembers what it has seen, each process would remember its own share of the episodes."""
    own = () if network is None else network.modules()
    if run.processes * run.nodes > 1 and any(getattr(m, "track_running_stats", False) for m in own):
        raise InvalidInput(
            "config: learn.network",
            got="layers with running statistics, on several processes",
            expected="one process, or layers without (track_running_stats=False, GroupNorm, LayerNorm)",
        )


def _check_processes(run: Run) -> None:
    """Of a launcher that starts others than the config says, each would take itself for the only one."""
    variable = "WORLD_SIZE" if "WORLD_SIZE" in os.environ else "SLURM_NTASKS"  # torchrun's goes first, as in Lightning
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
    for message in QUIET:
        warnings.filterwarnings("ignore", f".*{message}")
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
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
            Told(),
        ],
        plugins=[Whole(outdated), *_cluster()],
        default_root_dir=folder,
        enable_progress_bar=False,
        enable_model_summary=False,
    )


def _cluster() -> list[SLURMEnvironment]:
    """SLURM's, if it started this process: what Lightning saves at its signals would be taken without --resume."""
    alone = SLURMEnvironment.detect() and not TorchElasticEnvironment.detect()
    return [SLURMEnvironment(auto_requeue=False)] if alone else []


def _loggers(names: list[str], folder: Path) -> list[Logger]:
    out: list[Logger] = []
    for name in names:
        try:
            out.append((CSVLogger if name == "csv" else TensorBoardLogger)(folder, name="log"))
        except ModuleNotFoundError:
            raise MissingDependency("tensorboard is not installed", remedy="run: pip install tensorboard") from None
    return out


def _after(trainer: pl.Trainer, module: FitModule, data: Episodes, episodes: list) -> dict[str, float]:
    """What is left, with the final values."""
    found = trainer.validate(module, data.shared(episodes), verbose=False)[0]
    return {f"{key.removeprefix('val/')}_after": value for key, value in found.items()}


def _source(network: Network | None) -> bytes:
    """The file that a network's class stands in; empty where there is none, which making it will tell."""
    try:
        spec = None if network is None else find_spec(network.module.rpartition(".")[0])
        return b"" if spec is None or not spec.has_location else Path(str(spec.origin)).read_bytes()
    except (ImportError, ValueError, OSError):
        return b""


def _problem(config: Config, cloth: Cloth, data: Episodes) -> str:
    """Fingerprint of data, model, options and code, the library's and a network's; of what may change while a run
    rests, nothing.
    """
    fixed = replace(config, out="", run=Run(seed=config.run.seed), data=replace(config.data, train=[], val=[]))
    fixed = replace(fixed, optimizer=replace(config.optimizer, steps=Optimizer.steps))
    code = source_fingerprint(Path(__file__).resolve().parent), _source(config.learn.network)
    return digest([*code, fixed, len(data.train), *Objective(cloth, [], [*data.train, *data.val]).identity()])
