// Between points and the 27 nodes of the grid around each.
//
// Along each axis a point sees three nodes, with the weights f of the quadratic spline and other factors g: the weights'
// slopes, or the weights times the arm from the point to the node (lengths in grid spacings). A point's shares are four
// vectors, one for f f f and one for g along each axis:
//
//     b(n) = (f f f, g f f, f g f, f f g)       spread   G(n) += b(n) . S       collect   S = sum over n of b(n) G(n)
//
// and each is what the other needs for its adjoint. All sums go axis by axis: of 27 nodes each needs what is left of
// the third axis, and the first two are worked out 3 and 9 times.
#pragma once

#include <cstring>
#include <type_traits>

#include "rows.h"
#include "tape.h"

namespace tc {

constexpr int AROUND = 27;  // nodes of a point
constexpr int ON_NODE = 4;  // numbers of a node: mass, and a vector
constexpr int NOBODY = 0;   // node of the lanes behind the last point: always zero
constexpr int SHARES = 16;  // (mass or nothing, vector) four times

enum class By : int { slopes, arms };  // slopes: f f f carries mass alone; arms: all carry vectors alone

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

template <class R, By BY>
struct Transfer {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    const int* nodes;  // [AROUND, L]
    int lanes;         // that are points

    void spread(const P* offset, const P* share, R* grid) const {
        Axis<P> axes[3];
        see_all(offset, axes);
        const auto& [x, y, z] = axes;
        const bool whole = lanes == L;
        const int* node = nodes;
        for (int i = 0; i < 3; i++) {
            P u[4], v[4], w[4];
            first(x.f[i], x.g[i], share, u, v, w);
            for (int j = 0; j < 3; j++) {
                P p[4], q[4];
                second(y.f[j], y.g[j], u, v, w, p, q);
                for (int k = 0; k < 3; k++, node += L) {
                    P given[ON_NODE];
                    given[0] = CARRIES_MASS ? z.f[k] * p[0] : P(0.0);
                    for (int c = 1; c < 4; c++) given[c] = z.f[k] * p[c] + z.g[k] * q[c];
                    scatter_quads(given, [&](int lane, Quad<R> numbers) {
                        if (!whole && lane >= lanes) return;
                        Quad<R>& at = *reinterpret_cast<Quad<R>*>(grid + size_t(node[lane]) * ON_NODE);
                        at = at + numbers;
                    });
                }
            }
        }
    }

    void collect(const P* offset, P* share, const R* grid) const {
        Axis<P> axes[3];
        see_all(offset, axes);
        const auto& [x, y, z] = axes;
        for (int k = 0; k < SHARES; k++) share[k] = P(0.0);
        const int* node = nodes;
        for (int i = 0; i < 3; i++) {
            P u[4], v[4], w[4];
            clear(u), clear(v), clear(w);
            for (int j = 0; j < 3; j++) {
                P p[4], q[4];
                clear(p), clear(q);
                for (int k = 0; k < 3; k++, node += L) {
                    P seen[ON_NODE];
                    look(node, grid, seen);
                    add(z.f[k], seen, p), add(z.g[k], seen, q);
                }
                add(y.f[j], p, u), add(y.g[j], p, v), add(y.f[j], q, w);
            }
            add(x.f[i], u, share), add(x.g[i], u, share + 4), add(x.f[i], v, share + 8), add(x.f[i], w, share + 12);
        }
    }

    // The derivatives of that sum, for the adjoint of what was collected.
    void weigh(const P* offset, const P* share, const R* grid, P* offset_bar) const {
        P collected[SHARES]{};
        collect_and_weigh(offset, share, grid, collected, offset_bar);
    }
    // What collect gives, added to `collected`; and the derivatives by the offset of the sum over nodes of what the
    // shares spread, times the grid.
    void collect_and_weigh(const P* offset, const P* share, const R* grid, P* collected, P* offset_bar) const {
        Axis<P> axes[3];
        see_all(offset, axes);
        const auto& [x, y, z] = axes;
        const int* node = nodes;
        P along[3] = {P(0.0), P(0.0), P(0.0)}, sum[SHARES];
        for (P& s : sum) s = P(0.0);
        for (int i = 0; i < 3; i++) {
            P u[4], v[4], w[4], uu[4], vv[4], ww[4];
            first(x.f[i], x.g[i], share, u, v, w);
            clear(uu), clear(vv), clear(ww);
            for (int j = 0; j < 3; j++) {
                P p[4], q[4], pp[4], qq[4], p_slope[4], q_slope[4];
                clear(pp), clear(qq), clear(p_slope), clear(q_slope);
                for (int k = 0; k < 3; k++, node += L) {
                    P seen[ON_NODE];
                    look(node, grid, seen);
                    add(z.f[k], seen, pp), add(z.g[k], seen, qq);
                    add(z.f_slope[k], seen, p_slope), add(z.g_slope[k], seen, q_slope);
                }
                second(y.f[j], y.g[j], u, v, w, p, q);
                along[2] = along[2] + both(p, q, p_slope, q_slope);
                second(y.f_slope[j], y.g_slope[j], u, v, w, p, q);
                along[1] = along[1] + both(p, q, pp, qq);
                add(y.f[j], pp, uu), add(y.g[j], pp, vv), add(y.f[j], qq, ww);
            }
            first(x.f_slope[i], x.g_slope[i], share, u, v, w);
            along[0] = along[0] + both(u, w, uu, ww);
            for (int c = 1; c < 4; c++) along[0] = along[0] + v[c] * vv[c];
            add(x.f[i], uu, sum), add(x.g[i], uu, sum + 4), add(x.f[i], vv, sum + 8), add(x.f[i], ww, sum + 12);
        }
        for (int d = 0; d < 3; d++) offset_bar[d] = offset_bar[d] + along[d];
        each_share([&](int k) { collected[k] = collected[k] + sum[k]; });
    }

