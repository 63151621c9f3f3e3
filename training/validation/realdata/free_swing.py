"""The free swings at the end of the IRI runs: their measurement, and a fit of frequency and decay.

Swing: the rows of the grid, median over the columns, minus the upper row, are projected on the first mode of a hanging
chain, J0(j01 sqrt s), to which the second mode is orthogonal. ``q`` is then the excursion of the free edge in that
mode.

Free part: the tool stands still (3 mm), and the stamps of the mesh lag it. A further waiting time lets the jolt of the
stop decay.

Decay: air drag is quadratic, so the amplitude falls as A' = -B A^2, A = A0 / (1 + B A0 t), not exponentially.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2

from ..verification.closed_forms import BESSEL_J0_FIRST_ZERO
from .swings import ROBUST_SCALE_M, Run, accepted_frames, motion_stop

TYPICAL_LAG_S = 0.32  # of the stamps of the mesh
SETTLING_AFTER_STOP_S = 0.3


class FreeSwing(NamedTuple):
    """One run's free swing.

    Attributes:
        run: name.
        t: [F] s, from the beginning of the window.
        q: [F] m, excursion of the free edge in the first mode.
        rejected_fraction: of the window's frames.
        rejected_fraction_of_run: of the run's frames.
    """

    run: str
    t: np.ndarray
    q: np.ndarray
    rejected_fraction: float
    rejected_fraction_of_run: float


class DecayFit(NamedTuple):
    """One frequency and decay for many swings, each with its own rest position, cosine and sine.

    Attributes:
        frequency: Hz.
        decay: 1/(m s) if quadratic, else 1/s.
        cost: of the fit.
        rest: [R] m.
        cosine: [R] m.
        sine: [R] m.
    """

    frequency: float
    decay: float
    cost: float
    rest: np.ndarray
    cosine: np.ndarray
    sine: np.ndarray

    @property
    def amplitude(self) -> np.ndarray:
        """Amplitudes at the beginning [R] m."""
        return np.hypot(self.cosine, self.sine)


def chain_mode_shape(s: np.ndarray, zero: float = BESSEL_J0_FIRST_ZERO) -> np.ndarray:
    """Return the shape of a hanging chain's mode: 1 at the free end s = 0, 0 at s = 1."""
    from scipy.special import j0

    return j0(zero * np.sqrt(np.clip(s, 0, None)))


def chain_frequency(length: float) -> float:
    """Return the frequency [Hz] of a chain that hangs in vacuum: j01 / 2 sqrt(g / L) / 2 pi."""
    return BESSEL_J0_FIRST_ZERO / 2 * np.sqrt(STANDARD_GRAVITY_M_PER_S2 / length) / (2 * np.pi)


def project_on_mode(y: np.ndarray) -> np.ndarray:
    """Project excursions [..., N], evenly spaced from the free end up, on the first mode; returns [...]."""
    shape = chain_mode_shape(np.linspace(0, 1, y.shape[-1]))
    weight = shape * np.where(np.isin(np.arange(y.shape[-1]), (0, y.shape[-1] - 1)), 0.5, 1.0)
    return y @ weight / (shape @ weight)


