// Transfers with their tangents (Jacobian-vector products): one point after the other, and for each block one group of
// four directions after the other, whose numbers stay in registers.
#pragma once

#include "transfer.h"

namespace tc {

template <class R, TransferBasis BASIS, int N>
struct TransferJvp {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    using B = Block<R>;
    using D = DirectionPack<R, N>;
    const int* around;  // [L, BLOCKS_PER_POINT]
    int lanes;

    void p2g(const P* offset, const D* offset_dot, const P* share, const D* share_dot, R* grid, R* grid_dot) const {
        const SplineFactors<R, BASIS, 4> factors(offset);
        B shares[L];
        to_lanes<R>(share, shares);
        for (int lane = 0; lane < lanes; lane++) {
            const B f = factors.z(0, lane), g = factors.z(1, lane), f_slope = factors.z(2, lane),
                    g_slope = factors.z(3, lane);
            const B s = shares[lane], s0 = broadcast_quad<0>(s), s1 = broadcast_quad<1>(s);
            const B s2 = broadcast_quad<2>(s), s3 = broadcast_quad<3>(s);
            const B a = f * s0 + g * s3, b = f * s1, c = f * s2;
            const B a_slope = f_slope * s0 + g_slope * s3, b_slope = f_slope * s1, c_slope = f_slope * s2;
            const R* tangent_x = offset_tangent(offset_dot, 0, lane);
            const R* tangent_y = offset_tangent(offset_dot, 1, lane);
            const R* tangent_z = offset_tangent(offset_dot, 2, lane);
            const int* block = around + lane * BLOCKS_PER_POINT;
            for (int q = 0; q < N; q += 4) {
                B moved[4], ad[4], bd[4], cd[4];
                gather_directions(share_dot + lane, q, moved);
                for (int d = 0; d < 4; d++) {
                    const B z = broadcast(tangent_z[q + d]);
                    ad[d] = f * broadcast_quad<0>(moved[d]) + g * broadcast_quad<3>(moved[d]) + z * a_slope;
                    bd[d] = f * broadcast_quad<1>(moved[d]) + z * b_slope,
                    cd[d] = f * broadcast_quad<2>(moved[d]) + z * c_slope;
                }
                for (int i = 0; i < 3; i++) {
                    const LaneFactors<R> x = factors.x(i, lane);
                    const B u = broadcast(x.f) * a + broadcast(x.g) * b, v = broadcast(x.f) * c;
                    const B u_slope = broadcast(x.f_slope) * a + broadcast(x.g_slope) * b,
                            v_slope = broadcast(x.f_slope) * c;
                    B ud[4], vd[4];
                    for (int d = 0; d < 4; d++) {
                        ud[d] = broadcast(x.f) * ad[d] + broadcast(x.g) * bd[d] + broadcast(tangent_x[q + d]) * u_slope;
                        vd[d] = broadcast(x.f) * cd[d] + broadcast(tangent_x[q + d]) * v_slope;
                    }
                    for (int j = 0; j < 3; j++) {
                        const LaneFactors<R> y = factors.y(j, lane);
                        const B slope = broadcast(y.f_slope) * u + broadcast(y.g_slope) * v;
                        const size_t number = block[3 * i + j];
                        B &at = reinterpret_cast<B*>(grid)[number],
                          *block_tangent = reinterpret_cast<B*>(grid_dot) + number * N + q;
                        if (q == 0) at = at + broadcast(y.f) * u + broadcast(y.g) * v;
                        for (int d = 0; d < 4; d++)
                            block_tangent[d] = block_tangent[d] + broadcast(y.f) * ud[d] + broadcast(y.g) * vd[d] +
                                               broadcast(tangent_y[q + d]) * slope;
                    }
                }
            }
        }
        mark_written(grid), mark_written(grid_dot);
    }

