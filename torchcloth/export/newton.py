"""Newton's cloth, as a JSON file for ``ModelBuilder.add_cloth_mesh``.

Sources, at Newton 1.8.0: ``eval_triangle`` and ``eval_bending`` in
newton/_src/solvers/semi_implicit/kernels_particle.py; ``evaluate_neo_hookean_membrane_force_hessian`` and
``evaluate_dihedral_angle_based_bending_force_hessian`` in newton/_src/solvers/vbd/particle_vbd_kernels.py. The same
argument means different things to the two solvers:

- Membrane, per area: tri_ke/2 |F|^2 + ka/2 (J - 1 - tri_ke/ka)^2. At rest that is mu = tri_ke and lam = ka - tri_ke.
  SolverSemiImplicit takes ka = tri_ka, SolverVBD ka = tri_ka + tri_ke.
- Hinges: an edge of length L between triangles of area A1 and A2 has w = edge_ke L in SolverVBD. SolverSemiImplicit
  leaves out the division by twice the triangle's area, so that w = edge_ke L (A1 + A2).
- tri_kd: P = tri_kd (F' + J' cof F) in SolverSemiImplicit. It damps rotations, too, so it is set to 0. SolverVBD:
  S = 4 tri_kd E', as of a Kelvin-Voigt membrane.
- edge_kd: moment in proportion to the rate of the angle, as edge_ke to the angle.
- tri_drag (SolverSemiImplicit only): every corner gets -tri_drag A |v_n| v, so a triangle gets three of them, along v
  and not along the normal. tri_lift adds a force in proportion to the angle of attack, which quadratic drag has not.
"""

from __future__ import annotations

import json
from collections.abc import Iterable

import numpy as np

from .hinges import Hinges, find_hinges
from .report import Export, Parameter, describe_direction_spread
from .sheet import Sheet

FORMAT = "torchcloth-newton-cloth"
SOLVERS = ("SolverSemiImplicit", "SolverVBD")
SHOWN = ("density", "tri_ke", "tri_ka", "tri_kd", "tri_drag", "edge_ke", "edge_kd")  # arguments in the table
PARTICLE_RADIUS_OVER_THICKNESS = 0.5
CORNER_COUNT = 3  # of a triangle, each of which gets tri_drag's whole force


def cloth_arguments(sheet: Sheet, hinges: Hinges, solver: str) -> dict[str, float]:
    """Return the arguments of ``add_cloth_mesh`` that describe the fabric to a solver of ``SOLVERS``."""
    is_vbd = solver == "SolverVBD"
    weight = hinges.length if is_vbd else hinges.length * hinges.area
    edge_ke = sheet.bending / float(hinges.rigidity(weight).mean()) if len(hinges.length) else 0.0
    drag = sheet.air_density * sheet.drag_normal / (2 * CORNER_COUNT)
    return {
        "density": sheet.areal_density,
        "tri_ke": sheet.mu,
        "tri_ka": sheet.lam if is_vbd else sheet.lam + sheet.mu,
        "tri_kd": sheet.viscosity / 4 if is_vbd else 0.0,
        "tri_drag": 0.0 if is_vbd else drag,
        "tri_lift": 0.0,
        "edge_ke": edge_ke,
        "edge_kd": edge_ke * sheet.bending_damping,
        "particle_radius": PARTICLE_RADIUS_OVER_THICKNESS * sheet.thickness,
    }


def export_newton(sheet: Sheet) -> Export:
    """Return the sheet as JSON."""
    hinges = find_hinges(sheet.rest, sheet.faces)
    arguments = {solver: cloth_arguments(sheet, hinges, solver) for solver in SOLVERS}
    notes = [*sheet.notes, *_list_losses(sheet)]
    if sheet.bending > 0:
        for solver in SOLVERS:
            weight = hinges.length if solver == "SolverVBD" else hinges.length * hinges.area
            notes.append(f"{solver}: {describe_direction_spread(hinges.rigidity(weight))}")
    parameters = [
        Parameter(f"{solver}: {n}", arguments[solver][n], *_explain(n, solver)) for solver in SOLVERS for n in SHOWN
    ]
    content = {
        "format": FORMAT,
        "version": 1,
        "not_expressed": list(notes),
        "gravity": sheet.gravity.tolist(),
        "vertices": sheet.rest.tolist(),
        "indices": sheet.faces.ravel().tolist(),
        "arguments": arguments,
        "particle_mass": sheet.mass.tolist(),
        "initial_vertices": sheet.initial.tolist(),
        "grasps": {name: index.tolist() for name, index in sheet.grasps.items()},
        "physical": {
            "membrane_stiffness": sheet.membrane_stiffness,
            "poisson_ratio": sheet.poisson_ratio,
            "bending_stiffness": sheet.bending,
            "bending_damping_time": sheet.bending_damping,
            "membrane_viscosity": sheet.viscosity,
            "areal_density": sheet.areal_density,
            "thickness": sheet.thickness,
            "drag_normal": sheet.drag_normal,
            "air_density": sheet.air_density,
        },
    }
    return Export("newton", json.dumps(content, indent=1, allow_nan=False) + "\n", parameters, notes)


def _explain(name: str, solver: str) -> tuple[str, str]:
    """Return unit and meaning of an argument."""
    is_vbd = solver == "SolverVBD"
    return {
        "density": ("kg/m^2", "mass per area"),
        "tri_ke": ("N/m", "shear modulus mu h"),
        "tri_ka": ("N/m", "lambda h of plane stress" if is_vbd else "(lambda + mu) h of plane stress"),
        "tri_kd": ("N s/m", "viscosity / 4" if is_vbd else "0: it damps rotations"),
        "tri_drag": ("kg/m^3", "not used" if is_vbd else "rho C_n / 6"),
        "edge_ke": ("N" if is_vbd else "N/m^2", "bending stiffness of this mesh"),
        "edge_kd": ("N s" if is_vbd else "N s/m^2", "edge_ke times the damping time"),
    }[name]


def _list_losses(sheet: Sheet) -> Iterable[str]:
    yield "the membrane is neo-Hookean: as stiff at rest, softer than the cloth when stretched"
    if sheet.air_density > 0 and sheet.drag_normal > 0:
        yield "SolverVBD has no drag: add forces to state.particle_f"
        yield "SolverSemiImplicit: drag acts along the velocity, not along the normal: right broadside only"
    if sheet.drag_tangential > 0:
        yield f"tangential drag C_t = {sheet.drag_tangential:.3g} is left out"
    if np.abs(sheet.wind).max() > 0:
        yield "wind is left out"
    if sheet.damping_rate > 0:
        yield f"mass damping of {sheet.damping_rate:.3g} 1/s is left out"
    if sheet.viscosity > 0:
        yield "SolverSemiImplicit: viscosity of the membrane is left out, since tri_kd also damps rotations"
    yield "SolverSemiImplicit: torques of a hinge between triangles of different area do not balance"
    yield "SolverVBD steps implicitly, which damps more the longer the step"