def free_window(run: Run, wait: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times [F] s from the start of the free part, which frames are in it, and which are accepted."""
    is_accepted = accepted_frames(run)
    t = run["t_mesh_s"] - motion_stop(run) - TYPICAL_LAG_S - wait
    return t, t >= 0, is_accepted


def extract_swing(name: str, run: Run, wait: float = SETTLING_AFTER_STOP_S) -> FreeSwing:
    """Extract the free part of a run."""
    t, is_free, is_accepted = free_window(run, wait)
    rows = np.nanmedian(run["mesh_base_m"][..., 1], axis=1)
    use = is_free & is_accepted
    q = project_on_mode(rows[use] - rows[use, -1:])
    return FreeSwing(name, t[use], q, 1 - is_accepted[is_free].mean(), 1 - is_accepted.mean())


def measure_edge_sway(run: Run, swing: FreeSwing, rest: float, wait: float = SETTLING_AFTER_STOP_S) -> float:
    """Return the motion of the upper edge as a fraction of the swing."""
    _, is_free, is_accepted = free_window(run, wait)
    edge = np.nanmedian(run["mesh_base_m"][is_free & is_accepted][:, :, -1, 1], axis=1)
    q = swing.q - rest
    return float((edge - np.median(edge)) @ q / (q @ q))


def fit_decay(swings: Sequence[FreeSwing], quadratic: bool = True) -> DecayFit:
    """Fit one frequency and decay, and three numbers per run, by robust least squares (soft L1)."""
    from scipy.optimize import least_squares

    count = len(swings)
    owner = np.repeat(np.arange(count), [len(s.t) for s in swings])
    t, q = (np.concatenate(part) for part in zip(*((s.t, s.q) for s in swings), strict=True))
    run_columns = np.arange(3)[:, None] * count + owner + 2  # [3, F], of the numbers of a frame's run

    def model(*numbers: Any) -> Any:
        frequency, decay, rest, cosine, sine = numbers
        return (rest + damped_oscillation(t, frequency, decay, cosine, sine, quadratic)) / ROBUST_SCALE_M

    def residual(p: np.ndarray) -> np.ndarray:
        return model(p[0], p[1], *p[run_columns]) - q / ROBUST_SCALE_M

    def jacobian(p: np.ndarray) -> np.ndarray:
        """Return the Jacobian by complex steps; a run's numbers act on its own frames only."""
        step = 1e-30
        numbers = [p[0], p[1], *p[run_columns]]
        out = np.zeros((len(t), len(p)))
        for k, number in enumerate(numbers):
            column = model(*numbers[:k], number + 1j * step, *numbers[k + 1 :]).imag / step
            out[np.arange(len(t)), k if k < 2 else run_columns[k - 2]] = column
        return out

    def start(frequency: float) -> np.ndarray:
        harmonics = [damped_oscillation(t, frequency, 0.9, c, 1 - c, False) for c in (1.0, 0.0)]
        basis = np.stack([np.ones_like(t), *harmonics], axis=-1)
        solutions = [np.linalg.lstsq(basis[owner == k], q[owner == k], rcond=None)[0] for k in range(count)]
        return np.concatenate([[frequency, 15.0 if quadratic else 0.9], np.transpose(solutions).ravel()])

    best: Any = min(
        (
            least_squares(residual, start(f), cast(Any, jacobian), loss="soft_l1", x_scale="jac", max_nfev=200)
            for f in (0.85, 1.0)
        ),
        key=lambda result: result.cost,
    )
    return DecayFit(float(best.x[0]), float(best.x[1]), float(best.cost), *best.x[2:].reshape(3, count))


def damped_oscillation(t, frequency, decay, cosine, sine, quadratic=True) -> np.ndarray:
    """Return a damped oscillation [m] about its rest position at times t [s]."""
    phase = 2 * np.pi * frequency * t
    size = np.sqrt(cosine**2 + sine**2 + 1e-12)
    envelope = 1 / (1 + decay * size * t) if quadratic else np.exp(-decay * t)
    return envelope * (cosine * np.cos(phase) + sine * np.sin(phase))


def bootstrap_std(swings: Sequence[FreeSwing], times: int = 8, quadratic: bool = True) -> tuple[float, float]:
    """Return the standard deviations of frequency and decay by bootstrap over runs."""
    draw = np.random.default_rng(0)
    fits = [fit_decay([swings[i] for i in draw.integers(0, len(swings), len(swings))], quadratic) for _ in range(times)]
    return float(np.std([f.frequency for f in fits])), float(np.std([f.decay for f in fits]))


def added_air_depth(side: float, panels: int, piston: bool = False) -> float:
    """Return the depth [m] of air that moves with a square sheet in its first mode, in an ideal fluid.

    The sheet is a layer of doublets mu(x), constant per panel, with w = -1/4pi f.p. int mu / r^3 dA = the normal
    velocity at the panels' centres. The kinetic energy is rho/2 int mu w dA.

    Args:
        side: m.
        panels: along a side.
        piston: the sheet moves as a whole.
    """
    h = side / panels
    centre = (np.arange(panels) + 0.5) * h
    x, y = (g.ravel() for g in np.meshgrid(centre, centre, indexing="ij"))
    dx, dy = x[:, None] - x, y[:, None] - y

    def corner(a: float, b: float) -> np.ndarray:
        return a * b * np.hypot(dx + a * h / 2, dy + b * h / 2) / ((dx + a * h / 2) * (dy + b * h / 2))

    corners = corner(-1, -1) + corner(-1, 1) + corner(1, -1) + corner(1, 1)
    influence = corners / (4 * np.pi)
    w = np.ones_like(y) if piston else chain_mode_shape(y / side)
    return float(np.linalg.solve(influence, w) @ w / (w @ w))
