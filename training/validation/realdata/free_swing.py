"""The free swings at the end of the IRI runs: what is measured in them, and a fit of frequency and decay.

Swing: the grid's rows, median over the columns, minus the upper row, projected on the first mode of a hanging chain,
J0(j01 sqrt s), to which the second mode is orthogonal. ``q`` is then the excursion of the free edge in that mode.
Free part: the tool stands still (3 mm); the mesh's stamps lag it by LAG; WAIT more lets the jolt of the stop die out.
Decay: air drag is quadratic, so the amplitude falls as A' = -B A^2, A = A0 / (1 + B A0 t), not exponentially.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .swings import NOISE, Run, accepted, stop

LAG = 0.32  # s
WAIT = 0.3  # s
FIRST, SECOND = 2.404825557695773, 5.520078110286311  # zeros of J0


class Swing(NamedTuple):
    """One run's free swing."""

    run: str
    t: np.ndarray  # [F] s, from the beginning of the window
    q: np.ndarray  # [F] m
    refused: float  # share of the window's frames
    refused_all: float  # share of the run's frames


class Decay(NamedTuple):
    """One frequency and decay for many swings, each with its own rest, cosine and sine."""

    frequency: float  # Hz
    decay: float  # 1/(m s) if quadratic, else 1/s
    cost: float
    rest: np.ndarray  # [R] m
    cosine: np.ndarray  # [R] m
    sine: np.ndarray  # [R] m

    @property
    def amplitude(self) -> np.ndarray:
        return np.hypot(self.cosine, self.sine)


def mode(s: np.ndarray, zero: float = FIRST) -> np.ndarray:
    """Shape of a hanging chain's mode, 1 at the free end s = 0, 0 at s = 1."""
    from scipy.special import j0

    return j0(zero * np.sqrt(np.clip(s, 0, None)))


def chain_frequency(length: float) -> float:
    """Hz, of a chain that hangs from its upper end in vacuum: j01 / 2 sqrt(g / L) / 2 pi."""
    return FIRST / 2 * np.sqrt(9.81 / length) / (2 * np.pi)


def project(y: np.ndarray) -> np.ndarray:
    """Coordinate of the first mode, from excursions [..., N] at equal distances from the free end (first) up."""
    shape = mode(np.linspace(0, 1, y.shape[-1]))
    weight = shape * np.where(np.isin(np.arange(y.shape[-1]), (0, y.shape[-1] - 1)), 0.5, 1.0)
    return y @ weight / (shape @ weight)


def window(run: Run, wait: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times [F] s from the beginning of the free part, whether a frame is in it, and whether it is accepted."""
    good = accepted(run)
    t = run["t_mesh_s"] - stop(run) - LAG - wait
    return t, t >= 0, good


def swing(name: str, run: Run, wait: float = WAIT) -> Swing:
    """The free part of a run."""
    t, free, good = window(run, wait)
    rows = np.nanmedian(run["mesh_base_m"][..., 1], axis=1)
    use = free & good
    return Swing(name, t[use], project(rows[use] - rows[use, -1:]), 1 - good[free].mean(), 1 - good.mean())


def sway(run: Run, swing: Swing, rest: float, wait: float = WAIT) -> float:
    """Share of the swing by which the upper edge goes along."""
    _, free, good = window(run, wait)
    edge = np.nanmedian(run["mesh_base_m"][free & good][:, :, -1, 1], axis=1)
    q = swing.q - rest
    return float((edge - np.median(edge)) @ q / (q @ q))


def fit(swings: Sequence[Swing], quadratic: bool = True) -> Decay:
    """Robust least squares (soft L1 beyond NOISE) for one frequency and decay, three numbers per run."""
    from scipy.optimize import least_squares

    count = len(swings)
    owner = np.repeat(np.arange(count), [len(s.t) for s in swings])
    t, q = (np.concatenate(part) for part in zip(*((s.t, s.q) for s in swings), strict=True))
    own = np.arange(3)[:, None] * count + owner + 2  # [3, F], where a frame's own numbers stand

    def model(frequency, decay, rest, cosine, sine):
        return (rest + waves(t, frequency, decay, cosine, sine, quadratic)) / NOISE

    def residual(p: np.ndarray) -> np.ndarray:
        return model(p[0], p[1], *p[own]) - q / NOISE

    def slope(p: np.ndarray) -> np.ndarray:
        """Complex steps; a run's own numbers are seen by its own frames only."""
        step = 1e-30
        numbers = [p[0], p[1], *p[own]]
        out = np.zeros((len(t), len(p)))
        for k, number in enumerate(numbers):
            column = model(*numbers[:k], number + 1j * step, *numbers[k + 1 :]).imag / step
            out[np.arange(len(t)), k if k < 2 else own[k - 2]] = column
        return out

    def start(frequency: float) -> np.ndarray:
        waved = [waves(t, frequency, 0.9, c, 1 - c, False) for c in (1.0, 0.0)]
        basis = np.stack([np.ones_like(t), *waved], axis=-1)
        solved = [np.linalg.lstsq(basis[owner == k], q[owner == k], rcond=None)[0] for k in range(count)]
        return np.concatenate([[frequency, 15.0 if quadratic else 0.9], np.transpose(solved).ravel()])

    found = min(
        (least_squares(residual, start(f), slope, loss="soft_l1", x_scale="jac", max_nfev=200) for f in (0.85, 1.0)),
        key=lambda result: result.cost,
    )
    return Decay(float(found.x[0]), float(found.x[1]), float(found.cost), *found.x[2:].reshape(3, count))


def waves(t, frequency, decay, cosine, sine, quadratic=True) -> np.ndarray:
    """m, damped oscillation about its rest."""
    phase = 2 * np.pi * frequency * t
    size = np.sqrt(cosine**2 + sine**2 + 1e-12)
    fall = 1 / (1 + decay * size * t) if quadratic else np.exp(-decay * t)
    return fall * (cosine * np.cos(phase) + sine * np.sin(phase))


def spread(swings: Sequence[Swing], times: int = 8, quadratic: bool = True) -> tuple[float, float]:
    """Standard deviations of frequency and decay over runs drawn again (bootstrap)."""
    draw = np.random.default_rng(0)
    again = [fit([swings[i] for i in draw.integers(0, len(swings), len(swings))], quadratic) for _ in range(times)]
    return float(np.std([a.frequency for a in again])), float(np.std([a.decay for a in again]))


def air_depth(side: float, panels: int, piston: bool = False) -> float:
    """m of air that moves along with a square sheet in its first swing, in ideal fluid at rest far away.

    The sheet is a layer of doublets mu(x), constant per panel, with w = -1/4pi f.p. int mu / r^3 dA = the normal
    velocity at the panels' centres; the kinetic energy is rho/2 int mu w dA. ``piston``: the sheet moves as a whole.
    """
    h = side / panels
    centre = (np.arange(panels) + 0.5) * h
    x, y = (g.ravel() for g in np.meshgrid(centre, centre, indexing="ij"))
    dx, dy = x[:, None] - x, y[:, None] - y

    def corner(a: float, b: float) -> np.ndarray:
        return a * b * np.hypot(dx + a * h / 2, dy + b * h / 2) / ((dx + a * h / 2) * (dy + b * h / 2))

    influence = sum(corner(a, b) for a in (-1, 1) for b in (-1, 1)) / (4 * np.pi)
    w = np.ones_like(y) if piston else mode(y / side)
    return float(np.linalg.solve(influence, w) @ w / (w @ w))
