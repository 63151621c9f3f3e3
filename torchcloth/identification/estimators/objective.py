"""Episodes, model and data as the callbacks that the solvers work on."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..._utils.resume import ResumableStore, digest
from ...cloth import Cloth
from ...episodes.cloth_fingerprint import cloth_fingerprint_parts
from ...episodes.grip_patch_mesh import GrippedCloths, StretchedCloth
from ...episodes.observed import Episode
from ...episodes.observed_surface import build_surface
from ...episodes.replay import (
    Frames,
    StateModes,
    map_frames,
    see_at,
    shared_step,
    simulate,
    simulate_all,
    simulate_with_tangents,
)
from ...episodes.unknowns import Unknown
from ...errors import InvalidInput, SimulationDiverged, UnstableStep
from ...parameters import PhysicalParameter
from ..nuisances import AbstractNuisance, GripExtent, NuisanceSlice, RimScatter, add_lookahead, place_nuisances
from ..residuals.blocks import BLOCKS_BY_DATA_KIND, RESIDUAL_BLOCKS, Block, check_noise_floors
from ..residuals.metrics import DistanceMetrics, distance_metrics, force_rms, huber
from ..residuals.rows import ResidualRows, match_points
from ..uncertainty.identifiability import ParameterInfluence
from . import levenberg_marquardt
from .frame_times import FrameTimes, RowNoise, Scene, estimate_stamp_std
from .levenberg_marquardt import DEFAULT_NOISE_MODEL, NoiseModelSettings
from .rim_scatter import marginalise_piece_offsets

GRIP_EXTENT_STEP_STDS = 0.15  # of a finite slope by how far out a gripper holds the cloth
MAX_REMEMBERED_POINTS = 4  # whose simulated frames are kept in memory


class Objective:
    """Residuals and simulated frames as functions of the unknowns; it counts simulations.

    The vector of unknowns [K] holds the fabric's, then the nuisances of one episode after the other.

    Args:
        cloth: the model.
        unknowns: the fabric's unknowns.
        episodes: what drives the cloth and what was observed.
        dt: largest substep [s]; None: the stable one.
        nuisances: what differs from episode to episode.
        blocks: kinds of data in use.
        noise_floors: least standard deviation by block name; None: the blocks' own.

    Attributes:
        start: [K] unconstrained start values.
        prior_mean: [K].
        prior_std: [K].
        typical_changes: [K] changes of the unknowns that matter.
        surface: the cloth's surface as data see it.
        nuisance_bounds: [N, 2], least and largest value of every nuisance's number.
        nuisance_slices: for every episode, where its nuisances stand in the vector of unknowns.
        journal: store of earlier answers, or None.
        frame_times: errors of single stamps, which are marginalised; None: stamps count as exact.
        simulations: number of simulated episodes so far; one tangent counts as one.
    """

    patience = 1  # iterations without progress that a search by gradients may make
    noise_model: NoiseModelSettings = DEFAULT_NOISE_MODEL

    def __init__(
        self,
        cloth: Cloth,
        unknowns: Sequence[Unknown],
        episodes: Sequence[Episode],
        dt: float | None = None,
        nuisances: Sequence[AbstractNuisance] = (),
        blocks: Sequence[Block] = RESIDUAL_BLOCKS,
        noise_floors: Mapping[str, float] | None = None,
    ) -> None:
        self.cloth, self.unknowns, self.episodes, self.dt = cloth, list(unknowns), list(episodes), dt
        self.nuisances, self.blocks = list(nuisances), list(blocks)
        self.noise_floors = check_noise_floors(noise_floors)
        self.surface = build_surface(cloth, self.episodes)
        self.faces = self.surface.faces
        self.nuisance_slices = place_nuisances(self.nuisances, cloth, self.episodes, len(self.unknowns))
        stds = [std for slices in self.nuisance_slices for s in slices for std in s.stds]
        bounds = [pair for slices in self.nuisance_slices for s in slices for pair in s.bounds]
        self.nuisance_bounds = torch.tensor(bounds, dtype=torch.float64).reshape(-1, 2)
        zeros = [0.0 for _ in stds]
        self.prior_std = torch.tensor([*(u.prior_std for u in unknowns), *stds], dtype=torch.float64)
        self.typical_changes = torch.tensor([*(u.typical_change for u in unknowns), *stds], dtype=torch.float64)
        self.start = torch.tensor([*(u.start for u in unknowns), *zeros], dtype=torch.float64)
        self.prior_mean = torch.tensor([*(u.prior_mean for u in unknowns), *zeros], dtype=torch.float64)
        self.journal: ResumableStore | None = None
        self.frame_times: FrameTimes | None = None
        self.simulations = 0
        self._counted_points: set[tuple[float, ...]] = set()
        self._gripped_cloths = GrippedCloths(cloth)
        self._recent_frames: dict[tuple[float, ...], list[Frames]] = {}
        self._last_linearised: tuple[tuple[float, ...], list[tuple[Frames, Frames]]] | None = None

    def first_fraction(self, fraction: float) -> Objective:
        """Return the objective of the first ``fraction`` of the frames."""
        episodes = [e.first_fraction(fraction) for e in self.episodes]
        return self._with_episodes(add_lookahead(episodes, self.nuisances), self.nuisances)

    def with_thinned_clouds(self, points_per_frame: int) -> Objective:
        """Return the objective of clouds with about as many points, evenly taken; it has no journal."""
        thinned = [e.with_thinned_clouds(points_per_frame) for e in self.episodes]
        return self._copy(self.cloth, thinned, self.nuisances)

    def with_nuisances(self, nuisances: Sequence[AbstractNuisance]) -> Objective:
        """Return the objective with other nuisances."""
        return self._with_episodes(self.episodes, nuisances)

    def with_cloth(self, cloth: Cloth, episodes: Sequence[Episode] | None = None) -> Objective:
        """Return the objective of another model with the same unknowns; it has no journal.

        Args:
            cloth: the model.
            episodes: the same ones for its mesh; None: it has the same vertices.
        """
        return self._copy(cloth, self.episodes if episodes is None else episodes, self.nuisances)

    def with_frame_times(self, frame_times: FrameTimes | None) -> Objective:
        """Return the objective with other errors of single stamps; it goes on counting simulations."""
        other = copy.copy(self)
        other.frame_times, other._recent_frames, other._last_linearised = frame_times, {}, None
        return other

    def _with_episodes(self, episodes: Sequence[Episode], nuisances: Sequence[AbstractNuisance]) -> Objective:
        other = self._copy(self.cloth, episodes, nuisances)
        other.journal = self.journal
        return other

    def _copy(self, cloth: Cloth, episodes: Sequence[Episode], nuisances: Sequence[AbstractNuisance]) -> Objective:
        other = Objective(cloth, self.unknowns, episodes, self.dt, nuisances, self.blocks, self.noise_floors)
        other.frame_times = self.frame_times
        return other

    @property
    def has_data(self) -> bool:
        """Whether there are data of the kinds in use."""
        tests = {
            "points": lambda e: any(len(cloud) for cloud in e.clouds[1:]),
            "markers": lambda e: e.markers is not None and bool(e.markers[1:].isfinite().any()),
            "force": lambda e: any(bool(w[1:].isfinite().any()) for w in e.wrenches.values()),
        }
        return any(has_kind(e) for kind, has_kind in tests.items() if self.uses(kind) for e in self.episodes)

    def uses(self, *kinds: str) -> bool:
        """Tell whether data of one of these kinds (keys of ``BLOCKS_BY_DATA_KIND``) are in use."""
        names = {name for kind in kinds for name in BLOCKS_BY_DATA_KIND[kind]}
        return not {block.name for block in self.blocks}.isdisjoint(names)

    def problem(self) -> levenberg_marquardt.Problem:
        """Return the callbacks of the Levenberg-Marquardt solver."""
        max_step = [*(u.max_step for u in self.unknowns), *self.prior_std[len(self.unknowns) :].tolist()]
        return levenberg_marquardt.Problem(
            linearise=self.linearise,
            evaluate=self.evaluate,
            clip=self.clip,
            prior_mean=self.prior_mean,
            prior_std=self.prior_std,
            max_step=torch.tensor(max_step, dtype=torch.float64),
            noise_floor=torch.tensor([self.noise_floor(block) for block in self.blocks], dtype=torch.float64),
            outlier_distance=torch.tensor([block.outlier_distance for block in self.blocks], dtype=torch.float64),
            reported=len(self.unknowns),
            noise_model=self.noise_model,
        )

    def noise_floor(self, block: Block) -> float:
        """Return the least standard deviation of a residual of this kind, in the block's unit."""
        return self.stated_noise(block) or block.noise_floor

    def stated_noise(self, block: Block) -> float:
        """Return the standard deviation of the noise that a user states, in the block's unit; 0 if none is stated."""
        stds = [e.noise_std for e in self.episodes if e.noise_std is not None] if block.name == "points" else []
        return self.noise_floors.get(block.name, max(stds, default=0.0))

    def clip(self, raw: Tensor) -> Tensor:
        """Return the nearest legal point [K]."""
        legal = [u.clip(float(r)) for u, r in zip(self.unknowns, raw, strict=False)]
        end = len(legal) + len(self.nuisance_bounds)
        nuisances = raw[len(legal) : end].clamp(*self.nuisance_bounds.T)
        return torch.cat([torch.tensor(legal, dtype=raw.dtype), nuisances, raw[end:]])

    def start_with(self, values: Mapping[str, float]) -> Tensor:
        """Return the unconstrained start [K] with some physical values replaced, by parameter name.

        Raises:
            InvalidInput: a name that is not fitted.
        """
        index = {u.name: i for i, u in enumerate(self.unknowns)}
        out = self.start.clone()
        for name, value in values.items():
            if name not in index:
                raise InvalidInput("guess", got=repr(name), expected=f"one of {', '.join(index)}")
            parameter = self.unknowns[index[name]].parameter
            out[index[name]] = PhysicalParameter(value, parameter.unit, parameter.domain, name=name).raw.detach()
        return out

    def take_unknowns(self, raw: Tensor, other: Objective) -> Tensor:
        """Return the start [K] with the values [K'] that a point of an objective with other nuisances has."""
        out = self.start.clone()
        out[: len(self.unknowns)] = raw[: len(self.unknowns)]
        for slices, other_slices in zip(self.nuisance_slices, other.nuisance_slices, strict=True):
            indices = {s.nuisance.name: s.index for s in other_slices}
            for s in slices:
                if s.nuisance.name in indices:
                    out[s.index] = raw[indices[s.nuisance.name]]
        return out

    def to_scaled(self, raw: Tensor) -> Tensor:
        """Convert unknowns [K] to standard deviations from the priors' means."""
        return (raw - self.prior_mean) / self.prior_std

    def from_scaled(self, z: Tensor) -> Tensor:
        """Convert standard deviations from the priors' means [K] back to unknowns."""
        return self.prior_mean + self.prior_std * z

    def scale_gradient(self, gradient: Tensor) -> Tensor:
        """Convert a gradient [K] by the unknowns to one by the scaled unknowns."""
        return gradient * self.prior_std

    def physical_values(self, raw: Tensor) -> dict[str, float]:
        """Return the physical values of the fabric's unknowns by name."""
        return {u.name: u.value(float(r)) for u, r in zip(self.unknowns, raw, strict=False)}

    def fingerprint_parts(self) -> list[object]:
        """List everything that answers to the solvers' questions depend on."""
        data = [part for e in self.episodes for part in e.fingerprint_parts()]
        model = [*cloth_fingerprint_parts(self.cloth), self.dt]
        names = [u.name for u in self.unknowns], [b.name for b in self.blocks], [n.name for n in self.nuisances]
        return [*data, *model, *names, self.noise_floors, self.prior_mean, self.prior_std]

    def episode_of_rows(self, linear: levenberg_marquardt.Linearised) -> Tensor:
        """Return the index [R] of the episode that each row belongs to."""
        return torch.searchsorted(self._frame_ends(), linear.frame, right=True)

    def _frame_ends(self) -> Tensor:
        """[E] first frame number after each episode; time blocks do not reach across episodes."""
        gap = self.noise_model.frames_per_time_block
        return torch.tensor([len(e.times) + gap for e in self.episodes]).cumsum(0)

    # -- simulation -----------------------------------------------------------------------------------------------

    def simulate_vertices(self, raw: Tensor) -> list[Tensor]:
        """Simulate the vertices [T, V, 3] m of every episode, as they are observed."""
        return [frames.x for frames in self.observe(raw)]

    def observe(self, raw: Tensor) -> list[Frames]:
        """Simulate what is observed of every episode; the last few points are remembered."""
        self._count_simulations(raw)
        key = tuple(raw.tolist())
        if key not in self._recent_frames:
            with torch.no_grad():
                self._recent_frames[key] = [self.simulate(raw, i) for i in range(len(self.episodes))]
            while len(self._recent_frames) > MAX_REMEMBERED_POINTS:
                del self._recent_frames[next(iter(self._recent_frames))]
        return self._recent_frames[key]

    def _count_simulations(self, raw: Tensor) -> None:
        """Count a point once, whether it is simulated or read from the journal: a resumed fit counts the same."""
        key = tuple(raw.tolist())
        if key not in self._counted_points:
            self._counted_points.add(key)
            self.simulations += len(self.episodes)

    def simulate(self, raw: Tensor, i: int) -> Frames:
        """Simulate episode ``i``; differentiable in reverse mode when ``raw`` [K] requires grad."""
        return self._observe(raw, i, self._simulate_cloth(raw, i))

    def _observe(self, raw: Tensor, i: int, frames: Frames) -> Frames:
        """Observe frames of episode ``i`` with the observer's errors."""
        for s in self.nuisance_slices[i]:
            frames = s.nuisance.observe(frames, raw[s.index].to(frames.x), self.episodes[i])
        if self.frame_times is not None:
            frames = see_at(frames, self.episodes[i].times, self.frame_times.find_shifts(frames, self.scene(i)))
        return frames

    def _simulate_cloth(self, raw: Tensor, i: int) -> Frames:
        """Simulate episode ``i`` as an observer without errors sees it."""
        cloth, episode, view = self._gripped_episode(raw, i)
        return view(simulate(cloth, self.unknowns, raw[: len(self.unknowns)], episode, self.dt))

    @torch.no_grad()
    def simulate_cloth(self, raw: Tensor) -> list[Frames]:
        """Simulate all episodes as an observer without errors sees them."""
        return [self._simulate_cloth(raw, i) for i in range(len(self.episodes))]

    def simulate_fabrics(self, raw: Tensor, fabrics: Tensor) -> list[list[Frames] | None]:
        """Simulate all episodes with other fabrics, as ``simulate_cloth`` does.

        Args:
            raw: [K], whose nuisances count.
            fabrics: [N, U] the fabrics' unknowns.

        Returns:
            For each fabric the frames of all episodes; None where a simulation fails.
        """
        by_episode = [self._simulate_fabrics(raw, fabrics, i, self.dt) for i in range(len(self.episodes))]
        return [None if None in frames else list(frames) for frames in zip(*by_episode, strict=True)]

    def _simulate_fabrics(self, raw: Tensor, fabrics: Tensor, i: int, dt: float | None) -> list[Frames | None]:
        cloth, episode, view = self._gripped_episode(raw, i)
        simulated = simulate_all(cloth, self.unknowns, fabrics, episode, dt)
        return [None if frames is None else view(frames) for frames in simulated]

    def _gripped_episode(self, raw: Tensor, i: int) -> tuple[Cloth, Episode, Callable[[Frames], Frames]]:
        """Return the cloth as it is gripped in episode ``i``, the episode for it, and how its frames are seen."""
        (cloth, stretched), episode = self._gripped_cloth(raw, i), self._initial_episode(raw, i)
        if stretched is None:
            return cloth, episode, lambda frames: frames
        return cloth, stretched.take_start(episode), stretched.view

    def _gripped_cloth(self, raw: Tensor, i: int) -> tuple[Cloth, StretchedCloth | None]:
        """Return the cloth as it is gripped in episode ``i``, and where the pattern is stretched for that."""
        return self._gripped_cloths.grip(self._grip_extents(raw, i))

    def _grip_extents(self, raw: Tensor, i: int) -> dict[str, float]:
        """Return by how much farther out each gripper holds the cloth in episode ``i`` [m]."""
        slices = [s for s in self.nuisance_slices[i] if isinstance(s.nuisance, GripExtent)]
        names = [name for s in slices for name in s.nuisance.number_names(self.cloth, self.episodes[i])]
        values = [value for s in slices for value in raw[s.index].tolist()]
        return dict(zip(names, values, strict=True))

    def estimate_frame_times(self, raw: Tensor, std: float | None) -> FrameTimes | None:
        """Return the errors of single stamps that the data show at a point; None where they show none.

        Args:
            raw: [K].
            std: of a stamp [s]; None: estimated.
        """
        exact = self if self.frame_times is None else self.with_frame_times(None)  # its frames are remembered
        point = levenberg_marquardt.evaluate_point(self.problem(), raw, exact.evaluate_all(raw))
        noise = zip(point.scale.tolist(), point.effective_fraction.tolist(), point.outlier_cutoff.tolist(), strict=True)
        blocks = zip(self.blocks, noise, strict=False)
        times = FrameTimes(0.0 if std is None else std, {block.name: RowNoise(*n) for block, n in blocks})
        if std is None:
            scenes = [self.scene(i) for i in range(len(self.episodes))]
            times = replace(times, std=estimate_stamp_std(times, exact.observe(raw), scenes))
        if exact is not self:
            self.simulations += len(self.episodes)
        return times if times.std > 0 else None

    def scene(self, i: int) -> Scene:
        """Return what frames of episode ``i`` are compared with."""
        return Scene(self.episodes[i], self.surface, self.blocks)

    def _first_state_modes(self, i: int) -> tuple[list[int], StateModes]:
        """(indices of the unknowns that change the first state, changes by their units)."""
        episode, columns = self.episodes[i], []
        none = episode.initial.new_zeros(0, *episode.initial.shape)
        x, v = [none], [none]
        for s in self.nuisance_slices[i]:
            shape = s.nuisance.initial_shape_modes(self.cloth, episode)
            velocity = s.nuisance.initial_velocity_modes(self.cloth, episode)
            given = shape if velocity is None else velocity
            if given is not None:
                columns += range(s.index.start, s.index.stop)
                x.append(torch.zeros_like(given) if shape is None else shape)
                v.append(torch.zeros_like(given) if velocity is None else velocity)
        return columns, StateModes(torch.cat(x), torch.cat(v))

    def _initial_episode(self, raw: Tensor, i: int) -> Episode:
        """The episode with its first state changed by the nuisances."""
        episode, (columns, modes) = self.episodes[i], self._first_state_modes(i)
        if not columns:
            return episode
        values = raw[columns].to(episode.initial)
        velocity = episode.initial_velocity
        if velocity is not None:
            velocity = velocity + torch.einsum("k,kvc->vc", values, modes.v)
        initial = episode.initial + torch.einsum("k,kvc->vc", values, modes.x)
        return replace(episode, initial=initial, initial_velocity=velocity)

    def _differentiate(self, raw: Tensor, i: int, by_fabric: bool = True) -> tuple[Frames, Frames]:
        """One episode as an observer without errors sees it, and its derivatives by all unknowns, [K, ...].

        Those by errors of the observer are zero, and those by the fabric's unknowns if not ``by_fabric``.
        """
        (mode_columns, modes), episode = self._first_state_modes(i), self._initial_episode(raw, i)
        (cloth, stretched), fabric = self._gripped_cloth(raw, i), raw[: len(self.unknowns)]
        if stretched is not None:
            episode, modes = stretched.take_start(episode), StateModes(*map(stretched.take, modes))
        frames, computed = simulate_with_tangents(cloth, self.unknowns, fabric, episode, self.dt, modes, by_fabric)
        columns = torch.tensor([*range(len(self.unknowns) if by_fabric else 0), *mode_columns])
        if stretched is not None:
            frames, computed = stretched.view(frames), stretched.view(computed)

        def spread(d: Tensor) -> Tensor:
            return d.new_zeros(len(raw), *d.shape[1:]).index_copy(0, columns, d)

        derivatives = map_frames(computed, spread)
        self._replace_by_differences(raw, i, frames, derivatives, self._grip_extent_steps(i))
        return frames, derivatives

    def _grip_extent_steps(self, i: int) -> dict[int, float]:
        """Steps of finite slopes by how far grippers hold the cloth, by index: their meshes differ."""
        steps = {}
        for s in self.nuisance_slices[i]:
            if isinstance(s.nuisance, GripExtent):
                indices = range(s.index.start, s.index.stop)
                steps |= zip(indices, (GRIP_EXTENT_STEP_STDS * std for std in s.stds), strict=True)
        return steps

    def _replace_by_differences(
        self, raw: Tensor, i: int, frames: Frames, derivatives: Frames, steps: Mapping[int, float]
    ) -> None:
        """Write finite slopes by some unknowns into derivatives [K, ...] of episode ``i``.

        With contact all simulations have the same substep. The grid lies elsewhere at every substep, so that another
        count of substeps changes the forces a little.
        """
        dt = self.dt
        if dt is None and self.cloth.contact is not None:
            dt = self._shared_step(raw, steps)
            frames = self._simulate_fabrics(raw, raw.detach()[None, : len(self.unknowns)], i, dt)[0] or frames
        for k, (step, there) in self._simulate_shifted(raw, i, steps, dt).items():
            derivatives.x[k], derivatives.v[k] = (there.x - frames.x) / step, (there.v - frames.v) / step
            for name, wrench in derivatives.wrench.items():
                wrench[k] = (there.wrench[name] - frames.wrench[name]) / step

    def _shared_step(self, raw: Tensor, sizes: Mapping[int, float]) -> float | None:
        """Return a substep [s] that is stable at a point and at steps of its unknowns, by index, in both directions."""
        points = [raw.detach()]
        for k, size in sizes.items():
            for step in (size, -size):
                points.append(self.clip(raw.detach().index_add(0, torch.tensor(k), raw.new_tensor([step]))))
        return shared_step(self.cloth, self.unknowns, torch.stack(points)[:, : len(self.unknowns)])

    @torch.no_grad()
    def _simulate_shifted(
        self, raw: Tensor, i: int, sizes: Mapping[int, float], dt: float | None
    ) -> dict[int, tuple[float, Frames]]:
        """Simulate one step of each of some unknowns, by index, backwards where forwards fails.

        Returns:
            The step and the frames there; nothing where both fail.
        """
        out: dict[int, tuple[float, Frames]] = {}
        for sign in (1, -1):
            steps = {k: sign * size for k, size in sizes.items() if k not in out}
            shifted = {k: raw.detach().index_add(0, torch.tensor(k), raw.new_tensor([d])) for k, d in steps.items()}
            legal = {k: point for k, point in shifted.items() if torch.equal(self.clip(point), point)}
            fabrics = [k for k in legal if k < len(self.unknowns)]
            points = torch.stack([raw, *(legal[k] for k in fabrics)])[1:, : len(self.unknowns)]
            simulated = dict(zip(fabrics, self._simulate_fabrics(raw, points, i, dt), strict=True))
            for k in legal.keys() - set(fabrics):
                with suppress(SimulationDiverged, UnstableStep):
                    simulated[k] = self._simulate_cloth(legal[k], i)
            out |= {k: (steps[k], there) for k, there in simulated.items() if there is not None}
        return out

    def _observe_with_derivatives(
        self, raw: Tensor, i: int, frames: Frames, derivatives: Frames
    ) -> tuple[Frames, Frames]:
        """Observe frames of episode ``i`` and their derivatives (K in front) with the observer's errors."""
        for s in self.nuisance_slices[i]:
            frames, derivatives = apply_nuisance(s, frames, derivatives, raw, self.episodes[i])
        if self.frame_times is not None:
            times, shift = self.episodes[i].times, self.frame_times.find_shifts(frames, self.scene(i))
            frames, derivatives = (see_at(f, times, shift) for f in (frames, derivatives))
        return frames, derivatives

    # -- residuals ------------------------------------------------------------------------------------------------

    def evaluate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the residuals [R] and their error groups [R]."""
        rows = self.evaluate_all(raw)
        return rows.residual, rows.error_group

    def evaluate_all(self, raw: Tensor) -> levenberg_marquardt.Linearised:
        """Compute residual rows without derivatives."""
        self._count_simulations(raw)
        rows = self._recall("evaluate", raw, lambda: self._rows([(frames, None) for frames in self.observe(raw)]))
        return levenberg_marquardt.Linearised(*rows)

    def linearise(self, raw: Tensor) -> levenberg_marquardt.Linearised:
        """Compute residual rows with exact sensitivities, by forward mode through the whole simulation.

        Its frames are no answer of ``observe``. Their last digits differ from those of a simulation without tangents,
        so a resumed fit, which recalls either, would differ in the last digit.
        """
        self._count_simulations(raw)
        self.simulations += len(self.unknowns) * len(self.episodes)
        rows = self._recall("linearise", raw, lambda: self._observed_rows(raw, self._remember_derivatives(raw)))
        return levenberg_marquardt.Linearised(*rows)

    def _remember_derivatives(self, raw: Tensor) -> list[tuple[Frames, Frames]]:
        self._last_linearised = None  # two of them would double the memory
        simulated = [self._differentiate(raw, i) for i in range(len(self.episodes))]
        self._last_linearised = tuple(raw.tolist()), simulated
        return simulated

    def _take_derivatives(self, raw: Tensor) -> list[tuple[Frames, Frames]]:
        """Return all episodes with their derivatives, those of the last linearisation if it was here."""
        last, self._last_linearised = self._last_linearised, None
        if last is not None and last[0] == tuple(raw.tolist()):
            return last[1]
        return [self._differentiate(raw, i) for i in range(len(self.episodes))]

    def _observed_rows(self, raw: Tensor, simulated: Sequence[tuple[Frames, Frames]]) -> levenberg_marquardt.Linearised:
        """Rows of what an observer with errors sees of simulated episodes and their derivatives."""
        return self._rows([self._observe_with_derivatives(raw, i, *pair) for i, pair in enumerate(simulated)])

    def observer_problem(self, raw: Tensor, simulated: Sequence[Frames]) -> levenberg_marquardt.Problem:
        """Return the problem of the observer's errors, of cloth that moves as at ``raw``.

        Args:
            raw: [K].
            simulated: frames of all episodes there, as ``simulate_cloth`` returns them.
        """
        self._count_simulations(raw)
        is_observers = torch.zeros(len(raw), dtype=torch.bool)
        for s in (s for slices in self.nuisance_slices for s in slices if not s.nuisance.acts_on_cloth):
            is_observers[s.index] = True

        def linearise(at: Tensor) -> levenberg_marquardt.Linearised:
            none = [map_frames(frames, lambda x: x.new_zeros(len(raw), *x.shape)) for frames in simulated]
            return self._observed_rows(at, list(zip(simulated, none, strict=True)))

        def evaluate(at: Tensor) -> tuple[Tensor, Tensor]:
            rows = self._rows([(self._observe(at, i, frames), None) for i, frames in enumerate(simulated)])
            return rows.residual, rows.error_group

        problem = self.problem()
        prior_mean = torch.where(is_observers, problem.prior_mean, raw)
        return problem._replace(linearise=linearise, evaluate=evaluate, prior_mean=prior_mean)

    def linearise_first_shape(self, raw: Tensor) -> levenberg_marquardt.Linearised:
        """Compute residual rows with derivatives by the nuisances alone; those by the fabric's unknowns are zero."""
        self._count_simulations(raw)
        episodes = range(len(self.episodes))
        rows = self._recall(
            "linearise-first-shape",
            raw,
            lambda: self._observed_rows(raw, [self._differentiate(raw, i, by_fabric=False) for i in episodes]),
        )
        return levenberg_marquardt.Linearised(*rows)

    def distance_metrics(self, raw: Tensor) -> DistanceMetrics:
        """Compute the reported distances [m] at a point."""
        self._count_simulations(raw)

        def compute() -> tuple[Tensor, Tensor, Tensor]:
            metrics = distance_metrics(self.simulate_vertices(raw), self.episodes, self.faces)
            return torch.tensor(metrics.chamfer), torch.tensor(metrics.rms), metrics.per_frame

        chamfer, rms, per_frame = self._recall("figures", raw, compute)
        return DistanceMetrics(float(chamfer), float(rms), per_frame)

    def mean_distance(self, raw: Tensor) -> float:
        """Compute the mean distance [m] from the data in use; of forces alone, their root mean square error [N]."""
        if self.uses("points") and self.uses("markers"):
            return self.distance_metrics(raw).chamfer
        self._count_simulations(raw)
        (distance,) = self._recall("distance", raw, lambda: (torch.tensor(self._mean_distance(raw)),))
        return float(distance)

    def _mean_distance(self, raw: Tensor) -> float:
        if not self.uses("points", "markers"):
            return force_rms([frames.wrench for frames in self.observe(raw)], self.episodes)
        if self.uses("points"):
            episodes = [replace(e, markers=None) for e in self.episodes]
        else:
            episodes = [replace(e, clouds=[cloud[:0] for cloud in e.clouds]) for e in self.episodes]
        return distance_metrics(self.simulate_vertices(raw), episodes, self.faces).chamfer

    def robust_cost(self, raw: Tensor, i: int, at: levenberg_marquardt.Iterate) -> Tensor:
        """Compute the robust cost of episode ``i`` with the scales of ``at``, without priors.

        It is differentiable in reverse mode.
        """
        scene = match_points(self.simulate(raw, i), None, self.episodes[i], self.surface)
        total = raw.new_zeros(())
        for b, block in enumerate(self.blocks):
            rows = block.rows(scene)
            if rows is not None:
                loss, _ = huber(rows.residual.to(at.scale) / at.scale[b], at.outlier_cutoff[b])
                total = total + at.effective_fraction[b] * loss.sum()
        return total

    def value_and_gradient(
        self, question: str, raw: Tensor, loss: Callable[[Objective, Tensor, int], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Compute a loss summed over the episodes, and its gradient [K] in reverse mode, one graph at a time."""

        def compute() -> tuple[Tensor, Tensor]:
            leaf, total = raw.clone().requires_grad_(), torch.zeros((), dtype=raw.dtype)
            for i in range(len(self.episodes)):
                part = loss(self, leaf, i)
                part.backward()
                total += part.detach()
            return total, torch.zeros_like(raw) if leaf.grad is None else leaf.grad

        self.simulations += len(self.episodes)
        value, gradient = self._recall(question, raw, compute)
        return value, gradient

    def _recall(self, question: str, raw: Tensor, compute: Callable[[], Any]) -> Any:
        """Answer of the journal, if there is one that has it, else of ``compute``."""
        if self.journal is None:
            return compute()
        frame_counts = digest([*((e.observed_count, len(e.times)) for e in self.episodes), repr(self.frame_times)])
        return self.journal.get_or_compute(f"{question}-{frame_counts}", raw, compute)

    def linearise_by_differences(
        self, raw: Tensor, steps: Tensor
    ) -> tuple[levenberg_marquardt.Linearised, ParameterInfluence]:
        """Linearise with one-sided differences over finite ``steps`` of the fabric's unknowns.

        Such slopes still mean something where the motion is unstable.

        Returns:
            The rows, and how far a unit of each of the fabric's unknowns moves the cloth.
        """
        count, simulated = len(self.unknowns), self._take_derivatives(raw)
        self.simulations += count * len(self.episodes)
        for i, (frames, derivatives) in enumerate(simulated):
            self._replace_by_differences(raw, i, frames, derivatives, dict(enumerate(steps[:count].tolist())))
        position = torch.stack([d.x[:count].square().sum(-1).mean((1, 2)) for _, d in simulated])
        wrenches = [w for _, d in simulated for w in d.wrench.values()]
        forces = [w[:count, 1:, :3].square().sum(-1).mean(1) for w in wrenches]
        force = torch.stack(forces).mean(0) if forces else torch.zeros(count)
        return self._observed_rows(raw, simulated), ParameterInfluence(position.mean(0).sqrt(), force.sqrt())

    def _rows(self, simulated: Sequence[tuple[Frames, Frames | None]]) -> levenberg_marquardt.Linearised:
        parts: list[tuple[int, int, int, ResidualRows]] = []
        first_frame = 0
        scatter = next((n for n in self.nuisances if isinstance(n, RimScatter)), None)
        for i, ((frames, derivatives), episode) in enumerate(zip(simulated, self.episodes, strict=True)):
            if self.frame_times is None or derivatives is None:
                simulated_episode = match_points(frames, derivatives, episode, self.surface)
                rows_by_block = {block.name: block.rows(simulated_episode) for block in self.blocks}
            else:
                rows_by_block = self.frame_times.project(frames, derivatives, self.scene(i))
            for b, block in enumerate(self.blocks):
                rows = rows_by_block[block.name]
                if rows is not None and block.name == "edges" and scatter is not None:
                    rows = marginalise_piece_offsets(rows, scatter.std)
                if rows is not None:
                    parts.append((b, first_frame, self._frames_per_reference_period(episode.times), rows))
            first_frame += len(episode.times) + self.noise_model.frames_per_time_block
        if not parts:
            asked = ", ".join(block.name for block in self.blocks)
            raise InvalidInput("use", got=f"{asked}, which no episode has", expected="kinds of data that one has")
        count = len(self.start)
        residual = torch.cat([r.residual for *_, r in parts]).to(torch.float64)
        if any(r.jacobian is not None for *_, r in parts):
            jacobians = [
                r.residual.new_zeros(len(r.residual), count) if r.jacobian is None else r.jacobian for *_, r in parts
            ]
            jacobian = torch.cat(jacobians).to(torch.float64)
        else:  # a single zero, expanded: rows times unknowns of them would fill memory and journal
            jacobian = residual.new_zeros(1, 1).expand(len(residual), count)
        return levenberg_marquardt.Linearised(
            residual=residual,
            jacobian=jacobian,
            prior_weight=torch.ones_like(residual),
            frame=torch.cat([r.frame + first for _, first, _, r in parts]),
            error_group=torch.cat([r.error_group for *_, r in parts]),
            block=torch.cat([torch.full((len(r.residual),), b) for b, *_, r in parts]),
            time_block=torch.cat([r.frame // stride + first for _, first, stride, r in parts]),
        )

    def _frames_per_reference_period(self, times: Tensor) -> int:
        if len(times) < 2:
            return 1
        return max(1, round(1 / (self.noise_model.reference_rate_hz * float(times.diff().median()))))


def apply_nuisance(
    nuisance_slice: NuisanceSlice, frames: Frames, derivatives: Frames, raw: Tensor, episode: Episode
) -> tuple[Frames, Frames]:
    """Observe frames and their derivatives (K in front) through a nuisance."""
    values = raw[nuisance_slice.index].to(frames.x)
    value_derivatives = values.new_zeros(len(raw), len(values))
    value_derivatives[nuisance_slice.index] = torch.eye(len(values), dtype=values.dtype)

    def observe(frames: Frames, values: Tensor) -> Frames:
        return nuisance_slice.nuisance.observe(frames, values, episode)

    def along(d_frames: Frames, d_values: Tensor) -> Frames:
        return torch.func.jvp(observe, (frames, values), (d_frames, d_values))[1]

    return observe(frames, values), torch.func.vmap(along)(derivatives, value_derivatives)
