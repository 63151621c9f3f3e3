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
from ..effects.base import SMALLEST_FRACTION_OF_TYPICAL
from ..errors import InvalidInput, TorchclothError
from ..materials import AbstractMaterial
from ..meshes import Mesh
from ..recordings import Recording
from ..simulation.bound_modules import copy_parts
from .observed import Episode
from .replay import Frames, Replay, frames_from_rollout
from .user_errors import explain_user_error

RELEVANT_FRACTION = 0.75  # of the smallest effect of interest: a fitted amplitude may fall short of the true one
POSSIBLY_RELEVANT_FRACTION = 0.5  # of the smallest effect of interest, for what is confounded with a relevant cause
RESIDUAL_EFFECT_PREFIX = "residual"  # followed by a dot: names of laws that are no causes
STRAINED_PRIOR_STDS = 3.0  # distance from the data sheet at which a parameter replaces a missing effect
MAX_CLOCK_DELAY_S = 0.05  # simulations continue for this long after the last frame, for observers with a late clock
MotionTransform = Callable[[Episode], Episode]  # commanded episode -> what the robot really does
ObservationTransform = Callable[[Frames, Episode], Frames]  # true frames -> observed frames


@dataclass(frozen=True, eq=False)
class World:
    """A cloth, what the robot really does with it, and how it is observed.

    Attributes:
        cloth: the model.
        motion_transforms: errors of the robot, applied in order.
        observation_transforms: errors of the observer, applied in order.
    """

    cloth: Cloth
    motion_transforms: tuple[MotionTransform, ...] = ()
    observation_transforms: tuple[ObservationTransform, ...] = ()

    def simulate_observed(self, episode: Episode, dt: float | None = None) -> Frames:
        """Simulate what an observer sees of the episode, without derivatives.

        An observer with a late clock sees beyond the last frame (``Episode.with_lookahead``): the episode must have
        more frames than are wanted.
        """
        return self.observe(self.simulate(episode, dt), episode)

    def simulate(self, episode: Episode, dt: float | None = None) -> Frames:
        """Simulate what happens, without errors of an observer and without derivatives."""
        with torch.no_grad():
            return frames_from_rollout(Replay(self.cloth)(self.apply_motion(episode), dt))

    def apply_motion(self, episode: Episode) -> Episode:
        """Return the episode with what the robot really does."""
        for transform in self.motion_transforms:
            episode = transform(episode)
        return episode

    def observe(self, frames: Frames, episode: Episode) -> Frames:
        """Return what an observer sees of simulated frames."""
        for transform in self.observation_transforms:
            frames = transform(frames, episode)
        return frames

    def fingerprint_parts(self, episode: Episode) -> list[object]:
        """List everything but the cloth that simulations depend on.

        The transforms are functions. What they make of a shape that drifts stands for them.
        """
        driven = self.apply_motion(episode)
        v = torch.ones_like(driven.initial).expand(len(driven.times), -1, -1)
        x = driven.initial + v * (driven.times - driven.times[0]).to(v)[:, None, None]
        zero_wrench = {name: v.new_zeros(len(v), 6) for name in driven.motion}
        observed = self.observe(Frames(x, v, zero_wrench, v.new_zeros(len(v))), driven)
        frames = [observed.x, observed.v, *observed.wrench.values(), observed.rim_offset]
        return [*driven.fingerprint_parts(), *frames]

    def with_motion_transform(self, transform: MotionTransform) -> World:
        """Return the world with one more error of the robot."""
        return replace(self, motion_transforms=(*self.motion_transforms, transform))

    def with_observation_transform(self, transform: ObservationTransform) -> World:
        """Return the world with one more error of the observer."""
        return replace(self, observation_transforms=(*self.observation_transforms, transform))

    def with_cloth(
        self,
        effects: Mapping[str, AbstractEffect] | None = None,
        material: AbstractMaterial | None = None,
        boundaries: Mapping[str, AbstractBoundary] | None = None,
    ) -> World:
        """Return the world with parts of the cloth replaced or added, by name."""
        return replace(self, cloth=rebuild_cloth(self.cloth, effects or {}, material, boundaries or {}))


