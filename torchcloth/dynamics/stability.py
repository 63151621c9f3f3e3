"""The largest step that explicit integration survives."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.caching import Remembered
from ..errors import InvalidInput, UnstableStep
from ..materials import Stiffness
from .elasticity import grown_gradient
from .model import Model
from .viscous_stages import MOST, Polynomial

SAFETY = 0.7  # of the linear limit: leaves room for tangents that double beyond what the material states
LOOSE = 4.0  # speed that a grip yields for a viscous force over the one that causes it: stages hold what is held
STAGE = 0.4  # of a substep's cost, for a stage: 0.3 of bending, 0.45 of the membrane


class Limits(NamedTuple):
    """What bounds a substep of the symplectic Euler scheme."""

    squared: float  # 1/s^2, of the highest frequency omega
    damping: float  # 1/s, linear damping rate of what acts in one piece
    viscous: float  # 1/s, of what may act in stages, see relaxation.py

    def longest(self, stages: int) -> float:
        """Stable substep [s]: SAFETY x 2 / omega, less where there is damping."""
        if stages == 0:
            return self._explicit(4, self.damping + self.viscous)
        reach = SAFETY * Polynomial.of(stages).reach / self.viscous
        return min(self._explicit(2, self.damping), reach)

    def _explicit(self, room: float, c: float) -> float:
        """SAFETY times the step for which room - 2 c dt - omega^2 dt^2 = 0."""
        return SAFETY * ((c**2 + room * self.squared) ** 0.5 - c) / self.squared

    @property
    def step(self) -> float:
        """The stable substep [s] with which a simulation costs least."""
        return max((self.longest(n) / (1 + STAGE * n), self.longest(n)) for n in self._stages())[1]

    def stages(self, dt: float) -> int:
        """Fewest for ``dt`` [s], of at most ``step``; 0 for a step that overflowed.

        Who shortens the step wants room, for rates that stretching raises: their square grows as the step shrinks.
        """
        return next((n for n in self._stages() if (dt * self.step) ** 0.5 <= self.longest(n) * (1 + 1e-9)), 0)

    def _stages(self) -> list[int]:
        return [0, *range(2, MOST + 1)] if self.viscous > 0 else [0]


def check_precision(dtype: torch.dtype) -> None:
    """Refuse one in which a substep is lost in rounding."""
    if dtype not in (torch.float32, torch.float64):
        got = str(dtype).removeprefix("torch.")
        raise InvalidInput("precision of the cloth", got=got, expected="float32 or float64", remedy="use cloth.float()")


@torch.no_grad()
def limits_of(model: Model, gradient: Tensor, inelastic: Tensor | None = None) -> Limits:
    """Those of a cloth with all its parts; ``gradient``: of the shape functions of the pattern.

    ``inelastic``: what has set [..., E, 4], A by rows: triangles that are crushed are small, and their step is short.
    What was found last for a mesh is remembered, with all numbers that it hangs on.

    Raises:
        InvalidInput: a precision in which a substep is lost in rounding.
        UnstableStep: stiffnesses that overflow.
    """
    check_precision(gradient.dtype)
    spacing = None if model.grid is None else model.grid.spacing
    extra = [effect.rates(c, model.mass) for effect, c in model.effects.values()]
    elastic, damping = (sum(float(rate[i]) for rate in extra) for i in (0, 1))
    staged = model.effects.values() if model.custom_substep is None else ()
    viscous = sum(float(effect.viscous_rate(c, model.mass)) for effect, c in staged)
    yielding = max((effect.grip_compliance(c) for effect, c in model.effects.values()), default=0.0)
    if viscous > 0 and yielding * viscous * float(model.mass.detach().max()) > LOOSE:
        viscous = 0.0
    lighter = _lighter(model)
    stiffness = Stiffness(*(t.to(gradient) for t in model.material.stiffness(model.coefficients)))  # may be float64
    numbers = (*stiffness, model.areal_density, *([] if model.rest is None else [model.rest]))
    beside = (spacing, *((t.dtype, t.detach().tolist()) for t in numbers))

    def find() -> float:
        shape = gradient if model.rest is None else grown_gradient(gradient, model.rest)
        shape = shape if inelastic is None else shape @ inelastic.unflatten(-1, (2, 2))
        try:
            return squared_frequency(shape, model.areal_density, stiffness, spacing)
        except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage] - not finite, or its square
            largest = max(float(t.max()) for t in stiffness)
            raise UnstableStep("stiffness", got=f"{largest:.3g} N/m", expected="a fabric's: the step is 0 s") from error

    squared = _KNOWN.of(gradient, find, beside) if inelastic is None else find()
    return Limits(lighter * squared + elastic, max(0.0, damping - viscous), viscous)


def _lighter(model: Model) -> float:
    """Largest ratio of the fabric's own mass at a vertex to the one that it has; 1 where nothing takes mass away."""
    mass = model.mass.detach()
    if not bool((mass > 0).all()):
        raise InvalidInput(
            "mass", got=f"{float(mass.min()):.3g} kg at a vertex", expected="more than 0 with all effects"
        )
    added = [own for effect, c in model.effects.values() if (own := effect.mass(c)) is not None]
    return float((1 - sum(added) / mass).clamp(min=1.0).max()) if added else 1.0


