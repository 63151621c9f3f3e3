"""Contact between layers as CUDA C++: which triangles take part, the nodes around their points, and what these do.

Every substep lays the nodes out anew. Points are listed by cell, the cube of nodes that they see; each node adds up
what the points of its 27 cells give it, cell by cell and point by point, so sums do not depend on who comes first.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ..fields import Kind
from .program_ir import CORNERS, Layers, PerMass

if TYPE_CHECKING:
    from .codegen import Source

AROUND = 27  # nodes of a point
ROW = 19  # numbers that a point gives: 16 shares, and its offset

HERE = """
    const unsigned char *mask, *before;  // whether a triangle takes part: now, in the substep before
    unsigned char* masks;                // of all substeps
    R* reference;                        // positions at the last search
    int step, all;                       // substeps
    bool knows, keeps;                   // masks are there already; those of all substeps stay
    bool some, woken;                    // whether any take part, any that did not before
    Nodes nodes;
"""
TEXT = """
#define POINTS {points}
#define TRIANGLES {triangles}
#define EACH {each}
#define ROOM {room}
#define SHIFT {shift}
#define AROUND {around}
#define ROW {row}

// The nodes of a scene, by a hash. A cell goes by its lowest node.
struct Nodes {{
    Count* key;                 // [ROOM] of the node; -1: free
    int *count, *start, *cell;  // [ROOM] points of its cell, where they begin in the list, the cell's number
    int* slots;                 // [ROOM] those that are not free
    int *list, *home, *rank;    // [POINTS] points by cell; of a point: its cell's slot, its place there
    int *cells, *around;        // [POINTS] slots by cell; [POINTS, 27] their nodes' slots
    int* totals;                // cells, nodes, points of cells, whether there was no room
}};
FIXED R PLACES[EACH][3] = {{{places}}};

