// transfer.h with its tangents: a point after the other, and of a block what each direction does to it, one after the
// other; four at a time, whose numbers stay in registers.
#pragma once

#include "transfer.h"

namespace tc {

template <class R, By BY, int N>
struct TransferAlong {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    using B = Block<R>;
    using D = Along<R, N>;
    const int* around;  // [L, AROUND]
    int lanes;

    void spread(const P* offset, const D* offset_dot, const P* share, const D* share_dot, R* grid, R* grid_dot) const {
        const Sight<R, BY, 4> sight(offset);
        B shares[L];
        to_lanes<R>(share, shares);
        for (int lane = 0; lane < lanes; lane++) {
            const B f = sight.z(0, lane), g = sight.z(1, lane), f_slope = sight.z(2, lane), g_slope = sight.z(3, lane);
            const B own = shares[lane], s0 = part<0>(own), s1 = part<1>(own), s2 = part<2>(own), s3 = part<3>(own);
            const B a = f * s0 + g * s3, b = f * s1, c = f * s2;
            const B a_slope = f_slope * s0 + g_slope * s3, b_slope = f_slope * s1, c_slope = f_slope * s2;
            const R *way_x = way(offset_dot, 0, lane), *way_y = way(offset_dot, 1, lane), *way_z = way(offset_dot, 2, lane);
            const int* block = around + lane * AROUND;
            for (int q = 0; q < N; q += 4) {
                B moved[4], ad[4], bd[4], cd[4];
                each_way(share_dot + lane, q, moved);
                for (int d = 0; d < 4; d++) {
                    const B z = alike(way_z[q + d]);
                    ad[d] = f * part<0>(moved[d]) + g * part<3>(moved[d]) + z * a_slope;
                    bd[d] = f * part<1>(moved[d]) + z * b_slope, cd[d] = f * part<2>(moved[d]) + z * c_slope;
                }
                for (int i = 0; i < 3; i++) {
                    const Factors<R> x = sight.x(i, lane);
                    const B u = alike(x.f) * a + alike(x.g) * b, v = alike(x.f) * c;
                    const B u_slope = alike(x.f_slope) * a + alike(x.g_slope) * b, v_slope = alike(x.f_slope) * c;
                    B ud[4], vd[4];
                    for (int d = 0; d < 4; d++) {
                        ud[d] = alike(x.f) * ad[d] + alike(x.g) * bd[d] + alike(way_x[q + d]) * u_slope;
                        vd[d] = alike(x.f) * cd[d] + alike(way_x[q + d]) * v_slope;
                    }
                    for (int j = 0; j < 3; j++) {
                        const Factors<R> y = sight.y(j, lane);
                        const B slope = alike(y.f_slope) * u + alike(y.g_slope) * v;
                        const size_t number = block[3 * i + j];
                        B &at = reinterpret_cast<B*>(grid)[number], *along = reinterpret_cast<B*>(grid_dot) + number * N + q;
                        if (q == 0) at = at + alike(y.f) * u + alike(y.g) * v;
                        for (int d = 0; d < 4; d++)
                            along[d] = along[d] + alike(y.f) * ud[d] + alike(y.g) * vd[d] + alike(way_y[q + d]) * slope;
                    }
                }
            }
        }
        is_written(grid), is_written(grid_dot);
    }

