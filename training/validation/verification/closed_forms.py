"""Closed-form solutions, independent of torchcloth. SI units."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchcloth._utils.constants import STANDARD_GRAVITY_M_PER_S2

BESSEL_J0_FIRST_ZERO = 2.404825557695773


def uniaxial_tension(stretch: float, stiffness: float, poisson: float) -> tuple[float, float]:
    """Return the lateral stretch and the force per width [N/m] of a fixed-corotated membrane under uniaxial tension.

    d(psi)/d(s2) = 2 mu (s2 - 1) + lambda (s1 s2 - 1) s1 = 0 is linear in s2.
    """
    mu, lam = stiffness / (2 * (1 + poisson)), stiffness * poisson / (1 - poisson**2)
    lateral = (2 * mu + lam * stretch) / (2 * mu + lam * stretch**2)
    return lateral, 2 * mu * (stretch - 1) + lam * (stretch * lateral - 1) * lateral


def biaxial_tension(stretches: tuple[float, float], stiffness: float, poisson: float) -> tuple[float, float]:
    """Return the fixed-corotated principal stresses [N/m] per rest length."""
    mu, lam = stiffness / (2 * (1 + poisson)), stiffness * poisson / (1 - poisson**2)
    a, b = stretches
    return 2 * mu * (a - 1) + lam * (a * b - 1) * b, 2 * mu * (b - 1) + lam * (a * b - 1) * a


def elastic_stretches(stretches: tuple[float, float], limit: float) -> tuple[float, float]:
    """Return the elastic stretches after a sheet was pulled to ``stretches``, with sum (s - 1)^2 <= limit^2.

    The law is a radial return.
    """
    strain = np.array(stretches) - 1
    size = float(np.linalg.norm(strain))
    elastic = strain * min(1.0, limit / size) if size else strain
    return float(1 + elastic[0]), float(1 + elastic[1])


def hanging_strip_elongation(areal_density: float, length: float, stiffness: float) -> float:
    """Return the elongation [m] of a hanging strip without lateral contraction under its weight."""
    return areal_density * STANDARD_GRAVITY_M_PER_S2 * length**2 / (2 * stiffness)


def hanging_chain_frequency(length: float) -> float:
    """Return the frequency [Hz] of the first swinging mode of a hanging chain (Bernoulli 1732)."""
    return BESSEL_J0_FIRST_ZERO / (4 * math.pi) * math.sqrt(STANDARD_GRAVITY_M_PER_S2 / length)


def sliding_distance(angle: float, friction: float, t: float) -> float:
    """Return the distance [m] that a block slides down an incline in t, from rest; 0 where it sticks."""
    return 0.5 * max(0.0, STANDARD_GRAVITY_M_PER_S2 * (math.sin(angle) - friction * math.cos(angle))) * t**2


def fall_with_linear_drag(rate: float, t: float) -> tuple[float, float]:
    """Return depth [m] and speed [m/s] of a fall from rest with acceleration g - rate v."""
    speed = STANDARD_GRAVITY_M_PER_S2 / rate * -math.expm1(-rate * t)
    return (STANDARD_GRAVITY_M_PER_S2 * t - speed) / rate, speed


def fall_with_quadratic_drag(terminal: float, t: float) -> tuple[float, float]:
    """Return depth [m] and speed [m/s] of a fall from rest with acceleration g (1 - (v / terminal)^2)."""
    x = STANDARD_GRAVITY_M_PER_S2 * t / terminal
    return terminal**2 / STANDARD_GRAVITY_M_PER_S2 * math.log(math.cosh(x)), terminal * math.tanh(x)


class Elastica(NamedTuple):
    """Shape of a heavy elastica from its clamp.

    Attributes:
        along: [N] m, horizontal positions.
        height: [N] m.
    """

    along: np.ndarray
    height: np.ndarray


def solve_heavy_elastica(bending: float, areal_density: float, length: float) -> Elastica:
    """Solve B theta'' = rho_A g (L - s) cos(theta), theta upwards; clamped level at s = 0, free at s = L.

    Raises:
        ArithmeticError: the solver does not converge.
    """
    from scipy.integrate import solve_bvp

    weight = areal_density * STANDARD_GRAVITY_M_PER_S2
    s = np.linspace(0, length, 200)
    solution = solve_bvp(
        lambda s, y: np.array([y[1], weight * (length - s) * np.cos(y[0]) / bending, np.cos(y[0]), np.sin(y[0])]),
        lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
        s,
        np.zeros((4, len(s))),
        tol=1e-8,
        max_nodes=20000,
    )
    if not solution.success:
        raise ArithmeticError(f"heavy elastica: {solution.message}")
    along, height = solution.sol(s)[2:]
    return Elastica(along, height)
