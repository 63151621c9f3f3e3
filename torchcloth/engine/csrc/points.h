// Lists of contact points.
#pragma once

#include <vector>

#include "pack.h"
#include "search.h"

namespace tc {

// Points of some triangles: corners' vertices, triangle, number of the point, number within the triangle.
template <class R>
struct Points {
    std::vector<int> corner[3], triangle, own, place;
    std::vector<Wide<R>> weight;  // [packs, 3] barycentric coordinates
    int size() const { return int(own.size()); }
    void list(const Mask& mask, bool wanted, const std::vector<int>* corners, int triangles, int each) {
        for (auto* v : {&corner[0], &corner[1], &corner[2], &triangle, &own, &place}) v->clear();
        for (int t = 0; t < triangles; t++)
            for (int s = 0; s < each && has(mask, t) == wanted; s++) {
                for (int c = 0; c < 3; c++) corner[c].push_back(corners[c][t]);
                triangle.push_back(t), own.push_back(t * each + s), place.push_back(s);
            }
    }
    void weigh(const std::vector<R>& places) {
        constexpr int L = LANES<R>;
        weight.assign(size_t(size() + L - 1) / L * 3, Wide<R>(0.0));
        for (int p = 0; p < size(); p++)
            for (int c = 0; c < 3; c++) weight[p / L * 3 + c].v[p % L] = places[3 * place[p] + c];
    }
    void show(const int** rows) const {
        for (const auto* v : {&corner[0], &corner[1], &corner[2], &triangle, &own, &place}) *rows++ = v->data();
    }
};

}  // namespace tc
