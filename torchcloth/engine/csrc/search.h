// Triangles near another layer: near in space, but far along the cloth.
//
// Triangles go by patches of a few neighbours. Two patches of which no triangles are far along the cloth need no look;
// of the others only those are looked at whose boxes are near.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <vector>

#include "rows.h"
#include "team.h"

namespace tc {

constexpr int ROW = pitch_of(3);  // numbers between vertices

using Mask = std::vector<uint32_t>;  // a bit for each triangle
inline bool has(const Mask& mask, int i) { return mask[i / 32] >> (i % 32) & 1; }
inline void set(Mask& mask, int i) { mask[i / 32] |= 1u << (i % 32); }

template <class R>
struct Search {
    int triangles = 0;
    std::vector<int> corner[3];  // [triangles] vertices
    R reach = 0;
    bool everywhere = false;
    std::vector<int> order, starts;    // triangles patch by patch, and where patches begin, [patches + 1]
    std::vector<uint8_t> meet, apart;  // [patches, patches]; [in order, patches] a bit for each triangle of the patch

    void fill(const int* corners, int count, R distance, int patches, const int* sorted, const int* begins,
              const uint8_t* meeting, const uint8_t* distant) {
        triangles = count, reach = distance, everywhere = patches == 0;
        for (int c = 0; c < 3; c++) corner[c].assign(corners + size_t(c) * count, corners + size_t(c + 1) * count);
        if (everywhere) return;
        order.assign(sorted, sorted + count), starts.assign(begins, begins + patches + 1);
        meet.assign(meeting, meeting + size_t(patches) * patches);
        apart.assign(distant, distant + size_t(count) * patches);
    }

    void look(const R* x, Mask& mask, int parts, Team* team) const {
        if (everywhere) {
            for (int t = 0; t < triangles; t++) set(mask, t);
            return;
        }
        std::vector<R> centre[3];
        if (!centres(x, centre)) return;  // not finite: the caller will see that it went wrong
        std::fill(mask.begin(), mask.end(), 0);
        const int patches = int(starts.size()) - 1;
        std::vector<int> sorted(patches);
        std::iota(sorted.begin(), sorted.end(), 0);
        std::vector<R> low[3], high[3];
        std::vector<R> first(patches);
        for (int p = 0; p < patches; p++) first[p] = *std::min_element(centre[0].data() + starts[p], centre[0].data() + starts[p + 1]);
        std::sort(sorted.begin(), sorted.end(), [&](int a, int b) { return first[a] < first[b]; });
        boxes(centre, sorted, low, high);
        const std::vector<Together> together = side_by_side(centre);
        auto search = [&](int part, Mask& found, std::vector<R>& gap) {
            for (int i = part; i < patches; i += parts) {
                const int end = int(std::upper_bound(low[0].begin() + i, low[0].end(), high[0][i] + reach) - low[0].begin());
                std::fill(gap.begin() + i, gap.begin() + end, R(0));
                for (int d = 0; d < 3; d++) {
                    const R near = low[d][i], far = high[d][i], *lows = low[d].data(), *highs = high[d].data();
                    for (int j = i; j < end; j++) {
                        const R between = std::max(R(0), std::max(lows[j] - far, near - highs[j]));
                        gap[j] += between * between;
                    }
                }
                for (int j = i; j < end; j++)
                    if (gap[j] < reach * reach && meet[size_t(sorted[i]) * patches + sorted[j]] && near(together, sorted[i], sorted[j])) {
                        compare(centre, sorted[i], sorted[j], found);
                        compare(centre, sorted[j], sorted[i], found);
                    }
            }
        };
        std::vector<std::vector<R>> gaps(parts, first);  // made here: what throws in a team ends the process
        if (parts == 1) return search(0, mask, gaps[0]);
        std::vector<Mask> found(parts, mask);
        team->run(parts, [&](int m) { search(m, found[m], gaps[m]); });
        for (const Mask& own : found)
            for (size_t w = 0; w < mask.size(); w++) mask[w] |= own[w];
    }

    static constexpr int MOST = 8;  // triangles of a patch: engine/stages.py

  private:
    using Eight = Pack<R, MOST>;
    struct Together {
        Eight at[3];
    };
    std::vector<Together> side_by_side(const std::vector<R>* centre) const {  // smaller patches are filled up with their first
        std::vector<Together> out(starts.size() - 1);
        for (size_t p = 0; p < out.size(); p++)
            for (int d = 0; d < 3; d++)
                for (int k = 0; k < MOST; k++) out[p].at[d].v[k] = centre[d][starts[p] + k < starts[p + 1] ? starts[p] + k : starts[p]];
        return out;
    }
    // Whether there are triangles nearer than the reach, or not quite.
    bool near(const std::vector<Together>& patch, int a, int b) const {
        const Together &own = patch[a], &other = patch[b];
        Eight found(0.0);
        for (int k = 0; k < MOST; k++) {
            Eight sum(0.0);
            for (int d = 0; d < 3; d++) {
                const Eight way = other.at[d] - double(own.at[d][k]);
                sum = sum + way * way;
            }
            found = found + less(sum, 1.0001 * reach * reach);
        }
        return total(found) > 0;
    }
    bool centres(const R* x, std::vector<R>* centre) const {
        R sum = 0;
        for (int d = 0; d < 3; d++) {
            centre[d].resize(triangles);
            for (int k = 0; k < triangles; k++) {
                const int t = order[k];
                const R all = x[size_t(corner[0][t]) * ROW + d] + x[size_t(corner[1][t]) * ROW + d] + x[size_t(corner[2][t]) * ROW + d];
                sum += centre[d][k] = all / 3;
            }
        }
        return std::isfinite(sum);
    }
    void boxes(const std::vector<R>* centre, const std::vector<int>& sorted, std::vector<R>* low, std::vector<R>* high) const {
        for (int d = 0; d < 3; d++)
            for (int p : sorted) {
                const auto [least, most] = std::minmax_element(centre[d].data() + starts[p], centre[d].data() + starts[p + 1]);
                low[d].push_back(*least), high[d].push_back(*most);
            }
    }
    // Marks the triangles of patch a that are near one of patch b, but far along the cloth.
    void compare(const std::vector<R>* centre, int a, int b, Mask& mask) const {
        const R *x = centre[0].data(), *y = centre[1].data(), *z = centre[2].data();
        const size_t patches = starts.size() - 1;
        for (int k = starts[a]; k < starts[a + 1]; k++) {
            unsigned far = apart[k * patches + b];
            if (far == 0 || has(mask, order[k])) continue;
            for (; far != 0; far &= far - 1) {
                const int l = starts[b] + std::countr_zero(far);
                const R dx = x[k] - x[l], dy = y[k] - y[l], dz = z[k] - z[l];
                if (!(dx * dx + dy * dy + dz * dz < reach * reach)) continue;
                set(mask, order[k]);
                break;
            }
        }
    }
};

}  // namespace tc