  private:
    static constexpr bool CARRIES_MASS = BY == By::slopes;

    static TC_INLINE void see_all(const P* offset, Axis<P>* axes) {
        for (int d = 0; d < 3; d++) see(BY, offset[d], axes[d]);
    }
    // Shares with the factors of the first axis: those of f f, g f and f g along the others.
    static TC_INLINE void first(P f, P g, const P* share, P* u, P* v, P* w) {
        u[0] = CARRIES_MASS ? f * share[0] : P(0.0);
        for (int c = 1; c < 4; c++) {
            u[c] = CARRIES_MASS ? g * share[4 + c] : f * share[c] + g * share[4 + c];
            v[c] = f * share[8 + c], w[c] = f * share[12 + c];
        }
    }
    // And of the second: those of f and g along the third.
    static TC_INLINE void second(P f, P g, const P* u, const P* v, const P* w, P* p, P* q) {
        p[0] = CARRIES_MASS ? f * u[0] : P(0.0);
        for (int c = 1; c < 4; c++) p[c] = f * u[c] + g * v[c], q[c] = f * w[c];
    }
    static TC_INLINE void clear(P* to) {
        for (int c = 0; c < 4; c++) to[c] = P(0.0);
    }
    static TC_INLINE void add(P factor, const P* x, P* to) {
        for (int c = CARRIES_MASS ? 0 : 1; c < 4; c++) to[c] = to[c] + factor * x[c];
    }
    static TC_INLINE P both(const P* p, const P* q, const P* pp, const P* qq) {
        P sum = CARRIES_MASS ? p[0] * pp[0] : P(0.0);
        for (int c = 1; c < 4; c++) sum = sum + p[c] * pp[c] + q[c] * qq[c];
        return sum;
    }
    template <class F>
    static TC_INLINE void each_share(F f) {
        if (CARRIES_MASS) f(0);
        for (int k = CARRIES_MASS ? 4 : 0; k < SHARES; k++)
            if (k % 4) f(k);
    }
    static TC_INLINE void look(const int* node, const R* grid, P* seen) {
        gather_quads([&](int lane) { return grid + size_t(node[lane]) * ON_NODE; }, seen);
    }
};

// Along directions: a point after the other, with the four numbers of a node, and their directions, side by side.
template <class R, By BY>
struct TransferAlong {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    using D = Along<R>;
    using Row = Pack<R, ON_NODE * DIRECTIONS>;
    const int* nodes;  // [AROUND, L]
    int lanes;

    void spread(const P* offset, const D* offset_dot, const P* share, const D* share_dot, R* grid_dot) const {
        Point p(offset, offset_dot);
        R own[4][L][4];
        for (int b = 0; b < 4; b++) {
            P quad[4] = {share[4 * b], share[4 * b + 1], share[4 * b + 2], share[4 * b + 3]};
            scatter_quads(quad, [&](int lane, Quad<R> numbers) { std::memcpy(own[b][lane], &numbers, sizeof(numbers)); });
        }
        for (int lane = 0; lane < lanes; lane++) {
            p.go_to(lane);
            Row s[4], t[4];
            for (int b = 0; b < 4; b++) {
                Quad<R> numbers;
                std::memcpy(&numbers, own[b][lane], sizeof(numbers));
                s[b] = widened(numbers);
                t[b] = joined_rows(share_dot + size_t(4 * b) * L + lane, L);
            }
            const int* node = nodes + lane;
            for (int i = 0; i < 3; i++) {
                const auto x = p.at(0, i);
                const Row u = x.f * s[0] + x.g * s[1], v = x.f * s[2], w = x.f * s[3];
                const Row ud = x.f * t[0] + x.g * t[1] + (x.f_slope * s[0] + x.g_slope * s[1]) * p.way[0];
                const Row turn = x.f_slope * p.way[0], vd = x.f * t[2] + turn * s[2], wd = x.f * t[3] + turn * s[3];
                for (int j = 0; j < 3; j++) {
                    const auto y = p.at(1, j);
                    const Row a = (y.f * u + y.g * v) * p.way[2], b = y.f * w * p.way[2];
                    const Row ad = y.f * ud + y.g * vd + (y.f_slope * u + y.g_slope * v) * p.way[1];
                    const Row bd = y.f * wd + y.f_slope * w * p.way[1];
                    for (int k = 0; k < 3; k++, node += L) {
                        const auto z = p.at(2, k);
                        Row& at = *reinterpret_cast<Row*>(grid_dot + size_t(*node) * ON_NODE * DIRECTIONS);
                        at = at + z.f * ad + z.g * bd + z.f_slope * a + z.g_slope * b;
                    }
                }
            }
        }
    }

