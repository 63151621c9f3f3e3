"""Episodes, model and data as the callbacks that the solvers work on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from ..cloth import Cloth
from ..errors import InvalidInput
from ..parameters import PhysicalParameter
from . import gauss_newton
from .episodes import Episode
from .misfit import patches_of, rows
from .replays import simulate, tangents
from .unknowns import Unknown


class Objective:
    """Residuals and simulated frames as functions of the unknowns; counts simulations."""

    def __init__(
        self, cloth: Cloth, unknowns: Sequence[Unknown], episodes: Sequence[Episode], dt: float | None = None
    ) -> None:
        self.cloth, self.unknowns, self.episodes, self.dt = cloth, list(unknowns), list(episodes), dt
        self.faces, self.patches = torch.as_tensor(cloth.mesh.faces), patches_of(cloth.mesh)
        self.start = torch.tensor([u.start for u in unknowns], dtype=torch.float64)
        self.simulations = 0
        self._recent: dict[tuple[float, ...], list[Tensor]] = {}

    def problem(self) -> gauss_newton.Problem:
        """The callbacks of Gauss-Newton."""
        noises = [e.noise for e in self.episodes if e.noise is not None]
        return gauss_newton.Problem(
            linearise=self.linearise,
            evaluate=self.evaluate,
            clip=self.clip,
            prior_mean=self.start,
            prior_std=torch.tensor([u.prior_std for u in self.unknowns], dtype=torch.float64),
            longest=torch.tensor([u.longest_step for u in self.unknowns], dtype=torch.float64),
            noise=max(noises) if noises else None,
        )

    def clip(self, raw: Tensor) -> Tensor:
        """The nearest legal point."""
        return torch.tensor([u.clip(float(r)) for u, r in zip(self.unknowns, raw, strict=True)], dtype=raw.dtype)

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

    def values(self, raw: Tensor) -> dict[str, float]:
        """Physical values by name."""
        return {u.name: u.value(float(r)) for u, r in zip(self.unknowns, raw, strict=True)}

    def frames(self, raw: Tensor) -> list[Tensor]:
        """Simulated frames [T, V, 3] m of every episode; the last few points are remembered."""
        key = tuple(raw.tolist())
        if key not in self._recent:
            with torch.no_grad():
                frames = [simulate(self.cloth, self.unknowns, raw, e, self.dt) for e in self.episodes]
            self.simulations += len(self.episodes)
            self.remember(raw, frames)
        return self._recent[key]

    def remember(self, raw: Tensor, frames: list[Tensor]) -> None:
        """Keep the frames of a point that was simulated elsewhere."""
        self._recent[tuple(raw.tolist())] = frames
        while len(self._recent) > 4:
            del self._recent[next(iter(self._recent))]

    def evaluate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        """Residual rows and their patches."""
        parts = [
            rows(x, None, e, self.faces, self.patches) for x, e in zip(self.frames(raw), self.episodes, strict=True)
        ]
        return torch.cat([p.value for p in parts]).to(torch.float64), torch.cat([p.patch for p in parts])

    def linearise(self, raw: Tensor) -> gauss_newton.Linearised:
        """Residual rows with exact sensitivities, by forward mode through the whole simulation."""
        both = [tangents(self.cloth, self.unknowns, raw, e, self.dt) for e in self.episodes]
        self.simulations += len(self.unknowns) * len(self.episodes)
        self.remember(raw, [x for x, _ in both])
        return self._rows(both)

    def secants(self, raw: Tensor, steps: Tensor) -> gauss_newton.Linearised:
        """The same with one-sided differences over finite ``steps`` [K]: what survives where the motion is unstable."""
        base, moved = self.frames(raw), []
        for i, step in enumerate(steps):
            shifted = raw.clone()
            shifted[i] += step
            moved.append(self.frames(shifted))
        both = []
        for e in range(len(self.episodes)):
            slopes = [(m[e] - base[e]) / step for m, step in zip(moved, steps, strict=True)]
            both.append((base[e], torch.stack(slopes)))
        return self._rows(both)

    def _rows(self, both: Sequence[tuple[Tensor, Tensor]]) -> gauss_newton.Linearised:
        parts, counted, first = [], [], 0
        for (x, tangent), e in zip(both, self.episodes, strict=True):
            part = rows(x, tangent, e, self.faces, self.patches)
            parts.append(part)
            counted.append(part.frame + first)
            first += len(e.clouds) + gauss_newton.WINDOW  # windows do not reach across episodes
        double = torch.float64
        return gauss_newton.Linearised(
            value=torch.cat([p.value for p in parts]).to(double),
            jacobian=torch.cat([p.jacobian for p in parts if p.jacobian is not None]).to(double),
            factor=torch.cat([p.factor for p in parts]).to(double),
            frame=torch.cat(counted),
            patch=torch.cat([p.patch for p in parts]),
        )
