// Which sample points on the triangles may touch a body in this substep. The others need no work, and change nothing.
#pragma once

#include <algorithm>

#include "program.h"

namespace tc {

// A point of a triangle is no nearer to the body than a corner less the longest edge from it, and none approaches
// faster than the fastest corner. The stage writes a list of points; the reverse sweep runs it again.
template <class R>
struct PointBroadPhase : Stage<R> {
    const Program<R>& program;
    int list;
    int x, approach, dt;  // fields: positions; distances of the vertices to the body and speeds relative to it; substep
    int corners, starts;  // tables: [3, E]; first point of each triangle, [E + 1]
    int triangles;
    R lipschitz;  // of the distance function

    PointBroadPhase(const Program<R>& p, int list, int x, int approach, int dt, int corners, int starts, int triangles,
                    double lipschitz)
        : program(p), list(list), x(x), approach(approach), dt(dt), corners(corners), starts(starts),
          triangles(triangles), lipschitz(R(lipschitz)) {
        this->is_replayed = true;
    }

    void forward(Scene<R>& s) const override {
        if (s.lanes > 1) list_points<Wide<R>>(s);
        else list_points<Pack<R, 1>>(s);
    }
    // Lists the points that may touch the body in any of the scenes in a pack.
    template <class P>
    void list_points(Scene<R>& s) const {
        const int* corner = program.tables[corners].data();
        const int* start = program.tables[starts].data();
        const size_t pitch = program.fields[x].pitch;  // also that of the two numbers of each vertex's approach
        auto packs = [&](int field) { return reinterpret_cast<const P*>(s.value[field]); };
        const P *at = packs(x), *distance = packs(approach), *speed = distance + 1, step = *packs(dt);
        auto squared = [&](size_t a, size_t b) {
            P sum(0.0);
            for (int k = 0; k < 3; k++) sum = sum + (at[a + k] - at[b + k]) * (at[a + k] - at[b + k]);
            return sum;
        };
        thread_local std::vector<int> points;
        points.clear();
        for (int t = 0; t < triangles; t++) {
            const size_t a = corner[t] * pitch, b = corner[t + triangles] * pitch,
                         c = corner[t + 2 * triangles] * pitch;
            const P travel = step * larger(speed[a], larger(speed[b], speed[c]));
            auto is_far = [&](size_t corner, P squared_length) {  // by more than rounding; 1 or 0
                return less((sqrt(squared_length) * lipschitz + travel) * 1.0001 + 1e-6, distance[corner]);
            };
            const P ab = squared(a, b), ac = squared(a, c);
            P far = is_far(a, larger(ab, ac));
            if (is_one(far)) continue;
            const P bc = squared(b, c);
            far = larger(far, larger(is_far(b, larger(ab, bc)), is_far(c, larger(ac, bc))));
            if (is_one(far)) continue;
            for (int point = start[t]; point < start[t + 1]; point++) points.push_back(point);
        }
        spread_over_packs(points, s.point_lists[list]);
    }
    template <int L>
    static bool is_one(Pack<R, L> a) { return total(a) == R(L); }  // in all lanes
    // The points of a pack are far apart in the mesh, so that additions to one vertex need not wait for each other.
    static void spread_over_packs(const std::vector<int>& points, PointList& to) {
        const size_t count = points.size(), packs = (count + LANES<R> - 1) / LANES<R>;
        to.count = int(count);
        to.items.clear();
        for (size_t pack = 0; pack < packs; pack++)
            for (size_t k = pack; k < count; k += packs) to.items.push_back(points[k]);
        to.items.resize(packs * LANES<R>, count ? to.items.back() : 0);
    }
    void tangent(Scene<R>& s) const override { forward(s); }
    void reverse(Scene<R>&) const override {}
};

}  // namespace tc