    void collect(const P* offset, const D* offset_dot, D* share_dot, const R* grid, const R* grid_dot) const {
        Point p(offset, offset_dot);
        for (int lane = 0; lane < lanes; lane++) {
            p.go_to(lane);
            Row t[4] = {Row(0.0), Row(0.0), Row(0.0), Row(0.0)};
            const int* node = nodes + lane;
            for (int i = 0; i < 3; i++) {
                Quad<R> u(0.0), v(0.0), w(0.0);
                Row ud(0.0), vd(0.0), wd(0.0);
                for (int j = 0; j < 3; j++) {
                    Quad<R> a(0.0), b(0.0), a_slope(0.0), b_slope(0.0);
                    Row ad(0.0), bd(0.0);
                    for (int k = 0; k < 3; k++, node += L) {
                        const auto z = p.at(2, k);
                        const auto& g = *reinterpret_cast<const Quad<R>*>(grid + size_t(*node) * ON_NODE);
                        const auto& gd = *reinterpret_cast<const Row*>(grid_dot + size_t(*node) * ON_NODE * DIRECTIONS);
                        a = a + z.f * g, b = b + z.g * g, a_slope = a_slope + z.f_slope * g, b_slope = b_slope + z.g_slope * g;
                        ad = ad + z.f * gd, bd = bd + z.g * gd;
                    }
                    const auto y = p.at(1, j);
                    const Row turn = y.f_slope * p.way[1], wide = widened(a);
                    ad = ad + widened(a_slope) * p.way[2], bd = bd + widened(b_slope) * p.way[2];
                    ud = ud + y.f * ad + turn * wide, vd = vd + y.g * ad + y.g_slope * p.way[1] * wide;
                    wd = wd + y.f * bd + turn * widened(b);
                    u = u + y.f * a, v = v + y.g * a, w = w + y.f * b;
                }
                const auto x = p.at(0, i);
                const Row turn = x.f_slope * p.way[0], wide = widened(u);
                t[0] = t[0] + x.f * ud + turn * wide, t[1] = t[1] + x.g * ud + x.g_slope * p.way[0] * wide;
                t[2] = t[2] + x.f * vd + turn * widened(v), t[3] = t[3] + x.f * wd + turn * widened(w);
            }
            for (int b = 0; b < 4; b++) {
                D numbers[4];
                std::memcpy(numbers, &t[b], sizeof(numbers));
                for (int c = 0; c < 4; c++) share_dot[(4 * b + c) * L + lane] = numbers[c];
            }
        }
    }

  private:
    // Where a point is, and where it goes along each direction.
    struct Point {
        Axis<P> axes[3];
        const D* dot;
        int lane = 0;
        Row way[3];

        Point(const P* offset, const D* offset_dot) : dot(offset_dot) {
            for (int d = 0; d < 3; d++) see(BY, offset[d], axes[d]);
        }
        TC_INLINE void go_to(int next) {
            lane = next;
            for (int d = 0; d < 3; d++) way[d] = joined_rows(dot + size_t(d) * L + lane, 0);
        }
        struct Factors {
            R f, g, f_slope, g_slope;
        };
        TC_INLINE Factors at(int d, int i) const {
            const R* first = reinterpret_cast<const R*>(&axes[d]) + i * L + lane;
            return {first[0], first[3 * L], first[6 * L], first[9 * L]};
        }
    };
    static TC_INLINE Row joined_rows(const D* from, int step) {
        const D four[4] = {from[0], from[step], from[2 * step], from[3 * step]};
        Row out;
        std::memcpy(&out, four, sizeof(out));
        return out;
    }
    static TC_INLINE Row widened(Quad<R> a) {  // each number for all directions; in two steps, as in derivatives.h
        const auto b = __builtin_shufflevector(a.v, a.v, 0, 1, 2, 3, 0, 1, 2, 3);
        const auto c = __builtin_shufflevector(b, b, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        return Row(__builtin_shufflevector(c, c, 0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3));
    }
};

}  // namespace tc
