// exp, expm1 and atan2 of packs, accurate to one or two units in the last place. They are polynomials, so that no lane
// waits for a library call.
#pragma once

#include "pack.h"

namespace tc {

template <class R>
struct Format;
template <>
struct Format<float> {
    using Int = int32_t;
    static constexpr int mantissa = 23, bias = 127, exp_terms = 7, atan_terms = 5;
    static constexpr double whole = 0x1.8p23, largest = 87, ln2 = 0x1.62ep-1, ln2_rest = 0x1.0bfbe8e7bcd5ep-15;
    static constexpr double atan[] = {-0.33333331760434555943, 0.19999540314957969397, -0.14263949753605724022,
                                      0.10743668324830098134, -0.064517188693589580726};
};
template <>
struct Format<double> {
    using Int = int64_t;
    static constexpr int mantissa = 52, bias = 1023, exp_terms = 13, atan_terms = 11;
    static constexpr double whole = 0x1.8p52, largest = 708, ln2 = 0x1.62e42feep-1, ln2_rest = 0x1.a39ef35793c76p-33;
    static constexpr double atan[] = {-0.33333333333333330156, 0.19999999999995516545,  -0.14285714284665680761,
                                      0.11111111015107018721,  -0.090909045753064890845, 0.076921831253768920895,
                                      -0.066645105255089365988, 0.058581409048663282818, -0.050854078345894842573,
                                      0.039230447784793095235, -0.019175404711104933678};
};

// Splits x = k ln 2 + r with |r| <= ln 2 / 2 into 2^k and exp(r) - 1. Adding a number so large that it has no fraction
// rounds the quotient. ln 2 has two parts, so that k times the first is exact. Beyond the range, the end of the range
// counts.
template <class R, int L>
inline void split_exp(Pack<R, L> x, Pack<R, L>& power, Pack<R, L>& rest) {
    using P = Pack<R, L>;
    using F = Format<R>;
    typedef typename F::Int Ints __attribute__((vector_size(sizeof(R) * L)));
    x = at_most(at_least(x, -F::largest), F::largest);
    const P shifted = x * 1.44269504088896340736 + F::whole, k = shifted - F::whole;
    const P r = (x - k * F::ln2) - k * F::ln2_rest;
    P sum(1.0 / F::exp_terms);
    for (int n = F::exp_terms - 1; n >= 1; n--) sum = (sum * r + 1.0) * (1.0 / n);
    rest = sum * r;
    const Ints exponent = (Ints)shifted.v - (Ints)P(F::whole).v;
    power = P((typename P::Lanes)((exponent + F::bias) << F::mantissa));
}
template <class R, int L>
inline Pack<R, L> exp(Pack<R, L> x) {
    Pack<R, L> power, rest;
    split_exp(x, power, rest);
    return power * rest + power;
}
template <class R, int L>
inline Pack<R, L> expm1(Pack<R, L> x) {
    Pack<R, L> power, rest;
    split_exp(x, power, rest);
    return power * rest + (power - 1.0);
}

// The smaller over the larger coordinate; beyond tan(pi/8) the angle is taken from the diagonal.
template <class R, int L>
inline Pack<R, L> atan2(Pack<R, L> y, Pack<R, L> x) {
    using P = Pack<R, L>;
    const P width = abs(x), height = abs(y), steep = less(width, height);
    const P large = select(steep, height, width), small = select(steep, width, height);
    const P diagonal = less(large * 0.41421356237309504880, small);
    const P above = select(diagonal, small - large, small), below = select(diagonal, small + large, large);
    const P t = above / select(less(0.0, below), below, P(1.0)), z = t * t;
    P sum(Format<R>::atan[Format<R>::atan_terms - 1]);
    for (int n = Format<R>::atan_terms - 2; n >= 0; n--) sum = sum * z + Format<R>::atan[n];
    P angle = select(diagonal, P(0.78539816339744830962), P(0.0)) + (t + t * (z * sum));
    angle = select(steep, 1.57079632679489661923 - angle, angle);
    angle = select(less(x, 0.0), 3.14159265358979323846 - angle, angle);
    return select(less(y, 0.0), -angle, angle);
}

}  // namespace tc
