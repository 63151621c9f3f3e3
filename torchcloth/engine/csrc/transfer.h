// Between points and the 27 nodes of the grid around each.
//
// Along each axis a point sees three nodes, with the weights f of the quadratic spline and other factors g: the weights'
// slopes, or the weights times the arm from the point to the node (lengths in grid spacings). A point's shares are four
// vectors, one for f f f and one for g along each axis:
//
//     b(n) = (f f f, g f f, f g f, f f g)       spread   G(n) += b(n) . S       collect   S = sum over n of b(n) G(n)
//
// and each is what the other needs for its adjoint. Nodes lie by blocks of four along z, which is what the processor
// takes at once; blocks begin at every second node, so that the three of a point always lie in one, from its first or
// second node on. A point goes to nine blocks, and each node has two copies: nodes.h, per_mass.h.
#pragma once

#include <cstring>
#include <type_traits>

#include "rows.h"
#include "tape.h"

namespace tc {

// g++ 12 takes functions whose only stores go to blocks by their numbers for such that write nothing, and leaves them out.
TC_INLINE void is_written(const void* memory) { asm volatile("" : : "r"(memory) : "memory"); }

constexpr int AROUND = 9;     // blocks of a point
constexpr int ON_NODE = 4;    // numbers of a node: mass, and a vector
constexpr int ON_BLOCK = 16;  // of four nodes
constexpr int SHARES = 16;    // (mass or nothing, vector) four times

enum class By : int { slopes, arms };  // slopes: f f f carries mass alone; arms: all carry vectors alone

template <class R>
using Block = Pack<R, ON_BLOCK>;

template <class R>
TC_INLINE Block<R> alike(R number) { return Block<R>(double(number)); }
// Quad K of a block, for each of its nodes.
template <int K, class R>
TC_INLINE Block<R> part(const Block<R>& a) {
    constexpr int first = 4 * K % LANES<R>;
#define TC_QUAD first, first + 1, first + 2, first + 3
    if constexpr (HALVED<R, ON_BLOCK>) {
        const auto half = K < 2 ? a.low.v : a.high.v;
        const Wide<R> both(__builtin_shufflevector(half, half, TC_QUAD, TC_QUAD));
        return {both, both};
    } else return Block<R>(__builtin_shufflevector(a.v, a.v, TC_QUAD, TC_QUAD, TC_QUAD, TC_QUAD));
#undef TC_QUAD
}
// The four numbers that lie there, each four times. Reads a whole pack: a widening shuffle would go through memory.
template <class R>
TC_INLINE Block<R> widened(const Quad<R>* there) {
    Wide<R> a;
    std::memcpy(&a, there, sizeof(a));
    if constexpr (HALVED<R, ON_BLOCK>)
        return {Wide<R>(__builtin_shufflevector(a.v, a.v, 0, 0, 0, 0, 1, 1, 1, 1)), Wide<R>(__builtin_shufflevector(a.v, a.v, 2, 2, 2, 2, 3, 3, 3, 3))};
    else return Block<R>(__builtin_shufflevector(a.v, a.v, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3));
}
// Quad k: the sum of the four of argument k.
template <class R>
TC_INLINE Block<R> summed(Block<R> a, Block<R> b, Block<R> c, Block<R> d) {
    if constexpr (HALVED<R, ON_BLOCK>) {
        auto halves = [](Wide<R> x, Wide<R> y) {
            return Wide<R>(__builtin_shufflevector(x.v, y.v, 0, 1, 2, 3, 8, 9, 10, 11) + __builtin_shufflevector(x.v, y.v, 4, 5, 6, 7, 12, 13, 14, 15));
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

// What a point sees along one axis.
template <class T>
struct Axis {
    T f[3], g[3], f_slope[3], g_slope[3];
};

template <class T>
TC_INLINE void see(By by, T offset, Axis<T>& a) {
    const T before = 1.5 - offset, middle = offset - 1.0, after = offset - 0.5;
    a.f[0] = 0.5 * (before * before), a.f[1] = 0.75 - middle * middle, a.f[2] = 0.5 * (after * after);
    a.f_slope[0] = -before, a.f_slope[1] = -2.0 * middle, a.f_slope[2] = after;
    for (int i = 0; i < 3; i++)
        if (by == By::arms) {
            const T arm = double(i) - offset;
            a.g[i] = arm * a.f[i], a.g_slope[i] = arm * a.f_slope[i] - a.f[i];
        } else a.g[i] = a.f_slope[i], a.g_slope[i] = T(i == 1 ? -2.0 : 1.0);
}

// 1 where the three nodes along z begin at the second of a block, as the offset from its first one tells.
template <class P>
TC_INLINE P begins(const P* offset) { return 1.0 - less(offset[2], 1.5); }

// The factors of one of the points of a pack at node i along an axis.
template <class R>
struct Factors {
    R f, g, f_slope, g_slope;
    TC_INLINE Factors(const Axis<Wide<R>>& axis, int i, int lane) {
        constexpr int L = LANES<R>;
        const R* first = reinterpret_cast<const R*>(&axis) + i * L + lane;
        f = first[0], g = first[3 * L], f_slope = first[6 * L], g_slope = first[9 * L];
    }
};

// Between registers and the rows of their lanes.
template <class R>
TC_INLINE void to_lanes(const Wide<R>* regs, Block<R>* rows) {
    for (int b = 0; b < 4; b++) {
        Wide<R> quad[4] = {regs[4 * b], regs[4 * b + 1], regs[4 * b + 2], regs[4 * b + 3]};
        scatter_quads(quad, [&](int lane, Quad<R> numbers) { reinterpret_cast<Quad<R>*>(rows + lane)[b] = numbers; });
    }
}
template <class R>
TC_INLINE void to_registers(const Block<R>* rows, Wide<R>* regs) {
    for (int b = 0; b < 4; b++) gather_quads([&](int lane) { return reinterpret_cast<const R*>(rows + lane) + 4 * b; }, regs + 4 * b);
}

// What the points of a pack see: factors along x and y, and along z at the four nodes of a block.
template <class R, By BY, int KINDS>  // of those along z: f, g, and their slopes
struct Sight {
    using P = Wide<R>;
    Axis<P> axes[2];
    Quad<R> rows[KINDS + 1][LANES<R>];  // one more, as `widened` reads beyond

    explicit Sight(const P* offset) {
        for (int d = 0; d < 2; d++) see(BY, offset[d], axes[d]);
        const P second = begins(offset);
        Axis<P> three;
        see(BY, offset[2] - second, three);
        const P *factor[4] = {three.f, three.g, three.f_slope, three.g_slope}, none(0.0);
        for (int q = 0; q < KINDS; q++) {
            const P* n = factor[q];
            P quad[4] = {select(second, none, n[0]), select(second, n[0], n[1]), select(second, n[1], n[2]), select(second, n[2], none)};
            scatter_quads(quad, [&](int lane, Quad<R> numbers) { rows[q][lane] = numbers; });
        }
    }
    TC_INLINE Factors<R> x(int i, int lane) const { return Factors<R>(axes[0], i, lane); }
    TC_INLINE Factors<R> y(int j, int lane) const { return Factors<R>(axes[1], j, lane); }
    TC_INLINE Block<R> z(int q, int lane) const { return widened(&rows[q][lane]); }
};

template <class R, By BY>
struct Transfer {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    using B = Block<R>;
    const int* around;  // [L, AROUND]
    int lanes;          // that are points

    void spread(const P* offset, const P* share, R* grid) const {
        const Sight<R, BY, 2> sight(offset);
        B shares[L];
        to_lanes<R>(share, shares);
        for (int lane = 0; lane < lanes; lane++) {
            const B f = sight.z(0, lane), g = sight.z(1, lane), own = shares[lane];
            const B a = f * part<0>(own) + g * part<3>(own), b = f * part<1>(own), c = f * part<2>(own);
            const int* block = around + lane * AROUND;
            for (int i = 0; i < 3; i++) {
                const Factors<R> x = sight.x(i, lane);
                const B u = alike(x.f) * a + alike(x.g) * b, v = alike(x.f) * c;
                for (int j = 0; j < 3; j++) {
                    const Factors<R> y = sight.y(j, lane);
                    B& at = reinterpret_cast<B*>(grid)[block[3 * i + j]];
                    at = at + alike(y.f) * u + alike(y.g) * v;
                }
            }
        }
        is_written(grid);
    }

    void collect(const P* offset, P* share, const R* grid) const {
        const Sight<R, BY, 2> sight(offset);
        B shares[L];
        for (int lane = 0; lane < lanes; lane++) {
            B a(0.0), b(0.0), c(0.0);
            const int* block = around + lane * AROUND;
            for (int i = 0; i < 3; i++) {
                B u(0.0), v(0.0);
                for (int j = 0; j < 3; j++) {
                    const Factors<R> y = sight.y(j, lane);
                    const B& at = reinterpret_cast<const B*>(grid)[block[3 * i + j]];
                    u = u + alike(y.f) * at, v = v + alike(y.g) * at;
                }
                const Factors<R> x = sight.x(i, lane);
                a = a + alike(x.f) * u, b = b + alike(x.g) * u, c = c + alike(x.f) * v;
            }
            const B f = sight.z(0, lane), g = sight.z(1, lane);
            shares[lane] = summed(f * a, f * b, f * c, g * a);
        }
        for (int lane = lanes; lane < L; lane++) shares[lane] = B(0.0);
        to_registers<R>(shares, share);
    }

    // Derivatives by the offset of the sum over nodes of what the shares spread, times the grid. For the adjoint of what was
    // collected, whose shares are spread on the grid's adjoint:
    void spread_and_weigh(const P* offset, const P* share, R* grid_bar, const R* grid, P* offset_bar) const {
        look<true, false>(offset, share, grid_bar, grid, nullptr, offset_bar);
        is_written(grid_bar);
    }
    // and of what was spread, with what collect gives added to `collected`.
    void collect_and_weigh(const P* offset, const P* share, const R* grid, P* collected, P* offset_bar) const {
        look<false, true>(offset, share, nullptr, grid, collected, offset_bar);
    }

  private:
    template <bool SPREADS, bool COLLECTS>
    TC_INLINE void look(const P* offset, const P* share, R* grid_bar, const R* grid, P* collected, P* offset_bar) const {
        constexpr bool g_is_slope = BY == By::slopes;  // of f: some sums are then others
        const Sight<R, BY, 4> sight(offset);
        B shares[L], found[L], ways[L];
        to_lanes<R>(share, shares);
        for (int lane = 0; lane < lanes; lane++) {
            const B f = sight.z(0, lane), g = sight.z(1, lane), f_slope = sight.z(2, lane), g_slope = sight.z(3, lane);
            const B own = shares[lane], s0 = part<0>(own), s1 = part<1>(own), s2 = part<2>(own), s3 = part<3>(own);
            const B first = f * s0 + g * s3, second = f * s1, third = f * s2;
            B a(0.0), b(0.0), c(0.0), ax(0.0), bx(0.0), cx(0.0), ay(0.0), by(0.0), cy(0.0);
            const int* block = around + lane * AROUND;
            for (int i = 0; i < 3; i++) {
                const Factors<R> x = sight.x(i, lane);
                const B to_f = alike(x.f) * first + alike(x.g) * second, to_g = alike(x.f) * third;
                B u(0.0), v(0.0), uy(0.0), vy(0.0);
                for (int j = 0; j < 3; j++) {
                    const Factors<R> y = sight.y(j, lane);
                    const B& at = reinterpret_cast<const B*>(grid)[block[3 * i + j]];
                    u = u + alike(y.f) * at, v = v + alike(y.g) * at, vy = vy + alike(y.g_slope) * at;
                    if (!g_is_slope) uy = uy + alike(y.f_slope) * at;
                    if (SPREADS) {
                        B& to = reinterpret_cast<B*>(grid_bar)[block[3 * i + j]];
                        to = to + alike(y.f) * to_f + alike(y.g) * to_g;
                    }
                }
                a = a + alike(x.f) * u, b = b + alike(x.g) * u, c = c + alike(x.f) * v;
                bx = bx + alike(x.g_slope) * u, cx = cx + alike(x.f_slope) * v, cy = cy + alike(x.f) * vy;
                if (!g_is_slope) ax = ax + alike(x.f_slope) * u, ay = ay + alike(x.f) * uy, by = by + alike(x.g) * uy;
            }
            if (g_is_slope) ax = b, ay = c, by = cx;
            ways[lane] = summed(first * ax + second * bx + third * cx, first * ay + second * by + third * cy,
                                a * (f_slope * s0 + g_slope * s3) + f_slope * (s1 * b + s2 * c), B(0.0));
            if (COLLECTS) found[lane] = summed(f * a, f * b, f * c, g * a);
        }
        for (int lane = lanes; lane < L; lane++) ways[lane] = found[lane] = B(0.0);
        P sums[SHARES];
        to_registers<R>(ways, sums);
        for (int d = 0; d < 3; d++) offset_bar[d] = offset_bar[d] + ((sums[4 * d] + sums[4 * d + 1]) + (sums[4 * d + 2] + sums[4 * d + 3]));
        if (!COLLECTS) return;
        to_registers<R>(found, sums);
        for (int k = 0; k < SHARES; k++) collected[k] = collected[k] + sums[k];
    }
};

}  // namespace tc
