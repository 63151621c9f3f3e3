"""The substep of A-EP by the usual material point method, as Warp kernels."""

import warp as wp

from ..cases import CELL_SIZE_M, SUBSTEP_S
from .arrays import GRAVITY_Z_M_PER_S2, law

LAW = law()
MU, LAM, CONTACT, SHEAR, CONE = (wp.constant(wp.float32(value)) for value in LAW)
STEP, WIDTH, INVERSE = (wp.constant(wp.float32(value)) for value in (SUBSTEP_S, CELL_SIZE_M, 1.0 / CELL_SIZE_M))
FALL = wp.constant(wp.vec3(0.0, 0.0, GRAVITY_Z_M_PER_S2 * SUBSTEP_S))


@wp.func
def along_axis(offset: float):
    return wp.vec3(
        0.5 * (1.5 - offset) * (1.5 - offset),
        0.75 - (offset - 1.0) * (offset - 1.0),
        0.5 * (offset - 0.5) * (offset - 0.5),
    )


@wp.func
def slope_along(offset: float):
    return wp.vec3((offset - 1.5) * INVERSE, (2.0 - 2.0 * offset) * INVERSE, (offset - 0.5) * INVERSE)


@wp.func
def lowest(place: wp.vec3):
    return wp.vec3(wp.floor(place[0] - 0.5), wp.floor(place[1] - 0.5), wp.floor(place[2] - 0.5))


@wp.func
def on_node(node: wp.vec4):
    """Compute the velocity from momentum and mass."""
    m = wp.where(node[3] > 0.0, node[3], 1.0)
    return wp.vec3(node[0] / m, node[1] / m, node[2] / m)


@wp.kernel
def forces(
    x: wp.array(dtype=wp.vec3),
    d3: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    frame: wp.array(dtype=wp.vec4),
    area: wp.array(dtype=float),
    youngs: wp.array(dtype=float),
    force: wp.array(dtype=wp.vec3),
    pull: wp.array(dtype=wp.vec3),
):
    """Compute the forces on vertices, and store what the director does through the grid."""
    e = wp.tid()
    t = faces[e]
    g = frame[e]
    x0 = x[t[0]]
    d1 = x[t[1]] - x0
    d2 = x[t[2]] - x0
    f1 = g[0] * d1 + g[1] * d2
    f2 = g[2] * d1 + g[3] * d2
    normal = wp.cross(f1, f2)
    J = wp.length(normal)
    n = normal / J
    mu = MU * youngs[0]
    lam = LAM * youngs[0]
    bend = 2.0 * mu / wp.sqrt(wp.dot(f1, f1) + wp.dot(f2, f2) + 2.0 * J)
    along = 2.0 * mu - bend
    across = lam * (J - 1.0) - bend
    d = d3[e]
    height = wp.dot(n, d)
    gap = wp.max(0.0, 1.0 - height)
    slope = SHEAR * height + CONTACT * gap * gap
    turn = -slope * d
    turn = (turn - wp.dot(turn, n) * n) / J
    p1 = along * f1 + across * wp.cross(f2, n) + wp.cross(f2, turn)
    p2 = along * f2 + across * wp.cross(n, f1) + wp.cross(turn, f1)
    pull[e] = area[e] * (SHEAR * d - slope * n)
    second = -area[e] * (g[0] * p1 + g[2] * p2)
    third = -area[e] * (g[1] * p1 + g[3] * p2)
    wp.atomic_add(force, t[0], -(second + third))
    wp.atomic_add(force, t[1], second)
    wp.atomic_add(force, t[2], third)


@wp.kernel
def vertices_to_grid(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    mass: wp.array(dtype=float),
    force: wp.array(dtype=wp.vec3),
    grid: wp.array3d(dtype=wp.vec4),
):
    p = wp.tid()
    place = x[p] * INVERSE
    base = lowest(place)
    offset = place - base
    wx = along_axis(offset[0])
    wy = along_axis(offset[1])
    wz = along_axis(offset[2])
    m = mass[p]
    spread = (m * WIDTH) * C[p]
    given = m * (v[p] + FALL) + STEP * force[p] - spread @ offset
    for a in range(3):
        for b in range(3):
            for c in range(3):
                weight = wx[a] * wy[b] * wz[c]
                carried = weight * (given + spread @ wp.vec3(float(a), float(b), float(c)))
                node = wp.vec4(carried[0], carried[1], carried[2], weight * m)
                wp.atomic_add(grid, int(base[0]) + a, int(base[1]) + b, int(base[2]) + c, node)


