"""Nuisances: what differs from episode to episode and is no property of the fabric, as a few numbers with priors.

The numbers lie around zero. They are fitted together with the fabric, so that its error bars account for them, and they
are reported apart from it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from ..boundaries import Grasp
from ..cloth import Cloth
from ..episodes.grip_patch_mesh import grip_extent_range, grip_patches
from ..episodes.observed import Episode
from ..episodes.replay import Frames, see_at
from ..errors import InvalidInput

CAMERA_TURN_LEVER_M = 0.1  # distance at which a turned camera is off by as much as a shifted one
GRASP_TURN_REACH = 0.25  # of the cloth's extent, over which the fabric around a grip turns along
AXIS_NAMES = "xyz"
GRIP_EXTENT_STD_RADII = 0.6  # of the patch that a gripper holds, in radii of the stated one
BENCH_CAMERA_STDS: dict[str, float | None] = {"clock": 0.03, "jitter": None, "camera": 0.004}  # s, s, m
BENCH_RIM_STDS: dict[str, float | None] = {"rim": 0.005, "rim_scatter": None}  # m
BENCH_CLOTH_STDS: dict[str, float | None] = {"grasp": None, "grip": None, "shape": 0.004}  # m
MAX_CLOCK_OFFSET_STDS = 2.0  # for which a simulation goes on after the last frame


class AbstractNuisance(ABC):
    """One kind of nuisance.

    Args:
        std: standard deviation of the prior of each of its numbers; None: the default.

    Attributes:
        name: public name.
        unit: of its numbers.
        std: standard deviation of the prior, in ``unit``.
        acts_on_cloth: whether the cloth moves otherwise, so that slopes need simulations; else it is seen otherwise.
    """

    name: str
    unit: str
    std: float
    acts_on_cloth = False

    def __init__(self, std: float | None = None) -> None:
        self.std = type(self).std if std is None else std

    @abstractmethod
    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return names of the numbers, e.g. ["left.x", "left.y"]; [""] for a single one."""

    def units(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return the unit of each number."""
        return [self.unit] * len(self.number_names(cloth, episode))

    def stds(self, cloth: Cloth, episode: Episode) -> list[float]:
        """Return the standard deviation of each number's prior."""
        return [self.std] * len(self.number_names(cloth, episode))

    def bounds(self, cloth: Cloth, episode: Episode) -> list[tuple[float, float]]:
        """Return the least and the largest value of each number."""
        return [(-math.inf, math.inf)] * len(self.number_names(cloth, episode))

    def initial_shape_modes(self, cloth: Cloth, episode: Episode) -> Tensor | None:
        """Return how the numbers move the cloth at the first frame, [k, V, 3] m per unit; None: not at all."""
        return None

    def initial_velocity_modes(self, cloth: Cloth, episode: Episode) -> Tensor | None:
        """Return the velocities at the first frame that the numbers add, [k, V, 3] m/s per unit; None: not at all."""
        return None

    def observe(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """Return the frames as an observer with these errors sees them; differentiable."""
        return frames


class ClockOffset(AbstractNuisance):
    """Delay of the observation's clock: frames were taken later than they say."""

    name, unit, std = "clock", "s", 0.010

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return the name of a single number."""
        return [""]

    def observe(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """See every frame later, or earlier where the offset is negative."""
        return see_at(frames, episode.times, values)


class StampJitter(AbstractNuisance):
    """Scatter of single stamps of the camera: every frame has a time of its own.

    The times are marginalised frame by frame (``estimators.frame_times``) and are no numbers of the search.

    Args:
        std: standard deviation of a stamp [s]; None: estimated.

    Attributes:
        is_estimated: whether the standard deviation comes from the data.
    """

    name, unit, std = "jitter", "s", 0.03

    def __init__(self, std: float | None = None) -> None:
        super().__init__(std)
        self.is_estimated = std is None

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return nothing, because the times of the frames are marginalised."""
        return []


class CameraOffset(AbstractNuisance):
    """Shift and turn of the observer's frame; it turns about the cloth's centre at the first frame."""

    name, unit, std = "camera", "m", 0.002

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return names of three shifts and three turns."""
        return [*AXIS_NAMES, *(f"turn_{a}" for a in AXIS_NAMES)]

    def units(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return metres for shifts and radians for turns."""
        return ["m"] * 3 + ["rad"] * 3

    def stds(self, cloth: Cloth, episode: Episode) -> list[float]:
        """Return standard deviations, by default 2 mm and 1.1 degrees: a turn moves as much at a tenth of a metre."""
        return [self.std] * 3 + [self.std / CAMERA_TURN_LEVER_M] * 3

    def observe(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """Shift and turn by Cayley's map: the angle is the vector's length, up to its cube / 12."""
        zero = torch.zeros_like(values[0])
        x, y, z = 0.5 * values[3:]
        skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
        eye = torch.eye(3).to(skew)
        rotation = torch.linalg.solve(eye - skew, eye + skew)
        centre = episode.initial.mean(0)
        x = (frames.x - centre) @ rotation.mT + centre + values[:3]
        return frames._replace(x=x, v=frames.v @ rotation.mT)


class ForceTare(AbstractNuisance):
    """Reading of a force sensor without a load."""

    name, unit, std = "tare", "N", 0.1

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return names of three axes for each gripper that measures."""
        return [f"{name}.{a}" for name in episode.wrenches for a in AXIS_NAMES]

    def observe(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """Add the tare to the simulated force."""
        wrench = dict(frames.wrench)
        for name, force in zip(episode.wrenches, values.reshape(-1, 3), strict=True):
            wrench[name] = wrench[name] + torch.cat([force, torch.zeros_like(force)])
        return frames._replace(wrench=wrench)


class RimOffset(AbstractNuisance):
    """Distance by which the cloud's rim lies outside of the cloth's: blur moves it outwards, erosion inwards."""

    name, unit, std = "rim", "m", 0.002

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return the name of a single number."""
        return [""]

    def observe(self, frames: Frames, values: Tensor, episode: Episode) -> Frames:
        """Add the offset to the rim's expected distance."""
        return frames._replace(rim_offset=frames.rim_offset + values[0])


class RimScatter(AbstractNuisance):
    """Offset of each piece of the cloud's rim, on top of what all share: segmentation cuts sides differently.

    It lasts for the episode and is marginalised (``estimators.rim_scatter``); it has no numbers in the search.
    """

    name, unit, std = "rim_scatter", "m", 0.002

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return nothing, because the offsets of the pieces are marginalised."""
        return []


class AbstractGraspNuisance(AbstractNuisance):
    """Three numbers for each gripper."""

    acts_on_cloth = True

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return names of three axes for each gripper."""
        return [f"{name}.{a}" for name in _grasped_vertices(cloth) for a in AXIS_NAMES]


class GraspOffset(AbstractGraspNuisance):
    """Offset of the held vertices at the first frame; between grippers it is blended."""

    name, unit, std = "grasp", "m", 0.0015

    def initial_shape_modes(self, cloth: Cloth, episode: Episode) -> Tensor:
        """Return fields whose weights fall with the inverse square of the distance at rest; they add up to one."""
        grasped, rest = _grasped_vertices(cloth), _pattern(cloth).to(episode.initial)
        if not grasped:
            return rest.new_zeros(0, *rest.shape)
        distance = torch.stack([torch.cdist(rest, rest[index]).amin(1) for index in grasped.values()])
        inverse = 1 / (distance**2 + 1e-12)
        weight = inverse / inverse.sum(0)
        return torch.einsum("gv,ab->gavb", weight, torch.eye(3).to(weight)).flatten(0, 1)


class GraspTurn(AbstractGraspNuisance):
    """Turn of what each gripper holds about its middle, at the first frame; the fabric nearby turns along."""

    name, unit, std = "grasp_turn", "rad", 0.05

    def initial_shape_modes(self, cloth: Cloth, episode: Episode) -> Tensor:
        """Return small turns, which fade with the distance at rest within a quarter of the cloth's extent."""
        rest, x = _pattern(cloth).to(episode.initial), episode.initial
        reach, eye, turns = GRASP_TURN_REACH * cloth.mesh.extent, torch.eye(3).to(x), [x.new_zeros(0, *x.shape)]
        for index in _grasped_vertices(cloth).values():
            fading = 1 / (1 + (torch.cdist(rest, rest[index]).amin(1) / reach) ** 2) ** 2
            arm = (x - x[index].mean(0)) * fading[:, None]
            turns.append(torch.linalg.cross(eye[:, None].expand(-1, *x.shape), arm.expand(3, -1, -1)))
        return torch.cat(turns)


class GripExtent(AbstractNuisance):
    """How much farther out each gripper holds the cloth than the recording says: a hinge holds less, a clamp more.

    What lies within a patch that is stated to be held may turn in the gripper, and what lies beside its pads may be
    stiff. The same vertices are held, and the pattern is stretched around them, so that they lie at the edge of what is
    held.

    Args:
        std: of the prior of each number [m]; None: a fraction of the stated radius.
    """

    name, unit, std = "grip", "m", math.nan
    acts_on_cloth = True

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return the grippers whose patch has a place on the pattern."""
        return list(grip_patches(cloth))

    def stds(self, cloth: Cloth, episode: Episode) -> list[float]:
        """Return the standard deviations of the priors."""
        radii = [patch.radius for patch in grip_patches(cloth).values()]
        return [GRIP_EXTENT_STD_RADII * radius if math.isnan(self.std) else self.std for radius in radii]

    def bounds(self, cloth: Cloth, episode: Episode) -> list[tuple[float, float]]:
        """Return what the pattern around the patches has room for."""
        least, most = grip_extent_range(cloth)
        return [(least * patch.radius, most * patch.radius) for patch in grip_patches(cloth).values()]


class FirstStateOffset(AbstractNuisance):
    """Error of the first state: fields along three axes that vanish where the cloth is held.

    Args:
        std: of the prior of each number; None: the default.
        fields: [M, V], the coarsest first; None: a constant one and two linear ones, along the principal axes at rest.
    """

    acts_on_cloth = True

    def __init__(self, std: float | None = None, fields: Tensor | None = None) -> None:
        super().__init__(std)
        self.fields = fields

    def with_fields(self, fields: Tensor) -> FirstStateOffset:
        """Return the same nuisance with other fields [M, V]."""
        return type(self)(self.std, fields)

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return names of the fields along three axes."""
        names = ("mean", "first", "second") if self.fields is None else map(str, range(len(self.fields)))
        return [f"{field}.{a}" for field in names for a in AXIS_NAMES]

    def _modes(self, cloth: Cloth, episode: Episode) -> Tensor:
        """[3 M, V, 3] of unit size where they are largest."""
        rest = _pattern(cloth).to(episode.initial)
        if self.fields is None:
            centred = rest - rest.mean(0)
            axes = torch.linalg.svd(centred, full_matrices=False)[2][:2]
            along = (centred @ axes.mT).mT
            fields = torch.cat([torch.ones_like(along[:1]), along / along.abs().amax(1, keepdim=True)])
        else:
            fields = self.fields.to(rest)
        for index in _grasped_vertices(cloth).values():
            distance = torch.cdist(rest, rest[index]).amin(1)
            fields = fields * (distance / distance.max())
        fields = fields / fields.abs().amax(1, keepdim=True)
        return torch.einsum("mv,ab->mavb", fields, torch.eye(3).to(fields)).flatten(0, 1)


class InitialShapeOffset(FirstStateOffset):
    """Error of the first shape."""

    name, unit, std = "shape", "m", 0.005

    def initial_shape_modes(self, cloth: Cloth, episode: Episode) -> Tensor:
        """Return the fields as displacements."""
        return self._modes(cloth, episode)


class InitialVelocityOffset(FirstStateOffset):
    """Error of the velocities at the first frame, of an episode that begins in motion."""

    name, unit, std = "velocity", "m/s", 0.2

    def number_names(self, cloth: Cloth, episode: Episode) -> list[str]:
        """Return names of the fields along three axes; none for a cloth at rest."""
        return [] if episode.initial_velocity is None else super().number_names(cloth, episode)

    def initial_velocity_modes(self, cloth: Cloth, episode: Episode) -> Tensor | None:
        """Return the fields as velocities."""
        return None if episode.initial_velocity is None else self._modes(cloth, episode)


NUISANCE_KINDS: dict[str, type[AbstractNuisance]] = {
    kind.name: kind
    for kind in (
        ClockOffset,
        StampJitter,
        CameraOffset,
        ForceTare,
        RimOffset,
        RimScatter,
        GraspOffset,
        GraspTurn,
        GripExtent,
        InitialShapeOffset,
        InitialVelocityOffset,
    )
}


def implied_nuisances(uses: Collection[str], episodes: Sequence[Episode]) -> list[str]:
    """Return nuisances that these data always have.

    No camera sees an edge where it is. The state of a cloth that moves at the first frame is known with an error, which
    does not settle.
    """
    has_points = any(len(cloud) for e in episodes for cloud in e.clouds)
    moves = any(e.initial_velocity is not None for e in episodes)
    return ["rim"] * ("points" in uses and has_points) + ["shape", "velocity"] * moves


def bench_nuisances(uses: Collection[str], episodes: Sequence[Episode]) -> dict[str, float | None]:
    """Return what no recording of a real bench states exactly, with standard deviations; None: the kind's own.

    These are the clock, the stamps of single frames, the camera's pose, where and how far the grippers hold the cloth,
    and a measured first shape. ``studies strangers`` compares fits with and without them.

    Args:
        uses: names of the kinds of data in use.
        episodes: the recordings.
    """
    has_points = "points" in uses and any(any(map(len, e.clouds)) for e in episodes)
    has_markers = "markers" in uses and any(e.markers is not None for e in episodes)
    is_measured = any(e.is_first_shape_measured for e in episodes)
    return (
        (BENCH_CAMERA_STDS if has_points or has_markers else {})
        | (BENCH_RIM_STDS if has_points else {})
        | (BENCH_CLOTH_STDS if is_measured else {})
    )


def as_stds(wanted: Mapping[str, float | None] | Sequence[str]) -> dict[str, float | None]:
    """Return the standard deviation by name, None for the default, of names, a single name, or such a mapping."""
    names = [wanted] if isinstance(wanted, str) else wanted
    return dict(names) if isinstance(names, Mapping) else dict.fromkeys(names)


def select_nuisances(
    wanted: Mapping[str, float | None] | Sequence[str], implied: Sequence[str] = ()
) -> list[AbstractNuisance]:
    """Return nuisances by name, with the given standard deviation or the default; 0 leaves one out.

    Args:
        wanted: names, a single name, or a standard deviation by name.
        implied: names that join unless they are given as 0.

    Raises:
        InvalidInput: an unknown name, or a standard deviation that is negative or not finite.
    """
    stds = as_stds(wanted)
    for name, std in stds.items():
        if name not in NUISANCE_KINDS:
            raise InvalidInput("nuisance", got=repr(name), expected=f"one of {', '.join(NUISANCE_KINDS)}")
        if std is not None and not (math.isfinite(std) and std >= 0):
            expected = f"a standard deviation >= 0 in {NUISANCE_KINDS[name].unit}"
            raise InvalidInput(f"nuisance {name}", got=std, expected=expected)
    stds = {**dict.fromkeys(implied), **stds}
    return [kind(stds[name]) for name, kind in NUISANCE_KINDS.items() if name in stds and stds[name] != 0]


def add_lookahead(episodes: Sequence[Episode], nuisances: Sequence[AbstractNuisance]) -> list[Episode]:
    """Add frames after the last one, as far as a late clock may see."""
    stds = (n.std for n in nuisances if isinstance(n, ClockOffset))
    latest = MAX_CLOCK_OFFSET_STDS * max(stds, default=0.0)
    return [e.with_lookahead(latest) for e in episodes] if latest else list(episodes)


class NuisanceSlice(NamedTuple):
    """Where the numbers of one nuisance of one episode stand in the vector of unknowns.

    Attributes:
        nuisance: the kind.
        index: slice of the vector of unknowns.
        names: public names, e.g. "camera.turn_x".
        units: of each number.
        stds: standard deviation of each number's prior.
        bounds: least and largest value of each number.
    """

    nuisance: AbstractNuisance
    index: slice
    names: list[str]
    units: list[str]
    stds: list[float]
    bounds: list[tuple[float, float]]


def place_nuisances(
    nuisances: Sequence[AbstractNuisance], cloth: Cloth, episodes: Sequence[Episode], first: int
) -> list[list[NuisanceSlice]]:
    """Place every episode's nuisances one after the other in the vector of unknowns, from index ``first``."""
    out = []
    for episode in episodes:
        slices = []
        for nuisance in nuisances:
            parts = nuisance.number_names(cloth, episode)
            if parts:
                names = [f"{nuisance.name}.{part}" if part else nuisance.name for part in parts]
                units, stds = nuisance.units(cloth, episode), nuisance.stds(cloth, episode)
                index, bounds = slice(first, first + len(parts)), nuisance.bounds(cloth, episode)
                slices.append(NuisanceSlice(nuisance, index, names, units, stds, bounds))
                first += len(parts)
        out.append(slices)
    return out


def _grasped_vertices(cloth: Cloth) -> dict[str, Tensor]:
    return {name: part.index for name, part in cloth.boundaries.items() if isinstance(part, Grasp)}


def _pattern(cloth: Cloth) -> Tensor:
    return torch.as_tensor(cloth.mesh.vertices if cloth.mesh.uv is None else cloth.mesh.uv)
