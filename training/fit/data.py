"""Episodes for Lightning: found, split, and dealt to the processes without padding."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from glob import glob
from importlib import resources
from pathlib import Path

import lightning.pytorch as pl
import torch
from torch.utils.data import DataLoader, Sampler

from torchcloth import Cloth, recordings
from torchcloth.errors import InvalidInput
from torchcloth.identification import Episode, build_episode
from torchcloth.recordings import Recording
from torchcloth.recordings.size_checks import check_size

from .cloth_description import described, same_cloth
from .config import Data

EXAMPLE = "example:"


def found(data: Data) -> tuple[list[Recording], list[Recording]]:
    """The episodes to train with and to validate with.

    Raises:
        InvalidInput: a pattern without episodes, nothing to train with, an episode to do both with, or episodes of
            different cloths.
        RecordingError: an episode that cannot be trusted, or was seen in another unit than metres.
    """
    places = _folders(data.train, "data.train"), _folders(data.val, "data.val")
    if both := places[0].keys() & places[1].keys():
        got = f"{min(both)}, which is in data.train, too"
        raise InvalidInput("config: data.val", got=got, expected="episodes that are not trained with")
    train, val = ([recordings.read(folder) for folder in own.values()] for own in places)
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
    first = described(train[0])
    for other in (*train[1:], *val):
        if not same_cloth(first, described(other)):
            expected = f"cloth, grasps and surroundings of {train[0].path}"
            raise InvalidInput(f"{other.path}: another cloth", got="other values in episode.json", expected=expected)
    return train, val


def _folders(patterns: Sequence[str], key: str) -> dict[Path, Path]:
    """As they are named, by where they are: each once."""
    folders: dict[Path, Path] = {}
    for pattern in patterns:
        if pattern.startswith(EXAMPLE):
            shipped = resources.files("torchcloth") / "examples" / pattern.removeprefix(EXAMPLE)
            matches = [str(shipped)]
        else:
            found = (m for m in sorted(glob(pattern)) if Path(m).is_dir())  # pictures may lie beside episodes
            matches = list(found) if any(c in pattern for c in "*?[") else [pattern]
        if not matches:
            raise InvalidInput(f"config: {key}", got=f"no folder that matches {pattern}", expected="episodes")
        for folder in map(Path, matches):
            folders.setdefault(folder.resolve(), folder)
    return folders


class Deal(Sampler[list[int]]):
    """One process's share of the episodes of each optimiser step.

    Step ``s`` takes the episodes ``s * per_step`` and on of an endless row of shuffles, which only the seed decides: a
    resumed run goes on in it, and any number of processes deal out the same. Shares may differ by one.

    Args:
        count: of episodes.
        per_step: of them at a step.
        seed: of the shuffles.
        step: tells how many steps were done.
        rank, world: which process of how many.
    """

    def __init__(
        self, count: int, per_step: int, seed: int, step: Callable[[], int], rank: int = 0, world: int = 1
    ) -> None:
        self.count, self.per_step, self.seed, self.step = count, per_step, seed, step
        self.rank, self.world = rank, world

    def __iter__(self) -> Iterator[list[int]]:
        first = self.step() * self.per_step
        places = range(first, first + self.per_step)
        return iter([[self._at(place) for place in places][self.rank :: self.world]])

    def __len__(self) -> int:
        return 1

    def _at(self, place: int) -> int:
        shuffle, index = divmod(place, self.count)
        if self.per_step == self.count:
            return index  # all at every step: their order does not matter
        generator = torch.Generator().manual_seed(self.seed * 1_000_003 + shuffle)
        return int(torch.randperm(self.count, generator=generator)[index])


class Episodes(pl.LightningDataModule):
    """Episodes as tensors; one epoch is one optimiser step, one batch a list of episodes.

    Args:
        cloth: that they are checked against.
        train, val: recordings of it.
        per_step: training episodes at a step; 0: all.
        seed: of their order.

    Raises:
        InvalidInput: more episodes at a step than there are.
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
        """This process's share of one optimiser step."""
        deal = Deal(len(self.train), self.per_step, self.seed, self._step, *self._place())
        return _loader(self.train, deal)

    def val_dataloader(self) -> DataLoader | list[DataLoader]:
        """This process's share of the validation episodes."""
        return self.shared(self.val) if self.val else []

    def shared(self, episodes: list[Episode]) -> DataLoader:
        """Every process has a share of its own, or all of them where there are too few: means stay exact."""
        rank, world = self._place()
        own = range(len(episodes))[rank::world] if len(episodes) >= world else range(len(episodes))
        return _loader(episodes, [list(own)])

    def _step(self) -> int:
        return 0 if self.trainer is None else self.trainer.global_step

    def _place(self) -> tuple[int, int]:
        return (0, 1) if self.trainer is None else (self.trainer.global_rank, self.trainer.world_size)


def _loader(episodes: list[Episode], batches: Iterable[list[int]]) -> DataLoader:
    return DataLoader(episodes, batch_sampler=batches, collate_fn=list)  # type: ignore[arg-type]
