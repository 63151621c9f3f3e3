"""A cloth reduced to what other engines know: an isotropic sheet with mass, bending, damping, drag and grasps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..boundaries import Grasp
from ..cloth import Cloth
from ..effects import AbstractEffect, AddedMass, AirDrag, Bending, Gravity, KelvinVoigt, LineMass, MassDamping
from ..errors import InvalidInput
from ..meshes import Mesh
from ..types import Surface

DEFAULT_THICKNESS_M = 1e-3  # of a material that has none
TANGENT_STRAIN = 1e-5  # of central differences at rest; their error is its square
UNIFORM_RELATIVE_TOLERANCE = 1e-2  # smaller differences are not reported
PLANE_RELATIVE_TOLERANCE = 1e-9  # of the extent across a flat sheet
REST_STRAIN_TOLERANCE = 1e-3  # of vertices that stand in for the pattern


@dataclass(frozen=True, eq=False)
class Sheet:
    """An isotropic sheet in SI units.

    Attributes:
        rest: [V, 3] m, vertices of the unstrained sheet; in the plane z = 0 if the cloth has one pattern.
        faces: [F, 3].
        initial: [V, 3] m, vertices at the first frame of an episode; or of the mesh as it was given.
        mass: [V] kg.
        areal_density: kg/m^2.
        thickness: m.
        lam: Lame parameter of plane stress times thickness [N/m], at rest.
        mu: shear modulus times thickness [N/m], at rest.
        bending: rigidity of the plate [N m].
        bending_damping: ratio of viscous to elastic bending moment [s].
        viscosity: of the membrane [N s/m].
        drag_normal: drag coefficient C_n [-].
        drag_tangential: C_t of both sides [-].
        air_density: kg/m^3; 0 in vacuum.
        wind: [3] m/s.
        damping_rate: 1/s, of mass damping.
        gravity: [3] m/s^2.
        grasps: vertices by the name of the gripper.
        notes: what no isotropic sheet expresses, a sentence each.
    """

    rest: np.ndarray
    faces: np.ndarray
    initial: np.ndarray
    mass: np.ndarray
    areal_density: float
    thickness: float
    lam: float
    mu: float
    bending: float
    bending_damping: float
    viscosity: float
    drag_normal: float
    drag_tangential: float
    air_density: float
    wind: np.ndarray
    damping_rate: float
    gravity: np.ndarray
    grasps: Mapping[str, np.ndarray]
    notes: tuple[str, ...]

    @property
    def membrane_stiffness(self) -> float:
        """Young's modulus times thickness [N/m]."""
        return 4 * self.mu * (self.lam + self.mu) / (self.lam + 2 * self.mu)

    @property
    def poisson_ratio(self) -> float:
        """Poisson's ratio of the membrane [-]."""
        return self.lam / (self.lam + 2 * self.mu)

    @property
    def vertex_area(self) -> np.ndarray:
        """A third of each vertex's triangles, [V] m^2."""
        a, b, c = (self.rest[self.faces[:, k]] for k in range(3))
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return np.bincount(self.faces.ravel(), np.repeat(area / 3, 3), len(self.rest))


def describe_sheet(cloth: Cloth, initial: np.ndarray | None = None) -> Sheet:
    """Reduce a cloth to an isotropic sheet, and say what is lost.

    Args:
        cloth: the cloth.
        initial: [V, 3] m, positions of the vertices to start from; None: those of the mesh.

    Raises:
        InvalidInput: a batch of cloths, or initial vertices of another mesh.
    """
    with torch.no_grad():
        model = cloth.build_model()
        if model.mass.ndim > 2:
            raise InvalidInput("cloth", got="a batch of parameters", expected="one value of each, or one per triangle")
        area = torch.as_tensor(cloth.mesh.area)
        notes: list[str] = []
        lam, mu = _isotropic_moduli(cloth, area, notes)
        parts = _read_effects(cloth, area, notes)
        density = _mean("areal_density", cloth.areal_density.value, area, notes)
        mass = model.mass.squeeze(-1).double().cpu().numpy()
    rest = _rest_positions(cloth.mesh, parts.pop("rest_deformation"), notes)
    start = cloth.mesh.vertices if initial is None else np.asarray(initial, dtype=float)
    if start.shape != rest.shape:
        raise InvalidInput("initial vertices", got=f"shape {start.shape}", expected=f"{rest.shape}")
    grasps = {}
    for name, boundary in cloth.boundaries.items():
        if isinstance(boundary, Grasp):
            grasps[name] = boundary.index.cpu().numpy()
        else:
            notes.append(f"boundary {name!r} ({type(boundary).__name__}) is part of the scene and not exported")
    if cloth.contact is not None:
        notes.append("contact between layers (k, gamma, c_F) is left to the target's own contact")
    return Sheet(
        rest=rest,
        faces=cloth.mesh.faces,
        initial=start,
        mass=mass,
        areal_density=density,
        thickness=float(getattr(cloth.material, "thickness", DEFAULT_THICKNESS_M)),
        lam=lam,
        mu=mu,
        grasps=grasps,
        notes=tuple(notes),
        **parts,
    )


