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

    // Points move from cell to cell seldom: only those that did are looked up.
    void place(const Points<R>& points, const R* x, R spacing, bool anew) {
        const int size = points.size();
        if (anew || count() > 2 * fresh + 64) {
            forget(size);
            anew = true;
        }
        for (int first = 0; first < size; first += L) {
            P low[3], *before = lowest.data + first / L * 3, same(1.0);
            find(points, first, x, spacing, low);
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

    // Where the blocks of a pack's points begin: at the lowest node along x and y, along z at an even one.
    static void find(const Points<R>& points, int first, const R* x, R spacing, P* low) {
        const int last = points.size() - 1;
        low[0] = low[1] = low[2] = P(0.0);
        for (int c = 0; c < 3; c++) {
            P corner[4];
            const int* vertex = points.corner[c].data();
            gather_quads([&](int lane) { return x + size_t(vertex[first + lane < last ? first + lane : last]) * ROW; }, corner);
            for (int d = 0; d < 3; d++) low[d] = low[d] + points.weight[first / L * 3 + c] * corner[d];
        }
        for (int d = 0; d < 3; d++)
            for (int lane = 0; lane < L; lane++) low[d].v[lane] = std::floor(low[d].v[lane] / spacing - R(0.5));
        for (int lane = 0; lane < L; lane++) low[2].v[lane] = 2 * std::floor(low[2].v[lane] / 2);
    }
    void forget(int points) {
        around.assign(size_t(points) * AROUND, 0);
        key.assign(1024, -1), number.assign(1024, 0);
        above.assign(1, 0);
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
