"""The longest substep for which explicit integration is stable."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from .._utils.caching import VersionedTensorCache
from ..errors import InvalidInput, UnstableStep
from ..materials import Stiffness
from .elasticity import rest_shape_gradient
from .model import Model
from .viscous_stages import MAX_STAGES, StagePolynomial

# Substep over the linear stability limit. It leaves room for tangents that double beyond what the material states.
STABLE_STEP_OVER_LINEAR_LIMIT = 0.7
# Largest speed with which a grip yields to a viscous force, over the speed that causes the force. Beyond it viscous
# forces act in one piece: stages treat gripped vertices as prescribed.
MAX_GRIP_SPEED_RATIO = 4.0
STAGE_COST_IN_SUBSTEPS = 0.4  # measured: 0.3 for bending, 0.45 for the membrane


class StabilityLimits(NamedTuple):
    """Bounds on the substep of the symplectic Euler scheme.

    Attributes:
        squared_frequency: omega^2 [1/s^2] of the highest frequency.
        damping_rate: [1/s], linear damping that acts in one piece.
        viscous_rate: [1/s], linear damping that may act in stages (``viscous_stages``).
    """

    squared_frequency: float
    damping_rate: float
    viscous_rate: float

    def stable_step(self, stages: int) -> float:
        """Return the stable substep [s] with so many stages: at most STABLE_STEP_OVER_LINEAR_LIMIT x 2 / omega."""
        if stages == 0:
            return self._explicit_step(4, self.damping_rate + self.viscous_rate)
        limit = STABLE_STEP_OVER_LINEAR_LIMIT * StagePolynomial.for_stages(stages).largest_rate / self.viscous_rate
        return min(self._explicit_step(2, self.damping_rate), limit)

    def _explicit_step(self, room: float, c: float) -> float:
        """Return STABLE_STEP_OVER_LINEAR_LIMIT times the dt for which room - 2 c dt - omega^2 dt^2 = 0."""
        return (
            STABLE_STEP_OVER_LINEAR_LIMIT * ((c**2 + room * self.squared_frequency) ** 0.5 - c) / self.squared_frequency
        )

    @property
    def cheapest_step(self) -> float:
        """Stable substep [s] with which a simulation costs least."""
        steps = ((self.stable_step(n), 1 + STAGE_COST_IN_SUBSTEPS * n) for n in self._allowed_stages())
        return max((step / cost, step) for step, cost in steps)[1]

    def stages_for(self, dt: float) -> int:
        """Return the smallest number of stages for a substep ``dt`` [s] of at most ``cheapest_step``.

        Who shortens the step wants room for rates that stretching raises. So the square of the room grows as the step
        shrinks. A step that overflowed gets 0.
        """
        wanted = (dt * self.cheapest_step) ** 0.5
        return next((n for n in self._allowed_stages() if wanted <= self.stable_step(n) * (1 + 1e-9)), 0)

    def _allowed_stages(self) -> list[int]:
        return [0, *range(2, MAX_STAGES + 1)] if self.viscous_rate > 0 else [0]


def check_precision(dtype: torch.dtype) -> None:
    """Refuse a floating-point type in which a substep vanishes in rounding.

    Raises:
        InvalidInput: neither float32 nor float64.
    """
    if dtype not in (torch.float32, torch.float64):
        got = str(dtype).removeprefix("torch.")
        raise InvalidInput("precision of the cloth", got=got, expected="float32 or float64", remedy="use cloth.float()")


@torch.no_grad()
def stability_limits(
    model: Model, gradient: Tensor, inverse_plastic: Tensor | None = None, is_gripped: Tensor | None = None
) -> StabilityLimits:
    """Compute the stability limits of a cloth with all its parts.

    The frequency of the mesh is cached per mesh, with all numbers that it depends on.

    Args:
        model: the parts.
        gradient: [E, 3, 2] 1/m, gradients of the shape functions of the pattern.
        inverse_plastic: [..., E, 4], inverse of the plastic set by rows. Triangles that are crushed are small, and
            their step is short.
        is_gripped: [E, 3] bool, corners that a gripper holds during the whole motion. They do not vibrate, and shorten
            no step unless layers touch, grips yield, or all are gripped. None: none.

    Raises:
        InvalidInput: a precision in which a substep vanishes in rounding, or a vertex without mass.
        UnstableStep: stiffnesses that overflow.
    """
    check_precision(gradient.dtype)
    spacing = None if model.grid is None else model.grid.spacing
    bounds = [effect.stability_bounds(c, model.mass) for effect, c in model.effects.values()]
    from_effects, damping = (sum(float(bound[i]) for bound in bounds) for i in (0, 1))
    in_stages = model.effects.values() if model.custom_substep is None else ()
    viscous = sum(float(effect.viscous_stability_bound(c, model.mass)) for effect, c in in_stages)
    compliance = max((effect.grip_compliance(c) for effect, c in model.effects.values()), default=0.0)
    if viscous > 0 and compliance * viscous * float(model.mass.detach().max()) > MAX_GRIP_SPEED_RATIO:
        viscous = 0.0
    mass_ratio = _largest_mass_ratio(model)
    stiffness = Stiffness(*(t.to(gradient) for t in model.material.stiffness(model.coefficients)))  # may be float64
    inverse_rest = model.inverse_rest_deformation
    numbers = (*stiffness, model.areal_density, *([] if inverse_rest is None else [inverse_rest]))
    if spacing is not None or compliance > 0 or (is_gripped is not None and bool(is_gripped.all())):
        is_gripped = None
    grips = None if is_gripped is None else is_gripped.tolist()
    dependencies = (spacing, grips, *((t.dtype, t.detach().tolist()) for t in numbers))

    def compute() -> float:
        shape = gradient if inverse_rest is None else rest_shape_gradient(gradient, inverse_rest)
        shape = shape if inverse_plastic is None else shape @ inverse_plastic.unflatten(-1, (2, 2))
        shape = shape if is_gripped is None else shape.masked_fill(is_gripped.unsqueeze(-1), 0.0)
        try:
            return bound_squared_frequency(shape, model.areal_density, stiffness, spacing)
        except torch.linalg.LinAlgError as error:  # pyright: ignore[reportPrivateImportUsage] - not finite, or its square
            largest = max(float(t.max()) for t in stiffness)
            raise UnstableStep("stiffness", got=f"{largest:.3g} N/m", expected="a fabric's: the step is 0 s") from error

    if inverse_plastic is None:
        squared = _MESH_FREQUENCIES.get_or_compute(gradient, compute, dependencies)
    else:
        squared = compute()
    return StabilityLimits(mass_ratio * squared + from_effects, max(0.0, damping - viscous), viscous)


def _largest_mass_ratio(model: Model) -> float:
    """Return the largest ratio of the fabric's own mass at a vertex to its mass; 1 if no effect takes mass away."""
    mass = model.mass.detach()
    if not bool((mass > 0).all()):
        raise InvalidInput(
            "mass", got=f"{float(mass.min()):.3g} kg at a vertex", expected="more than 0 with all effects"
        )
    added = [extra for effect, c in model.effects.values() if (extra := effect.mass(c)) is not None]
    return float((1 - sum(added) / mass).clamp(min=1.0).max()) if added else 1.0


