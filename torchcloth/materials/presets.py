"""Published fabrics, each with its source and the reading of its units."""

from __future__ import annotations

from typing import NamedTuple

from ..errors import InvalidInput


class Fabric(NamedTuple):
    """Arguments for ``AEP``, a typical areal density [kg/m^2], and where the numbers come from."""

    material: dict[str, float]
    areal_density: float
    source: str


_DIFFCP = (
    "DiffCP (Zheng et al.), table of mean fabric parameters. The table has no units; read as kPa at a thickness of "
    "1 mm it gives plausible membrane stiffnesses, and that is a reading, not a statement of the paper. The areal "
    "density is ours."
)


def _diffcp(E: float, nu: float, k: float, gamma: float, areal_density: float) -> Fabric:
    kilo = 1e3
    material = {
        "youngs_modulus": E * kilo,
        "poisson_ratio": nu,
        "contact_stiffness": k * kilo,
        "shear_stiffness": gamma * kilo,
        "thickness": 1e-3,
    }
    return Fabric(material, areal_density, _DIFFCP)


FABRICS: dict[str, Fabric] = {
    "cotton": _diffcp(609.02, 0.15, 6520.57, 1674.00, 0.15),
    "artificial_silk": _diffcp(713.00, 0.37, 9330.89, 553.84, 0.08),
    "wool": _diffcp(221.37, 0.31, 4729.10, 2000.57, 0.25),
    "polyester": _diffcp(1792.45, 0.13, 8715.03, 1260.79, 0.12),
    "coated_nylon": _diffcp(3579.50, 0.06, 9638.63, 2388.09, 0.10),
}


def find(name: str) -> Fabric:
    """The fabric called ``name``.

    Raises:
        InvalidInput: no such fabric.
    """
    if name not in FABRICS:
        raise InvalidInput("preset", got=repr(name), expected=f"one of {', '.join(sorted(FABRICS))}")
    return FABRICS[name]