STAGE Count key_of(Count x, Count y, Count z) {{
    const Count bits = (1 << 21) - 1;
    return (x & bits) << 42 | (y & bits) << 21 | (z & bits);
}}
STAGE int slot_of(Count key) {{ return int((unsigned long long)(key) * 0x9E3779B97F4A7C15ull >> SHIFT); }}
STAGE int insert(const Nodes& n, Count key) {{
    volatile int* full = n.totals + 3;  // then all that follows would take for ever
    int at = slot_of(key);
    for (int tries = 0; tries < ROOM && !*full; tries++, at = (at + 1) & (ROOM - 1)) {{
        const Count there = Count(ATOMIC_CAS((unsigned long long*)(n.key + at), ~0ull, (unsigned long long)(key)));
        if (there == key) return at;
        if (there != -1) continue;
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

// Weights f of the quadratic spline at the three nodes along an axis, other factors g, and the slopes of both.
struct Axis {{ R f[3], g[3], f_slope[3], g_slope[3]; }};
STAGE void see(bool arms, R offset, Axis& a) {{
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

// What a point collects of the nodes, added to `share`; with `given`, also what its offset does to the work of what is
// given on them, added to `turn`.
STAGE void look(const Nodes& n, int point, bool arms, const R* offset, const R* from, R* share, const R* given,
                R* turn) {{
    Axis x, y, z;
    see(arms, offset[0], x), see(arms, offset[1], y), see(arms, offset[2], z);
    const int* around = n.around + AROUND * n.cell[n.home[point]];
    for (int q = 0; q < AROUND; q++) {{
        const int i = q / 9, j = q / 3 % 3, k = q % 3;
        const R* node = from + 4 * around[q];
        R b[4];
        factors(x, y, z, i, j, k, b);
        if (share)
            for (int s = 0; s < 4; s++)
                for (int c = 0; c < 4; c++) share[4 * s + c] += b[s] * node[c];
        if (!given) continue;
        R work[4];
        for (int s = 0; s < 4; s++) {{
            work[s] = R(0);
            for (int c = 0; c < 4; c++) work[s] += given[4 * s + c] * node[c];
        }}
        turn[0] += y.f[j] * z.f[k] * (x.f_slope[i] * work[0] + x.g_slope[i] * work[1]) +
                   x.f_slope[i] * (y.g[j] * z.f[k] * work[2] + y.f[j] * z.g[k] * work[3]);
        turn[1] += x.f[i] * z.f[k] * (y.f_slope[j] * work[0] + y.g_slope[j] * work[2]) +
                   y.f_slope[j] * (x.g[i] * z.f[k] * work[1] + x.f[i] * z.g[k] * work[3]);
        turn[2] += x.f[i] * y.f[j] * (z.f_slope[k] * work[0] + z.g_slope[k] * work[3]) +
                   z.f_slope[k] * (x.g[i] * y.f[j] * work[1] + x.f[i] * y.g[j] * work[2]);
    }}
}}

// What points give to the nodes, by rows of 16 shares and the offset, which lie in `given`.
STAGE void gather(const Nodes& n, bool arms, const R* given, R* to, bool begins) {{
    for (int m = T; m < n.totals[1]; m += THREADS) {{
        const int slot = n.slots[m];
        const Count key = n.key[slot], x = key >> 42, y = key >> 21, z = key;
        R sum[4] = {{R(0), R(0), R(0), R(0)}};
        for (int q = 0; q < AROUND; q++) {{
            const int i = q / 9, j = q / 3 % 3, k = q % 3, home = find(n, key_of(x - i, y - j, z - k));
            if (home < 0) continue;
            for (int e = n.start[home], end = e + n.count[home]; e < end; e++) {{
                const R* own = given + ROW * n.list[e];
                Axis a, b, c;
                see(arms, own[16], a), see(arms, own[17], b), see(arms, own[18], c);
                R u[4];
                factors(a, b, c, i, j, k, u);
                for (int s = 0; s < 4; s++)
                    for (int d = 0; d < 4; d++) sum[d] += u[s] * own[4 * s + d];
            }}
        }}
        for (int d = 0; d < 4; d++) to[4 * slot + d] = begins ? sum[d] : to[4 * slot + d] + sum[d];
    }}
    SYNC();
}}
"""


class OfLayers:
    """Functions of the search, and memory for what it finds."""

    def __init__(self, source: Source, stage: Layers, begins: set[int]) -> None:
        self._source, self._stage = source, stage

    def text(self) -> str:
        """What loops over points call."""
        places = ", ".join("{" + ", ".join(f"R({w!r})" for w in row) + "}" for row in self._stage.places.tolist())
        room, points = self._stage.room, self._stage.points
        shift = 64 - (room.bit_length() - 1)
        numbers = {"points": points, "triangles": self._stage.triangles, "each": len(self._stage.places)}
        return TEXT.format(places=places, room=room, shift=shift, around=AROUND, row=ROW, **numbers)

    @property
    def memory(self) -> int:
        """Integers of a scene, of 32 bits."""
        size = 6 * self._stage.room + (4 + AROUND) * self._stage.points + 4
        return size + size % 2  # each scene's begins with one of 64

    def places(self) -> Iterator[str]:
        """Where all of it lies in ``h.nodes``, which begins at ``grids``."""
        room, points = self._stage.room, self._stage.points
        yield f"    int* grid = grids + scene * {self.memory};"
        yield "    h.nodes.key = reinterpret_cast<Count*>(grid);"
        at = 2 * room
        for name, size in (
            *((name, room) for name in ("count", "start", "cell", "slots")),
            *((name, points) for name in ("list", "home", "rank", "cells")),
            ("around", AROUND * points),
            ("totals", 4),
        ):
            yield f"    h.nodes.{name} = grid + {at};"
            at += size
        yield f"    for (int i = T; i < {room}; i += THREADS) h.nodes.key[i] = -1, h.nodes.count[i] = 0;"
        yield "    for (int i = T; i < 4; i += THREADS) h.nodes.totals[i] = 0;"
        yield "    SYNC();"

    def forward(self) -> Iterator[str]:
        """Decide, and lay out the nodes."""
        s = self._stage
        yield f"const int* corners = h.tables + {self._source.own_table(s.corners)};"
        self._source.need(scratch=3 * s.triangles, shared=1)
        yield f"const R* x = h.f{s.x};"
        yield "h.mask = h.masks + Count(h.keeps ? h.step : h.step % 2) * TRIANGLES;"
        yield "h.before = h.step == 0 ? h.mask : h.masks + Count(h.keeps ? h.step - 1 : (h.step - 1) % 2) * TRIANGLES;"
        yield "if (!h.knows) {"
        yield "    unsigned char* mask = const_cast<unsigned char*>(h.mask);"
        yield f"    bool moved = h.step % {s.chunk} == 0;"
        yield f"    if (!moved) for (int i = T; i < {self._source.of.fields[s.x].size}; i += THREADS) {{"
        yield "        const R way = x[i] - h.reference[i];"
        yield f"        moved = moved || !(way < R({s.skin / 2!r}) && -way < R({s.skin / 2!r}));"
        yield "    }"
        yield "    if (any(moved, h.shared)) {"
        yield f"        copy(h.reference, x, {self._source.of.fields[s.x].size});"
        yield from (f"        {line}" for line in self._searched())
        yield "    } else for (int t = T; t < TRIANGLES; t += THREADS) mask[t] = h.before[t];"
        yield "    SYNC();"
        yield "}"
        yield "bool some = false, woken = false;"
        yield "for (int t = T; t < TRIANGLES; t += THREADS)"
        yield "    some = some || h.mask[t], woken = woken || (h.mask[t] && !h.before[t]);"
        yield "h.some = any(some, h.shared), h.woken = any(woken, h.shared);"
        yield from self._laid_out()

    def _searched(self) -> Iterator[str]:
        """Triangles far from each other along the cloth whose centres are near."""
        yield "R* centre = h.scratch;"
        yield "bool lost = false;"
        yield "for (int t = T; t < TRIANGLES; t += THREADS)"
        yield "    for (int d = 0; d < 3; d++) {"
        at = _at_corners("{}")
        yield f"        centre[3 * t + d] = ({at}) / R(3);"
        yield "        lost = lost || !(centre[3 * t + d] - centre[3 * t + d] == R(0));"
        yield "    }"
        yield "if (any(lost, h.shared)) {  // who called will see that it went wrong"
        yield "    for (int t = T; t < TRIANGLES; t += THREADS) mask[t] = 0;"
        yield "} else for (int t = T; t < TRIANGLES; t += THREADS) {"
        if self._stage.apart is None:
            yield "    mask[t] = 1;"
            yield "}"
            return
        words = -(-self._stage.triangles // 32)
        bits = np.zeros((self._stage.triangles, 32 * words), bool)
        bits[:, : self._stage.triangles] = self._stage.apart
        apart = self._source.own_table(np.packbits(bits, axis=1, bitorder="little").view(np.int32))
        yield "    const R a = centre[3 * t], b = centre[3 * t + 1], c = centre[3 * t + 2];"
        yield f"    const int* far = h.tables + {apart} + t * {words};"
        yield "    bool near = false;"
        yield "    for (int u = 0; u < TRIANGLES && !near; u++) {"
        yield "        const R d = a - centre[3 * u], e = b - centre[3 * u + 1], f = c - centre[3 * u + 2];"
        yield f"        const R least = R({self._stage.reach!r}) * R({self._stage.reach!r});"
        yield "        near = d * d + e * e + f * f < least && (far[u >> 5] >> (u & 31) & 1);"
        yield "    }"
        yield "    mask[t] = near;"
        yield "}"

    def _laid_out(self) -> Iterator[str]:
        s = self._stage
        yield "const Nodes& n = h.nodes;"
        yield "if (n.totals[3]) h.some = h.woken = false;  // nobody changes that before all have waited"
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
        yield f"        const R place = floor(({at}) / R({s.spacing!r}) - R(0.5));"
        yield f"        h.f{s.base}[3 * p + d] = place, low[d] = Count(place);"
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
        yield f"    for (int q = 0; q < {AROUND}; q++)"
        yield f"        n.around[{AROUND} * m + q] = insert(n, key_of(a + q / 9, b + q / 3 % 3, c + q % 3));"
        yield "}"
        yield "SYNC();"
        yield "if (n.totals[3]) {"
        yield "    h.some = h.woken = false;"
        yield "    return;"
        yield "}"
        yield "for (int p = T; p < POINTS; p += THREADS)"
        yield "    if (h.mask[p / EACH]) n.list[n.start[n.home[p]] + n.rank[p]] = p;"
        yield "SYNC();"
        yield "for (int m = T; m < n.totals[0]; m += THREADS) {  // in an order that is always the same"
        yield "    int* own = n.list + n.start[n.cells[m]];"
        yield "    for (int i = 1; i < n.count[n.cells[m]]; i++) {"
        yield "        const int point = own[i];"
        yield "        int at = i;"
        yield "        for (; at > 0 && own[at - 1] > point; at--) own[at] = own[at - 1];"
        yield "        own[at] = point;"
        yield "    }"
        yield "}"
        yield "SYNC();"

    def reverse(self) -> Iterator[str]:
        """It has no derivative."""
        return iter(())

    def cleared(self) -> Iterator[str]:
        """Adjoints of the nodes, before a substep goes back."""
        fields = [k for k in self._stage.fields if self._source.of.fields[k].kind == Kind.NODES]
        yield "        for (int m = T; m < 4 * h.nodes.totals[1]; m += THREADS) {"
        yield "            const int at = 4 * h.nodes.slots[m / 4] + m % 4;"
        yield "            " + ", ".join(f"h.g{k}[at] = R(0)" for k in fields) + ";"
        yield "        }"


class OfPerMass:
    """Functions of a division on the nodes; csrc/per_mass.h."""

    def __init__(self, source: Source, stage: PerMass, begins: set[int]) -> None:
        self._stage = stage

    def _each(self) -> Iterator[str]:
        yield "if (!h.some) return;"
        yield "const Nodes& n = h.nodes;"
        yield "for (int m = T; m < n.totals[1]; m += THREADS) {"
        yield "    const int at = 4 * n.slots[m];"
        yield f"    const R mass = h.f{self._stage.mass}[at];"
        yield f"    const bool counts = R({self._stage.least!r}) < mass;"
        yield "    const R over = R(1) / (counts ? mass : R(1));"

    def forward(self) -> Iterator[str]:
        """Values."""
        given, out = self._stage.given, self._stage.out
        yield from self._each()
        yield f"    h.f{out}[at] = R(0);"
        yield f"    for (int c = 1; c < 4; c++) h.f{out}[at + c] = h.f{given}[at + c] * over;"
        yield "}"
        yield "SYNC();"

    def reverse(self) -> Iterator[str]:
        """Adjoints."""
        mass, given, out = self._stage.mass, self._stage.given, self._stage.out
        yield from self._each()
        yield "    R work = R(0);"
        yield "    for (int c = 1; c < 4; c++) {"
        yield f"        const R seed = h.g{out}[at + c] * over;"
        yield f"        h.g{given}[at + c] += seed, work += seed * h.f{out}[at + c];"
        yield "    }"
        yield f"    if (counts) h.g{mass}[at] -= work;"
        yield "}"
        yield "SYNC();"


def _at_corners(term: str) -> str:
    """Sum over the corners k of triangle t of what ``term`` makes of component d of their positions."""
    return " + ".join(term.format(f"x[3 * corners[{k} * TRIANGLES + t] + d]", k=k) for k in range(CORNERS))
