"""Shuffled batches of the pose network's training data, from folders of motions (`motions.make_data`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import lightning.pytorch as pl
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import ConcatDataset, DataLoader, Dataset, Sampler

from torchcloth.errors import InvalidInput
from torchcloth.pose.scene_frame import PoseInputs

from .motions import FRAMES_PER_RUN, load_motion
from .scenes import Fabric

Array = np.ndarray
NEXT_FRAMES = FRAMES_PER_RUN - 1
BATCHES_PER_BUCKET = 16  # of which the samples are sorted by their number of vertices


class PoseSample(NamedTuple):
    """A frame: what a robot knows of it, and the truth; the fields of `PoseInputs` without batch come first.

    Attributes:
        points: [N, 3] m.
        rest: [V, 3] m.
        grip: [V] int64, 0: free, k = 1 or 2: in gripper k.
        grip_position: [2, 3] m, reported; NaN: no such gripper.
        grip_velocity: [2, 3] m/s.
        previous: [V, 3] m; NaN: no estimate of the frame before.
        x: [V, 3] m, truth when the cloud was taken. The gripper poses are later by the lag of the camera.
        v: [V, 3] m/s.
        fabric: [3], logarithms of membrane stiffness [N/m], bending stiffness [N m] and C_n [-].
        next_points: [F, N, 3] m, clouds of the next frames; NaN: there is no such cloud.
        next_times: [F] s after the cloud; NaN likewise.
        time: s, of the cloud in its motion.
        visible: share of the cloth's pixels that occluders leave.
        is_stray: [N] bool, points that are not of the cloth.
        motion: all of the motion, as its file has it (`load_motion`): mesh, fabric, true paths of the grippers.
    """

    points: Array
    rest: Array
    grip: Array
    grip_position: Array
    grip_velocity: Array
    previous: Array
    x: Array
    v: Array
    fabric: Array
    next_points: Array
    next_times: Array
    time: float
    visible: float
    is_stray: Array
    motion: Mapping[str, Any]


class PoseBatch(NamedTuple):
    """Samples as tensors, padded to the largest mesh.

    Attributes:
        inputs: of the network.
        x: [B, V, 3] m, truth; 0 where padded.
        v: [B, V, 3] m/s.
        fabric: [B, 3], logarithms.
        next_points: [B, F, N, 3] m; NaN: there is no such cloud.
        next_times: [B, F] s.
        is_stray: [B, N] bool; not true of points that augmentation moved.
        world_map: [B, 3, 3], by which augmentation has turned or mirrored the world of each sample.
        samples: of the batch, as they were before.
    """

    inputs: PoseInputs
    x: Tensor
    v: Tensor
    fabric: Tensor
    next_points: Tensor
    next_times: Tensor
    is_stray: Tensor
    world_map: Tensor
    samples: list[PoseSample]


# -- reading ----------------------------------------------------------------------------------------------------------


class PoseDataset(Dataset[PoseSample]):
    """All frames of the motions of a folder, in memory.

    Args:
        folder: that `make_data` made.
        motions: how many motions to read at most; None: all.

    Attributes:
        vertex_counts: [samples] of the meshes.
        rejected: number of scenes without frames.

    Raises:
        InvalidInput: a folder without motions.
        RecordingError: a damaged file.
    """

    def __init__(self, folder: str | Path, motions: int | None = None) -> None:
        paths = sorted(Path(folder).glob("motion_*.npz"))[:motions]
        loaded = [load_motion(path) for path in paths]
        self.motions = [motion for motion in loaded if str(motion["rejected"]) == ""]
        self.rejected = len(loaded) - len(self.motions)
        self._places = [(k, row) for k, motion in enumerate(self.motions) for row in range(len(motion["times"]))]
        if not self._places:
            raise InvalidInput("data", got=f"{folder} without motions", expected="a folder of pose data")
        self.vertex_counts = np.array([len(self.motions[k]["rest"]) for k, _ in self._places])

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index: int) -> PoseSample:
        k, row = self._places[index]
        motion = self.motions[k]
        next_points = np.full((NEXT_FRAMES, *motion["points"].shape[1:]), np.nan, np.float32)
        next_times = np.full(NEXT_FRAMES, np.nan, np.float32)
        for step in range(NEXT_FRAMES):
            following = np.flatnonzero(motion["frame"] == motion["frame"][row] + step + 1)
            if len(following):
                next_points[step] = motion["points"][following[0]]
                next_times[step] = motion["times"][following[0]] - motion["times"][row]
        fabric = Fabric(*motion["fabric"])
        return PoseSample(
            points=motion["points"][row],
            rest=motion["rest"],
            grip=motion["grip"].astype(np.int64),
            grip_position=motion["grip_position"][row],
            grip_velocity=motion["grip_velocity"][row],
            previous=motion["previous"][row],
            x=motion["x"][row],
            v=motion["v"][row],
            fabric=np.log([fabric.membrane_stiffness, fabric.bending_stiffness, fabric.drag]).astype(np.float32),
            next_points=next_points,
            next_times=next_times,
            time=float(motion["times"][row]),
            visible=float(motion["visible"][row]),
            is_stray=motion["is_stray"][row],
            motion=motion,
        )


def collate(samples: Sequence[PoseSample]) -> PoseBatch:
    """Stack samples, padded to the largest mesh, with positions 0 and ``previous`` NaN where nothing exists."""
    size = max(len(sample.rest) for sample in samples)

    def pad(name: str, value: float = 0.0) -> Tensor:
        arrays = [getattr(sample, name) for sample in samples]
        out = np.full((len(arrays), size, *arrays[0].shape[1:]), value, arrays[0].dtype)
        for row, array in zip(out, arrays, strict=True):
            row[: len(array)] = array
        return torch.as_tensor(out)

    def stack(name: str) -> Tensor:
        return torch.as_tensor(np.stack([getattr(sample, name) for sample in samples]))

    counts = torch.tensor([len(sample.rest) for sample in samples])
    inputs = PoseInputs(
        points=stack("points"),
        rest=pad("rest"),
        exists=torch.arange(size) < counts[:, None],
        grip=pad("grip", 0),
        grip_position=stack("grip_position"),
        grip_velocity=stack("grip_velocity"),
        previous=pad("previous", np.nan),
    )
    return PoseBatch(
        inputs,
        pad("x"),
        pad("v"),
        stack("fabric"),
        stack("next_points"),
        stack("next_times"),
        stack("is_stray"),
        torch.eye(3, dtype=torch.float32).repeat(len(samples), 1, 1),
        list(samples),
    )


# -- augmentation -----------------------------------------------------------------------------------------------------


class Augmentation(NamedTuple):
    """What is changed of the samples of a batch, at random.

    Attributes:
        mirror: probability of a mirror image. Rest coordinates are mirrored, too, so that left stays left.
        cut: probability that a half-space of the cloud is hidden.
        max_cut: largest fraction of the points in it.
        patches: probability that up to three balls of the cloud are hidden.
        patch_radius: m, largest of a ball.
        noise: m, largest standard deviation of further noise of a point.
        shift: m, standard deviation of a shift of the whole cloud.
        grip_noise: m, standard deviation of a gripper's position.
        drop_previous: probability that the estimate of the frame before is left out.
    """

    mirror: float = 0.5
    cut: float = 0.4
    max_cut: float = 0.6
    patches: float = 0.3
    patch_radius: float = 0.12
    noise: float = 0.002
    shift: float = 0.001
    grip_noise: float = 0.0005
    drop_previous: float = 0.1


MIN_POINTS_AFTER_CUTS = 32


def augment(batch: PoseBatch, options: Augmentation, generator: torch.Generator) -> PoseBatch:
    """Turn the scenes about the vertical, mirror some, hide parts of the clouds, and add noise.

    Truth, rest coordinates, clouds, next clouds and gripper poses change together. ``world_map`` says how.
    """
    inputs, count, dtype = batch.inputs, len(batch.x), batch.x.dtype
    draw = partial(torch.rand, generator=generator, dtype=dtype)
    normal = partial(torch.randn, generator=generator, dtype=dtype)
    angle = 2 * torch.pi * draw(count)
    sign = torch.where(draw(count) < options.mirror, -1.0, 1.0).to(dtype)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    c, s = angle.cos(), angle.sin()
    turn = torch.stack([sign * c, -s, zero, sign * s, c, zero, zero, zero, one], -1).reshape(-1, 3, 3)

    def carry(value: Tensor) -> Tensor:
        return torch.einsum("bij,b...j->b...i", turn, value)

    points = _hide_parts(carry(inputs.points), options, generator)
    points = points + options.noise * draw(count, 1, 1) * normal(points.shape) + options.shift * normal(count, 1, 3)
    is_dropped = draw(count, 1, 1) < options.drop_previous
    moved = inputs._replace(
        points=points,
        rest=inputs.rest * torch.stack([sign, one, one], -1)[:, None],
        grip_position=carry(inputs.grip_position) + options.grip_noise * normal(count, 2, 3),
        grip_velocity=carry(inputs.grip_velocity),
        previous=torch.where(is_dropped, torch.nan, carry(inputs.previous)),
    )
    return batch._replace(
        inputs=moved,
        x=carry(batch.x),
        v=carry(batch.v),
        next_points=carry(batch.next_points),
        world_map=turn @ batch.world_map,
    )


def _hide_parts(points: Tensor, options: Augmentation, generator: torch.Generator) -> Tensor:
    """Replace hidden points [B, N, 3] by repeated ones of the rest."""
    count, size, _ = points.shape
    draw = partial(torch.rand, generator=generator, dtype=points.dtype)
    direction = torch.randn(count, 3, generator=generator, dtype=points.dtype)
    rank = torch.einsum("bni,bi->bn", points, direction).argsort(-1).argsort(-1) / size
    fraction = options.max_cut * draw(count, 1) * (draw(count, 1) < options.cut)
    hidden = rank < fraction
    for _ in range(3):
        centre = points.gather(1, (size * draw(count, 1, 1)).long().expand(-1, 1, 3))
        radius = options.patch_radius * draw(count, 1) * (draw(count, 1) < options.patches)
        hidden = hidden | ((points - centre).norm(dim=-1) < radius)
    hidden = hidden & ((~hidden).sum(-1, keepdim=True) >= MIN_POINTS_AFTER_CUTS)
    order = hidden.long().argsort(dim=-1, stable=True)
    place = torch.arange(size) % (~hidden).sum(-1, keepdim=True)
    return points.gather(1, order.gather(1, place)[..., None].expand(-1, -1, 3))


# -- batches ----------------------------------------------------------------------------------------------------------


class SizeBucketSampler(Sampler[list[int]]):
    """Sampler of shuffled batches of meshes of about the same size, so that little is padded.

    Args:
        sizes: [samples] numbers of vertices.
        batch_size: of all batches but perhaps one.
        seed: of the order, which differs between epochs.
        rank: of this process; each takes every ``world``-th batch.
        world: number of processes.
    """

    def __init__(self, sizes: Array, batch_size: int, seed: int, rank: int = 0, world: int = 1) -> None:
        self.sizes, self.batch_size, self.seed, self.epoch = sizes, batch_size, seed, 0
        self.rank, self.world = rank, world

    def __iter__(self) -> Iterator[list[int]]:
        rng = np.random.default_rng([self.seed, self.epoch])
        self.epoch += 1
        order = rng.permutation(len(self.sizes))
        batches = []
        bucket = BATCHES_PER_BUCKET * self.batch_size
        for first in range(0, len(order), bucket):
            part = order[first : first + bucket]
            part = part[np.argsort(self.sizes[part], kind="stable")]
            batches += [part[k : k + self.batch_size].tolist() for k in range(0, len(part), self.batch_size)]
        order = rng.permutation(len(batches))
        return iter([batches[k] for k in order[self.rank : len(self) * self.world : self.world]])

    def __len__(self) -> int:
        bucket = BATCHES_PER_BUCKET * self.batch_size
        whole, rest = divmod(len(self.sizes), bucket)
        return max(1, (whole * BATCHES_PER_BUCKET + -(-rest // self.batch_size)) // self.world)

    def set_epoch(self, epoch: int) -> None:
        """Set the number of the next epoch."""
        self.epoch = epoch


class PoseDataModule(pl.LightningDataModule):
    """Data module of folders of pose data.

    Args:
        folder: of the training data.
        batch_size: samples in a batch.
        validation_folder: of other data; None: no validation.
        unlabelled_folder: of motions without truth, which are mixed with those of ``folder``; None: none.
        augmentation: of the training batches; None: none.
        motions: how many motions to read at most; None: all.
        seed: of the order and of the augmentation.

    Raises:
        InvalidInput: a batch size below 1.
    """

    def __init__(
        self,
        folder: str | Path,
        batch_size: int = 64,
        *,
        validation_folder: str | Path | None = None,
        unlabelled_folder: str | Path | None = None,
        augmentation: Augmentation | None = Augmentation(),  # noqa: B008 - immutable
        motions: int | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if batch_size < 1:
            raise InvalidInput("batch_size", got=batch_size, expected="1 or more")
        self.folder, self.validation_folder, self.motions = folder, validation_folder, motions
        self.unlabelled_folder = unlabelled_folder
        self.batch_size, self.augmentation, self.seed = batch_size, augmentation, seed
        self._train: Dataset[PoseSample] | None = None
        self._sizes = np.zeros(0, np.int64)
        self._validation: PoseDataset | None = None
        self._generator = torch.Generator().manual_seed(seed)

    def setup(self, stage: str | None = None) -> None:
        """Read the folders, once."""
        if self._train is None and stage in (None, "fit"):
            parts = [PoseDataset(self.folder, self.motions)]
            if self.unlabelled_folder is not None:
                parts.append(PoseDataset(self.unlabelled_folder))
            self._train, self._sizes = ConcatDataset(parts), np.concatenate([part.vertex_counts for part in parts])
        if self._validation is None and self.validation_folder is not None:
            self._validation = PoseDataset(self.validation_folder)

    def train_dataloader(self) -> DataLoader:
        """Return the loader of shuffled, augmented batches."""
        self.setup("fit")
        assert self._train is not None
        rank, world = (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)
        sampler = SizeBucketSampler(self._sizes, self.batch_size, self.seed, rank, world)
        return DataLoader(self._train, batch_sampler=sampler, collate_fn=self._collate_augmented)

    def val_dataloader(self) -> DataLoader | list[DataLoader]:
        """Return the loader of the validation data, in the order of their sizes."""
        self.setup("validate")
        if self._validation is None:
            return []
        order = np.argsort(self._validation.vertex_counts, kind="stable")
        batches = [order[k : k + self.batch_size].tolist() for k in range(0, len(order), self.batch_size)]
        return DataLoader(self._validation, batch_sampler=batches, collate_fn=collate)  # type: ignore[arg-type]

    def _collate_augmented(self, samples: list[PoseSample]) -> PoseBatch:
        batch = collate(samples)
        return batch if self.augmentation is None else augment(batch, self.augmentation, self._generator)
