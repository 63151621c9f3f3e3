// The nodes of the grid that are touched, numbered as they come. The grid wraps around: transfer/reference.py.
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
    std::vector<int> around;  // [packs, AROUND, L] nodes of each point
    Buffer<R> lowest;         // [points, ROW] the lowest of them, in grid spacings
    int count = 1;            // NOBODY, nodes in use, and some that nobody touches any more

    void start(size_t points) { lowest.reset(size_t(round_up(int(points), L)) * ROW); }

    // Points move from cell to cell seldom: only those that did are looked up.
    void place(const Points<R>& points, const R* x, R spacing, int wrap, bool anew) {
        const int size = points.size();
        if (anew || count > 2 * fresh + 64) {
            forget(size);
            anew = true;
        }
        for (int first = 0; first < size; first += L) {
            P low[4], before[4];
            find(points, first, x, spacing, low);
            R* rows = lowest.data + size_t(first) * ROW;
            gather_quads([&](int lane) { return rows + lane * ROW; }, before);
            P same(1.0);
            for (int d = 0; d < 3; d++) same = same * (1.0 - abs(less(low[d], before[d]) + less(before[d], low[d])));
            if (!anew && total(same) == L) continue;
            for (int lane = 0; lane < L && first + lane < size; lane++) {
                if (!anew && same[lane] == 1) continue;
                const int64_t cell[3] = {int64_t(low[0][lane]), int64_t(low[1][lane]), int64_t(low[2][lane])};
                for (int d = 0; d < 3; d++) rows[lane * ROW + d] = low[d][lane];
                look_up(cell, wrap, around.data() + size_t(first) * AROUND + lane);
            }
        }
        if (anew) fresh = count;
    }

  private:
    std::vector<int64_t> key;  // open addressing; -1: free
    std::vector<int> number;
    int fresh = 0;             // nodes when all were last looked up

    // The lowest node of the points of a pack.
    static void find(const Points<R>& points, int first, const R* x, R spacing, P* low) {
        const int last = points.size() - 1;
        low[0] = low[1] = low[2] = low[3] = P(0.0);
        for (int c = 0; c < 3; c++) {
            P corner[4];
            const int* vertex = points.corner[c].data();
            gather_quads([&](int lane) { return x + size_t(vertex[first + lane < last ? first + lane : last]) * ROW; }, corner);
            for (int d = 0; d < 3; d++) low[d] = low[d] + points.weight[first / L * 3 + c] * corner[d];
        }
        for (int d = 0; d < 3; d++)
            for (int lane = 0; lane < L; lane++) low[d].v[lane] = std::floor(low[d].v[lane] / spacing - R(0.5));
    }
    void forget(int points) {
        around.assign(size_t(round_up(points, L)) * AROUND, NOBODY);
        key.assign(1024, -1), number.assign(1024, 0);
        count = NOBODY + 1;
    }
    void look_up(const int64_t* cell, int wrap, int* out) {
        int64_t axis[3][3];
        for (int d = 0; d < 3; d++)
            for (int i = 0; i < 3; i++) axis[d][i] = ((cell[d] + i) % wrap + wrap) % wrap;
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++)
                for (int k = 0; k < 3; k++) {
                    *out = node((axis[0][i] * wrap + axis[1][j]) * wrap + axis[2][k]);
                    out += L;
                }
    }
    int node(int64_t wanted) {
        if (size_t(count) * 3 > key.size()) grow();
        const size_t at = slot(wanted);
        if (key[at] != wanted) key[at] = wanted, number[at] = count++;
        return number[at];
    }
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
