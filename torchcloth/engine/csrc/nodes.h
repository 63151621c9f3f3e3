// The blocks of nodes that are touched, numbered as they come. Positions may be anywhere: nodes are found by a hash.
// Where several threads share the points, each part of them has blocks of its own: of some there are several copies.
#pragma once

#include <bit>
#include <cmath>
#include <cstdint>
#include <vector>

#include "points.h"
#include "program.h"
#include "transfer.h"

namespace tc {

template <class R>
struct Nodes {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    std::vector<int> around;  // [points, AROUND]
    std::vector<int> above;   // by block, the one whose first two nodes are this one's last two; 0: none; -1: a copy
    std::vector<int> twin;    // by block, the next copy of it, which belongs to a later part but for the first one's; 0: none
    std::vector<bool> lowermost;  // by block: it is above none
    Buffer<P> lowest;         // [packs, 3] where each point's blocks begin, in grid spacings
    int count() const { return int(above.size()); }  // nothing, and blocks in use, and some that nobody touches any more
    // Where the blocks of a part begin; the last part also has what came later.
    int begin(int m) const { return m < int(begins.size()) ? begins[m] : count(); }

    // f(copy) of a block for all of them, in the order of their parts, so that sums do not depend on what came first.
    template <class F>
    void copies(int first, F f) const {
        bool waits = true;
        for (int b = twin[first]; b != 0; b = twin[b]) {
            if (waits && part_of[first] < part_of[b]) f(first), waits = false;
            f(b);
        }
        if (waits) f(first);
    }

    void start(size_t points) { lowest.reset(size_t(round_up(int(points), L)) / L * 3); }

    // Points move from cell to cell seldom: only those that did are looked up, and only packs that may have some.
    void place(const Points<R>& points, const R* x, int vertices, R spacing, bool anew, int parts, Team* team) {
        const int size = points.size(), packs = (size + L - 1) / L;
        if (size == 0) return;
        if (anew || count() > 2 * fresh + 64) {
            forget(size, parts);
            anew = true;
        }
        way += 1.0001 * moved(x, vertices);
        auto check = [&](int part) {
            for (int pack = begin_of(part, parts, packs); pack < begin_of(part + 1, parts, packs); pack++)
                strayed[pack] = anew || way >= until[pack] ? stray(points, pack, x, spacing, anew) : 0;
        };
        if (parts == 1) check(0);
        else team->run(parts, check);
        for (int part = 0; part < parts; part++) {
            if (anew) begins[part] = count();
            for (int pack = begin_of(part, parts, packs); pack < begin_of(part + 1, parts, packs); pack++)
                for (unsigned left = strayed[pack]; left != 0; left &= left - 1) {
                    const int lane = std::countr_zero(left), point = pack * L + lane;
                    const P* low = lowest.data + 3 * pack;
                    look_up(int64_t(low[0][lane]), int64_t(low[1][lane]), int64_t(low[2][lane]), part, &around[size_t(point) * AROUND]);
                }
        }
        if (anew) fresh = count();
    }

  private:
    std::vector<int64_t> key;  // open addressing; -1: free
    std::vector<int> number;
    std::vector<int> part_of;  // by block
    std::vector<int> begins;   // by part
    int fresh = 0;             // blocks when all were last looked up
    Buffer<R> then;            // positions of the vertices at the last call
    double way = 0;            // that they have gone in all
    std::vector<double> until; // by pack: where a point may come to other nodes
    std::vector<unsigned> strayed;  // by pack, a bit for each point that has

