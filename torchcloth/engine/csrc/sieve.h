// Which points on the triangles may touch a body in this substep: the others need no work, and change nothing.
#pragma once

#include <algorithm>

#include "program.h"

namespace tc {

// Points of a triangle are no nearer to the body than a corner less the longest way there, and none approaches faster
// than the fastest corner. Writes a list of points; its stage runs again before the reverse sweep.
template <class R>
struct Sieve : Stage<R> {
    const Program<R>& program;
    int list;
    int x, reach, dt;             // fields: positions; distances of the vertices to the body, speeds relative to it; step
    int corners, starts;          // tables: [3, E]; first point of each triangle, [E + 1]
    int triangles;
    R steep;  // how much the distance may change along a way of length 1

    Sieve(const Program<R>& p, int list, int x, int reach, int dt, int corners, int starts, int triangles, double steep)
        : program(p), list(list), x(x), reach(reach), dt(dt), corners(corners), starts(starts), triangles(triangles),
          steep(R(steep)) {
        this->again = true;
    }

    void forward(Scene<R>& s) const override {
        const int* corner = program.tables[corners].data();
        const int* start = program.tables[starts].data();
        const size_t pitch = program.fields[x].pitch;  // also of the two numbers of each vertex's reach
        const R *at = s.value[x], *distance = s.value[reach], *speed = distance + 1;
        const R step = s.value[dt][0];
        auto squared = [&](size_t a, size_t b) {
            R sum = 0;
            for (int k = 0; k < 3; k++) sum += (at[a + k] - at[b + k]) * (at[a + k] - at[b + k]);
            return sum;
        };
        thread_local std::vector<int> found;
        found.clear();
        for (int t = 0; t < triangles; t++) {
            const size_t a = corner[t] * pitch, b = corner[t + triangles] * pitch, c = corner[t + 2 * triangles] * pitch;
            const R moved = step * std::max(speed[a], std::max(speed[b], speed[c]));
            auto far = [&](size_t corner, R way) {  // by more than rounding
                return distance[corner] > R(1.0001) * (steep * std::sqrt(way) + moved) + R(1e-6);
            };
            const R ab = squared(a, b), ac = squared(a, c);
            if (far(a, std::max(ab, ac))) continue;
            const R bc = squared(b, c);
            if (far(b, std::max(ab, bc)) || far(c, std::max(ac, bc))) continue;
            for (int point = start[t]; point < start[t + 1]; point++) found.push_back(point);
        }
        scatter(found, s.lists[list]);
    }
    // Those that are side by side in a pack are far apart in the mesh: what they add to vertices need not wait.
    static void scatter(const std::vector<int>& found, List& to) {
        const size_t count = found.size(), packs = (count + LANES<R> - 1) / LANES<R>;
        to.count = int(count);
        to.items.clear();
        for (size_t pack = 0; pack < packs; pack++)
            for (size_t k = pack; k < count; k += packs) to.items.push_back(found[k]);
        to.items.resize(packs * LANES<R>, count ? to.items.back() : 0);
    }
    void tangent(Scene<R>& s) const override { forward(s); }
    void reverse(Scene<R>&) const override {}
};

}  // namespace tc
