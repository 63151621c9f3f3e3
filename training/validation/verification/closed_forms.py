"""Truth on paper: solutions that know nothing of torchcloth. SI units."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

GRAVITY = 9.81  # m/s^2
J01 = 2.404825557695773  # first zero of the Bessel function J0


def uniaxial(stretch: float, stiffness: float, poisson: float) -> tuple[float, float]:
    """(stretch across, force per width [N/m]) of a fixed-corotated membrane that is free to contract.

    d(psi)/d(s2) = 2 mu (s2 - 1) + lambda (s1 s2 - 1) s1 = 0 is linear in s2.
    """
    mu, lam = stiffness / (2 * (1 + poisson)), stiffness * poisson / (1 - poisson**2)
    across = (2 * mu + lam * stretch) / (2 * mu + lam * stretch**2)
    return across, 2 * mu * (stretch - 1) + lam * (stretch * across - 1) * across


def sag(areal_density: float, length: float, stiffness: float) -> float:
    """How much a strip without lateral contraction lengthens under its own weight [m]."""
    return areal_density * GRAVITY * length**2 / (2 * stiffness)


def chain_frequency(length: float) -> float:
    """First swing of a hanging chain [Hz] (Bernoulli 1732)."""
    return J01 / (4 * math.pi) * math.sqrt(GRAVITY / length)


def slide(angle: float, friction: float, t: float) -> float:
    """Way of a block on an incline after t, from rest [m]; 0 where it sticks."""
    return 0.5 * max(0.0, GRAVITY * (math.sin(angle) - friction * math.cos(angle))) * t**2


def fall_with_linear_drag(rate: float, t: float) -> tuple[float, float]:
    """(depth [m], speed [m/s]) from rest with acceleration g - rate v."""
    speed = GRAVITY / rate * -math.expm1(-rate * t)
    return (GRAVITY * t - speed) / rate, speed


def fall_with_quadratic_drag(terminal: float, t: float) -> tuple[float, float]:
    """(depth [m], speed [m/s]) from rest with acceleration g (1 - (v / terminal)^2)."""
    x = GRAVITY * t / terminal
    return terminal**2 / GRAVITY * math.log(math.cosh(x)), terminal * math.tanh(x)


class Elastica(NamedTuple):
    """Shape of a heavy elastica from its clamp."""

    along: np.ndarray  # [N] m, horizontal
    height: np.ndarray  # [N] m


def heavy_elastica(bending: float, areal_density: float, length: float) -> Elastica:
    """B theta'' = rho_A g (L - s) cos(theta), theta upwards; clamped level at s = 0, free at s = L."""
    from scipy.integrate import solve_bvp

    weight = areal_density * GRAVITY
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


def elastic_part(stretches: tuple[float, float], limit: float) -> tuple[float, float]:
    """Elastic stretches once a sheet was pulled to ``stretches``, with sum (s - 1)^2 <= limit^2 (radial return)."""
    strain = np.array(stretches) - 1
    size = float(np.linalg.norm(strain))
    kept = strain * min(1.0, limit / size) if size else strain
    return float(1 + kept[0]), float(1 + kept[1])


def biaxial_tension(stretches: tuple[float, float], stiffness: float, poisson: float) -> tuple[float, float]:
    """Fixed-corotated principal stresses [N/m] per rest length."""
    mu, lam = stiffness / (2 * (1 + poisson)), stiffness * poisson / (1 - poisson**2)
    a, b = stretches
    return 2 * mu * (a - 1) + lam * (a * b - 1) * b, 2 * mu * (b - 1) + lam * (a * b - 1) * a
