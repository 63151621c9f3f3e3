"""Everything between a robot's commands and a sensor's readings, and hypotheses that change it."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..boundaries import AbstractBoundary
from ..cloth import Cloth
from ..effects import AbstractEffect
from ..errors import TorchclothError
from ..materials import AbstractMaterial
from ..meshes import Mesh
from ..recordings import Recording
from ..simulation.bound_modules import loose
from .observed import Episode
from .replay import Frames, Replay, frames_of
from .user_errors import blame

MATTERS = 0.75  # of the smallest amplitude of interest: what is fitted may fall short of what is there
MIGHT_MATTER = 0.5  # the same, beside what matters
RESIDUAL = "residual"  # and a dot: names of laws that are no causes
OFTEN = 3.0  # prior standard deviations, from which a parameter does another effect's job
Motion = Callable[[Episode], Episode]  # what the robot really does, from what it says
View = Callable[[Frames, Episode], Frames]  # what is seen, from what is there


@dataclass(frozen=True, eq=False)
class World:
    """A cloth, what the robot really does with it, and how it is looked at."""

    cloth: Cloth
    motions: tuple[Motion, ...] = ()
    views: tuple[View, ...] = ()

    def frames(self, episode: Episode, dt: float | None = None) -> Frames:
        """What an observer has of the episode, simulated without derivatives.

        One with a late clock sees beyond the last frame (``Episode.beyond``): give the episode more than are wanted.
        """
        return self.seen(self.simulated(episode, dt), episode)

    def simulated(self, episode: Episode, dt: float | None = None) -> Frames:
        """What happens, whoever looks on."""
        with torch.no_grad():
            return frames_of(Replay(self.cloth)(self.driven(episode), dt))

    def driven(self, episode: Episode) -> Episode:
        """The episode with what the robot really does."""
        for motion in self.motions:
            episode = motion(episode)
        return episode

    def seen(self, frames: Frames, episode: Episode) -> Frames:
        """What an observer has of what happens."""
        for view in self.views:
            frames = view(frames, episode)
        return frames

    def identity(self, episode: Episode) -> list[object]:
        """What simulations of it depend on beside the cloth: of functions, what they make of a shape that drifts."""
        driven = self.driven(episode)
        v = torch.ones_like(driven.initial).expand(len(driven.times), -1, -1)
        x = driven.initial + v * (driven.times - driven.times[0]).to(v)[:, None, None]
        still = {name: v.new_zeros(len(v), 6) for name in driven.motion}
        seen = self.seen(Frames(x, v, still, v.new_zeros(len(v))), driven)
        return [*driven.identity(), seen.x, seen.v, *seen.wrench.values(), seen.edge]

    def with_motion(self, motion: Motion) -> World:
        """The same with one more error of the robot."""
        return replace(self, motions=(*self.motions, motion))

    def with_view(self, view: View) -> World:
        """The same with one more error of the observer."""
        return replace(self, views=(*self.views, view))

    def with_cloth(
        self,
        effects: Mapping[str, AbstractEffect] | None = None,
        material: AbstractMaterial | None = None,
        boundaries: Mapping[str, AbstractBoundary] | None = None,
    ) -> World:
        """The same with other or more parts of the cloth, by name."""
        return replace(self, cloth=rebuilt(self.cloth, effects or {}, material, boundaries or {}))


def copied(cloth: Cloth) -> Cloth:
    """A cloth of its own on the same mesh, which nobody changes."""
    return copy.deepcopy(cloth, {id(cloth.mesh): cloth.mesh})


def rebuilt(
    cloth: Cloth,
    effects: Mapping[str, AbstractEffect],
    material: AbstractMaterial | None,
    boundaries: Mapping[str, AbstractBoundary],
    mesh: Mesh | None = None,
) -> Cloth:
    """A new cloth with some parts replaced or added, which nobody trains; it shares the mesh alone with the old one."""
    kept = loose(cloth)
    found = Cloth(
        mesh or cloth.mesh,
        material or kept.material,
        kept.areal_density,
        {**kept.effects, **effects},
        {**kept.boundaries, **boundaries},
        cloth.contact,
        cloth.engine,
    )
    return found.requires_grad_(False)


@dataclass(frozen=True)
class Hypothesis:
    """One number that changes a world; 0 is the world as it is.

    Attributes:
        name: e.g. "air.drag_n"; what errs alike along several axes shares it up to a bracket: "env.gravity_tilt[x]".
        unit: of the amplitude.
        typical: an amplitude that real recordings have.
        apply: (world, amplitude) -> world.
        signed: negative amplitudes make sense.
        share: smallest amplitude of interest, as a share of the typical one.
        step: of slopes beside an amplitude, as a share of the typical one.
        needs: what a recording must have for it to mean anything.
        kin: names that no experiment of this kind can tell from it, by structure.
        twin: base parameter that is the same number (``Parameter.more``); where that is fitted, its prior alone tells
            of the hypothesis.
        low, high: amplitudes that a world can have.
        brings: another hypothesis, which comes along at its typical amplitude where the world has none of it.
        finer: its slopes are taken on the finer mesh where it does something on the given one: it acts in folds, for
            which that is too coarse.
        says: what it is in a sentence, for reports; the catalogue's have theirs in the glossary.
    """

    name: str
    unit: str
    typical: float
    apply: Callable[[World, float], World]
    signed: bool = False
    share: float = 0.4
    step: float = 0.1
    needs: Callable[[Recording], bool] = lambda recording: True
    kin: tuple[str, ...] = ()
    twin: str = ""
    low: float = -math.inf
    high: float = math.inf
    brings: str = ""
    finer: bool = False
    says: str = ""

    def __post_init__(self) -> None:
        if isinstance(self.kin, list):  # which has no hash
            object.__setattr__(self, "kin", tuple(self.kin))

    def applied(self, world: World, amplitude: float) -> World:
        """The world with so much of it.

        Raises:
            InvalidInput: it fails with an error that is none of the library's, or gives something else.
        """
        try:
            found = self.apply(world, amplitude)
            if not isinstance(found, World):
                raise TypeError(f"apply gives {type(found).__name__}, no World")
        except TorchclothError:
            raise
        except Exception as error:  # whatever a user's own does wrong
            raise blame(self.name, error) from error
        return found

    @property
    def effect(self) -> str:
        """The name without its axis."""
        return self.name.partition("[")[0]

    @property
    def sizes(self) -> tuple[float | bool, ...]:
        """What says from where on it matters, and how large it may be."""
        return self.typical, self.share, self.step, self.signed, self.low, self.high

    @property
    def smallest(self) -> float:
        """Of interest."""
        return self.share * self.typical

    @property
    def opposite(self) -> Hypothesis:
        """The same, asked about the other way, as far as a world can have it."""
        return replace(self, typical=min(max(-self.typical, self.low), self.high))

    @property
    def reverses(self) -> bool:
        """Asking the other way makes sense: there is more than a step to go."""
        return self.signed and abs(self.opposite.typical) > abs(self.step * self.typical)

    def matters(self, amplitude: float) -> bool:
        """Large enough to be named."""
        return abs(amplitude) > MATTERS * abs(self.smallest)

    def might_matter(self, amplitude: float) -> bool:
        """Large enough to be named with what it cannot be told from, and which matters."""
        return abs(amplitude) > MIGHT_MATTER * abs(self.smallest)


@dataclass(frozen=True)
class Parameter:
    """A number of the base model that is always fitted: log or plain, with a Gaussian prior around the data sheet.

    Plain where a logarithm or logit would saturate: a coordinate in which nothing moves any more has no end.

    Attributes:
        name: public name of the parameter.
        step: finite step for derivatives, in the coordinate.
        std: of the prior, in the coordinate.
        apply: (world, coordinate) -> world, which may be the given one, changed; 0 is the data sheet's value.
        value: coordinate -> physical value.
        low, high: least and largest coordinate.
    """

    name: str
    unit: str
    step: float
    std: float
    apply: Callable[[World, float], World]
    value: Callable[[float], float]
    low: float = -math.inf
    high: float = math.inf

    def more(self, coordinate: float, than: float = 0.0) -> float:
        """By how much a value exceeds that of another coordinate: as a share, or plainly where the sheet has 0."""
        before = self.value(than)
        return (self.value(coordinate) - before) / (before if self.value(0.0) else 1.0)


@dataclass(frozen=True)
class Model:
    """A base world, values of its parameters, and amplitudes of the hypotheses that it has accepted."""

    base: World
    parameters: tuple[Parameter, ...]
    values: Tensor  # [P], coordinates
    accepted: tuple[Hypothesis, ...] = ()
    amplitudes: tuple[float, ...] = ()
    met: tuple[dict[str, Any], ...] = ()  # marks of episodes that its numbers come from

    def world(self, extra: Sequence[tuple[Hypothesis, float]] = ()) -> World:
        """The world at these numbers, with further hypotheses at given amplitudes."""
        world = replace(self.base, cloth=copied(self.base.cloth))
        for parameter, coordinate in zip(self.parameters, self.values.tolist(), strict=True):
            world = parameter.apply(world, coordinate)
        own = zip(self.accepted, self.amplitudes, strict=True)
        brought = {h.brings for h in self.accepted}  # none of it, where that was found, is not what comes along
        for hypothesis, amplitude in (*own, *extra):
            if amplitude or hypothesis.name in brought:
                world = hypothesis.applied(world, amplitude)
        return world

    @property
    def point(self) -> Tensor:
        """[P + A] coordinates of the parameters, then amplitudes."""
        return torch.cat([self.values, torch.tensor(self.amplitudes, dtype=self.values.dtype)])

    def at(self, point: Tensor) -> Model:
        """The same model elsewhere; coordinates and amplitudes stop at their ends, those without a sign at zero."""
        values = point.clamp(*self.ends)
        return replace(
            self, values=values[: len(self.parameters)], amplitudes=tuple(values[len(self.parameters) :].tolist())
        )

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """(least, largest) of the coordinates [P + A]."""
        own = [(p.low, p.high) for p in self.parameters]
        own += [(h.low if h.signed else max(h.low, 0.0), h.high) for h in self.accepted]
        low, high = torch.tensor(own, dtype=self.values.dtype).reshape(-1, 2).unbind(-1)
        return low, high

    @property
    def strained(self) -> list[tuple[Parameter, float]]:
        """Parameters farther from their data sheet than these are wrong, with prior standard deviations."""
        away = [(p, abs(c) / p.std) for p, c in zip(self.parameters, self.values.tolist(), strict=True)]
        return [(p, far) for p, far in away if far > OFTEN]

    def others(self, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Those that it has not accepted."""
        taken = {h.name for h in self.accepted}
        return [h for h in hypotheses if h.name not in taken]

    def place(self, name: str) -> int:
        """Of an accepted hypothesis among them."""
        return [h.name for h in self.accepted].index(name)

    def plus(self, hypothesis: Hypothesis, amplitude: float = 0.0) -> Model:
        """With one more accepted hypothesis."""
        return replace(self, accepted=(*self.accepted, hypothesis), amplitudes=(*self.amplitudes, amplitude))

    def without(self, name: str) -> Model:
        """Less one accepted hypothesis."""
        kept = [(h, a) for h, a in zip(self.accepted, self.amplitudes, strict=True) if h.name != name]
        return replace(self, accepted=tuple(h for h, _ in kept), amplitudes=tuple(a for _, a in kept))
