// Packs of L numbers, and their arithmetic, which all kernels use. GCC and Clang compile it to the processor's SIMD
// instructions.
#pragma once

#include <cmath>
#include <cstdint>

#include "enums.h"

namespace tc {

constexpr int WIDTH = 64;  // bytes of a pack, one cache line

template <class R, int L>
struct Pack {
    typedef R Lanes __attribute__((vector_size(sizeof(R) * L)));
    Lanes v;

    Pack() = default;
    Pack(Lanes lanes) : v(lanes) {}
    Pack(double c) : v(Lanes{} + R(c)) {}
    R operator[](int lane) const { return v[lane]; }
};

// A pack wider than a register has two halves. As one vector, the compiler would pass it through memory.
template <class R, int L>
constexpr bool HALVED = L * int(sizeof(R)) > WIDTH;
template <class R, int L>
    requires(HALVED<R, L>)
struct Pack<R, L> {
    using Half = Pack<R, L / 2>;
    Half low, high;

    Pack() = default;
    Pack(Half low, Half high) : low(low), high(high) {}
    Pack(double c) : low(c), high(c) {}
};

template <class R>
constexpr int LANES = WIDTH / int(sizeof(R));
template <class R>
using Wide = Pack<R, LANES<R>>;

#define TC_BINARY(op)                                                                                     \
    template <class R, int L>                                                                             \
    inline Pack<R, L> operator op(Pack<R, L> a, Pack<R, L> b) { return Pack<R, L>(a.v op b.v); }          \
    template <class R, int L>                                                                             \
    inline Pack<R, L> operator op(Pack<R, L> a, double b) { return Pack<R, L>(a.v op R(b)); }             \
    template <class R, int L>                                                                             \
    inline Pack<R, L> operator op(double a, Pack<R, L> b) { return Pack<R, L>(R(a) op b.v); }             \
    template <class R, int L>                                                                             \
        requires(HALVED<R, L>)                                                                            \
    inline Pack<R, L> operator op(Pack<R, L> a, Pack<R, L> b) { return {a.low op b.low, a.high op b.high}; } \
    template <class R, int L>                                                                             \
        requires(HALVED<R, L>)                                                                            \
    inline Pack<R, L> operator op(Pack<R, L> a, double b) { return {a.low op b, a.high op b}; }           \
    template <class R, int L>                                                                             \
        requires(HALVED<R, L>)                                                                            \
    inline Pack<R, L> operator op(double a, Pack<R, L> b) { return {a op b.low, a op b.high}; }
TC_BINARY(+)
TC_BINARY(-)
TC_BINARY(*)
TC_BINARY(/)
#undef TC_BINARY

template <class R, int L>
inline Pack<R, L> operator-(Pack<R, L> a) { return Pack<R, L>(-a.v); }

// Comparisons return 1 or 0; `select` returns the first argument after the condition where that is not 0.
template <class R, int L>
inline Pack<R, L> less(Pack<R, L> a, Pack<R, L> b) {
    return Pack<R, L>(a.v < b.v ? Pack<R, L>(1.0).v : Pack<R, L>(0.0).v);
}
template <class R, int L>
inline Pack<R, L> less(Pack<R, L> a, double b) { return less(a, Pack<R, L>(b)); }
template <class R, int L>
inline Pack<R, L> less(double a, Pack<R, L> b) { return less(Pack<R, L>(a), b); }
template <class R, int L>
inline Pack<R, L> select(Pack<R, L> c, Pack<R, L> a, Pack<R, L> b) {
    return Pack<R, L>(c.v != Pack<R, L>(0.0).v ? a.v : b.v);
}
template <class R, int L>
inline Pack<R, L> select(Pack<R, L> c, Pack<R, L> a, double b) { return select(c, a, Pack<R, L>(b)); }
template <class R, int L>
inline Pack<R, L> select(Pack<R, L> c, double a, Pack<R, L> b) { return select(c, Pack<R, L>(a), b); }
template <class R, int L>
inline Pack<R, L> at_least(Pack<R, L> a, double c) { return select(less(a, c), Pack<R, L>(c), a); }
template <class R, int L>
inline Pack<R, L> at_most(Pack<R, L> a, double c) { return select(less(c, a), Pack<R, L>(c), a); }
template <class R, int L>
inline Pack<R, L> larger(Pack<R, L> a, Pack<R, L> b) { return select(less(a, b), b, a); }
template <class R, int L>
inline Pack<R, L> abs(Pack<R, L> a) { return select(less(a, 0.0), -a, a); }
template <class R, int L>
inline Pack<R, L> detach(Pack<R, L> a) { return a; }
template <class R, int L>
inline Pack<R, L> constant(Pack<R, L>, double c) { return Pack<R, L>(c); }

#define TC_EACH(name, call)                                                                               \
    template <class R, int L>                                                                             \
    inline Pack<R, L> name(Pack<R, L> a) {                                                                \
        Pack<R, L> r;                                                                                     \
        for (int i = 0; i < L; i++) r.v[i] = call(a.v[i]);                                                \
        return r;                                                                                         \
    }
TC_EACH(sqrt, std::sqrt)
#undef TC_EACH

template <class R, int L>
inline R total(Pack<R, L> a) {
    for (int half = L / 2; half > 0; half /= 2)
        for (int i = 0; i < half; i++) a.v[i] += a.v[i + half];
    return a.v[0];
}

}  // namespace tc
