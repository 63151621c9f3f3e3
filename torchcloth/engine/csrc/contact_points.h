// Lists of contact points.
#pragma once

#include <vector>

#include "layer_search.h"
#include "pack.h"

namespace tc {

// Points of some triangles: vertices of the corners, triangle, number of the point, number within the triangle.
template <class R>
struct ContactPoints {
    std::vector<int> corner[3], triangle, point, place;
    std::vector<Wide<R>> weight;  // [packs, 3] barycentric coordinates
    int size() const { return int(point.size()); }
    // Lists the points of the first so many triangles whose bit of the mask is as wanted.
    void select(const Mask& mask, bool wanted, const std::vector<int>* corners, int triangles,
                int points_per_triangle) {
        for (auto* v : {&corner[0], &corner[1], &corner[2], &triangle, &point, &place}) v->clear();
        for (int t = 0; t < triangles; t++)
            for (int s = 0; s < points_per_triangle && is_set(mask, t) == wanted; s++) {
                for (int c = 0; c < 3; c++) corner[c].push_back(corners[c][t]);
                triangle.push_back(t), point.push_back(t * points_per_triangle + s), place.push_back(s);
            }
    }
    void set_weights(const std::vector<R>& places) {
        constexpr int L = LANES<R>;
        weight.assign(size_t(size() + L - 1) / L * 3, Wide<R>(0.0));
        for (int p = 0; p < size(); p++)
            for (int c = 0; c < 3; c++) weight[p / L * 3 + c].v[p % L] = places[3 * place[p] + c];
    }
    // Writes the tables of rows in the order of contact_table.
    void export_tables(const int** rows) const {
        for (const auto* v : {&corner[0], &corner[1], &corner[2], &triangle, &point, &place}) *rows++ = v->data();
    }
};

}  // namespace tc