def copy_cloth(cloth: Cloth) -> Cloth:
    """Return a copy of a cloth that shares its mesh."""
    return copy.deepcopy(cloth, {id(cloth.mesh): cloth.mesh})


def rebuild_cloth(
    cloth: Cloth,
    effects: Mapping[str, AbstractEffect],
    material: AbstractMaterial | None,
    boundaries: Mapping[str, AbstractBoundary],
    mesh: Mesh | None = None,
) -> Cloth:
    """Return a new cloth with some parts replaced or added, without gradients; it shares only the mesh with the old.

    Args:
        cloth: the old one.
        effects: by name.
        material: None: the old one's.
        boundaries: by name.
        mesh: None: the old one's.
    """
    parts = copy_parts(cloth)
    rebuilt = Cloth(
        mesh or cloth.mesh,
        material or parts.material,
        parts.areal_density,
        {**parts.effects, **effects},
        {**parts.boundaries, **boundaries},
        cloth.contact,
        cloth.engine,
    )
    return rebuilt.requires_grad_(False)


@dataclass(frozen=True)
class Hypothesis:
    """A possible cause of a misfit: one number that changes a world. At 0 the world stays as it is.

    Attributes:
        name: e.g. "air.drag_n". Errors that act alike along several axes share it up to a bracket:
            "env.gravity_tilt[x]".
        unit: of the amplitude.
        typical: an amplitude that real recordings have.
        apply: (world, amplitude) -> world.
        signed: whether negative amplitudes make sense.
        smallest_fraction: smallest effect of interest, as a fraction of the typical one.
        step_fraction: finite step of slopes, as a fraction of the typical amplitude.
        is_applicable: recording -> whether the recording has what the hypothesis needs to mean anything.
        structurally_equivalent: names that no experiment of this kind can separate from it.
        equivalent_parameter: base parameter that is the same number (``BaseParameter.relative_change``). Where that is
            fitted, its prior alone shows the hypothesis.
        min_amplitude: least amplitude that a world can have.
        max_amplitude: largest amplitude that a world can have.
        implies: another hypothesis, which joins at its typical amplitude where the world has none of it.
        needs_fine_mesh: whether its slopes are computed on the fine mesh, if it has an effect on the given one. It then
            acts in folds, for which the given mesh is too coarse.
        title: a few words for reports.
        description: a sentence for reports.
        effect_names: names that ``apply`` gives effects in the cloth; ``*`` stands for a gripper's or table's name.
    """

    name: str
    unit: str
    typical: float
    apply: Callable[[World, float], World]
    signed: bool = False
    smallest_fraction: float = SMALLEST_FRACTION_OF_TYPICAL
    step_fraction: float = 0.1
    is_applicable: Callable[[Recording], bool] = lambda recording: True
    structurally_equivalent: tuple[str, ...] = ()
    equivalent_parameter: str = ""
    min_amplitude: float = -math.inf
    max_amplitude: float = math.inf
    implies: str = ""
    needs_fine_mesh: bool = False
    title: str = ""
    description: str = ""
    effect_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.structurally_equivalent, list):  # a list has no hash
            object.__setattr__(self, "structurally_equivalent", tuple(self.structurally_equivalent))

    @classmethod
    def from_amplitude(
        cls,
        effect: type[AbstractEffect],
        parameter: str = "",
        apply: Callable[[World, float], World] | None = None,
        *,
        axis: str = "",
        effect_name: str = "",
        **options: Any,
    ) -> Hypothesis:
        """Build a hypothesis from what an effect declares in ``amplitudes``.

        Args:
            effect: class of the effect.
            parameter: of which the declaration is; empty: the main one.
            apply: (world, amplitude) -> world; None: the effect joins the cloth, with its other parameters at their
                defaults.
            axis: follows the cause's name in brackets.
            effect_name: name of the effect in the cloth; empty: the cause's name after its first dot.
            options: further fields of the hypothesis, which replace declared ones.

        Raises:
            InvalidInput: the effect declares no such parameter, or no cause for it.
        """
        parameter = parameter or next(iter(effect.amplitudes))
        if (amplitude := effect.amplitudes.get(parameter)) is None:
            names = ", ".join(effect.amplitudes)
            raise InvalidInput(f"parameter of {effect.__name__}", got=repr(parameter), expected=f"one of {names}")
        cause = options.get("name", amplitude.cause)
        if not cause:
            raise InvalidInput(
                f"amplitude {parameter!r} of {effect.__name__}", got="no cause", expected='a name, cause="my.effect"'
            )
        effect_name = effect_name or cause.partition(".")[2].replace(".", "_")

        def add_effect(world: World, value: float) -> World:
            return world.with_cloth({effect_name: effect(**{parameter: value})})

        declared = {
            "name": f"{cause}[{axis}]" if axis else cause,
            "unit": amplitude.unit,
            "typical": amplitude.typical_of_cause,
            "apply": add_effect if apply is None else apply,
            "signed": amplitude.signed,
            "smallest_fraction": amplitude.smallest_fraction,
            "title": amplitude.title,
            "description": amplitude.description,
            "effect_names": (effect_name,),
        }
        return cls(**declared | options)

    def apply_to(self, world: World, amplitude: float) -> World:
        """Return the world with this amplitude of the hypothesis.

        Raises:
            InvalidInput: ``apply`` fails with an error that is none of the library's, or returns no world.
        """
        try:
            changed = self.apply(world, amplitude)
            if not isinstance(changed, World):
                raise TypeError(f"apply gives {type(changed).__name__}, no World")
        except TorchclothError:
            raise
        except Exception as error:  # a user's function may raise anything
            raise explain_user_error(self.name, error) from error
        return changed

    @property
    def effect(self) -> str:
        """Name without its axis."""
        return self.name.partition("[")[0]

    @property
    def amplitude_settings(self) -> tuple[float | bool, ...]:
        """Numbers that say from where on it matters, and how large it may be."""
        return (
            self.typical,
            self.smallest_fraction,
            self.step_fraction,
            self.signed,
            self.min_amplitude,
            self.max_amplitude,
        )

    @property
    def smallest_of_interest(self) -> float:
        """Smallest effect of interest, in ``unit``."""
        return self.smallest_fraction * self.typical

    @property
    def opposite(self) -> Hypothesis:
        """The hypothesis with the typical amplitude of the other sign, as far as a world can have it."""
        return replace(self, typical=min(max(-self.typical, self.min_amplitude), self.max_amplitude))

    @property
    def is_reversible(self) -> bool:
        """Whether the opposite makes sense: it allows more than a finite step."""
        return self.signed and abs(self.opposite.typical) > abs(self.step_fraction * self.typical)

    def is_relevant(self, amplitude: float) -> bool:
        """Tell whether an amplitude is large enough to be named."""
        return abs(amplitude) > RELEVANT_FRACTION * abs(self.smallest_of_interest)

    def is_possibly_relevant(self, amplitude: float) -> bool:
        """Tell whether an amplitude is large enough to be named together with a relevant, confounded cause."""
        return abs(amplitude) > POSSIBLY_RELEVANT_FRACTION * abs(self.smallest_of_interest)