def _isotropic_moduli(cloth: Cloth, area: Tensor, notes: list[str]) -> tuple[float, float]:
    """Return the Lame parameters [N/m] of the isotropic membrane that is nearest to the tangents at rest."""
    c, h = cloth.material.coefficients(), TANGENT_STRAIN

    def stress(warp: float, weft: float, shear: float) -> Tensor:
        surface = _stretched_surface(1 + warp, 1 + weft, shear / 2)
        p1, p2 = cloth.material.membrane_stress(c, surface)
        return torch.stack([p1[..., 0], p2[..., 1], p1[..., 1]], -1)

    columns = [(stress(*(h * e)) - stress(*(-h * e))) / (2 * h) for e in np.eye(3)]
    tangent = torch.stack(columns, -1).expand(len(area), 3, 3)
    names = ("warp", "weft", "coupling", "shear")
    c11, c22, c12, c66 = (
        _mean(f"membrane tangent {name}", tangent[:, i, j], area, notes)
        for name, (i, j) in zip(names, ((0, 0), (1, 1), (0, 1), (2, 2)), strict=True)
    )
    mu, bulk = (c11 + c22 - 2 * c12 + 4 * c66) / 8, (c11 + c22 + 2 * c12) / 4  # means over all directions
    isotropic = np.array([bulk + mu, bulk + mu, bulk - mu, mu])
    given = np.array([c11, c22, c12, c66])
    if np.abs(given - isotropic).max() > UNIFORM_RELATIVE_TOLERANCE * isotropic[0]:
        values = ", ".join(f"{name} {value:.4g}" for name, value in zip(names, given, strict=True))
        notes.append(f"the membrane is woven ({values} N/m at rest); exported is the mean over all directions")
    if type(cloth.material).__name__ == "StiffeningAEP":
        notes.append("the membrane stiffens with strain; exported are its moduli at rest")
    if getattr(cloth.material, "plastic", None) is not None:
        notes.append("lasting set (plasticity) of the membrane is left out")
    return bulk - mu, mu


def _stretched_surface(warp: float, weft: float, shear: float) -> Surface:
    f1 = torch.tensor([[warp, shear, 0.0]], dtype=torch.float64)
    f2 = torch.tensor([[shear, weft, 0.0]], dtype=torch.float64)
    normal = torch.cross(f1, f2, dim=-1)
    J = normal.norm(dim=-1, keepdim=True)
    n = normal / J
    cofactors = torch.cross(f2, n, dim=-1), torch.cross(n, f1, dim=-1)
    return Surface(f1, f2, *cofactors, n, J, torch.ones(1, 1, dtype=torch.float64), torch.zeros_like(f1))