    void g2p(const P* offset, const D* offset_dot, P* share, D* share_dot, const R* grid, const R* grid_dot) const {
        constexpr bool g_is_slope = BASIS == TransferBasis::gradient;  // some sums are then equal
        const SplineFactors<R, BASIS, 4> factors(offset);
        B shares[L];
        for (int lane = 0; lane < lanes; lane++) {
            B a(0.0), b(0.0), c(0.0), ax(0.0), bx(0.0), cx(0.0), ay(0.0), by(0.0), cy(0.0);
            const int* block = around + lane * BLOCKS_PER_POINT;
            for (int i = 0; i < 3; i++) {
                B u(0.0), v(0.0), uy(0.0), vy(0.0);
                for (int j = 0; j < 3; j++) {
                    const LaneFactors<R> y = factors.y(j, lane);
                    const B& at = reinterpret_cast<const B*>(grid)[block[3 * i + j]];
                    u = u + broadcast(y.f) * at, v = v + broadcast(y.g) * at, vy = vy + broadcast(y.g_slope) * at;
                    if (!g_is_slope) uy = uy + broadcast(y.f_slope) * at;
                }
                const LaneFactors<R> x = factors.x(i, lane);
                a = a + broadcast(x.f) * u, b = b + broadcast(x.g) * u, c = c + broadcast(x.f) * v;
                bx = bx + broadcast(x.g_slope) * u, cx = cx + broadcast(x.f_slope) * v, cy = cy + broadcast(x.f) * vy;
                if (!g_is_slope)
                    ax = ax + broadcast(x.f_slope) * u, ay = ay + broadcast(x.f) * uy, by = by + broadcast(x.g) * uy;
            }
            if (g_is_slope) ax = b, ay = c, by = cx;
            const B f = factors.z(0, lane), g = factors.z(1, lane), f_slope = factors.z(2, lane),
                    g_slope = factors.z(3, lane);
            shares[lane] = sum_quads(f * a, f * b, f * c, g * a);
            const B by_x = sum_quads(f * ax, f * bx, f * cx, g * ax), by_y = sum_quads(f * ay, f * by, f * cy, g * ay);
            const B by_z = sum_quads(f_slope * a, f_slope * b, f_slope * c, g_slope * a);
            const R* tangent_x = offset_tangent(offset_dot, 0, lane);
            const R* tangent_y = offset_tangent(offset_dot, 1, lane);
            const R* tangent_z = offset_tangent(offset_dot, 2, lane);
            for (int q = 0; q < N; q += 4) {
                B ad[4], bd[4], cd[4];
                for (int d = 0; d < 4; d++) ad[d] = bd[d] = cd[d] = B(0.0);
                for (int i = 0; i < 3; i++) {
                    B ud[4], vd[4];
                    for (int d = 0; d < 4; d++) ud[d] = vd[d] = B(0.0);
                    for (int j = 0; j < 3; j++) {
                        const LaneFactors<R> y = factors.y(j, lane);
                        const B* block_tangent =
                            reinterpret_cast<const B*>(grid_dot) + size_t(block[3 * i + j]) * N + q;
                        for (int d = 0; d < 4; d++)
                            ud[d] = ud[d] + broadcast(y.f) * block_tangent[d],
                            vd[d] = vd[d] + broadcast(y.g) * block_tangent[d];
                    }
                    const LaneFactors<R> x = factors.x(i, lane);
                    for (int d = 0; d < 4; d++)
                        ad[d] = ad[d] + broadcast(x.f) * ud[d], bd[d] = bd[d] + broadcast(x.g) * ud[d],
                        cd[d] = cd[d] + broadcast(x.f) * vd[d];
                }
                B moved[4];
                for (int d = 0; d < 4; d++)
                    moved[d] = sum_quads(f * ad[d], f * bd[d], f * cd[d], g * ad[d]) +
                               (broadcast(tangent_x[q + d]) * by_x + broadcast(tangent_y[q + d]) * by_y +
                                broadcast(tangent_z[q + d]) * by_z);
                scatter_directions(moved, q, share_dot + lane);
            }
        }
        for (int lane = lanes; lane < L; lane++) shares[lane] = B(0.0);
        to_registers<R>(shares, share);
    }

  private:
    static_assert(N % 4 == 0);  // numbers in a quad
    static TC_INLINE const R* offset_tangent(const D* offset_dot, int axis, int lane) {
        return reinterpret_cast<const R*>(offset_dot + size_t(axis) * L + lane);
    }
    // Converts the tangents of 16 numbers to blocks of four directions, from direction `first` on; and back.
    static TC_INLINE void gather_directions(const D* from, int first, B* to) {
        auto at = [=](int number) { return reinterpret_cast<const R*>(from + size_t(number) * L) + first; };
        if constexpr (HALVED<R, BLOCK_NUMBERS>) {
            P low[4], high[4];
            gather_quads(at, low), gather_quads([at](int number) { return at(number + L); }, high);
            for (int d = 0; d < 4; d++) to[d] = {low[d], high[d]};
        } else gather_quads(at, to);
    }
    static TC_INLINE void scatter_directions(B* from, int first, D* to) {
        auto give = [=](int number, Quad<R> tangent) {
            *reinterpret_cast<Quad<R>*>(reinterpret_cast<R*>(to + size_t(number) * L) + first) = tangent;
        };
        if constexpr (HALVED<R, BLOCK_NUMBERS>) {
            P low[4], high[4];
            for (int d = 0; d < 4; d++) low[d] = from[d].low, high[d] = from[d].high;
            scatter_quads(low, give),
                scatter_quads(high, [give](int number, Quad<R> tangent) { give(number + L, tangent); });
        } else scatter_quads(from, give);
    }
};

}  // namespace tc
