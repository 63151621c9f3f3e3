"""Episodes for Lightning: read, split, and distributed to the processes without padding."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from glob import glob
from importlib import resources
from pathlib import Path

import lightning.pytorch as pl
import torch
from torch.utils.data import DataLoader, Sampler

from torchcloth import Cloth, recordings
from torchcloth.episodes.observed import check_is_held
from torchcloth.errors import InvalidInput
from torchcloth.identification import Episode, build_episode
from torchcloth.recordings import Recording
from torchcloth.recordings.size_checks import check_size

from .cloth_description import describe_cloth, same_cloth
from .config import Data

EXAMPLE_PREFIX = "example:"


def read_episodes(data: Data) -> tuple[list[Recording], list[Recording]]:
    """Read the episodes for training and validation.

    Raises:
        InvalidInput: a pattern matches nothing, there is nothing to train with, an episode is in both sets, or the
            episodes show different cloths.
        RecordingError: an episode is inconsistent, is not in metres, or is to be trained with although nothing holds
            the cloth.
    """
    folders = _folders(data.train, "data.train"), _folders(data.val, "data.val")
    if shared := folders[0].keys() & folders[1].keys():
        got = f"{min(shared)}, which is in data.train, too"
        raise InvalidInput("config: data.val", got=got, expected="episodes that are not trained with")
    train, val = ([recordings.read(folder) for folder in selection.values()] for selection in folders)
    motions = {r.split.get("motion") for r in train}
    for motion in data.val_motion:
        if motion not in motions:
            known = ", ".join(sorted(map(str, motions - {None}))) or "none is named"
            raise InvalidInput("config: data.val_motion", got=repr(motion), expected=f"one of data.train: {known}")
    val += [r for r in train if r.split.get("motion") in data.val_motion]
    train = [r for r in train if r.split.get("motion") not in data.val_motion]
    if not train:
        raise InvalidInput("config: data.train", got="no episodes", expected="one or more to train with")
    for recording in (*train, *val):
        check_size(recording)
    for recording in train:
        check_is_held(recording)
    first = describe_cloth(train[0])
    for other in (*train[1:], *val):
        if not same_cloth(first, describe_cloth(other)):
            expected = f"cloth, grasps and surroundings of {train[0].path}"
            raise InvalidInput(f"{other.path}: another cloth", got="other values in episode.json", expected=expected)
    return train, val


def _folders(patterns: Sequence[str], key: str) -> dict[Path, Path]:
    """Return the named folders by their resolved paths, each once."""
    folders: dict[Path, Path] = {}
    for pattern in patterns:
        if pattern.startswith(EXAMPLE_PREFIX):
            shipped = resources.files("torchcloth") / "examples" / pattern.removeprefix(EXAMPLE_PREFIX)
            matches = [str(shipped)]
        else:
            existing = (m for m in sorted(glob(pattern)) if Path(m).is_dir())  # pictures may lie beside episodes
            matches = list(existing) if any(c in pattern for c in "*?[") else [pattern]
        if not matches:
            raise InvalidInput(f"config: {key}", got=f"no folder that matches {pattern}", expected="episodes")
        for folder in map(Path, matches):
            folders.setdefault(folder.resolve(), folder)
    return folders


class ShuffledEpisodeSampler(Sampler[list[int]]):
    """Sampler of one process's share of the episodes of each optimiser step.

    The order is an infinite sequence of shuffles that depends only on the seed. Step ``s`` starts at position
    ``s * per_step``. A resumed run therefore continues the sequence, and the order does not depend on the number of
    processes. Shares may differ by one.

    Args:
        count: number of episodes.
        per_step: number of episodes in a step.
        seed: of the shuffles.
        step: function that returns the number of finished steps.
        rank: index of the process.
        world: number of processes.
    """

    def __init__(
        self, count: int, per_step: int, seed: int, step: Callable[[], int], rank: int = 0, world: int = 1
    ) -> None:
        self.count, self.per_step, self.seed, self.step = count, per_step, seed, step
        self.rank, self.world = rank, world

    def __iter__(self) -> Iterator[list[int]]:
        first = self.step() * self.per_step
        positions = range(first, first + self.per_step)
        return iter([[self._at(position) for position in positions][self.rank :: self.world]])

    def __len__(self) -> int:
        return 1

    def _at(self, position: int) -> int:
        shuffle, index = divmod(position, self.count)
        if self.per_step == self.count:
            return index  # all episodes are in each step, so their order does not matter
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + shuffle)
        return int(torch.randperm(self.count, generator=generator)[index])


class Episodes(pl.LightningDataModule):
    """Data module: one epoch is one optimiser step, and one batch is a list of episodes.

    Args:
        cloth: that the episodes are checked against.
        train: recordings to train with.
        val: recordings to validate with.
        per_step: number of training episodes in a step; 0: all.
        seed: of their order.

    Raises:
        InvalidInput: ``per_step`` exceeds the number of episodes.
    """

    def __init__(
        self, cloth: Cloth, train: Sequence[Recording], val: Sequence[Recording], per_step: int = 0, seed: int = 0
    ) -> None:
        super().__init__()
        self.train, self.val = [build_episode(cloth, r) for r in train], [build_episode(cloth, r) for r in val]
        self.per_step, self.seed = per_step or len(self.train), seed
        if self.per_step > len(self.train):
            expected = f"at most {len(self.train)}, the training episodes"
            raise InvalidInput("config: data.per_step", got=self.per_step, expected=expected)

    def train_dataloader(self) -> DataLoader:
        """Return the loader of this process's share of one optimiser step."""
        sampler = ShuffledEpisodeSampler(len(self.train), self.per_step, self.seed, self._step, *self._process_index())
        return _loader(self.train, sampler)

    def val_dataloader(self) -> DataLoader | list[DataLoader]:
        """Return the loader of this process's share of the validation episodes."""
        return self.shared_loader(self.val) if self.val else []

    def shared_loader(self, episodes: list[Episode]) -> DataLoader:
        """Return a loader of this process's share, or of all episodes if there are fewer than processes.

        Means over all processes are exact in both cases.
        """
        rank, world = self._process_index()
        selection = range(len(episodes))[rank::world] if len(episodes) >= world else range(len(episodes))
        return _loader(episodes, [list(selection)])

    def _step(self) -> int:
        return 0 if self.trainer is None else self.trainer.global_step

    def _process_index(self) -> tuple[int, int]:
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)


def _loader(episodes: list[Episode], batches: Iterable[list[int]]) -> DataLoader:
    return DataLoader(episodes, batch_sampler=batches, collate_fn=list)  # type: ignore[arg-type]
