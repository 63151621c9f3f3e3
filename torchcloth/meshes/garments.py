"""Garments sewn from flat panels, lying on each other in the world's xy plane.

Front up, the body's length along y, centred at the origin. "left" is the side of negative x: left as one looks at the
garment's front. Front and back are cut alike. Material axes: warp along the body's length, in sleeves along the sleeve.
Default measures are those of an adult's medium size.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InvalidInput
from .mesh import Mesh
from .sewing import Curve, Drawing, Kind, Piece, sew

DEFAULT_GARMENT_TRIANGLES = 1500
GARMENT_GAP_M = 0.010  # between front and back


def shirt(
    *,
    length: float = 0.72,
    chest: float = 0.54,
    hem: float = 0.54,
    shoulders: float = 0.46,
    shoulder_drop: float = 0.045,
    neck: float = 0.19,
    neck_depth: float = 0.09,
    armhole: float = 0.24,
    sleeve: float = 0.24,
    sleeve_angle: float = 0.6,
    cuff: float = 0.18,
    triangles: int = DEFAULT_GARMENT_TRIANGLES,
    gap: float = GARMENT_GAP_M,
) -> Mesh:
    """Build a T-shirt; with a longer ``sleeve`` a sweatshirt. Openings: neck, hem, left and right cuff.

    Args:
        length: from the neck's upper edge to the hem [m].
        chest: width under the arms, lying flat [m].
        hem: width at the hem, lying flat [m].
        shoulders: from shoulder to shoulder [m].
        shoulder_drop: of the shoulder below the neck [m].
        neck: width of the neck opening [m].
        neck_depth: depth of the neck opening [m].
        armhole: from the shoulder down to the underarm [m].
        sleeve: along its upper edge, from the shoulder to the cuff [m].
        sleeve_angle: of the sleeve below the horizontal [rad].
        cuff: width of the sleeve's end, lying flat [m].
        triangles: about how many.
        gap: between front and back [m]; seams close it.

    Raises:
        InvalidInput: measures that give no garment.
    """
    _check(locals())
    axis = np.array([np.cos(sleeve_angle), -np.sin(sleeve_angle)])
    neck_point, shoulder = (neck / 2, 0.0), (shoulders / 2, -shoulder_drop)
    underarm, corner = (chest / 2, -shoulder_drop - armhole), (hem / 2, -length)
    cuff_top = shoulder + sleeve * axis
    cuff_low = cuff_top + cuff * np.array([axis[1], -axis[0]])
    inward = (min(shoulders, chest) / 2 - 0.1 * armhole, -shoulder_drop - 0.75 * armhole)
    curves = {
        "hem": _curve("open", (0.0, -length), corner),
        "side": _curve("sewn", corner, underarm),
        "armhole": _curve("joined", underarm, inward, shoulder),
        "shoulder": _curve("sewn", shoulder, neck_point),
        "neck": _curve("open", neck_point, (neck / 2, -neck_depth), (0.0, -neck_depth)),
        "middle": _curve("fold", (0.0, -neck_depth), (0.0, -length)),
        "underarm": _curve("sewn", underarm, cuff_low),
        "cuff": _curve("open", cuff_low, cuff_top),
        "sleeve": _curve("sewn", cuff_top, shoulder),
    }
    pieces = {
        "body": Piece(("hem", "side", "armhole", "shoulder", "neck", "middle")),
        "sleeve": Piece(("underarm", "cuff", "sleeve", "-armhole"), warp=(-axis[0], -axis[1])),
    }
    corners = {
        "shoulder": ("shoulder", 0),
        "neck corner": ("neck", 0),
        "underarm": ("side", -1),
        "hem corner": ("side", 0),
        "cuff top": ("sleeve", 0),
        "cuff bottom": ("underarm", -1),
    }
    return sew(Drawing(curves, pieces, corners), triangles, gap)


def trousers(
    *,
    length: float = 1.04,
    waist: float = 0.40,
    hip: float = 0.53,
    rise: float = 0.28,
    hem: float = 0.21,
    spread: float = 0.05,
    triangles: int = DEFAULT_GARMENT_TRIANGLES,
    gap: float = GARMENT_GAP_M,
) -> Mesh:
    """Build long trousers; with a shorter ``length`` shorts. Openings: waist, left and right hem.

    Args:
        length: from the waist to the hems [m].
        waist: width at the waist, lying flat [m].
        hip: width at the hip, lying flat [m].
        rise: from the waist down to the crotch [m].
        hem: width of a leg's end, lying flat [m].
        spread: how far outward the legs' ends lie from straight down [m].
        triangles: about how many.
        gap: between front and back [m]; seams close it.

    Raises:
        InvalidInput: measures that give no garment.
    """
    _check(locals())
    centre, crotch = hip / 4 + spread, (0.0, -rise)
    inner, outer = (centre - hem / 2, -length), (centre + hem / 2, -length)
    hip_point, waist_point = (hip / 2, -0.8 * rise), (waist / 2, 0.0)
    curves = {
        "crotch": _curve("joined", (0.0, 0.0), crotch),
        "inner leg": _curve("sewn", crotch, (0.3 * inner[0], -rise - 0.2 * (length - rise)), inner),
        "hem": _curve("open", inner, outer),
        "side": _curve("sewn", outer, hip_point, (hip / 2, -0.4 * rise), waist_point),
        "waist": _curve("open", waist_point, (0.0, 0.0)),
    }
    corners = {
        "waist corner": ("waist", 0),
        "hem outside": ("hem", -1),
        "hem inside": ("hem", 0),
    }
    pieces = {"leg": Piece(("crotch", "inner leg", "hem", "side", "waist"))}
    return sew(Drawing(curves, pieces, corners), triangles, gap)


def dress(
    *,
    length: float = 1.05,
    bust: float = 0.47,
    waist: float = 0.39,
    hem: float = 0.78,
    shoulders: float = 0.38,
    shoulder_drop: float = 0.03,
    neck: float = 0.22,
    neck_depth: float = 0.12,
    armhole: float = 0.22,
    waist_height: float = 0.43,
    triangles: int = DEFAULT_GARMENT_TRIANGLES,
    gap: float = GARMENT_GAP_M,
) -> Mesh:
    """Build a sleeveless dress of bodice and flared skirt. Openings: neck, hem, left and right armhole.

    Args:
        length: from the neck's upper edge to the hem [m].
        bust: width under the arms, lying flat [m].
        waist: width at the waist, lying flat [m].
        hem: width at the hem, lying flat [m].
        shoulders: from shoulder to shoulder [m].
        shoulder_drop: of the shoulder below the neck [m].
        neck: width of the neck opening [m].
        neck_depth: depth of the neck opening [m].
        armhole: from the shoulder down to the underarm [m].
        waist_height: from the neck's upper edge down to the waist [m].
        triangles: about how many.
        gap: between front and back [m]; seams close it.

    Raises:
        InvalidInput: measures that give no garment.
    """
    _check(locals())
    neck_point, shoulder = (neck / 2, 0.0), (shoulders / 2, -shoulder_drop)
    underarm, waist_point = (bust / 2, -shoulder_drop - armhole), (waist / 2, -waist_height)
    skirt = length - waist_height
    if not skirt > 0:
        expected = f"a waist_height below the length, {length:g} m"
        raise InvalidInput("skirt", got="no area", expected=expected)
    corner = (hem / 2, -length + hem / 2 * (hem - waist) / 4 / skirt)  # the hem meets the side at a right angle
    inward = (shoulders / 2 - 0.1 * armhole, -shoulder_drop - 0.8 * armhole)
    curves = {
        "hem": _curve("open", (0.0, -length), (hem / 4, -length), corner),
        "skirt side": _curve("sewn", corner, waist_point),
        "waist": _curve("joined", waist_point, (0.0, -waist_height)),
        "skirt middle": _curve("fold", (0.0, -waist_height), (0.0, -length)),
        "bodice side": _curve("sewn", waist_point, underarm),
        "armhole": _curve("open", underarm, inward, shoulder),
        "shoulder": _curve("sewn", shoulder, neck_point),
        "neck": _curve("open", neck_point, (neck / 2, -neck_depth), (0.0, -neck_depth)),
        "bodice middle": _curve("fold", (0.0, -neck_depth), (0.0, -waist_height)),
    }
    pieces = {
        "skirt": Piece(("hem", "skirt side", "waist", "skirt middle")),
        "bodice": Piece(("-waist", "bodice side", "armhole", "shoulder", "neck", "bodice middle")),
    }
    corners = {
        "shoulder": ("shoulder", 0),
        "neck corner": ("neck", 0),
        "underarm": ("bodice side", -1),
        "waist corner": ("waist", 0),
        "hem corner": ("skirt side", 0),
    }
    return sew(Drawing(curves, pieces, corners), triangles, gap)


def _check(measures: dict[str, float]) -> None:
    """Check that every measure is a finite length; ``sew`` checks the drawing."""
    for name, value in measures.items():
        if not np.isfinite(value) or (value <= 0 and name not in ("spread", "sleeve_angle", "shoulder_drop", "gap")):
            raise InvalidInput(name, got=f"{value:g}", expected="a positive, finite number")


def _curve(kind: Kind, *points: ArrayLike) -> Curve:
    """Build a curve: straight through two points; the last three of more are those of a quadratic Bezier curve."""
    p = np.array(points, dtype=float)
    if len(p) > 2:
        t = np.linspace(0.0, 1.0, 65)[1:-1, None]
        bent = (1 - t) ** 2 * p[-3] + 2 * t * (1 - t) * p[-2] + t**2 * p[-1]
        p = np.vstack([p[:-2], bent, p[-1:]])
    return Curve(kind, p)
