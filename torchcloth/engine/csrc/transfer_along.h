// Tangents of transfer.h: a point after the other, with the four numbers of a node, and their directions, side by side.
#pragma once

#include "transfer.h"

namespace tc {

template <class R, By BY>
struct TransferAlong {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    using D = Along<R>;
    using Row = Pack<R, ON_NODE * DIRECTIONS>;
    const int* around;  // [L, AROUND]
    int lanes;

    void spread(const P* offset, const D* offset_dot, const P* share, const D* share_dot, R* grid_dot) const {
        Point p(offset, offset_dot);
        Block<R> own[L];
        to_lanes<R>(share, own);
        for (int lane = 0; lane < lanes; lane++) {
            p.go_to(lane);
            Row s[4], t[4];
            for (int b = 0; b < 4; b++) {
                s[b] = widened(reinterpret_cast<const Quad<R>*>(own + lane)[b]);
                t[b] = joined_rows(share_dot + size_t(4 * b) * L + lane, L);
            }
            const int* block = around + lane * AROUND;
            const int begin = int(p.second[lane]);
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
                    Row* at = reinterpret_cast<Row*>(grid_dot) + size_t(block[3 * i + j]) * 4 + begin;
                    for (int k = 0; k < 3; k++, at++) {
                        const auto z = p.at(2, k);
                        *at = *at + z.f * ad + z.g * bd + z.f_slope * a + z.g_slope * b;
                    }
                }
            }
        }
        is_written(grid_dot);
    }

    void collect(const P* offset, const D* offset_dot, D* share_dot, const R* grid, const R* grid_dot) const {
        Point p(offset, offset_dot);
        for (int lane = 0; lane < lanes; lane++) {
            p.go_to(lane);
            Row t[4] = {Row(0.0), Row(0.0), Row(0.0), Row(0.0)};
            const int* block = around + lane * AROUND;
            const int begin = int(p.second[lane]);
            for (int i = 0; i < 3; i++) {
                Quad<R> u(0.0), v(0.0), w(0.0);
                Row ud(0.0), vd(0.0), wd(0.0);
                for (int j = 0; j < 3; j++) {
                    Quad<R> a(0.0), b(0.0), a_slope(0.0), b_slope(0.0);
                    Row ad(0.0), bd(0.0);
                    for (int k = 0; k < 3; k++) {
                        const auto z = p.at(2, k);
                        const size_t node = size_t(block[3 * i + j]) * 4 + begin + k;
                        const auto& g = *reinterpret_cast<const Quad<R>*>(grid + node * ON_NODE);
                        const auto& gd = *reinterpret_cast<const Row*>(grid_dot + node * ON_NODE * DIRECTIONS);
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
        P second;
        const D* dot;
        int lane = 0;
        Row way[3];

        Point(const P* offset, const D* offset_dot) : second(begins(offset)), dot(offset_dot) {
            for (int d = 0; d < 3; d++) see(BY, d == 2 ? offset[2] - second : offset[d], axes[d]);
        }
        TC_INLINE void go_to(int next) {
            lane = next;
            for (int d = 0; d < 3; d++) way[d] = joined_rows(dot + size_t(d) * L + lane, 0);
        }
        TC_INLINE Factors<R> at(int d, int i) const { return Factors<R>(axes[d], i, lane); }
    };
    static TC_INLINE Row joined_rows(const D* from, int step) {
        const D four[4] = {from[0], from[step], from[2 * step], from[3 * step]};
        Row out;
        std::memcpy(&out, four, sizeof(out));
        return out;
    }
};

}  // namespace tc
