// Transfers between contact points and the 27 grid nodes around each: particle to grid (p2g) and grid to particle
// (g2p).
//
// Along each axis a point sees three nodes, with the weights f of the quadratic spline and other factors g. These are
// the slopes of the weights, or the weights times the arm from the point to the node (lengths in grid spacings). A
// point's shares are four vectors, one for f f f and one for g along each axis:
//
//     b(n) = (f f f, g f f, f g f, f f g)       p2g   G(n) += b(n) . S       g2p   S = sum over n of b(n) G(n)
//
// Each transfer is what the adjoint of the other needs. Nodes lie in blocks of four along z, which the processor
// handles at once. Blocks begin at every second node, so that a point's three nodes always lie in one block, from its
// first or second node on. A point goes to nine blocks, and each node has two copies: sparse_grid.h,
// grid_momentum_to_velocity.h.
#pragma once

#include <cstring>
#include <type_traits>

#include "row_layout.h"
#include "tape.h"

namespace tc {

// g++ 12 removes functions whose only stores go to blocks by their numbers, as if they wrote nothing. This prevents it.
TC_INLINE void mark_written(const void* memory) { asm volatile("" : : "r"(memory) : "memory"); }

constexpr int BLOCKS_PER_POINT = 9;
constexpr int NODE_NUMBERS = 4;    // of a node: mass, and a vector
constexpr int BLOCK_NUMBERS = 16;  // of four nodes
// With TransferBasis::gradient, f f f carries mass alone. With TransferBasis::affine, all factors carry vectors alone.

template <class R>
using Block = Pack<R, BLOCK_NUMBERS>;

template <class R>
TC_INLINE Block<R> broadcast(R number) { return Block<R>(double(number)); }
// Quad K of a block, for each of its nodes.
template <int K, class R>
TC_INLINE Block<R> broadcast_quad(const Block<R>& a) {
    constexpr int first = 4 * K % LANES<R>;
#define TC_QUAD first, first + 1, first + 2, first + 3
    if constexpr (HALVED<R, BLOCK_NUMBERS>) {
        const auto half = K < 2 ? a.low.v : a.high.v;
        const Wide<R> both(__builtin_shufflevector(half, half, TC_QUAD, TC_QUAD));
        return {both, both};
    } else return Block<R>(__builtin_shufflevector(a.v, a.v, TC_QUAD, TC_QUAD, TC_QUAD, TC_QUAD));
#undef TC_QUAD
}
// Each of four numbers in memory, four times. It reads a whole pack, because a widening shuffle would go through
// memory.
template <class R>
TC_INLINE Block<R> repeat_each(const Quad<R>* source) {
    Wide<R> a;
    std::memcpy(&a, source, sizeof(a));
    if constexpr (HALVED<R, BLOCK_NUMBERS>)
        return {Wide<R>(__builtin_shufflevector(a.v, a.v, 0, 0, 0, 0, 1, 1, 1, 1)),
                Wide<R>(__builtin_shufflevector(a.v, a.v, 2, 2, 2, 2, 3, 3, 3, 3))};
    else return Block<R>(__builtin_shufflevector(a.v, a.v, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3));
}
// Quad k is the sum of the four quads of argument k.
template <class R>
TC_INLINE Block<R> sum_quads(Block<R> a, Block<R> b, Block<R> c, Block<R> d) {
    if constexpr (HALVED<R, BLOCK_NUMBERS>) {
        auto halves = [](Wide<R> x, Wide<R> y) {
            return Wide<R>(__builtin_shufflevector(x.v, y.v, 0, 1, 2, 3, 8, 9, 10, 11) +
                           __builtin_shufflevector(x.v, y.v, 4, 5, 6, 7, 12, 13, 14, 15));
        };
        return {halves(a.low + a.high, b.low + b.high), halves(c.low + c.high, d.low + d.high)};
    } else {
        auto halves = [](Block<R> x, Block<R> y) {
            return __builtin_shufflevector(x.v, y.v, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
                   __builtin_shufflevector(x.v, y.v, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
        };
        const auto ab = halves(a, b), cd = halves(c, d);
        return Block<R>(__builtin_shufflevector(ab, cd, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27) +
                        __builtin_shufflevector(ab, cd, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31));
    }
}

// Weights f and other factors g of a point's three nodes along one axis, and the derivatives of both by the offset.
template <class T>
struct AxisFactors {
    T f[3], g[3], f_slope[3], g_slope[3];
};

template <class T>
TC_INLINE void spline_factors(TransferBasis basis, T offset, AxisFactors<T>& a) {
    const T before = 1.5 - offset, middle = offset - 1.0, after = offset - 0.5;
    a.f[0] = 0.5 * (before * before), a.f[1] = 0.75 - middle * middle, a.f[2] = 0.5 * (after * after);
    a.f_slope[0] = -before, a.f_slope[1] = -2.0 * middle, a.f_slope[2] = after;
    for (int i = 0; i < 3; i++)
        if (basis == TransferBasis::affine) {
            const T arm = double(i) - offset;
            a.g[i] = arm * a.f[i], a.g_slope[i] = arm * a.f_slope[i] - a.f[i];
        } else a.g[i] = a.f_slope[i], a.g_slope[i] = T(i == 1 ? -2.0 : 1.0);
}

// 1 where the three nodes along z begin at the second node of a block; the offset is from its first node.
template <class P>
TC_INLINE P starts_at_second(const P* offset) { return 1.0 - less(offset[2], 1.5); }

// The factors of one point of a pack at node i along an axis.
template <class R>
struct LaneFactors {
    R f, g, f_slope, g_slope;
    TC_INLINE LaneFactors(const AxisFactors<Wide<R>>& axis, int i, int lane) {
        constexpr int L = LANES<R>;
        const R* first = reinterpret_cast<const R*>(&axis) + i * L + lane;
        f = first[0], g = first[3 * L], f_slope = first[6 * L], g_slope = first[9 * L];
    }
};

// Conversion between registers and the rows of their lanes.
template <class R>
TC_INLINE void to_lanes(const Wide<R>* regs, Block<R>* rows) {
    for (int b = 0; b < 4; b++) {
        Wide<R> quad[4] = {regs[4 * b], regs[4 * b + 1], regs[4 * b + 2], regs[4 * b + 3]};
        scatter_quads(quad, [&](int lane, Quad<R> numbers) { reinterpret_cast<Quad<R>*>(rows + lane)[b] = numbers; });
    }
}
template <class R>
TC_INLINE void to_registers(const Block<R>* rows, Wide<R>* regs) {
    for (int b = 0; b < 4; b++)
        gather_quads([&](int lane) { return reinterpret_cast<const R*>(rows + lane) + 4 * b; }, regs + 4 * b);
}

// Factors of the points of a pack along x and y, and along z at the four nodes of a block.
template <class R, TransferBasis BASIS, int FACTORS>  // how many of those along z: f, g, f_slope, g_slope
struct SplineFactors {
    using P = Wide<R>;
    AxisFactors<P> axes[2];
    Quad<R> rows[FACTORS + 1][LANES<R>];  // one row more, because `repeat_each` reads beyond

    explicit SplineFactors(const P* offset) {
        for (int d = 0; d < 2; d++) spline_factors(BASIS, offset[d], axes[d]);
        const P second = starts_at_second(offset);
        AxisFactors<P> three;
        spline_factors(BASIS, offset[2] - second, three);
        const P *factor[4] = {three.f, three.g, three.f_slope, three.g_slope}, none(0.0);
        for (int q = 0; q < FACTORS; q++) {
            const P* n = factor[q];
            P quad[4] = {select(second, none, n[0]), select(second, n[0], n[1]), select(second, n[1], n[2]),
                         select(second, n[2], none)};
            scatter_quads(quad, [&](int lane, Quad<R> numbers) { rows[q][lane] = numbers; });
        }
    }
    TC_INLINE LaneFactors<R> x(int i, int lane) const { return LaneFactors<R>(axes[0], i, lane); }
    TC_INLINE LaneFactors<R> y(int j, int lane) const { return LaneFactors<R>(axes[1], j, lane); }
    TC_INLINE Block<R> z(int q, int lane) const { return repeat_each(&rows[q][lane]); }
};

template <class R, TransferBasis BASIS>
struct Transfer {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    using B = Block<R>;
    const int* around;  // [L, BLOCKS_PER_POINT] blocks
    int lanes;          // that have points

    void p2g(const P* offset, const P* share, R* grid) const {
        const SplineFactors<R, BASIS, 2> factors(offset);
        B shares[L];
        to_lanes<R>(share, shares);
        for (int lane = 0; lane < lanes; lane++) {
            const B f = factors.z(0, lane), g = factors.z(1, lane), s = shares[lane];
            const B a = f * broadcast_quad<0>(s) + g * broadcast_quad<3>(s);
            const B b = f * broadcast_quad<1>(s), c = f * broadcast_quad<2>(s);
            const int* block = around + lane * BLOCKS_PER_POINT;
            for (int i = 0; i < 3; i++) {
                const LaneFactors<R> x = factors.x(i, lane);
                const B u = broadcast(x.f) * a + broadcast(x.g) * b, v = broadcast(x.f) * c;
                for (int j = 0; j < 3; j++) {
                    const LaneFactors<R> y = factors.y(j, lane);
                    B& at = reinterpret_cast<B*>(grid)[block[3 * i + j]];
                    at = at + broadcast(y.f) * u + broadcast(y.g) * v;
                }
            }
        }
        mark_written(grid);
    }

    void g2p(const P* offset, P* share, const R* grid) const {
        const SplineFactors<R, BASIS, 2> factors(offset);
        B shares[L];
        for (int lane = 0; lane < lanes; lane++) {
            B a(0.0), b(0.0), c(0.0);
            const int* block = around + lane * BLOCKS_PER_POINT;
            for (int i = 0; i < 3; i++) {
                B u(0.0), v(0.0);
                for (int j = 0; j < 3; j++) {
                    const LaneFactors<R> y = factors.y(j, lane);
                    const B& at = reinterpret_cast<const B*>(grid)[block[3 * i + j]];
                    u = u + broadcast(y.f) * at, v = v + broadcast(y.g) * at;
                }
                const LaneFactors<R> x = factors.x(i, lane);
                a = a + broadcast(x.f) * u, b = b + broadcast(x.g) * u, c = c + broadcast(x.f) * v;
            }
            const B f = factors.z(0, lane), g = factors.z(1, lane);
            shares[lane] = sum_quads(f * a, f * b, f * c, g * a);
        }
        for (int lane = lanes; lane < L; lane++) shares[lane] = B(0.0);
        to_registers<R>(shares, share);
    }

    // Adjoint of g2p: adds the shares' adjoints to the grid's adjoint, and the derivative of the work of the shares on
    // the grid by the offset to the offset's adjoint.
    void g2p_adjoint(const P* offset, const P* share, R* grid_bar, const R* grid, P* offset_bar) const {
        adjoint<true, false>(offset, share, grid_bar, grid, nullptr, offset_bar);
        mark_written(grid_bar);
    }
    // Adjoint of p2g: adds the sums over the grid's adjoint to the shares' adjoints, and likewise for the offset.
    void p2g_adjoint(const P* offset, const P* share, const R* grid, P* share_bar, P* offset_bar) const {
        adjoint<false, true>(offset, share, nullptr, grid, share_bar, offset_bar);
    }

  private:
    template <bool ADDS_TO_GRID, bool SUMS_GRID>
    TC_INLINE void adjoint(const P* offset, const P* share, R* grid_bar, const R* grid, P* share_bar,
                           P* offset_bar) const {
        constexpr bool g_is_slope = BASIS == TransferBasis::gradient;  // some sums are then equal
        const SplineFactors<R, BASIS, 4> factors(offset);
        B shares[L], share_rows[L], offset_rows[L];
        to_lanes<R>(share, shares);
        for (int lane = 0; lane < lanes; lane++) {
            const B f = factors.z(0, lane), g = factors.z(1, lane), f_slope = factors.z(2, lane),
                    g_slope = factors.z(3, lane);
            const B s = shares[lane], s0 = broadcast_quad<0>(s), s1 = broadcast_quad<1>(s), s2 = broadcast_quad<2>(s),
                    s3 = broadcast_quad<3>(s);
            const B first = f * s0 + g * s3, second = f * s1, third = f * s2;
            B a(0.0), b(0.0), c(0.0), ax(0.0), bx(0.0), cx(0.0), ay(0.0), by(0.0), cy(0.0);
            const int* block = around + lane * BLOCKS_PER_POINT;
            for (int i = 0; i < 3; i++) {
                const LaneFactors<R> x = factors.x(i, lane);
                const B to_f = broadcast(x.f) * first + broadcast(x.g) * second, to_g = broadcast(x.f) * third;
                B u(0.0), v(0.0), uy(0.0), vy(0.0);
                for (int j = 0; j < 3; j++) {
                    const LaneFactors<R> y = factors.y(j, lane);
                    const B& at = reinterpret_cast<const B*>(grid)[block[3 * i + j]];
                    u = u + broadcast(y.f) * at, v = v + broadcast(y.g) * at, vy = vy + broadcast(y.g_slope) * at;
                    if (!g_is_slope) uy = uy + broadcast(y.f_slope) * at;
                    if (ADDS_TO_GRID) {
                        B& to = reinterpret_cast<B*>(grid_bar)[block[3 * i + j]];
                        to = to + broadcast(y.f) * to_f + broadcast(y.g) * to_g;
                    }
                }
                a = a + broadcast(x.f) * u, b = b + broadcast(x.g) * u, c = c + broadcast(x.f) * v;
                bx = bx + broadcast(x.g_slope) * u, cx = cx + broadcast(x.f_slope) * v, cy = cy + broadcast(x.f) * vy;
                if (!g_is_slope)
                    ax = ax + broadcast(x.f_slope) * u, ay = ay + broadcast(x.f) * uy, by = by + broadcast(x.g) * uy;
            }
            if (g_is_slope) ax = b, ay = c, by = cx;
            offset_rows[lane] = sum_quads(first * ax + second * bx + third * cx, first * ay + second * by + third * cy,
                                a * (f_slope * s0 + g_slope * s3) + f_slope * (s1 * b + s2 * c), B(0.0));
            if (SUMS_GRID) share_rows[lane] = sum_quads(f * a, f * b, f * c, g * a);
        }
        for (int lane = lanes; lane < L; lane++) offset_rows[lane] = share_rows[lane] = B(0.0);
        P sums[TRANSFER_SHARES];
        to_registers<R>(offset_rows, sums);
        for (int d = 0; d < 3; d++)
            offset_bar[d] = offset_bar[d] + ((sums[4 * d] + sums[4 * d + 1]) + (sums[4 * d + 2] + sums[4 * d + 3]));
        if (!SUMS_GRID) return;
        to_registers<R>(share_rows, sums);
        for (int k = 0; k < TRANSFER_SHARES; k++) share_bar[k] = share_bar[k] + sums[k];
    }
};

}  // namespace tc