    // The longest that a vertex went since the last time, along one of the axes; no point goes farther.
    R moved(const R* x, int vertices) {
        const size_t size = size_t(vertices) * ROW;
        if (then.size != size) then.reset(size);
        const Quad<R>* now = reinterpret_cast<const Quad<R>*>(x);
        Quad<R>*last = reinterpret_cast<Quad<R>*>(then.data), most(0.0);
        for (int v = 0; v < vertices; v++) {
            const Quad<R> step = abs(now[v] - last[v]);
            most = select(less(most, step), step, most), last[v] = now[v];
        }
        return std::max(most[0], std::max(most[1], most[2]));
    }
    // The points of a pack that have come to other nodes, a bit each; notes where they are now.
    unsigned stray(const Points<R>& points, int pack, const R* x, R spacing, bool anew) {
        const int lanes = std::min(L, points.size() - pack * L);
        P low[3], *before = lowest.data + 3 * pack, same(1.0);
        until[pack] = way + find(points, pack * L, x, spacing, low);
        for (int d = 0; d < 3; d++) same = same * (1.0 - abs(less(low[d], before[d]) + less(before[d], low[d])));
        if (!anew && total(same) == L) return 0;
        unsigned found = 0;
        for (int lane = 0; lane < lanes; lane++) found |= unsigned(anew || same[lane] != 1) << lane;
        for (int d = 0; d < 3; d++) before[d] = low[d];
        return found;
    }
    // Where the blocks of a pack's points begin: at the lowest node along x and y, along z at an even one. Returns how far
    // all points are from where that changes, by more than rounding.
    static R find(const Points<R>& points, int first, const R* x, R spacing, P* low) {
        const int last = points.size() - 1;
        P at[3] = {P(0.0), P(0.0), P(0.0)}, room(1.0);
        for (int c = 0; c < 3; c++) {
            P corner[4];
            const int* vertex = points.corner[c].data();
            gather_quads([&](int lane) { return x + size_t(vertex[first + lane < last ? first + lane : last]) * ROW; }, corner);
            for (int d = 0; d < 3; d++) at[d] = at[d] + points.weight[first / L * 3 + c] * corner[d];
        }
        for (int d = 0; d < 3; d++) {
            const double width = d == 2 ? 2 : 1;
            for (int lane = 0; lane < L; lane++) {
                at[d].v[lane] = at[d].v[lane] / spacing - R(0.5);
                low[d].v[lane] = R(width) * std::floor(at[d].v[lane] / R(width));
            }
            const P below = at[d] - low[d], above = width - below;
            room = select(less(below, room), below, room);
            room = select(less(above, room), above, room);
        }
        R least = 1;
        for (int lane = 0; lane < L && first + lane <= last; lane++) least = std::min(least, room[lane]);
        return (least - R(1e-4)) * spacing;
    }
    void forget(int points, int parts) {
        begins.assign(parts, 0);
        strayed.assign(size_t(points + L - 1) / L, 0);
        around.assign(size_t(points) * AROUND, 0);
        key.assign(1024, -1), number.assign(1024, 0);
        above.assign(1, 0), twin.assign(1, 0), part_of.assign(1, 0), lowermost.assign(1, false);
        until.assign(size_t(points + L - 1) / L, 0);
    }
    void look_up(int64_t x, int64_t y, int64_t z, int part, int* out) {
        for (int64_t i = 0; i < 3; i++)
            for (int64_t j = 0; j < 3; j++) *out++ = block(x + i, y + j, z >> 1, part);
    }
    static int64_t key_of(int64_t x, int64_t y, int64_t z) {
        constexpr int64_t bits = (1 << 21) - 1;
        return (x & bits) << 42 | (y & bits) << 21 | (z & bits);
    }
    int block(int64_t x, int64_t y, int64_t z, int part) {
        if (size_t(count()) * 3 > key.size()) grow();
        const size_t at = slot(key_of(x, y, z));
        const int added = count();
        if (key[at] != -1) {
            int one = number[at];
            if (part_of[one] == part) return one;
            while (twin[one] != 0 && part_of[twin[one]] < part) one = twin[one];
            const int next = twin[one];
            if (next != 0 && part_of[next] == part) return next;
            twin[one] = added;
            above.push_back(-1), lowermost.push_back(false), twin.push_back(next), part_of.push_back(part);
            return added;
        } else {
            const int below = number[slot(key_of(x, y, z - 1))], over = number[slot(key_of(x, y, z + 1))];
            if (below) above[below] = added;
            if (over) lowermost[over] = false;
            above.push_back(over), lowermost.push_back(below == 0), twin.push_back(0), part_of.push_back(part);
            key[at] = key_of(x, y, z), number[at] = added;
            return added;
        }
    }
    // Where a key is, or would be; there the number is 0.
    size_t slot(int64_t wanted) const {
        size_t at = (uint64_t(wanted) * 0x9E3779B97F4A7C15ull >> 43) & (key.size() - 1);  // high bits: all of the key tells there
        while (key[at] != -1 && key[at] != wanted) at = (at + 1) & (key.size() - 1);
        return at;
    }
    void grow() {
        std::vector<int64_t> old_key(4 * key.size(), -1);
        std::vector<int> old_number(4 * key.size(), 0);
        old_key.swap(key), old_number.swap(number);
        for (size_t i = 0; i < old_key.size(); i++)
            if (old_key[i] != -1) {
                const size_t at = slot(old_key[i]);
                key[at] = old_key[i], number[at] = old_number[i];
            }
    }
};

}  // namespace tc