def _read_effects(cloth: Cloth, area: Tensor, notes: list[str]) -> dict:
    """Return the sheet's fields that effects give, and the rest deformation [2, 2] or None."""
    fields = dict.fromkeys(
        ("bending", "bending_damping", "viscosity", "drag_normal", "drag_tangential", "air_density", "damping_rate"),
        0.0,
    )
    out = {**fields, "wind": np.zeros(3), "gravity": np.zeros(3), "rest_deformation": None}
    effects: Any = cloth.effects
    for name, effect in effects.items():
        c = effect.coefficients()
        if isinstance(effect, Gravity):
            out["gravity"] = out["gravity"] + c.reshape(-1, 3)[0].double().cpu().numpy()
        elif isinstance(effect, Bending):
            out["bending"], out["bending_damping"] = _read_bending(name, effect, area, notes)
        elif isinstance(effect, KelvinVoigt):
            out["viscosity"] += _mean(f"{name}.viscosity", effect.viscosity.value, area, notes)
        elif isinstance(effect, AirDrag):
            out["drag_normal"] = _mean(f"{name}.normal", effect.normal.value, area, notes)
            out["drag_tangential"] = _mean(f"{name}.tangential", effect.tangential.value, area, notes)
            out["air_density"], out["wind"] = effect.density, effect.wind.detach().double().cpu().numpy()
        elif isinstance(effect, MassDamping):
            out["damping_rate"] += float(effect.rate.value)
        elif (deformation := effect.rest_deformation(c)) is not None:
            if deformation.shape[0] > 1:
                notes.append(f"effect {name!r}: a rest shape that differs between triangles is left out")
            else:
                total = deformation[0].double().cpu().numpy()
                out["rest_deformation"] = total if out["rest_deformation"] is None else out["rest_deformation"] @ total
        elif not isinstance(effect, LineMass):  # its mass is in the vertices' masses
            notes.append(f"effect {name!r} ({type(effect).__name__}) is left out{_reason(effect)}")
    return out


def _reason(effect: AbstractEffect) -> str:
    return ": no target carries air along" if isinstance(effect, AddedMass) else ": no target has it"


def _read_bending(name: str, effect: Bending, area: Tensor, notes: list[str]) -> tuple[float, float]:
    stiffness = _mean(f"{name}.stiffness", effect.stiffness.value, area, notes)
    ratio = 1.0 if effect.weft_ratio is None else float(effect.weft_ratio.value)
    if effect.weft_ratio is not None or effect.twist_ratio is not None:
        stiffness *= ratio**0.5
        notes.append(f"bending is woven (weft over warp {ratio:.3g}); exported is the geometric mean")
    if effect.curl_warp is not None or effect.curl_weft is not None:
        notes.append(f"effect {name!r}: curl at rest is left out")
    if type(effect) is not Bending:
        notes.append(f"effect {name!r} ({type(effect).__name__}): only its elastic stiffness is exported")
    return stiffness, 0.0 if effect.damping_time is None else float(effect.damping_time.value)


def _mean(name: str, value: Tensor, area: Tensor, notes: list[str]) -> float:
    """Return a value, or the mean of a field over the area."""
    field = value.double().cpu().reshape(-1)
    if field.numel() == 1:
        return float(field)
    weight = area.double().reshape(-1)
    mean = float((field * weight).sum() / weight.sum())
    if float(field.max() - field.min()) > UNIFORM_RELATIVE_TOLERANCE * abs(mean):
        notes.append(
            f"{name} differs between triangles ({float(field.min()):.4g} to {float(field.max()):.4g}); "
            f"exported is the mean {mean:.4g}"
        )
    return mean


def _rest_positions(mesh: Mesh, deformation: np.ndarray | None, notes: list[str]) -> np.ndarray:
    """Return the vertices [V, 3] m of an unstrained sheet: of the pattern where it is one piece, else of the mesh."""
    uv = mesh.uv
    if uv is not None and (mesh.is_pattern_from_behind.all() or not mesh.is_pattern_from_behind.any()):
        flat = uv if deformation is None else uv @ deformation.T
        return np.column_stack([flat, np.zeros(len(flat))])
    if deformation is not None:
        notes.append("the rest shape's shrinkage is left out: the cloth has no single flat pattern")
    sides = np.linalg.norm(np.roll(mesh.rest, -1, 1) - mesh.rest, axis=-1)
    placed = mesh.vertices[mesh.faces]
    strain = np.abs(np.linalg.norm(np.roll(placed, -1, 1) - placed, axis=-1) / sides - 1).max()
    if strain > REST_STRAIN_TOLERANCE:
        notes.append(
            f"the cloth has no single flat pattern; the mesh's vertices stand in for it, whose edges are up to "
            f"{100 * strain:.1f} % off their rest lengths"
        )
    extents = np.linalg.svd(mesh.vertices - mesh.vertices.mean(0), compute_uv=False)
    if extents[2] > PLANE_RELATIVE_TOLERANCE * extents[0]:
        notes.append("the rest shape is not flat: the target may take its folds as rest angles; here they rest flat")
    return mesh.vertices
