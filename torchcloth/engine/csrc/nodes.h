// The blocks of nodes that are touched, numbered as they come. Positions may be anywhere: nodes are found by a hash.
#pragma once

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
    std::vector<int> above;   // by block, the one whose first two nodes are this one's last two; 0: none
    Buffer<P> lowest;         // [packs, 3] where each point's blocks begin, in grid spacings
    int count() const { return int(above.size()); }  // nothing, and blocks in use, and some that nobody touches any more

    void start(size_t points) { lowest.reset(size_t(round_up(int(points), L)) / L * 3); }

    // Points move from cell to cell seldom: only those that did are looked up, and only packs that may have some.
    void place(const Points<R>& points, const R* x, int vertices, R spacing, bool anew) {
        const int size = points.size();
        if (size == 0) return;
        if (anew || count() > 2 * fresh + 64) {
            forget(size);
            anew = true;
        }
        way += 1.0001 * moved(x, vertices);
        for (int first = 0; first < size; first += L) {
            if (!anew && way < until[first / L]) continue;
            P low[3], *before = lowest.data + first / L * 3, same(1.0);
            until[first / L] = way + find(points, first, x, spacing, low);
            for (int d = 0; d < 3; d++) same = same * (1.0 - abs(less(low[d], before[d]) + less(before[d], low[d])));
            if (!anew && total(same) == L) continue;
            for (int d = 0; d < 3; d++) before[d] = low[d];
            for (int lane = 0; lane < L && first + lane < size; lane++)
                if (anew || same[lane] != 1)
                    look_up(int64_t(low[0][lane]), int64_t(low[1][lane]), int64_t(low[2][lane]), &around[size_t(first + lane) * AROUND]);
        }
        if (anew) fresh = count();
    }

  private:
    std::vector<int64_t> key;  // open addressing; -1: free
    std::vector<int> number;
    int fresh = 0;             // blocks when all were last looked up
    Buffer<R> then;            // positions of the vertices at the last call
    double way = 0;            // that they have gone in all
    std::vector<double> until; // by pack: where a point may come to other nodes

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
    void forget(int points) {
        around.assign(size_t(points) * AROUND, 0);
        key.assign(1024, -1), number.assign(1024, 0);
        above.assign(1, 0);
        until.assign(size_t(points + L - 1) / L, 0);
    }
    void look_up(int64_t x, int64_t y, int64_t z, int* out) {
        for (int64_t i = 0; i < 3; i++)
            for (int64_t j = 0; j < 3; j++) *out++ = block(x + i, y + j, z >> 1);
    }
    static int64_t key_of(int64_t x, int64_t y, int64_t z) {
        constexpr int64_t bits = (1 << 21) - 1;
        return (x & bits) << 42 | (y & bits) << 21 | (z & bits);
    }
    int block(int64_t x, int64_t y, int64_t z) {
        if (size_t(count()) * 3 > key.size()) grow();
        const size_t at = slot(key_of(x, y, z));
        if (key[at] != -1) return number[at];
        const int added = count(), below = number[slot(key_of(x, y, z - 1))];
        above.push_back(number[slot(key_of(x, y, z + 1))]);
        if (below) above[below] = added;
        key[at] = key_of(x, y, z), number[at] = added;
        return added;
    }
    // Where a key is, or would be; there the number is 0.
    size_t slot(int64_t wanted) const {
        size_t at = (uint64_t(wanted) * 0x9E3779B97F4A7C15ull >> 20) & (key.size() - 1);
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