_MESH_FREQUENCIES: VersionedTensorCache[float] = VersionedTensorCache()  # by the gradient, which belongs to one mesh


def bound_squared_frequency(gradient: Tensor, density: Tensor, stiffness: Stiffness, spacing: float | None) -> float:
    """Compute a bound on omega^2 [1/s^2] of the mesh and its directors.

    The highest frequency of the mesh is bounded by that of its stiffest free element with lumped mass
    (Irons and Treharne 1971). The director adds its own. A contact point alone in its grid cell sees
    sum_i |dw_i|^2 / w_i, which is 4 / spacing^2 at a node and 6 between two. Of these 4 are counted: contact was met
    with at most a quarter of them. The director's shear reacts on the out-of-plane motion of the triangle.

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
    root = _matrix_root(stiffness)
    membrane = torch.linalg.eigvalsh(root.mT @ gram @ root)[..., -1:]
    steepest = torch.linalg.eigvalsh(gradient.mT @ gradient)[..., -1:]
    squared = 3 * membrane / density
    if spacing is not None:
        grid = 4 * torch.maximum(stiffness.normal, stiffness.shear) / spacing**2
        squared = torch.maximum(squared, (grid + 3 * stiffness.shear * steepest) / density)
    return float(squared.detach().max())


def _matrix_root(stiffness: Stiffness) -> Tensor:
    """Return the square root of the plane elasticity matrix, [..., 3, 3], in engineering strains.

    For a positive 2 x 2 matrix M it is (M + d 1) / sqrt(tr M + 2 d), d = sqrt(det M).
    """
    warp, weft, coupling, shear = torch.broadcast_tensors(*stiffness[:4])
    d = (warp * weft - coupling * coupling).sqrt()
    trace, zero = (warp + weft + 2 * d).sqrt(), torch.zeros_like(d)
    off = coupling / trace
    rows = [[(warp + d) / trace, off, zero], [off, (weft + d) / trace, zero], [zero, zero, shear.sqrt()]]
    return torch.stack([torch.cat(row, -1) for row in rows], dim=-2)
