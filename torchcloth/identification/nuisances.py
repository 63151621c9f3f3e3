"""What differs from episode to episode and is no property of the fabric: a few numbers around zero, each with a prior.

They are fitted beside the fabric, so that its error bars know them, and reported apart from it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.linalg import hermite, hermite_slope
from ..boundaries import Grasp
from ..cloth import Cloth
from ..episodes.observed import Episode
from ..episodes.replay import Frames
from ..errors import InvalidInput

LEVER = 0.1  # m, at which a turned camera is off by as much as a shifted one
AXES = "xyz"
LATEST = 2.0  # standard deviations of a clock, for which a simulation goes on after the last frame


class AbstractNuisance(ABC):
    """One kind; ``std`` is the standard deviation of each of its numbers, in ``unit``."""

    name: str
    unit: str
    std: float  # the default

    def __init__(self, std: float | None = None) -> None:
        self.std = type(self).std if std is None else std

    @abstractmethod
    def parts(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Names of the numbers, e.g. ["left.x", "left.y"]; [""] for a single one."""

    def units(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Of each number."""
        return [self.unit] * len(self.parts(cloth, episode))

    def stds(self, cloth: Cloth, episode: Episode) -> list[float]:
        """Of each number."""
        return [self.std] * len(self.parts(cloth, episode))

    def modes(self, cloth: Cloth, episode: Episode) -> Tensor | None:
        """[k, V, 3] m per unit: how the numbers move the cloth at the first frame; None: not at all."""
        return None

    def see(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """What an observer has of the frames, differentiable."""
        return frames


class Clock(AbstractNuisance):
    """The observation's clock is late by so much: frames were taken later than they say."""

    name, unit, std = "clock", "s", 0.010

    def parts(self, cloth: Cloth, episode: Episode) -> list[str]:
        """One number."""
        return [""]

    def see(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """Cubic between frames, by their velocities; at rest before the first and after the last."""
        t = (episode.times - episode.times[0]).to(frames.x)
        x, v = (path(t, frames.x, frames.v, t + values[0]) for path in (hermite, hermite_slope))
        return frames._replace(x=x, v=v)


class Camera(AbstractNuisance):
    """The observer's frame is shifted, and turned about the cloth's middle at the first frame."""

    name, unit, std = "camera", "m", 0.002

    def parts(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Three shifts and three turns."""
        return [*AXES, *(f"turn_{a}" for a in AXES)]

    def units(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Metres and radians."""
        return ["m"] * 3 + ["rad"] * 3

    def stds(self, cloth: Cloth, episode: Episode) -> list[float]:
        """A turn by the same at a tenth of a metre: 2 mm and 1.1 degrees by default."""
        return [self.std] * 3 + [self.std / LEVER] * 3

    def see(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """By Cayley's map, a turn by the vector's length up to its cube / 12."""
        zero = torch.zeros_like(values[0])
        x, y, z = 0.5 * values[3:]
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
        eye = torch.eye(3).to(skew)
        rotation = torch.linalg.solve(eye - skew, eye + skew)
        centre = episode.initial.mean(0)
        x = (frames.x - centre) @ rotation.mT + centre + values[:3]
        return frames._replace(x=x, v=frames.v @ rotation.mT)


class Tare(AbstractNuisance):
    """Force sensors read so much where there is none."""

    name, unit, std = "tare", "N", 0.1

    def parts(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Three axes for each gripper that measures."""
        return [f"{name}.{a}" for name in episode.wrenches for a in AXES]

    def see(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """Added to the simulated force."""
        wrench = dict(frames.wrench)
        for name, own in zip(episode.wrenches, values.reshape(-1, 3), strict=True):
            wrench[name] = wrench[name] + torch.cat([own, torch.zeros_like(own)])
        return frames._replace(wrench=wrench)


class Rim(AbstractNuisance):
    """The cloud's rim lies farther out than the cloth's by so much, everywhere: blur outwards, erosion inwards."""

    name, unit, std = "rim", "m", 0.002

    def parts(self, cloth: Cloth, episode: Episode) -> list[str]:
        """One number."""
        return [""]

    def see(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """Added to what the rim's residuals expect."""
        return frames._replace(edge=frames.edge + values[0])


class Held(AbstractNuisance):
    """The held places are off by so much at the first frame; between grippers the error is blended."""

    name, unit, std = "grasp", "m", 0.0015

    def parts(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Three axes for each gripper."""
        return [f"{name}.{a}" for name in _held(cloth) for a in AXES]

    def modes(self, cloth: Cloth, episode: Episode) -> Tensor:
        """Weights fall with the inverse square of the distance at rest; they add up to one."""
        held, rest = _held(cloth), _pattern(cloth).to(episode.initial)
        if not held:
            return rest.new_zeros(0, *rest.shape)
        distance = torch.stack([torch.cdist(rest, rest[index]).amin(1) for index in held.values()])
        inverse = 1 / (distance**2 + 1e-12)
        share = inverse / inverse.sum(0)
        return torch.einsum("gv,ab->gavb", share, torch.eye(3).to(share)).flatten(0, 1)


class Shape(AbstractNuisance):
    """The first shape is off: constant and linear fields that vanish where it is held."""

    name, unit, std = "shape", "m", 0.005

    def parts(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Three fields, three axes."""
        return [f"{field}.{a}" for field in ("mean", "first", "second") for a in AXES]

    def modes(self, cloth: Cloth, episode: Episode) -> Tensor:
        """Fields along the principal axes at rest, of unit size at the cloth's ends."""
        rest = _pattern(cloth).to(episode.initial)
        centred = rest - rest.mean(0)
        axes = torch.linalg.svd(centred, full_matrices=False)[2][:2]
        along = (centred @ axes.mT).mT
        fields = torch.cat([torch.ones_like(along[:1]), along / along.abs().amax(1, keepdim=True)])
        for index in _held(cloth).values():
            distance = torch.cdist(rest, rest[index]).amin(1)
            fields = fields * (distance / distance.max())
        fields = fields / fields.abs().amax(1, keepdim=True)
        return torch.einsum("mv,ab->mavb", fields, torch.eye(3).to(fields)).flatten(0, 1)


KINDS: dict[str, type[AbstractNuisance]] = {kind.name: kind for kind in (Clock, Camera, Tare, Rim, Held, Shape)}


def implied(uses: Collection[str], episodes: Sequence[Episode]) -> list[str]:
    """What data of these kinds cannot be read without: no camera sees an edge where it is."""
    return ["rim"] if "points" in uses and any(len(cloud) for e in episodes for cloud in e.clouds) else []


def chosen(wanted: Mapping[str, float | None] | Sequence[str], implied: Sequence[str] = ()) -> list[AbstractNuisance]:
    """Nuisances by name, with a standard deviation of their own where one is given; 0 leaves one out; a string is one.

    Raises:
        InvalidInput: an unknown name, or a deviation that is negative or not finite.
    """
    wanted = [wanted] if isinstance(wanted, str) else wanted
    given = dict(wanted) if isinstance(wanted, Mapping) else dict.fromkeys(wanted)
    for name, std in given.items():
        if name not in KINDS:
            raise InvalidInput("nuisance", got=repr(name), expected=f"one of {', '.join(KINDS)}")
        if std is not None and not (math.isfinite(std) and std >= 0):
            raise InvalidInput(f"nuisance {name}", got=std, expected=f"a standard deviation >= 0 in {KINDS[name].unit}")
    every = {**dict.fromkeys(implied), **given}
    return [kind(every[name]) for name, kind in KINDS.items() if name in every and every[name] != 0]


def foreseen(episodes: Sequence[Episode], nuisances: Sequence[AbstractNuisance]) -> list[Episode]:
    """With frames after the last, as far as a late clock may see."""
    late = LATEST * max((n.std for n in nuisances if isinstance(n, Clock)), default=0.0)
    return [e.beyond(late) for e in episodes] if late else list(episodes)


class Placed(NamedTuple):
    """The numbers of one nuisance of one episode within the vector of unknowns."""

    nuisance: AbstractNuisance
    where: slice
    names: list[str]  # e.g. "camera.turn_x"
    units: list[str]
    stds: list[float]


def place(
    nuisances: Sequence[AbstractNuisance], cloth: Cloth, episodes: Sequence[Episode], first: int
) -> list[list[Placed]]:
    """For every episode its nuisances, one after the other from index ``first``."""
    out = []
    for episode in episodes:
        own = []
        for nuisance in nuisances:
            parts = nuisance.parts(cloth, episode)
            if parts:
                names = [f"{nuisance.name}.{part}" if part else nuisance.name for part in parts]
                units, stds = nuisance.units(cloth, episode), nuisance.stds(cloth, episode)
                own.append(Placed(nuisance, slice(first, first + len(parts)), names, units, stds))
                first += len(parts)
        out.append(own)
    return out


def _held(cloth: Cloth) -> dict[str, Tensor]:
    return {name: part.index for name, part in cloth.boundaries.items() if isinstance(part, Grasp)}


def _pattern(cloth: Cloth) -> Tensor:
    return torch.as_tensor(cloth.mesh.vertices if cloth.mesh.uv is None else cloth.mesh.uv)