_KNOWN: Remembered[float] = Remembered()  # by the gradient, which belongs to one mesh


def squared_frequency(gradient: Tensor, density: Tensor, stiffness: Stiffness, spacing: float | None) -> float:
    """Bound on omega^2 [1/s^2] of the mesh and its directors.

    The highest frequency of the mesh is bounded by that of its stiffest free element with lumped mass
    (Irons and Treharne 1971). The director adds its own: a contact point alone in its grid cell sees
    sum_i |dw_i|^2 / w_i, 4 / spacing^2 at a node and 6 between two, of which 4 are counted (contact was met with at
    most a quarter of them); its shear reacts on the triangle's out-of-plane motion.

    Args:
        gradient: [E, 3, 2] 1/m, gradients of the shape functions.
        density: [..., E or 1, 1] kg/m^2.
        stiffness: tangents [N/m].
        spacing: contact grid [m]; None without contact.
    """
    gx, gy = gradient[..., 0], gradient[..., 1]
    zero = torch.zeros_like(gx)
    strain = torch.stack([torch.cat([gx, zero], -1), torch.cat([zero, gy], -1), torch.cat([gy, gx], -1)], dim=-2)
    gram = strain @ strain.mT  # [E, 3, 3], the non-zero spectrum of B^T B
    root = _root(stiffness)
    membrane = torch.linalg.eigvalsh(root.mT @ gram @ root)[..., -1:]
    steepest = torch.linalg.eigvalsh(gradient.mT @ gradient)[..., -1:]
    squared = 3 * membrane / density
    if spacing is not None:
        grid = 4 * torch.maximum(stiffness.normal, stiffness.shear) / spacing**2
        squared = torch.maximum(squared, (grid + 3 * stiffness.shear * steepest) / density)
    return float(squared.detach().max())


def _root(stiffness: Stiffness) -> Tensor:
    """Square root of the plane elasticity matrix [..., 3, 3] in engineering strains.

    Of a positive 2 x 2 matrix M it is (M + d 1) / sqrt(tr M + 2 d), d = sqrt(det M).
    """
    warp, weft, coupling, shear = torch.broadcast_tensors(*stiffness[:4])
    d = (warp * weft - coupling * coupling).sqrt()
    trace, zero = (warp + weft + 2 * d).sqrt(), torch.zeros_like(d)
    off = coupling / trace
    rows = [[(warp + d) / trace, off, zero], [off, (weft + d) / trace, zero], [zero, zero, shear.sqrt()]]
    return torch.stack([torch.cat(row, -1) for row in rows], dim=-2)