@dataclass(frozen=True)
class BaseParameter:
    """A number of the base model that is always fitted, with a Gaussian prior around the data sheet.

    Its coordinate is a logarithm, or plain where a logarithm or logit would saturate: a coordinate along which nothing
    moves any more has no end.

    Attributes:
        name: public name of the parameter.
        unit: of the physical value.
        step: finite step of slopes, in the coordinate.
        prior_std: standard deviation of the prior, in the coordinate.
        apply: (world, coordinate) -> world, which may be the given one, changed. At 0 it has the data sheet's value.
        value: coordinate -> physical value.
        min_coordinate: least coordinate.
        max_coordinate: largest coordinate.
    """

    name: str
    unit: str
    step: float
    prior_std: float
    apply: Callable[[World, float], World]
    value: Callable[[float], float]
    min_coordinate: float = -math.inf
    max_coordinate: float = math.inf

    def relative_change(self, coordinate: float, than: float = 0.0) -> float:
        """Return how much a value exceeds that of another coordinate, relative, or absolute where the sheet has 0.

        Args:
            coordinate: of the value.
            than: coordinate of the value that it is compared with.
        """
        before = self.value(than)
        return (self.value(coordinate) - before) / (before if self.value(0.0) else 1.0)


@dataclass(frozen=True)
class WorldModel:
    """A base world, values of its parameters, and amplitudes of the hypotheses that it has accepted.

    Attributes:
        base: the world at the data sheet's values.
        parameters: P parameters of the base world.
        coordinates: [P] of the parameters.
        accepted: A hypotheses.
        amplitudes: of the accepted hypotheses.
        episode_fingerprints: of the episodes that the numbers come from.
    """

    base: World
    parameters: tuple[BaseParameter, ...]
    coordinates: Tensor
    accepted: tuple[Hypothesis, ...] = ()
    amplitudes: tuple[float, ...] = ()
    episode_fingerprints: tuple[dict[str, Any], ...] = ()

    def build_world(self, extra: Sequence[tuple[Hypothesis, float]] = ()) -> World:
        """Build the world at these numbers, with further (hypothesis, amplitude) pairs."""
        world = replace(self.base, cloth=copy_cloth(self.base.cloth))
        for parameter, coordinate in zip(self.parameters, self.coordinates.tolist(), strict=True):
            world = parameter.apply(world, coordinate)
        accepted = zip(self.accepted, self.amplitudes, strict=True)
        implied = {h.implies for h in self.accepted}  # one that was fitted to 0 must not join at its typical amplitude
        for hypothesis, amplitude in (*accepted, *extra):
            if amplitude or hypothesis.name in implied:
                world = hypothesis.apply_to(world, amplitude)
        return world

    @property
    def point(self) -> Tensor:
        """[P + A] coordinates of the parameters, then amplitudes."""
        return torch.cat([self.coordinates, torch.tensor(self.amplitudes, dtype=self.coordinates.dtype)])

    def at_point(self, point: Tensor) -> WorldModel:
        """Return the model at another point [P + A], clipped to the bounds."""
        clipped, count = point.clamp(*self.bounds), len(self.parameters)
        return replace(self, coordinates=clipped[:count], amplitudes=tuple(clipped[count:].tolist()))

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Least and largest point, [P + A] each; amplitudes without a sign end at zero."""
        pairs = [(p.min_coordinate, p.max_coordinate) for p in self.parameters]
        pairs += [(h.min_amplitude if h.signed else max(h.min_amplitude, 0.0), h.max_amplitude) for h in self.accepted]
        low, high = torch.tensor(pairs, dtype=self.coordinates.dtype).reshape(-1, 2).unbind(-1)
        return low, high

    @property
    def strained_parameters(self) -> list[tuple[BaseParameter, float]]:
        """Parameters that are far from their data sheet, with the distance in prior standard deviations."""
        pairs = zip(self.parameters, self.coordinates.tolist(), strict=True)
        distances = [(p, abs(coordinate) / p.prior_std) for p, coordinate in pairs]
        return [(p, distance) for p, distance in distances if distance > STRAINED_PRIOR_STDS]

    def not_accepted(self, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return those of some hypotheses that the model has not accepted."""
        names = {h.name for h in self.accepted}
        return [h for h in hypotheses if h.name not in names]

    def index_of(self, name: str) -> int:
        """Return the index of an accepted hypothesis."""
        return [h.name for h in self.accepted].index(name)

    def with_hypothesis(self, hypothesis: Hypothesis, amplitude: float = 0.0) -> WorldModel:
        """Return the model with one more accepted hypothesis."""
        return replace(self, accepted=(*self.accepted, hypothesis), amplitudes=(*self.amplitudes, amplitude))

    def without_hypothesis(self, name: str) -> WorldModel:
        """Return the model without one of its accepted hypotheses."""
        pairs = [(h, a) for h, a in zip(self.accepted, self.amplitudes, strict=True) if h.name != name]
        return replace(self, accepted=tuple(h for h, _ in pairs), amplitudes=tuple(a for _, a in pairs))
