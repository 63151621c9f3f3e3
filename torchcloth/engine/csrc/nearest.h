// The place on a triangle of a mesh that is nearest to a point.
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "pack.h"
#include "vec.h"

namespace tc {

template <class R>
struct SurfacePoint {
    R weights[3];  // barycentric coordinates
    R squared;     // distance
};

template <class R>
struct Nearest {
    const R* corners;  // [F, 3, 3]
    int64_t count;
    std::vector<Wide<R>> x, y, z, radius;  // spheres around the triangles
    std::vector<Wide<R>> distance;         // of one point, from their centres

    Nearest(const R* corners, int64_t count) : corners(corners), count(count) {
        constexpr int L = LANES<R>;
        const size_t packs = (count + L - 1) / L;
        for (auto* rows : {&x, &y, &z, &radius, &distance}) rows->resize(packs, Wide<R>(0.0));
        for (int64_t f = 0; f < count; f++) {
            const Vec<R> a = corner(f, 0), b = corner(f, 1), c = corner(f, 2);
            const Vec<R> sum = a + b + c, middle{sum.x / 3, sum.y / 3, sum.z / 3};
            R farthest = 0;
            for (const auto& at : {a, b, c}) farthest = std::max(farthest, dot(at - middle, at - middle));
            x[f / L].v[f % L] = middle.x, y[f / L].v[f % L] = middle.y, z[f / L].v[f % L] = middle.z;
            radius[f / L].v[f % L] = std::sqrt(farthest);
        }
        for (int64_t f = count; f < int64_t(packs) * L; f++)
            radius[f / L].v[f % L] = std::numeric_limits<R>::infinity();
    }

    // The first of the nearest triangles; -1 if the point or the triangles are not finite.
    int64_t find(const R* at, SurfacePoint<R>& result) {
        constexpr int L = LANES<R>;
        const Vec<R> point{at[0], at[1], at[2]};
        Wide<R> least{double(std::numeric_limits<R>::max())};
        for (size_t k = 0; k < x.size(); k++) {
            const Wide<R> dx = x[k] - Wide<R>(point.x), dy = y[k] - Wide<R>(point.y), dz = z[k] - Wide<R>(point.z);
            distance[k] = sqrt(dx * dx + dy * dy + dz * dz);
            const Wide<R> reach = distance[k] + radius[k];
            least = select(less(reach, least), reach, least);
        }
        R bound = least[0];
        for (int i = 1; i < L; i++) bound = std::min(bound, least[i]);
        bound *= 1 + 16 * std::numeric_limits<R>::epsilon();
        int64_t first = -1;
        result.squared = std::numeric_limits<R>::infinity();
        for (int64_t f = 0; f < count; f++) {
            if (!(distance[f / L][f % L] - radius[f / L][f % L] <= bound)) continue;
            const SurfacePoint<R> candidate = on_triangle(point, f);
            if (candidate.squared < result.squared) result = candidate, first = f;
        }
        return first;
    }

    // The nearest place of one triangle: inside, or on one of its edges.
    SurfacePoint<R> on_triangle(Vec<R> point, int64_t f) const {
        const Vec<R> a = corner(f, 0), e1 = corner(f, 1) - a, e2 = corner(f, 2) - a, offset = point - a;
        const Vec<R> normal = cross(e1, e2);
        const R square = dot(normal, normal);
        const R v = dot(cross(offset, e2), normal) / square, w = dot(cross(e1, offset), normal) / square;
        if (1 - v - w >= 0 && v >= 0 && w >= 0) return place(point, f, 1 - v - w, v, w);
        SurfacePoint<R> best{{}, std::numeric_limits<R>::infinity()};
        for (int from = 0; from < 3; from++) {
            const int to = (from + 1) % 3;
            const Vec<R> start = corner(f, from), edge = corner(f, to) - start;
            const R t = std::clamp(dot(point - start, edge) / dot(edge, edge), R(0), R(1));
            R weights[3] = {};
            weights[from] = 1 - t, weights[to] = t;
            const SurfacePoint<R> candidate = place(point, f, weights[0], weights[1], weights[2]);
            if (candidate.squared < best.squared) best = candidate;
        }
        return best;
    }

    SurfacePoint<R> place(Vec<R> point, int64_t f, R a, R b, R c) const {
        const Vec<R> p = corner(f, 0), q = corner(f, 1), r = corner(f, 2);
        const Vec<R> away{point.x - (a * p.x + b * q.x + c * r.x), point.y - (a * p.y + b * q.y + c * r.y),
                          point.z - (a * p.z + b * q.z + c * r.z)};
        return {{a, b, c}, dot(away, away)};
    }
    Vec<R> corner(int64_t f, int k) const {
        const R* p = corners + 9 * f + 3 * k;
        return {p[0], p[1], p[2]};
    }
};

template <class R>
void nearest(const R* points, int64_t many, const R* corners, int64_t count, int64_t* face, R* weights) {
    Nearest<R> search(corners, count);
    for (int64_t k = 0; k < many; k++) {
        SurfacePoint<R> result;
        face[k] = search.find(points + 3 * k, result);
        std::copy(result.weights, result.weights + 3, weights + 3 * k);
    }
}

}  // namespace tc
