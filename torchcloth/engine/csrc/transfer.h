// Between points and the 27 nodes of the grid around each. With bases B and a point's shares S, four numbers per basis,
// everything follows from the sum over bases and nodes of B(n) S . G(n):
//
//     spread   G(n) += B(n) S          collect   S += sum over n of B(n) G(n)          weigh   B(n) += S . G(n)
//
// and each is what the others need for their adjoints and tangents. Bases and shares lie in registers, basis by basis.
#pragma once

#include <type_traits>
#include <utility>

#include "rows.h"
#include "tape.h"

namespace tc {

constexpr int AROUND = 27;  // nodes of a point
constexpr int ON_NODE = 4;  // numbers of a node
constexpr int NOBODY = 0;   // node of the lanes behind the last point: always zero

// Of the numbers of a node, the first is mass, which only the first of two bases carries; the others are a vector.
constexpr bool carries(int bases, int b, int c) { return (bases == 2 && b == 0) == (c == 0); }

template <class R, int BASES>
struct Transfer {
    static constexpr int L = LANES<R>;
    using P = Wide<R>;
    using D = Along<R>;
    const int* nodes;  // [AROUND, L]
    int lanes;         // that are points

    void spread(const P* basis, const P* share, R* grid) const {
        const bool whole = lanes == L;
        for (int n = 0; n < AROUND; n++) {
            P given[ON_NODE];
            for (int c = 0; c < ON_NODE; c++) given[c] = P(0.0);
            each([&](auto k, auto b, auto c) { given[c] = given[c] + basis[b * AROUND + n] * share[k]; });
            const int* node = nodes + n * L;
            scatter_quads(given, [&](int lane, Quad<R> numbers) {
                if (!whole && lane >= lanes) return;
                Quad<R>& at = *reinterpret_cast<Quad<R>*>(grid + size_t(node[lane]) * ON_NODE);
                at = at + numbers;
            });
        }
    }
    void collect(const P* basis, P* share, const R* grid) const {
        P sum[BASES * ON_NODE];
        each([&](auto k, auto, auto) { sum[k] = share[k]; });
        for (int n = 0; n < AROUND; n++) {
            P seen[ON_NODE];
            look(n, grid, seen);
            each([&](auto k, auto b, auto c) { sum[k] = sum[k] + basis[b * AROUND + n] * seen[c]; });
        }
        each([&](auto k, auto, auto) { share[k] = sum[k]; });
    }
    void weigh(P* basis, const P* share, const R* grid) const {
        for (int n = 0; n < AROUND; n++) {
            P seen[ON_NODE];
            look(n, grid, seen);
            each([&](auto k, auto b, auto c) { basis[b * AROUND + n] = basis[b * AROUND + n] + share[k] * seen[c]; });
        }
    }
    // Both at once, of the adjoint of what was spread.
    void collect_and_weigh(const P* basis, P* basis_bar, const P* share, P* share_bar, const R* grid) const {
        P sum[BASES * ON_NODE];
        each([&](auto k, auto, auto) { sum[k] = share_bar[k]; });
        for (int n = 0; n < AROUND; n++) {
            P seen[ON_NODE];
            look(n, grid, seen);
            each([&](auto k, auto b, auto c) {
                sum[k] = sum[k] + basis[b * AROUND + n] * seen[c];
                basis_bar[b * AROUND + n] = basis_bar[b * AROUND + n] + share[k] * seen[c];
            });
        }
        each([&](auto k, auto, auto) { share_bar[k] = sum[k]; });
    }
    // Of directions: what a lane's bases and shares, and their tangents, give to the nodes' tangents.
    void spread_along(const R* basis, const D* basis_dot, const R* share, const D* share_dot, D* grid) const {
        for (int lane = 0; lane < lanes; lane++) {
            R own[BASES * ON_NODE];
            D dots[BASES * ON_NODE];
            each([&](auto k, auto, auto) { own[k] = share[k * L + lane], dots[k] = share_dot[k * L + lane]; });
            for (int n = 0; n < AROUND; n++) {
                D* at = grid + size_t(nodes[n * L + lane]) * ON_NODE;
                D sum[ON_NODE];
                for (int c = first; c < ON_NODE; c++) sum[c] = at[c];
                each([&](auto k, auto b, auto c) {
                    const int m = (b * AROUND + n) * L + lane;
                    sum[c] = sum[c] + basis[m] * dots[k] + own[k] * basis_dot[m];
                });
                for (int c = first; c < ON_NODE; c++) at[c] = sum[c];
            }
        }
    }
    void collect_along(const R* basis, const D* basis_dot, D* share_dot, const R* grid, const D* grid_dot) const {
        for (int lane = 0; lane < lanes; lane++) {
            D sum[BASES * ON_NODE];
            for (D& x : sum) x = D(0.0);
            for (int n = 0; n < AROUND; n++) {
                const size_t at = size_t(nodes[n * L + lane]) * ON_NODE;
                each([&](auto k, auto b, auto c) {
                    const int m = (b * AROUND + n) * L + lane;
                    sum[k] = sum[k] + basis[m] * grid_dot[at + c] + grid[at + c] * basis_dot[m];
                });
            }
            for (int k = 0; k < BASES * ON_NODE; k++) share_dot[k * L + lane] = sum[k];
        }
    }

  private:
    static constexpr int first = BASES == 2 ? 0 : 1;

    // f(share, basis, number) for all numbers that a basis carries, as constants.
    template <class F>
    TC_INLINE static void each(F f) { each(f, std::make_integer_sequence<int, BASES * ON_NODE>{}); }
    template <class F, int... K>
    TC_INLINE static void each(F f, std::integer_sequence<int, K...>) { (one<K>(f), ...); }
    template <int K, class F>
    TC_INLINE static void one(F f) {
        constexpr int b = K / ON_NODE, c = K % ON_NODE;
        if constexpr (carries(BASES, b, c)) f(std::integral_constant<int, K>{}, std::integral_constant<int, b>{}, std::integral_constant<int, c>{});
    }
    void look(int n, const R* grid, P* seen) const {
        const int* node = nodes + n * L;
        gather_quads([&](int lane) { return grid + size_t(node[lane]) * ON_NODE; }, seen);
    }
};

}  // namespace tc
