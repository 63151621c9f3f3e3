// Which points on the triangles may touch a body in this substep: the others need no work, and change nothing.
#pragma once

#include "program.h"

namespace tc {

// Points of a triangle are no nearer to the body than its first corner less the longest way there, and none approaches
// faster than the fastest corner. Writes a list of points; its stage runs again before the reverse sweep.
template <class R>
struct Sieve : Stage<R> {
    const Program<R>& program;
    int list;
    int x, reach, dt;             // fields: positions; distances of the vertices to the body, speeds relative to it; step
    int corners, starts, points;  // tables: [3, E]; where a triangle's points start in `points`, [E + 1]
    int triangles;
    R steep;  // how much the distance may change along a way of length 1

    Sieve(const Program<R>& p, int list, int x, int reach, int dt, int corners, int starts, int points, int triangles,
          double steep)
        : program(p), list(list), x(x), reach(reach), dt(dt), corners(corners), starts(starts), points(points),
          triangles(triangles), steep(R(steep)) {
        this->again = true;
    }

    void forward(Scene<R>& s) const override {
        const int* corner = program.tables[corners].data();
        const int *start = program.tables[starts].data(), *point = program.tables[points].data();
        const size_t pitch = program.fields[x].pitch;  // also of the two numbers of each vertex's reach
        const R *at = s.value[x], *distance = s.value[reach], *speed = distance + 1;
        const R step = s.value[dt][0];
        auto squared = [&](size_t a, size_t b) {
            R sum = 0;
            for (int k = 0; k < 3; k++) sum += (at[a + k] - at[b + k]) * (at[a + k] - at[b + k]);
            return sum;
        };
        std::vector<int>& found = s.lists[list];
        found.clear();
        for (int t = 0; t < triangles; t++) {
            const size_t a = corner[t] * pitch, b = corner[t + triangles] * pitch, c = corner[t + 2 * triangles] * pitch;
            const R way = std::sqrt(std::max(squared(a, b), squared(a, c)));
            const R slack = steep * way + step * std::max(speed[a], std::max(speed[b], speed[c]));
            if (distance[a] > R(1.0001) * slack + R(1e-6)) continue;  // more than rounding
            found.insert(found.end(), point + start[t], point + start[t + 1]);
        }
    }
    void tangent(Scene<R>& s) const override { forward(s); }
    void reverse(Scene<R>&) const override {}
};

}  // namespace tc