    void collect(const P* offset, const D* offset_dot, P* share, D* share_dot, const R* grid, const R* grid_dot) const {
        constexpr bool g_is_slope = BY == By::slopes;  // of f: some sums are then others
        const Sight<R, BY, 4> sight(offset);
        B shares[L];
        for (int lane = 0; lane < lanes; lane++) {
            B a(0.0), b(0.0), c(0.0), ax(0.0), bx(0.0), cx(0.0), ay(0.0), by(0.0), cy(0.0);
            const int* block = around + lane * AROUND;
            for (int i = 0; i < 3; i++) {
                B u(0.0), v(0.0), uy(0.0), vy(0.0);
                for (int j = 0; j < 3; j++) {
                    const Factors<R> y = sight.y(j, lane);
                    const B& at = reinterpret_cast<const B*>(grid)[block[3 * i + j]];
                    u = u + alike(y.f) * at, v = v + alike(y.g) * at, vy = vy + alike(y.g_slope) * at;
                    if (!g_is_slope) uy = uy + alike(y.f_slope) * at;
                }
                const Factors<R> x = sight.x(i, lane);
                a = a + alike(x.f) * u, b = b + alike(x.g) * u, c = c + alike(x.f) * v;
                bx = bx + alike(x.g_slope) * u, cx = cx + alike(x.f_slope) * v, cy = cy + alike(x.f) * vy;
                if (!g_is_slope) ax = ax + alike(x.f_slope) * u, ay = ay + alike(x.f) * uy, by = by + alike(x.g) * uy;
            }
            if (g_is_slope) ax = b, ay = c, by = cx;
            const B f = sight.z(0, lane), g = sight.z(1, lane), f_slope = sight.z(2, lane), g_slope = sight.z(3, lane);
            shares[lane] = summed(f * a, f * b, f * c, g * a);
            const B by_x = summed(f * ax, f * bx, f * cx, g * ax), by_y = summed(f * ay, f * by, f * cy, g * ay);
            const B by_z = summed(f_slope * a, f_slope * b, f_slope * c, g_slope * a);
            const R *way_x = way(offset_dot, 0, lane), *way_y = way(offset_dot, 1, lane), *way_z = way(offset_dot, 2, lane);
            for (int q = 0; q < N; q += 4) {
                B ad[4], bd[4], cd[4];
                for (int d = 0; d < 4; d++) ad[d] = bd[d] = cd[d] = B(0.0);
                for (int i = 0; i < 3; i++) {
                    B ud[4], vd[4];
                    for (int d = 0; d < 4; d++) ud[d] = vd[d] = B(0.0);
                    for (int j = 0; j < 3; j++) {
                        const Factors<R> y = sight.y(j, lane);
                        const B* along = reinterpret_cast<const B*>(grid_dot) + size_t(block[3 * i + j]) * N + q;
                        for (int d = 0; d < 4; d++) ud[d] = ud[d] + alike(y.f) * along[d], vd[d] = vd[d] + alike(y.g) * along[d];
                    }
                    const Factors<R> x = sight.x(i, lane);
                    for (int d = 0; d < 4; d++)
                        ad[d] = ad[d] + alike(x.f) * ud[d], bd[d] = bd[d] + alike(x.g) * ud[d], cd[d] = cd[d] + alike(x.f) * vd[d];
                }
                B found[4];
                for (int d = 0; d < 4; d++)
                    found[d] = summed(f * ad[d], f * bd[d], f * cd[d], g * ad[d]) +
                               (alike(way_x[q + d]) * by_x + alike(way_y[q + d]) * by_y + alike(way_z[q + d]) * by_z);
                together(found, q, share_dot + lane);
            }
        }
        for (int lane = lanes; lane < L; lane++) shares[lane] = B(0.0);
        to_registers<R>(shares, share);
    }

  private:
    static_assert(N % 4 == 0);  // numbers in a quad
    static TC_INLINE const R* way(const D* offset_dot, int axis, int lane) { return reinterpret_cast<const R*>(offset_dot + size_t(axis) * L + lane); }
    // The numbers' tangents, one number after the other, into those of four directions from the `first` one; and back.
    static TC_INLINE void each_way(const D* from, int first, B* to) {
        auto at = [=](int number) { return reinterpret_cast<const R*>(from + size_t(number) * L) + first; };
        if constexpr (HALVED<R, ON_BLOCK>) {
            P low[4], high[4];
            gather_quads(at, low), gather_quads([at](int number) { return at(number + L); }, high);
            for (int d = 0; d < 4; d++) to[d] = {low[d], high[d]};
        } else gather_quads(at, to);
    }
    static TC_INLINE void together(B* from, int first, D* to) {
        auto give = [=](int number, Quad<R> tangent) {
            *reinterpret_cast<Quad<R>*>(reinterpret_cast<R*>(to + size_t(number) * L) + first) = tangent;
        };
        if constexpr (HALVED<R, ON_BLOCK>) {
            P low[4], high[4];
            for (int d = 0; d < 4; d++) low[d] = from[d].low, high[d] = from[d].high;
            scatter_quads(low, give), scatter_quads(high, [give](int number, Quad<R> tangent) { give(number + L, tangent); });
        } else scatter_quads(from, give);
    }
};

}  // namespace tc
