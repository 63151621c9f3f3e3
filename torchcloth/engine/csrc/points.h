// Lists of contact points.
#pragma once

#include <vector>

#include "pack.h"
#include "search.h"
#include "team.h"

namespace tc {

// Points of some triangles: corners' vertices, triangle, number of the point, number within the triangle.
template <class R>
struct Points {
    std::vector<int> corner[3], triangle, own, place;
    std::vector<Wide<R>> weight;  // [packs, 3] barycentric coordinates
    int size() const { return int(own.size()); }
    void list(const Mask& mask, bool wanted, const std::vector<int>* corners, int triangles, int each) {
        for (auto* v : {&corner[0], &corner[1], &corner[2], &triangle, &own, &place}) v->clear();
        std::vector<int> found;
        for (int t = 0; t < triangles; t++)
            for (int s = 0; s < each && has(mask, t) == wanted; s++) found.push_back(t * each + s);
        for (int point : scattered(found)) {
            const int t = point / each;
            for (int c = 0; c < 3; c++) corner[c].push_back(corners[c][t]);
            triangle.push_back(t), own.push_back(point), place.push_back(point % each);
        }
    }
    void weigh(const std::vector<R>& places) {
        constexpr int L = LANES<R>;
        weight.assign(size_t(size() + L - 1) / L * 3, Wide<R>(0.0));
        for (int p = 0; p < size(); p++)
            for (int c = 0; c < 3; c++) weight[p / L * 3 + c].v[p % L] = places[3 * place[p] + c];
    }
    // Neighbours in a pack are far apart, so that additions to one node need not wait for each other; neighbouring packs
    // are near each other, for what lies in the cache, and for threads that have some packs each.
    static std::vector<int> scattered(const std::vector<int>& found) {
        constexpr int lanes = LANES<float>, most = 16;
        const int packs = (int(found.size()) + lanes - 1) / lanes, groups = (packs + most - 1) / most;
        std::vector<int> out;
        for (int group = 0; group < groups; group++) {
            const int first = begin_of(group, groups, packs), last = begin_of(group + 1, groups, packs);
            const size_t end = std::min(found.size(), size_t(last) * lanes);
            for (int p = 0; p < last - first; p++)
                for (size_t k = size_t(first) * lanes + p; k < end; k += last - first) out.push_back(found[k]);
        }
        return out;
    }
    void show(const int** rows) const {
        for (const auto* v : {&corner[0], &corner[1], &corner[2], &triangle, &own, &place}) *rows++ = v->data();
    }
};

}  // namespace tc
