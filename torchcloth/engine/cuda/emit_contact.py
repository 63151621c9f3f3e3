"""Contact between layers as CUDA C++: which triangles take part, the nodes around their points, and what these do.

Every substep lays the nodes out anew. Points are listed by cell, the cube of nodes around them. Each node sums what the
points of its 27 cells add, cell by cell and point by point, so sums do not depend on the order of threads.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ..enums import TRANSFER_SHARES, FieldKind
from .layout import NODES_OF_POINT, Layout
from .program_ir import TRIANGLE_CORNERS, ContactSearch, GridVelocity

POINT_ROW_NUMBERS = TRANSFER_SHARES + 3  # numbers that a point adds to the nodes: its shares, and its offset

SCENE_CONTEXT_MEMBERS = """
    const unsigned char *mask, *before;  // whether a triangle is active: now, in the substep before
    unsigned char* masks;                // of all substeps
    R* reference;                        // positions at the last search
    int step, all;                       // substeps
    bool has_masks, keeps;               // masks exist already; those of all substeps are kept
    bool some, activated;                // whether any triangle is active, any that was not before
    Nodes nodes;
"""
CONTACT_FUNCTIONS = """
#define POINTS {points}
#define TRIANGLES {triangles}
#define EACH {each}
#define ROOM {room}
#define SHIFT {shift}
#define AROUND {around}
#define POINT_ROW {row}

// The nodes of a scene, in a hash table. A cell is named by its lowest node.
struct Nodes {{
    Count* key;                 // [ROOM] of the node; -1: free
    int *count, *start, *cell;  // [ROOM] points of its cell, where they begin in the list, the cell's number
    int* slots;                 // [ROOM] those that are not free
    int *list, *home, *rank;    // [POINTS] points by cell; of a point: its cell's slot, its place there
    int *cells, *around;        // [POINTS] slots by cell; [POINTS, 27] their nodes' slots
    int* totals;                // counts of cells, nodes, points of cells; whether there was no room
}};
FIXED R PLACES[EACH][3] = {{{places}}};

STAGE Count key_of(Count x, Count y, Count z) {{
    const Count bits = (1 << 21) - 1;
    return (x & bits) << 42 | (y & bits) << 21 | (z & bits);
}}
STAGE int slot_of(Count key) {{ return int((unsigned long long)(key) * 0x9E3779B97F4A7C15ull >> SHIFT); }}
STAGE int insert(const Nodes& n, Count key) {{
    volatile int* full = n.totals + 3;  // all later searches would take for ever
    int at = slot_of(key);
    for (int tries = 0; tries < ROOM && !*full; tries++, at = (at + 1) & (ROOM - 1)) {{
        const Count stored = Count(ATOMIC_CAS((unsigned long long*)(n.key + at), ~0ull, (unsigned long long)(key)));
        if (stored == key) return at;
        if (stored != -1) continue;
        const int number = ATOMIC_ADD(n.totals + 1, 1);
        n.slots[number] = at;
        if (number >= ROOM - ROOM / 8) *full = 1;
        return at;
    }}
    return at;
}}
STAGE int find(const Nodes& n, Count key) {{
    int at = slot_of(key);
    for (int tries = 0; tries < ROOM && n.key[at] != -1; tries++, at = (at + 1) & (ROOM - 1))
        if (n.key[at] == key) return at;
    return -1;
}}

// Weights f of the quadratic spline at the three nodes along an axis, the other factors g (slopes of the weights, or
// weights times arms), and the derivatives of both by the offset.
struct Axis {{ R f[3], g[3], f_slope[3], g_slope[3]; }};
STAGE void spline_factors(bool arms, R offset, Axis& a) {{
    const R before = R(1.5) - offset, middle = offset - R(1), after = offset - R(0.5);
    a.f[0] = R(0.5) * before * before, a.f[1] = R(0.75) - middle * middle, a.f[2] = R(0.5) * after * after;
    a.f_slope[0] = -before, a.f_slope[1] = R(-2) * middle, a.f_slope[2] = after;
    for (int i = 0; i < 3; i++) {{
        const R arm = R(i) - offset;
        a.g[i] = arms ? arm * a.f[i] : a.f_slope[i];
        a.g_slope[i] = arms ? arm * a.f_slope[i] - a.f[i] : R(i == 1 ? -2 : 1);
    }}
}}

