// Triangles near another layer: near in space, but far apart along the cloth.
//
// Triangles are grouped into patches of a few neighbours. Two patches without triangles far apart along the cloth need
// no search. Of the others, only patches whose bounding boxes are near each other are compared.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <numeric>
#include <vector>

#include "row_layout.h"
#include "thread_team.h"

namespace tc {

constexpr int VERTEX_PITCH = pitch_of(3);  // numbers between vertices

using Mask = std::vector<uint32_t>;  // a bit for each triangle
inline bool is_set(const Mask& mask, int i) { return mask[i / 32] >> (i % 32) & 1; }
inline void set_bit(Mask& mask, int i) { mask[i / 32] |= 1u << (i % 32); }

template <class R>
struct LayerSearch {
    int triangles = 0;
    std::vector<int> corner[3];  // [triangles] vertices
    R reach = 0;
    bool all_active = false;
    std::vector<int> order, starts;     // triangles patch by patch, and where patches begin, [patches + 1]
    std::vector<uint8_t> may_meet;      // [patches, patches]
    std::vector<uint8_t> non_adjacent;  // [triangles in order, patches] a bit for each triangle of the patch

    void fill(const int* corners, int count, R distance, int patches, const int* sorted, const int* begins,
              const uint8_t* meeting, const uint8_t* distant) {
        triangles = count, reach = distance, all_active = patches == 0;
        for (int c = 0; c < 3; c++) corner[c].assign(corners + size_t(c) * count, corners + size_t(c + 1) * count);
        if (all_active) return;
        order.assign(sorted, sorted + count), starts.assign(begins, begins + patches + 1);
        may_meet.assign(meeting, meeting + size_t(patches) * patches);
        non_adjacent.assign(distant, distant + size_t(count) * patches);
    }

    // Writes the mask of active triangles; leaves it where positions are not finite, which the caller reports.
    void find_active(const R* x, Mask& mask, int parts, ThreadTeam* team) const {
        if (all_active) {
            for (int t = 0; t < triangles; t++) set_bit(mask, t);
            return;
        }
        std::vector<R> centre[3];
        if (!compute_centres(x, centre)) return;
        std::fill(mask.begin(), mask.end(), 0);
        const int patches = int(starts.size()) - 1;
        std::vector<int> sorted(patches);
        std::iota(sorted.begin(), sorted.end(), 0);
        std::vector<R> low[3], high[3];
        std::vector<R> first(patches);
        for (int p = 0; p < patches; p++)
            first[p] = *std::min_element(centre[0].data() + starts[p], centre[0].data() + starts[p + 1]);
        std::sort(sorted.begin(), sorted.end(), [&](int a, int b) { return first[a] < first[b]; });
        compute_boxes(centre, sorted, low, high);
        const std::vector<PatchCentres> patch_centres = group_centres(centre);
        auto search = [&](int part, Mask& active, std::vector<R>& gap) {
            for (int i = part; i < patches; i += parts) {
                const int end =
                    int(std::upper_bound(low[0].begin() + i, low[0].end(), high[0][i] + reach) - low[0].begin());
                std::fill(gap.begin() + i, gap.begin() + end, R(0));
                for (int d = 0; d < 3; d++) {
                    const R lower = low[d][i], upper = high[d][i], *lows = low[d].data(), *highs = high[d].data();
                    for (int j = i; j < end; j++) {
                        const R between = std::max(R(0), std::max(lows[j] - upper, lower - highs[j]));
                        gap[j] += between * between;
                    }
                }
                for (int j = i; j < end; j++)
                    if (gap[j] < reach * reach && may_meet[size_t(sorted[i]) * patches + sorted[j]] &&
                        may_be_near(patch_centres, sorted[i], sorted[j])) {
                        mark_near(centre, sorted[i], sorted[j], active);
                        mark_near(centre, sorted[j], sorted[i], active);
                    }
            }
        };
        // allocated here, because an exception in a team ends the process
        std::vector<std::vector<R>> gaps(parts, first);
        if (parts == 1) return search(0, mask, gaps[0]);
        std::vector<Mask> part_masks(parts, mask);
        team->run(parts, [&](int m) { search(m, part_masks[m], gaps[m]); });
        for (const Mask& part_mask : part_masks)
            for (size_t w = 0; w < mask.size(); w++) mask[w] |= part_mask[w];
    }

  private:
    using PatchPack = Pack<R, PATCH_TRIANGLES>;
    struct PatchCentres {
        PatchPack at[3];
    };
    // The centres of each patch in packs; smaller patches are filled up with their first triangle.
    std::vector<PatchCentres> group_centres(const std::vector<R>* centre) const {
        std::vector<PatchCentres> out(starts.size() - 1);
        for (size_t p = 0; p < out.size(); p++)
            for (int d = 0; d < 3; d++)
                for (int k = 0; k < PATCH_TRIANGLES; k++)
                    out[p].at[d].v[k] = centre[d][starts[p] + k < starts[p + 1] ? starts[p] + k : starts[p]];
        return out;
    }
    // Whether two patches have triangles nearer than the reach, by more than rounding.
    bool may_be_near(const std::vector<PatchCentres>& patch, int a, int b) const {
        const PatchCentres &first = patch[a], &second = patch[b];
        PatchPack near(0.0);
        for (int k = 0; k < PATCH_TRIANGLES; k++) {
            PatchPack sum(0.0);
            for (int d = 0; d < 3; d++) {
                const PatchPack difference = second.at[d] - double(first.at[d][k]);
                sum = sum + difference * difference;
            }
            near = near + less(sum, 1.0001 * reach * reach);
        }
        return total(near) > 0;
    }
    // Computes the triangles' centres in order; returns whether all are finite.
    bool compute_centres(const R* x, std::vector<R>* centre) const {
        R sum = 0;
        for (int d = 0; d < 3; d++) {
            centre[d].resize(triangles);
            for (int k = 0; k < triangles; k++) {
                const int t = order[k];
                auto component = [&](int c) { return x[size_t(corner[c][t]) * VERTEX_PITCH + d]; };
                const R all = component(0) + component(1) + component(2);
                sum += centre[d][k] = all / 3;
            }
        }
        return std::isfinite(sum);
    }
    void compute_boxes(const std::vector<R>* centre, const std::vector<int>& sorted, std::vector<R>* low,
                       std::vector<R>* high) const {
        for (int d = 0; d < 3; d++)
            for (int p : sorted) {
                const R* values = centre[d].data();
                const auto [smallest, largest] = std::minmax_element(values + starts[p], values + starts[p + 1]);
                low[d].push_back(*smallest), high[d].push_back(*largest);
            }
    }
    // Marks the triangles of patch a that are near one of patch b, but far apart along the cloth.
    void mark_near(const std::vector<R>* centre, int a, int b, Mask& mask) const {
        const R *x = centre[0].data(), *y = centre[1].data(), *z = centre[2].data();
        const size_t patches = starts.size() - 1;
        for (int k = starts[a]; k < starts[a + 1]; k++) {
            unsigned far = non_adjacent[k * patches + b];
            if (far == 0 || is_set(mask, order[k])) continue;
            for (; far != 0; far &= far - 1) {
                const int l = starts[b] + std::countr_zero(far);
                const R dx = x[k] - x[l], dy = y[k] - y[l], dz = z[k] - z[l];
                if (!(dx * dx + dy * dy + dz * dz < reach * reach)) continue;
                set_bit(mask, order[k]);
                break;
            }
        }
    }
};

}  // namespace tc