@wp.kernel
def elements_to_grid(
    x: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    C: wp.array(dtype=wp.mat33),
    d3: wp.array(dtype=wp.vec3),
    pull: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    mass: wp.array(dtype=float),
    grid: wp.array3d(dtype=wp.vec4),
):
    e = wp.tid()
    t = faces[e]
    place = (x[t[0]] + x[t[1]] + x[t[2]]) * (INVERSE / 3.0)
    mean = (v[t[0]] + v[t[1]] + v[t[2]]) / 3.0
    base = lowest(place)
    offset = place - base
    wx = along_axis(offset[0])
    wy = along_axis(offset[1])
    wz = along_axis(offset[2])
    dx = slope_along(offset[0])
    dy = slope_along(offset[1])
    dz = slope_along(offset[2])
    m = mass[e]
    spread = (m * WIDTH) * C[e]
    given = m * (mean + FALL) - spread @ offset
    d = d3[e]
    push = STEP * pull[e]
    for a in range(3):
        for b in range(3):
            for c in range(3):
                weight = wx[a] * wy[b] * wz[c]
                slope = dx[a] * wy[b] * wz[c] * d[0] + wx[a] * dy[b] * wz[c] * d[1] + wx[a] * wy[b] * dz[c] * d[2]
                carried = weight * (given + spread @ wp.vec3(float(a), float(b), float(c))) - slope * push
                node = wp.vec4(carried[0], carried[1], carried[2], weight * m)
                wp.atomic_add(grid, int(base[0]) + a, int(base[1]) + b, int(base[2]) + c, node)


@wp.kernel
def grid_to_vertices(
    x: wp.array(dtype=wp.vec3),
    grid: wp.array3d(dtype=wp.vec4),
    gripped: wp.array(dtype=int),
    driven: wp.array(dtype=wp.vec3),
    k: int,
    x_after: wp.array(dtype=wp.vec3),
    v_after: wp.array(dtype=wp.vec3),
    C_after: wp.array(dtype=wp.mat33),
):
    p = wp.tid()
    place = x[p] * INVERSE
    base = lowest(place)
    offset = place - base
    wx = along_axis(offset[0])
    wy = along_axis(offset[1])
    wz = along_axis(offset[2])
    v = wp.vec3()
    C = wp.mat33()
    for a in range(3):
        for b in range(3):
            for c in range(3):
                given = on_node(grid[int(base[0]) + a, int(base[1]) + b, int(base[2]) + c])
                given = wx[a] * wy[b] * wz[c] * given
                v += given
                C += wp.outer(given, wp.vec3(float(a), float(b), float(c)) - offset)
    if gripped[p] == 1:
        v = driven[k]
    C_after[p] = 4.0 * INVERSE * C
    v_after[p] = v
    x_after[p] = x[p] + STEP * v


@wp.kernel
def grid_to_elements(
    x: wp.array(dtype=wp.vec3),
    d3: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    grid: wp.array3d(dtype=wp.vec4),
    x_after: wp.array(dtype=wp.vec3),
    C_after: wp.array(dtype=wp.mat33),
    d3_after: wp.array(dtype=wp.vec3),
):
    """Gather the affine velocity; directors carried along, then mapped back to separation and friction."""
    e = wp.tid()
    t = faces[e]
    place = (x[t[0]] + x[t[1]] + x[t[2]]) * (INVERSE / 3.0)
    base = lowest(place)
    offset = place - base
    wx = along_axis(offset[0])
    wy = along_axis(offset[1])
    wz = along_axis(offset[2])
    dx = slope_along(offset[0])
    dy = slope_along(offset[1])
    dz = slope_along(offset[2])
    d = d3[e]
    C = wp.mat33()
    change = wp.vec3()
    for a in range(3):
        for b in range(3):
            for c in range(3):
                given = on_node(grid[int(base[0]) + a, int(base[1]) + b, int(base[2]) + c])
                slope = dx[a] * wy[b] * wz[c] * d[0] + wx[a] * dy[b] * wz[c] * d[1] + wx[a] * wy[b] * dz[c] * d[2]
                C += wp.outer(wx[a] * wy[b] * wz[c] * given, wp.vec3(float(a), float(b), float(c)) - offset)
                change += slope * given
    C_after[e] = 4.0 * INVERSE * C
    moved = d + STEP * change
    x0 = x_after[t[0]]
    n = wp.normalize(wp.cross(x_after[t[1]] - x0, x_after[t[2]] - x0))
    height = wp.dot(n, moved)
    r = moved - height * n
    gap = wp.max(0.0, 1.0 - height)
    limit = CONE * CONTACT * gap * gap
    squared = SHEAR * SHEAR * wp.dot(r, r)
    mapped = moved
    if height > 1.0:
        mapped = n
    elif squared > limit * limit:
        mapped = limit / wp.sqrt(squared) * r + height * n
    d3_after[e] = mapped


@wp.kernel
def squares(x: wp.array(dtype=wp.vec3), origin: wp.vec3, share: float, loss: wp.array(dtype=float)):
    p = x[wp.tid()] - origin
    wp.atomic_add(loss, 0, share * wp.dot(p, p))


@wp.kernel
def begin_vertices(start: wp.array(dtype=wp.vec3), x: wp.array(dtype=wp.vec3)):
    x[wp.tid()] = start[wp.tid()]


@wp.kernel
def begin_elements(start: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i), d3: wp.array(dtype=wp.vec3)):
    e = wp.tid()
    t = faces[e]
    d3[e] = wp.normalize(wp.cross(start[t[1]] - start[t[0]], start[t[2]] - start[t[0]]))
