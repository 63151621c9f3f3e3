"""Episodes, model and data as the callbacks that the solvers work on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ..._utils.resume import Journal, digest
from ...cloth import Cloth
from ...episodes.cloth_facts import facts_of
from ...episodes.observed import Episode
from ...episodes.observed_surface import sheet_for
from ...episodes.replay import Frames, each, simulate, tangents
from ...episodes.unknowns import Unknown
from ...errors import InvalidInput, SimulationDiverged, UnstableStep
from ...parameters import PhysicalParameter
from ..nuisances import AbstractNuisance, Placed, foreseen, place
from ..residuals.blocks import BLOCKS, USES, Block, floors_of
from ..residuals.metrics import Figures, figures, forces_rms, huber
from ..residuals.rows import Rows, scene_of
from ..uncertainty.identifiability import Reach
from . import levenberg_marquardt


class Objective:
    """Residuals and simulated frames as functions of the unknowns; counts simulations.

    The vector of unknowns holds the fabric's first, then the nuisances of one episode after the other.
    """

    patience = 1  # iterations that may bring nothing, of a search by gradients

    def __init__(
        self,
        cloth: Cloth,
        unknowns: Sequence[Unknown],
        episodes: Sequence[Episode],
        dt: float | None = None,
        nuisances: Sequence[AbstractNuisance] = (),
        blocks: Sequence[Block] = BLOCKS,
        floors: Mapping[str, float] | None = None,
    ) -> None:
        self.cloth, self.unknowns, self.episodes, self.dt = cloth, list(unknowns), list(episodes), dt
        self.nuisances, self.blocks, self.floors = list(nuisances), list(blocks), floors_of(floors)
        self.sheet = sheet_for(cloth, self.episodes)
        self.faces = self.sheet.faces
        self.placed = place(self.nuisances, cloth, self.episodes, len(self.unknowns))
        stds = [std for own in self.placed for p in own for std in p.stds]
        self.prior_std = torch.tensor([*(u.prior_std for u in unknowns), *stds], dtype=torch.float64)
        self.sizes = torch.tensor([*(u.size for u in unknowns), *stds], dtype=torch.float64)
        self.start = torch.tensor([*(u.start for u in unknowns), *(0.0 for _ in stds)], dtype=torch.float64)
        self.middle = torch.tensor([*(u.middle for u in unknowns), *(0.0 for _ in stds)], dtype=torch.float64)
        self.journal: Journal | None = None
        self.simulations = 0
        self._met: set[tuple[float, ...]] = set()
        self._recent: dict[tuple[float, ...], list[Frames]] = {}

    def part(self, share: float) -> Objective:
        """The same for the first ``share`` of the frames."""
        return self._like(foreseen([e.until(share) for e in self.episodes], self.nuisances), self.nuisances)

    @property
    def told(self) -> bool:
        """Whether there are any data of the kinds in use."""
        of = {
            "points": lambda e: any(len(cloud) for cloud in e.clouds[1:]),
            "markers": lambda e: e.markers is not None and bool(e.markers[1:].isfinite().any()),
            "force": lambda e: any(bool(w[1:].isfinite().any()) for w in e.wrenches.values()),
        }
        return any(there(e) for kind, there in of.items() if self.uses(kind) for e in self.episodes)

    def uses(self, *kinds: str) -> bool:
        """Whether data of one of these kinds (of ``USES``) are asked for."""
        return not {block.name for block in self.blocks}.isdisjoint(name for kind in kinds for name in USES[kind])

    def beside(self, nuisances: Sequence[AbstractNuisance]) -> Objective:
        """The same with other nuisances."""
        return self._like(self.episodes, nuisances)

    def _like(self, episodes: Sequence[Episode], nuisances: Sequence[AbstractNuisance]) -> Objective:
        other = Objective(self.cloth, self.unknowns, episodes, self.dt, nuisances, self.blocks, self.floors)
        other.journal = self.journal
        return other

    def problem(self) -> levenberg_marquardt.Problem:
        """The callbacks of Gauss-Newton."""
        longest = [*(u.longest_step for u in self.unknowns), *self.prior_std[len(self.unknowns) :].tolist()]
        return levenberg_marquardt.Problem(
            linearise=self.linearise,
            evaluate=self.evaluate,
            clip=self.clip,
            prior_mean=self.middle,
            prior_std=self.prior_std,
            longest=torch.tensor(longest, dtype=torch.float64),
            noise=torch.tensor([self.floor(block) for block in self.blocks], dtype=torch.float64),
            gate=torch.tensor([block.gate for block in self.blocks], dtype=torch.float64),
        )

    def floor(self, block: Block) -> float:
        """Least standard deviation of a residual of this kind."""
        noises = [e.noise for e in self.episodes if e.noise is not None]
        stated = max(noises) if noises and block.name == "points" else block.floor
        return self.floors.get(block.name, stated)

    def clip(self, raw: Tensor) -> Tensor:
        """The nearest legal point."""
        legal = [u.clip(float(r)) for u, r in zip(self.unknowns, raw, strict=False)]
        return torch.cat([torch.tensor(legal, dtype=raw.dtype), raw[len(legal) :]])

    def raw(self, values: Mapping[str, float]) -> Tensor:
        """Unconstrained start with some values by name replaced; unknown names are refused."""
        known = {u.name: i for i, u in enumerate(self.unknowns)}
        out = self.start.clone()
        for name, value in values.items():
            if name not in known:
                raise InvalidInput("guess", got=repr(name), expected=f"one of {', '.join(known)}")
            parameter = self.unknowns[known[name]].parameter
            out[known[name]] = PhysicalParameter(value, parameter.unit, parameter.domain, name=name).raw.detach()
        return out

    def scaled(self, raw: Tensor) -> Tensor:
        """In units of the priors' standard deviations, from their middle."""
        return (raw - self.middle) / self.prior_std

    def unscaled(self, z: Tensor) -> Tensor:
        """The inverse of ``scaled``."""
        return self.middle + self.prior_std * z

    def pulled(self, slope: Tensor) -> Tensor:
        """A gradient by the scaled unknowns from one by the unknowns."""
        return slope * self.prior_std

    def values(self, raw: Tensor) -> dict[str, float]:
        """Physical values of the fabric's unknowns by name."""
        return {u.name: u.value(float(r)) for u, r in zip(self.unknowns, raw, strict=False)}

    def identity(self) -> list[object]:
        """What the answers to the solvers' questions depend on."""
        data = [part for e in self.episodes for part in e.identity()]
        model = [*facts_of(self.cloth), self.dt]
        names = [u.name for u in self.unknowns], [b.name for b in self.blocks], [n.name for n in self.nuisances]
        return [*data, *model, *names, self.floors, self.middle, self.prior_std]

    def episode_of(self, linear: levenberg_marquardt.Linearised) -> Tensor:
        """[R] which episode a row belongs to."""
        ends = torch.tensor([len(e.times) + levenberg_marquardt.WINDOW for e in self.episodes]).cumsum(0)
        return torch.searchsorted(ends, linear.frame, right=True)

    # -- simulation -----------------------------------------------------------------------------------------------

    def frames(self, raw: Tensor) -> list[Tensor]:
        """Frames [T, V, 3] m of every episode as they are seen."""
        return [frames.x for frames in self.seen(raw)]

    def seen(self, raw: Tensor) -> list[Frames]:
        """What is seen and felt of every episode; the last few points are remembered."""
        self._meet(raw)
        key = tuple(raw.tolist())
        if key not in self._recent:
            with torch.no_grad():
                self._recent[key] = [self.simulate(raw, i) for i in range(len(self.episodes))]
            while len(self._recent) > 4:
                del self._recent[next(iter(self._recent))]
        return self._recent[key]

    def _meet(self, raw: Tensor) -> None:
        """Count a point once, whether its answer is computed or found in the journal: a resumed fit counts the same."""
        key = tuple(raw.tolist())
        if key not in self._met:
            self._met.add(key)
            self.simulations += len(self.episodes)

    def simulate(self, raw: Tensor, i: int) -> Frames:
        """One episode; differentiable in reverse mode when ``raw`` requires grad."""
        fabric, episode = raw[: len(self.unknowns)], self._begun(raw, i)
        frames = simulate(self.cloth, self.unknowns, fabric, episode, self.dt)
        for p in self.placed[i]:
            frames = p.nuisance.see(frames, raw[p.where].to(frames.x), self.episodes[i])
        return frames

    def _modes(self, i: int) -> list[tuple[slice, Tensor]]:
        found = ((p.where, p.nuisance.modes(self.cloth, self.episodes[i])) for p in self.placed[i])
        return [(where, modes) for where, modes in found if modes is not None]

    def _begun(self, raw: Tensor, i: int) -> Episode:
        """The episode with its first shape as the nuisances have it."""
        episode = self.episodes[i]
        for where, modes in self._modes(i):
            shift = torch.einsum("k,kvc->vc", raw[where].to(modes), modes)
            episode = replace(episode, initial=episode.initial + shift)
        return episode

    def _tangents(self, raw: Tensor, i: int) -> tuple[Frames, Frames]:
        """One episode, and its derivatives by all unknowns."""
        own, episode = self._modes(i), self._begun(raw, i)
        modes = torch.cat([m for _, m in own]) if own else None
        fabric = raw[: len(self.unknowns)]
        frames, few = tangents(self.cloth, self.unknowns, fabric, episode, self.dt, modes)
        index = [*range(len(self.unknowns)), *(k for where, _ in own for k in range(where.start, where.stop))]
        moved = each(few, lambda d: d.new_zeros(len(raw), *d.shape[1:]).index_copy(0, torch.tensor(index), d))
        for p in self.placed[i]:
            frames, moved = pushed(p, frames, moved, raw, self.episodes[i])
        return frames, moved

    # -- residuals ------------------------------------------------------------------------------------------------

    def evaluate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Residual rows and their patches."""
        rows = self.evaluate_all(raw)
        return rows.value, rows.patch

    def evaluate_all(self, raw: Tensor) -> levenberg_marquardt.Linearised:
        """Residual rows without derivatives."""
        self._meet(raw)
        work = lambda: self._rows([(frames, None) for frames in self.seen(raw)])  # noqa: E731
        return levenberg_marquardt.Linearised(*self._ask("evaluate", raw, work))

    def linearise(self, raw: Tensor) -> levenberg_marquardt.Linearised:
        """Residual rows with exact sensitivities, by forward mode through the whole simulation.

        Its frames are not remembered: their last digits are not those of a simulation alone, and a resumed fit, which
        recalls either, would then differ in the last digit.
        """
        work = lambda: self._rows([self._tangents(raw, i) for i in range(len(self.episodes))])  # noqa: E731
        self._meet(raw)
        self.simulations += len(self.unknowns) * len(self.episodes)
        return levenberg_marquardt.Linearised(*self._ask("linearise", raw, work))

    def figures(self, raw: Tensor) -> Figures:
        """Distances at a point."""
        self._meet(raw)
        chamfer, rms, per_frame = self._ask("figures", raw, lambda: self._figures(raw))
        return Figures(float(chamfer), float(rms), per_frame)

    def _figures(self, raw: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        now = figures(self.frames(raw), self.episodes, self.faces)
        return torch.tensor(now.chamfer), torch.tensor(now.rms), now.per_frame

    def distance(self, raw: Tensor) -> float:
        """Mean distance [m] from what was seen and is in use; of forces alone their root mean square [N]."""
        if self.uses("points") and self.uses("markers"):
            return self.figures(raw).chamfer
        self._meet(raw)
        return float(self._ask("distance", raw, lambda: torch.tensor(self._distance(raw))))

    def _distance(self, raw: Tensor) -> float:
        if not self.uses("points", "markers"):
            return forces_rms([frames.wrench for frames in self.seen(raw)], self.episodes)
        if self.uses("points"):
            seen = [replace(e, markers=None) for e in self.episodes]
        else:
            seen = [replace(e, clouds=[cloud[:0] for cloud in e.clouds]) for e in self.episodes]
        return figures(self.frames(raw), seen, self.faces).chamfer

    def cost(self, raw: Tensor, i: int, at: levenberg_marquardt.Iterate) -> Tensor:
        """Robust cost of episode ``i`` by the scales of ``at``, without priors; differentiable in reverse mode."""
        scene = scene_of(self.simulate(raw, i), None, self.episodes[i], self.sheet)
        total = raw.new_zeros(())
        for b, block in enumerate(self.blocks):
            rows = block.rows(scene)
            if rows is not None:
                loss, _ = huber(rows.value.to(at.scale) / at.scale[b], at.gate[b])
                total = total + at.share[b] * loss.sum()
        return total

    def value_and_slope(
        self, question: str, raw: Tensor, loss: Callable[[Objective, Tensor, int], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """A loss summed over the episodes, and its gradient [K] in reverse mode; one graph at a time."""

        def work() -> tuple[Tensor, Tensor]:
            leaf, total = raw.clone().requires_grad_(), torch.zeros((), dtype=raw.dtype)
            for i in range(len(self.episodes)):
                part = loss(self, leaf, i)
                part.backward()
                total += part.detach()
            return total, torch.zeros_like(raw) if leaf.grad is None else leaf.grad

        self.simulations += len(self.episodes)
        value, slope = self._ask(question, raw, work)
        return value, slope

    def _ask(self, question: str, raw: Tensor, work: Callable[[], Any]) -> Any:
        if self.journal is None:
            return work()
        return self.journal.ask(f"{question}-{digest([(e.observed, len(e.times)) for e in self.episodes])}", raw, work)

    def secants(self, raw: Tensor, steps: Tensor) -> tuple[levenberg_marquardt.Linearised, Reach]:
        """The same with one-sided differences over finite ``steps`` of the fabric's unknowns, and how far these reach.

        They are what survives where the motion is unstable.
        """
        both = [self._tangents(raw, i) for i in range(len(self.episodes))]
        for k in range(len(self.unknowns)):
            step, seen = self._beside(raw, k, float(steps[k]))
            for (frames, moved), ahead in zip(both, seen, strict=bool(step)):
                moved.x[k] = (ahead.x - frames.x) / step
                for name in moved.wrench:
                    moved.wrench[name][k] = (ahead.wrench[name] - frames.wrench[name]) / step
        count = len(self.unknowns)
        position = torch.stack([m.x[:count].square().sum(-1).mean((1, 2)) for _, m in both])
        wrenches = [w[:count, 1:, :3].square().sum(-1).mean(1) for _, m in both for w in m.wrench.values()]
        force = torch.stack(wrenches).mean(0) if wrenches else torch.zeros(count)
        return self._rows(both), Reach(position.mean(0).sqrt(), force.sqrt())

    def _beside(self, raw: Tensor, k: int, step: float) -> tuple[float, list[Frames]]:
        """(step along an unknown, what is seen there), back where nothing can be simulated ahead; (0, []): nowhere."""
        here, clip = float(raw[k]), self.unknowns[k].clip
        for way in (clip(here + step) - here, clip(here - step) - here):
            shifted = raw.clone()
            shifted[k] += way
            with suppress(SimulationDiverged, UnstableStep):
                if way:
                    return way, self.seen(shifted)
        return 0.0, []

    def _rows(self, both: Sequence[tuple[Frames, Frames | None]]) -> levenberg_marquardt.Linearised:
        parts: list[tuple[int, int, int, Rows]] = []
        first = 0
        for (frames, moved), episode in zip(both, self.episodes, strict=True):
            scene = scene_of(frames, moved, episode, self.sheet)
            for b, block in enumerate(self.blocks):
                rows = block.rows(scene)
                if rows is not None:
                    parts.append((b, first, _stride(episode.times), rows))
            first += len(episode.times) + levenberg_marquardt.WINDOW  # windows do not reach across episodes
        if not parts:
            asked = ", ".join(block.name for block in self.blocks)
            raise InvalidInput("use", got=f"{asked}, which no episode has", expected="kinds of data that one has")
        double, count = torch.float64, len(self.start)
        value = torch.cat([r.value for *_, r in parts]).to(double)
        if any(r.jacobian is not None for *_, r in parts):
            zeros = lambda r: r.value.new_zeros(len(r.value), count)  # noqa: E731
            jacobian = torch.cat([zeros(r) if r.jacobian is None else r.jacobian for *_, r in parts]).to(double)
        else:  # one zero for all: with many rows and unknowns they would fill memory and journal
            jacobian = value.new_zeros(1, 1).expand(len(value), count)
        return levenberg_marquardt.Linearised(
            value=value,
            jacobian=jacobian,
            factor=torch.ones_like(value),
            frame=torch.cat([r.frame + offset for _, offset, _, r in parts]),
            patch=torch.cat([r.patch for *_, r in parts]),
            block=torch.cat([torch.full((len(r.value),), b) for b, *_, r in parts]),
            moment=torch.cat([r.frame // stride + offset for _, offset, stride, r in parts]),
        )


def _stride(times: Tensor) -> int:
    """Frames in 1 / PACE s."""
    return 1 if len(times) < 2 else max(1, round(1 / (levenberg_marquardt.PACE * float(times.diff().median()))))


def pushed(p: Placed, frames: Frames, moved: Frames, raw: Tensor, episode: Episode) -> tuple[Frames, Frames]:
    """A nuisance's view of the frames, and the derivatives through it."""
    values = raw[p.where].to(frames.x)
    own = values.new_zeros(len(raw), len(values))
    own[p.where] = torch.eye(len(values), dtype=values.dtype)
    see = lambda f, v: p.nuisance.see(f, v, episode)  # noqa: E731
    along = lambda df, dv: torch.func.jvp(see, (frames, values), (df, dv))[1]  # noqa: E731
    return see(frames, values), torch.func.vmap(along)(moved, own)