STAGE void factors(const Axis& x, const Axis& y, const Axis& z, int i, int j, int k, R* b) {{
    b[0] = x.f[i] * y.f[j] * z.f[k], b[1] = x.g[i] * y.f[j] * z.f[k];
    b[2] = x.f[i] * y.g[j] * z.f[k], b[3] = x.f[i] * y.f[j] * z.g[k];
}}

// Grid to particle: adds the sums over a point's nodes to `shares`. With `seeds`, which weigh these sums, it also adds
// the derivative of the weighted sum by the offset to `offset_adjoint`.
STAGE void g2p(const Nodes& n, int point, bool arms, const R* offset, const R* from, R* shares, const R* seeds,
               R* offset_adjoint) {{
    Axis x, y, z;
    spline_factors(arms, offset[0], x), spline_factors(arms, offset[1], y), spline_factors(arms, offset[2], z);
    const int* around = n.around + AROUND * n.cell[n.home[point]];
    for (int q = 0; q < AROUND; q++) {{
        const int i = q / 9, j = q / 3 % 3, k = q % 3;
        const R* node = from + 4 * around[q];
        R b[4];
        factors(x, y, z, i, j, k, b);
        if (shares)
            for (int s = 0; s < 4; s++)
                for (int c = 0; c < 4; c++) shares[4 * s + c] += b[s] * node[c];
        if (!seeds) continue;
        R work[4];
        for (int s = 0; s < 4; s++) {{
            work[s] = R(0);
            for (int c = 0; c < 4; c++) work[s] += seeds[4 * s + c] * node[c];
        }}
        offset_adjoint[0] += y.f[j] * z.f[k] * (x.f_slope[i] * work[0] + x.g_slope[i] * work[1]) +
                   x.f_slope[i] * (y.g[j] * z.f[k] * work[2] + y.f[j] * z.g[k] * work[3]);
        offset_adjoint[1] += x.f[i] * z.f[k] * (y.f_slope[j] * work[0] + y.g_slope[j] * work[2]) +
                   y.f_slope[j] * (x.g[i] * z.f[k] * work[1] + x.f[i] * z.g[k] * work[3]);
        offset_adjoint[2] += x.f[i] * y.f[j] * (z.f_slope[k] * work[0] + z.g_slope[k] * work[3]) +
                   z.f_slope[k] * (x.g[i] * y.f[j] * work[1] + x.f[i] * y.g[j] * work[2]);
    }}
}}

