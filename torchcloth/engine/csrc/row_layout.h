// Conversion between rows of memory and packs. Fields of several components lie row by row, four numbers at a time, and
// are transposed in registers. Fields of one component lie contiguously.
#pragma once

#include <utility>

#include "pack.h"

namespace tc {

template <class R>
using Quad = Pack<R, 4>;

constexpr int round_up(int n, int to) { return (n + to - 1) / to * to; }
constexpr int pitch_of(int comps) { return comps == 1 ? 1 : round_up(comps, 4); }

// Transposes four packs whose chunks of four lanes are rows into packs of one component each; it is its own inverse.
inline void transpose(Pack<float, 16>* r) {
    typedef Pack<float, 16>::Lanes V;
#define TC_LANES(a, b, c, d) \
    a, b, c, d, a + 4, b + 4, c + 4, d + 4, a + 8, b + 8, c + 8, d + 8, a + 12, b + 12, c + 12, d + 12
    const V t0 = __builtin_shufflevector(r[0].v, r[1].v, TC_LANES(0, 16, 1, 17));
    const V t1 = __builtin_shufflevector(r[0].v, r[1].v, TC_LANES(2, 18, 3, 19));
    const V t2 = __builtin_shufflevector(r[2].v, r[3].v, TC_LANES(0, 16, 1, 17));
    const V t3 = __builtin_shufflevector(r[2].v, r[3].v, TC_LANES(2, 18, 3, 19));
    r[0].v = __builtin_shufflevector(t0, t2, TC_LANES(0, 1, 16, 17));
    r[1].v = __builtin_shufflevector(t0, t2, TC_LANES(2, 3, 18, 19));
    r[2].v = __builtin_shufflevector(t1, t3, TC_LANES(0, 1, 16, 17));
    r[3].v = __builtin_shufflevector(t1, t3, TC_LANES(2, 3, 18, 19));
#undef TC_LANES
}
inline void transpose(Pack<double, 8>* r) {
    typedef Pack<double, 8>::Lanes V;
#define TC_LANES(a, b, c, d) a, b, c, d, a + 4, b + 4, c + 4, d + 4
    const V t0 = __builtin_shufflevector(r[0].v, r[1].v, TC_LANES(0, 8, 2, 10));
    const V t1 = __builtin_shufflevector(r[0].v, r[1].v, TC_LANES(1, 9, 3, 11));
    const V t2 = __builtin_shufflevector(r[2].v, r[3].v, TC_LANES(0, 8, 2, 10));
    const V t3 = __builtin_shufflevector(r[2].v, r[3].v, TC_LANES(1, 9, 3, 11));
    r[0].v = __builtin_shufflevector(t0, t2, TC_LANES(0, 1, 8, 9));
    r[1].v = __builtin_shufflevector(t1, t3, TC_LANES(0, 1, 8, 9));
    r[2].v = __builtin_shufflevector(t0, t2, TC_LANES(2, 3, 10, 11));
    r[3].v = __builtin_shufflevector(t1, t3, TC_LANES(2, 3, 10, 11));
#undef TC_LANES
}

inline Pack<float, 16> concatenate(Quad<float> a, Quad<float> b, Quad<float> c, Quad<float> d) {
    const auto low = __builtin_shufflevector(a.v, b.v, 0, 1, 2, 3, 4, 5, 6, 7);
    const auto high = __builtin_shufflevector(c.v, d.v, 0, 1, 2, 3, 4, 5, 6, 7);
    return Pack<float, 16>(__builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15));
}
inline Pack<double, 8> concatenate(Quad<double> a, Quad<double> b) {
    return Pack<double, 8>(__builtin_shufflevector(a.v, b.v, 0, 1, 2, 3, 4, 5, 6, 7));
}

template <int Q>
inline Quad<float> chunk(Pack<float, 16> r) {
    return Quad<float>(__builtin_shufflevector(r.v, r.v, 4 * Q, 4 * Q + 1, 4 * Q + 2, 4 * Q + 3));
}
template <int Q>
inline Quad<double> chunk(Pack<double, 8> r) {
    return Quad<double>(__builtin_shufflevector(r.v, r.v, 4 * Q, 4 * Q + 1, 4 * Q + 2, 4 * Q + 3));
}

// Transposes a square of numbers: element `lane` of pack k and element k of pack `lane` change places.
template <int STEP, class R, int L, size_t... I>
inline void swap_off_diagonal(Pack<R, L>& a, Pack<R, L>& b, std::index_sequence<I...>) {
    const auto first = __builtin_shufflevector(a.v, b.v, (I & STEP ? L + I - STEP : I)...);
    const auto second = __builtin_shufflevector(a.v, b.v, (I & STEP ? L + I : I + STEP)...);
    a.v = first, b.v = second;
}
template <int STEP = 1, class R, int L>
inline void transpose_square(Pack<R, L>* r) {
    for (int k = 0; k < L; k++)
        if (!(k & STEP)) swap_off_diagonal<STEP>(r[k], r[k + STEP], std::make_index_sequence<L>{});
    if constexpr (2 * STEP < L) transpose_square<2 * STEP>(r);
}

// row(lane) returns where a lane's four numbers lie.
template <class F>
inline void gather_quads(F row, Pack<float, 16>* r) {
    auto at = [&](int lane) { return *reinterpret_cast<const Quad<float>*>(row(lane)); };
    for (int j = 0; j < 4; j++) r[j] = concatenate(at(j), at(4 + j), at(8 + j), at(12 + j));
    transpose(r);
}
template <class F>
inline void gather_quads(F row, Pack<double, 8>* r) {
    auto at = [&](int lane) { return *reinterpret_cast<const Quad<double>*>(row(lane)); };
    for (int j = 0; j < 4; j++) r[j] = concatenate(at(j), at(4 + j));
    transpose(r);
}

// Calls give(lane, four numbers) for every lane in order; destroys r.
template <class F>
inline void scatter_quads(Pack<float, 16>* r, F give) {
    transpose(r);
    for (int j = 0; j < 4; j++) give(j, chunk<0>(r[j]));
    for (int j = 0; j < 4; j++) give(4 + j, chunk<1>(r[j]));
    for (int j = 0; j < 4; j++) give(8 + j, chunk<2>(r[j]));
    for (int j = 0; j < 4; j++) give(12 + j, chunk<3>(r[j]));
}
template <class F>
inline void scatter_quads(Pack<double, 8>* r, F give) {
    transpose(r);
    for (int j = 0; j < 4; j++) give(j, chunk<0>(r[j]));
    for (int j = 0; j < 4; j++) give(4 + j, chunk<1>(r[j]));
}

}  // namespace tc
