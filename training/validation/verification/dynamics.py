"""Motion against closed forms: falling, swinging, sliding."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

import torchcloth as tc
from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2

from . import closed_forms
from .case_figures import plot_against_truth
from .registry import Outcome, Row, Tolerance, register_case, relative
from .scenes import indices_where, make_strip, stationary_trajectory

ROUNDING_TOLERANCE = Tolerance(1e-6, "relative")


def make_square_sheet(effects, boundaries=None, n: int = 8, density: float = 0.15) -> tc.Cloth:
    """Return a sheet of 0.3 m without contact."""
    mesh = tc.meshes.rectangle(0.3, 0.3, resolution=(n, n))
    return tc.Cloth(mesh, tc.materials.AEP(3e5), density, effects, boundaries, contact=None)


@register_case(
    "free-fall",
    "Free fall",
    truth="g t²/2 and g t; the symplectic step is ahead of g t²/2 by g t Δt/2, so two steps are extrapolated to Δt = 0",
    tolerance=ROUNDING_TOLERANCE,
)
def free_fall(fast: bool) -> Outcome:
    """Measure depth and speed of a free fall."""
    cloth = make_square_sheet({"gravity": tc.effects.Gravity()})
    t, dt = 0.05 if fast else 0.3, 1e-4
    with torch.no_grad():
        coarse, fine = (cloth(cloth.rest_state(), times=[0.0, t], dt=step) for step in (dt, dt / 2))
    depth = -(2 * fine.x - coarse.x)[-1, :, 2]
    expected = 0.5 * STANDARD_GRAVITY_M_PER_S2 * t**2
    worst = depth[(depth - expected).abs().argmax()]
    ahead = float(-coarse.x[-1, :, 2].mean()) - expected
    return Outcome(
        [
            Row("depth, Δt → 0, worst vertex", 1e3 * float(worst), 1e3 * expected, "mm"),
            Row("speed", float(-coarse.v[-1, :, 2].mean()), STANDARD_GRAVITY_M_PER_S2 * t, "m/s"),
            Row("ahead at Δt = 0.1 ms", 1e3 * ahead, 1e3 * STANDARD_GRAVITY_M_PER_S2 * t * dt / 2, "mm"),
        ]
    )


@register_case(
    "drag",
    "Fall through air",
    truth="g t/c − v/c with v = g/c (1 − exp(−c t)) for linear drag; v∞ tanh(g t/v∞) for a flat sheet with normal drag",
    tolerance=relative(0.01),
    draw=lambda figure, data: plot_against_truth(
        figure.subplots(), data["t"], data["measured"], data["truth"], ("time [s]", "speed with linear drag [m/s]")
    ),
)
def drag(fast: bool) -> Outcome:
    """Measure depth and speed of falls with linear and quadratic drag."""
    rate, times = 4.0, np.linspace(0, 1.0, 21)
    cloth = make_square_sheet({"gravity": tc.effects.Gravity(), "drag": tc.effects.MassDamping(rate)})
    with torch.no_grad():
        out = cloth(cloth.rest_state(), times=times)
    depth, speed = closed_forms.fall_with_linear_drag(rate, 1.0)
    rows = [
        Row("depth after 1 s, linear drag", float(-out.x[-1, :, 2].mean()), depth, "m"),
        Row("speed after 1 s, linear drag", float(-out.v[-1, :, 2].mean()), speed, "m/s"),
    ]
    measured = -out.v[..., 2].mean(-1).numpy()
    truth = np.array([closed_forms.fall_with_linear_drag(rate, t)[1] for t in times])
    cloth = make_square_sheet({"gravity": tc.effects.Gravity(), "air": tc.effects.AirDrag(1.2, density=1.2)})
    with torch.no_grad():
        out = cloth(cloth.rest_state(), times=[0.0, 0.6])
    depth, speed = closed_forms.fall_with_quadratic_drag(
        math.sqrt(2 * 0.15 * STANDARD_GRAVITY_M_PER_S2 / (1.2 * 1.2)), 0.6
    )
    rows.append(Row("depth after 0.6 s, normal drag", float(-out.x[-1, :, 2].mean()), depth, "m"))
    rows.append(Row("speed after 0.6 s, normal drag", float(-out.v[-1, :, 2].mean()), speed, "m/s"))
    return Outcome(rows, {"t": times, "measured": measured, "truth": truth})


@register_case(
    "incline",
    "Sheet on an inclined plane",
    truth="sticks below arctan μ; above, g (sin α − μ cos α) t²/2",
    tolerance=relative(0.03),
    draw=lambda figure, data: plot_against_truth(
        figure.subplots(), data["ratio"], data["measured"], data["truth"], ("tan α / μ", "displacement in 0.4 s [mm]")
    ),
)
def incline(fast: bool) -> Outcome:
    """Measure how far a sheet slides on planes of several slopes."""
    mu, t = 0.4, 0.4
    ratios = [0.5, 0.9, 0.98, 1.02, 1.1, 1.5, 2.5]
    displacements, truth = [], []
    for ratio in ratios:
        angle = math.atan(mu * ratio)
        g = (STANDARD_GRAVITY_M_PER_S2 * math.sin(angle), 0.0, -STANDARD_GRAVITY_M_PER_S2 * math.cos(angle))
        cloth = make_square_sheet({"gravity": tc.effects.Gravity(g)}, {"plane": tc.boundaries.Plane(friction=mu)}, n=5)
        with torch.no_grad():
            out = cloth(cloth.rest_state(), times=[0.0, t])
        displacements.append(float((out.x[-1] - out.x[0])[:, 0].mean()))
        truth.append(closed_forms.sliding_distance(angle, mu, t))
    measured, expected = 1e3 * np.array(displacements), 1e3 * np.array(truth)
    rows = []
    for ratio, a, b in zip(ratios, measured, expected, strict=True):
        tolerance = Tolerance(1e-6, "absolute") if b == 0 else None
        rows.append(
            Row(f"displacement at tan α = {ratio:g} μ, {'sticks' if b == 0 else 'slides'}", a, b, "mm", tolerance)
        )
    data = {"ratio": np.array(ratios), "measured": measured, "truth": expected}
    return Outcome(rows, data, f"μ = {mu:g}, from rest, {t:g} s.")


@register_case(
    "small-swing",
    "Small swing of a hanging strip of 0.30 m in vacuum",
    truth="j₀,₁ / (4π) √(g/L) = 1.094 Hz, the hanging chain",
    tolerance=relative(0.02),
    draw=lambda figure, data: plot_against_truth(
        figure.subplots(), data["t"], data["measured"], data["truth"], ("time [s]", "mean displacement [mm]")
    ),
)
def small_swing(fast: bool) -> Outcome:
    """Measure the frequency of a strip that swings in its first mode."""
    length = 0.30
    rows, data = [], {}
    scenes = [
        ("21 rows", 21, None),
        ("41 rows", 41, None),
        ("21 rows, with the contact grid", 21, tc.Contact(spacing=0.03, everywhere=True)),
    ]
    for label, rows_of_vertices, contact in scenes[:1] if fast else scenes:
        t, mean = simulate_swing(rows_of_vertices, contact, 2.0)
        frequency, _, amplitude_ratio = fit_harmonic(t, mean)
        rows.append(Row(label, frequency, closed_forms.hanging_chain_frequency(length), "Hz"))
        if label == "21 rows, with the contact grid" or fast:
            rows.append(Row(f"amplitude remaining after 2 s, {label}", 100 * amplitude_ratio, 100.0, "%", finding=True))
        data = data or {
            "t": t,
            "measured": 1e3 * mean,
            "truth": 1e3 * mean[0] * np.cos(2 * math.pi * rows[0].truth * t),
        }
    return Outcome(
        rows, data, "Y = 600 N/m, 0.15 kg/m², no bending. The strip starts at rest in its first mode, 3 mm at the end."
    )


def simulate_swing(rows: int, contact: tc.Contact | None, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times [T] s and mean displacements [T] m of a strip that is released in the chain's first mode."""
    from scipy.special import j0

    length = 0.30
    mesh = make_strip(length, 0.03, (rows, 3))
    s = mesh.vertices[:, 0]
    cloth = tc.Cloth(
        mesh,
        tc.materials.AEP(6e5, 0.3, contact_stiffness=1e5, shear_stiffness=2e4),
        0.15,
        {"gravity": tc.effects.Gravity((STANDARD_GRAVITY_M_PER_S2, 0.0, 0.0))},
        {"clamp": tc.boundaries.Grasp(indices_where(s < 1e-9))},
        contact,
    )
    times = np.linspace(0, end, 101)
    with torch.no_grad():
        rest = cloth.settle(cloth.rest_state(), {"clamp": stationary_trajectory()}, duration=0.15, rate=60.0)
        mode = torch.as_tensor(j0(closed_forms.BESSEL_J0_FIRST_ZERO * np.sqrt(1 - s / length)))
        x = rest.x + 3e-3 * mode[:, None] * torch.tensor([0.0, 0.0, 1.0])
        out = cloth(cloth.state(x), {"clamp": stationary_trajectory()}, times=times)
    mass = cloth.build_model().mass.detach()[:, 0]
    return times, (out.x[..., 2] @ mass / mass.sum()).numpy()


def fit_harmonic(t: np.ndarray, signal: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Fit one harmonic to a signal.

    Returns:
        Frequency [Hz], fitted signal, and amplitude in the second half over that in the first.
    """
    from scipy.optimize import minimize_scalar

    def harmonic(f: float, part: slice = slice(None)) -> tuple[np.ndarray, float, float]:
        basis = np.stack([np.cos(2 * np.pi * f * t[part]), np.sin(2 * np.pi * f * t[part])], 1)
        weights, *_ = np.linalg.lstsq(basis, signal[part], rcond=None)
        return basis @ weights, float(np.linalg.norm(basis @ weights - signal[part])), float(np.linalg.norm(weights))

    best: Any = minimize_scalar(lambda f: harmonic(f)[1], bounds=(0.8, 1.4), method="bounded", options={"xatol": 1e-6})
    half = len(t) // 2
    amplitude_ratio = harmonic(best.x, slice(half, None))[2] / harmonic(best.x, slice(None, half))[2]
    return float(best.x), harmonic(best.x)[0], amplitude_ratio