// Particle to grid: each node sums what the points around it add, from rows of 16 shares and the offset.
STAGE void p2g(const Nodes& n, bool arms, const R* rows, R* to, bool begins) {{
    for (int m = T; m < n.totals[1]; m += THREADS) {{
        const int slot = n.slots[m];
        const Count key = n.key[slot], x = key >> 42, y = key >> 21, z = key;
        R sum[4] = {{R(0), R(0), R(0), R(0)}};
        for (int q = 0; q < AROUND; q++) {{
            const int i = q / 9, j = q / 3 % 3, k = q % 3, home = find(n, key_of(x - i, y - j, z - k));
            if (home < 0) continue;
            for (int e = n.start[home], end = e + n.count[home]; e < end; e++) {{
                const R* row = rows + POINT_ROW * n.list[e];
                Axis a, b, c;
                spline_factors(arms, row[16], a), spline_factors(arms, row[17], b), spline_factors(arms, row[18], c);
                R u[4];
                factors(a, b, c, i, j, k, u);
                for (int s = 0; s < 4; s++)
                    for (int d = 0; d < 4; d++) sum[d] += u[s] * row[4 * s + d];
            }}
        }}
        for (int d = 0; d < 4; d++) to[4 * slot + d] = begins ? sum[d] : to[4 * slot + d] + sum[d];
    }}
    SYNC();
}}
"""


class ContactSearchEmitter:
    """Functions of the contact search, and memory for its results.

    Args:
        layout: memory of the program.
        stage: the search.
        first_written: not used; all emitters take it.
    """

    def __init__(self, layout: Layout, stage: ContactSearch, first_written: set[int]) -> None:
        self._layout, self._stage = layout, stage

    def text(self) -> str:
        """Return the functions that loops over points call."""
        places = ", ".join("{" + ", ".join(f"R({w!r})" for w in row) + "}" for row in self._stage.barycentric.tolist())
        slots, points = self._stage.node_slots, self._stage.points
        shift = 64 - (slots.bit_length() - 1)
        numbers = {"points": points, "triangles": self._stage.triangles, "each": len(self._stage.barycentric)}
        numbers |= {"room": slots, "shift": shift, "around": NODES_OF_POINT, "row": POINT_ROW_NUMBERS}
        return CONTACT_FUNCTIONS.format(places=places, **numbers)

    def places(self) -> Iterator[str]:
        """Yield the lines that let ``h.nodes`` point to the scene's part of ``grids``, and that empty it."""
        slots, points = self._stage.node_slots, self._stage.points
        yield f"    int* grid = grids + scene * {self._layout.grid_size};"
        yield "    h.nodes.key = reinterpret_cast<Count*>(grid);"
        at = 2 * slots
        for name, size in (
            *((name, slots) for name in ("count", "start", "cell", "slots")),
            *((name, points) for name in ("list", "home", "rank", "cells")),
            ("around", NODES_OF_POINT * points),
            ("totals", 4),
        ):
            yield f"    h.nodes.{name} = grid + {at};"
            at += size
        yield f"    for (int i = T; i < {slots}; i += THREADS) h.nodes.key[i] = -1, h.nodes.count[i] = 0;"
        yield "    for (int i = T; i < 4; i += THREADS) h.nodes.totals[i] = 0;"
        yield "    SYNC();"

    def forward(self) -> Iterator[str]:
        """Yield the lines that decide which triangles are active, and lay out the nodes."""
        s = self._stage
        yield f"const int* corners = h.tables + {self._layout.add_table(s.corners)};"
        self._layout.reserve(scratch=3 * s.triangles, shared=1)
        yield f"const R* x = h.f{s.x};"
        yield "h.mask = h.masks + Count(h.keeps ? h.step : h.step % 2) * TRIANGLES;"
        yield "h.before = h.step == 0 ? h.mask : h.masks + Count(h.keeps ? h.step - 1 : (h.step - 1) % 2) * TRIANGLES;"
        yield "if (!h.has_masks) {"
        yield "    unsigned char* mask = const_cast<unsigned char*>(h.mask);"
        yield f"    bool moved = h.step % {s.search_interval} == 0;"
        yield f"    if (!moved) for (int i = T; i < {self._layout.fields[s.x].size}; i += THREADS) {{"
        yield "        const R change = x[i] - h.reference[i];"
        yield f"        moved = moved || !(change < R({s.search_skin / 2!r}) && -change < R({s.search_skin / 2!r}));"
        yield "    }"
        yield "    if (any(moved, h.shared)) {"
        yield f"        copy(h.reference, x, {self._layout.fields[s.x].size});"
        yield from (f"        {line}" for line in self._search())
        yield "    } else for (int t = T; t < TRIANGLES; t += THREADS) mask[t] = h.before[t];"
        yield "    SYNC();"
        yield "}"
        yield "bool some = false, activated = false;"
        yield "for (int t = T; t < TRIANGLES; t += THREADS)"
        yield "    some = some || h.mask[t], activated = activated || (h.mask[t] && !h.before[t]);"
        yield "h.some = any(some, h.shared), h.activated = any(activated, h.shared);"
        yield from self._lay_out_nodes()

    def _search(self) -> Iterator[str]:
        """Lines that mark triangles whose centres are near each other, but far apart along the cloth."""
        yield "R* centre = h.scratch;"
        yield "bool diverged = false;"
        yield "for (int t = T; t < TRIANGLES; t += THREADS)"
        yield "    for (int d = 0; d < 3; d++) {"
        at = _at_corners("{}")
        yield f"        centre[3 * t + d] = ({at}) / R(3);"
        yield "        diverged = diverged || !(centre[3 * t + d] - centre[3 * t + d] == R(0));"
        yield "    }"
        yield "if (any(diverged, h.shared)) {  // the caller reports it"
        yield "    for (int t = T; t < TRIANGLES; t += THREADS) mask[t] = 0;"
        yield "} else for (int t = T; t < TRIANGLES; t += THREADS) {"
        if self._stage.non_adjacent is None:
            yield "    mask[t] = 1;"
            yield "}"
            return
        words = -(-self._stage.triangles // 32)
        bits = np.zeros((self._stage.triangles, 32 * words), bool)
        bits[:, : self._stage.triangles] = self._stage.non_adjacent
        table = self._layout.add_table(np.packbits(bits, axis=1, bitorder="little").view(np.int32))
        yield "    const R a = centre[3 * t], b = centre[3 * t + 1], c = centre[3 * t + 2];"
        yield f"    const int* far = h.tables + {table} + t * {words};"
        yield "    bool near = false;"
        yield "    for (int u = 0; u < TRIANGLES && !near; u++) {"
        yield "        const R d = a - centre[3 * u], e = b - centre[3 * u + 1], f = c - centre[3 * u + 2];"
        yield f"        const R squared_reach = R({self._stage.reach!r}) * R({self._stage.reach!r});"
        yield "        near = d * d + e * e + f * f < squared_reach && (far[u >> 5] >> (u & 31) & 1);"
        yield "    }"
        yield "    mask[t] = near;"
        yield "}"

    def _lay_out_nodes(self) -> Iterator[str]:
        s = self._stage
        yield "const Nodes& n = h.nodes;"
        yield "if (n.totals[3]) h.some = h.activated = false;  // no thread changes it before all have waited"
        yield "for (int m = T; m < n.totals[1]; m += THREADS) n.key[n.slots[m]] = -1, n.count[n.slots[m]] = 0;"
        yield "SYNC();"
        yield "if (T == 0) n.totals[0] = n.totals[1] = n.totals[2] = 0;"
        yield "SYNC();"
        yield "if (!h.some) return;"
        yield "for (int p = T; p < POINTS; p += THREADS) {"
        yield "    const int t = p / EACH;"
        yield "    if (!h.mask[t]) continue;"
        yield "    Count low[3];"
        yield "    for (int d = 0; d < 3; d++) {"
        at = _at_corners("PLACES[p % EACH][{k}] * {}")
        yield f"        const R place = floor(({at}) / R({s.spacing!r}) + h.f{s.shift}[d] - R(0.5));"
        yield f"        h.f{s.lowest_node}[3 * p + d] = place, low[d] = Count(place);"
        yield "    }"
        yield "    const int home = insert(n, key_of(low[0], low[1], low[2]));"
        yield "    n.home[p] = home, n.rank[p] = ATOMIC_ADD(n.count + home, 1);"
        yield "    if (n.rank[p] == 0) n.cell[home] = ATOMIC_ADD(n.totals, 1), n.cells[n.cell[home]] = home;"
        yield "}"
        yield "SYNC();"
        yield "for (int m = T; m < n.totals[0]; m += THREADS) {"
        yield "    const int home = n.cells[m];"
        yield "    const Count key = n.key[home], a = key >> 42, b = key >> 21, c = key;"
        yield "    n.start[home] = ATOMIC_ADD(n.totals + 2, n.count[home]);"
        yield f"    for (int q = 0; q < {NODES_OF_POINT}; q++)"
        yield f"        n.around[{NODES_OF_POINT} * m + q] = insert(n, key_of(a + q / 9, b + q / 3 % 3, c + q % 3));"
        yield "}"
        yield "SYNC();"
        yield "if (n.totals[3]) {"
        yield "    h.some = h.activated = false;"
        yield "    return;"
        yield "}"
        yield "for (int p = T; p < POINTS; p += THREADS)"
        yield "    if (h.mask[p / EACH]) n.list[n.start[n.home[p]] + n.rank[p]] = p;"
        yield "SYNC();"
        yield "for (int m = T; m < n.totals[0]; m += THREADS) {  // points in an order that is always the same"
        yield "    int* points = n.list + n.start[n.cells[m]];"
        yield "    for (int i = 1; i < n.count[n.cells[m]]; i++) {"
        yield "        const int point = points[i];"
        yield "        int at = i;"
        yield "        for (; at > 0 && points[at - 1] > point; at--) points[at] = points[at - 1];"
        yield "        points[at] = point;"
        yield "    }"
        yield "}"
        yield "SYNC();"

    def reverse(self) -> Iterator[str]:
        """Yield nothing, because the search has no derivative."""
        return iter(())

    def clear_node_adjoints(self) -> Iterator[str]:
        """Yield the lines that clear the adjoints of the nodes, before the reverse sweep of a substep."""
        fields = [k for k in self._stage.fields if self._layout.fields[k].kind == FieldKind.NODES]
        yield "        for (int m = T; m < 4 * h.nodes.totals[1]; m += THREADS) {"
        yield "            const int at = 4 * h.nodes.slots[m / 4] + m % 4;"
        yield "            " + ", ".join(f"h.g{k}[at] = R(0)" for k in fields) + ";"
        yield "        }"


class GridVelocityEmitter:
    """Functions of the division of momentum by mass on the nodes; ``csrc/grid_momentum_to_velocity.h``.

    Args:
        layout: not used; all emitters take it.
        stage: the division.
        first_written: likewise.
    """

    def __init__(self, layout: Layout, stage: GridVelocity, first_written: set[int]) -> None:
        self._stage = stage

    def _node_loop(self) -> Iterator[str]:
        yield "if (!h.some) return;"
        yield "const Nodes& n = h.nodes;"
        yield "for (int m = T; m < n.totals[1]; m += THREADS) {"
        yield "    const int at = 4 * n.slots[m];"
        yield f"    const R mass = h.f{self._stage.mass}[at];"
        yield f"    const bool counts = R({self._stage.min_mass!r}) < mass;"
        yield "    const R over = R(1) / (counts ? mass : R(1));"

    def forward(self) -> Iterator[str]:
        """Yield the lines for values."""
        momentum, velocity = self._stage.momentum, self._stage.velocity
        yield from self._node_loop()
        yield f"    h.f{velocity}[at] = R(0);"
        yield f"    for (int c = 1; c < 4; c++) h.f{velocity}[at + c] = h.f{momentum}[at + c] * over;"
        yield "}"
        yield "SYNC();"

    def reverse(self) -> Iterator[str]:
        """Yield the lines for adjoints."""
        mass, momentum, velocity = self._stage.mass, self._stage.momentum, self._stage.velocity
        yield from self._node_loop()
        yield "    R work = R(0);"
        yield "    for (int c = 1; c < 4; c++) {"
        yield f"        const R seed = h.g{velocity}[at + c] * over;"
        yield f"        h.g{momentum}[at + c] += seed, work += seed * h.f{velocity}[at + c];"
        yield "    }"
        yield f"    if (counts) h.g{mass}[at] -= work;"
        yield "}"
        yield "SYNC();"


def _at_corners(term: str) -> str:
    """Sum over the corners k of triangle t of what ``term`` makes of component d of their positions."""
    return " + ".join(term.format(f"x[3 * corners[{k} * TRIANGLES + t] + d]", k=k) for k in range(TRIANGLE_CORNERS))
