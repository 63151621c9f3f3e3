// Membrane laws: torchcloth/materials and strain.py.
#include "kernels.h"
#include "../vec.h"

namespace tc {

// The surface seen from another rest shape: F -> F A with A by rows. strain.py
template <class T>
struct Seen {
    Vec<T> f1, f2;
    T J;
    constexpr Seen(Vec<T> g1, Vec<T> g2, T ratio, const T* a)
        : f1(a[0] * g1 + a[2] * g2), f2(a[1] * g1 + a[3] * g2), J((a[0] * a[3] - a[1] * a[2]) * ratio) {}
};

// f1, f2, cofactors, n, J, A -> the same of F A.
struct SeenFrom {
    static constexpr const char* name = "seen_from";
    static constexpr int inputs = 20, outputs = 16;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec();
        r.at += 6;
        const auto n = r.vec();
        const T J = r.number();
        const Seen<T> s(f1, f2, J, r.at);
        Write<T> w{out};
        w.vec(s.f1), w.vec(s.f2), w.vec(cross(s.f2, n)), w.vec(cross(n, s.f1)), w.vec(n), w.number(s.J);
    }
};

template <class T>
struct Columns {
    Vec<T> p1, p2;
};
template <class T>
constexpr Columns<T> pulled_back(Columns<T> p, const T* a) {
    return {a[0] * p.p1 + a[1] * p.p2, a[2] * p.p1 + a[3] * p.p2};
}

// Stress columns of F A, A -> P A^T.
struct PulledBack {
    static constexpr const char* name = "pulled_back";
    static constexpr int inputs = 10, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p1 = r.vec(), p2 = r.vec();
        const auto p = pulled_back(Columns<T>{p1, p2}, r.at);
        Write<T> w{out};
        w.vec(p.p1), w.vec(p.p2);
    }
};

// Stress columns per true rest area, A = inverse growth -> P A^T / det A, per area of the pattern.
struct Grown {
    static constexpr const char* name = "grown";
    static constexpr int inputs = 10, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p1 = r.vec(), p2 = r.vec();
        const T* a = r.at;
        const auto p = pulled_back(Columns<T>{p1, p2}, a);
        const T share = 1.0 / (a[0] * a[3] - a[1] * a[2]);
        Write<T> w{out};
        w.vec(share * p.p1), w.vec(share * p.p2);
    }
};

// f1, f2, cofactors, n, J, set A before, limit -> A after. materials/yielding.py
struct NormYield {
    static constexpr const char* name = "norm_yield";
    static constexpr int inputs = 21, outputs = 4;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec();
        r.at += 9;
        const T J = r.number();
        const T* a = r.at;
        const T limit = a[4];
        const Seen<T> s(f1, f2, J, a);
        const T warp = dot(s.f1, s.f1), weft = dot(s.f2, s.f2), trace = sqrt(warp + weft + 2.0 * s.J);
        const T u11 = (warp + s.J) / trace, u22 = (weft + s.J) / trace, u12 = dot(s.f1, s.f2) / trace;
        const T e1 = u11 - 1.0, e2 = u22 - 1.0;
        const T length = safe_sqrt(e1 * e1 + 2.0 * (u12 * u12) + e2 * e2);
        const T yields = less(limit, length);
        const T keep = select(yields, limit / select(yields, length, 1.0), 1.0);
        const T turn = (1.0 - keep) / s.J;  // U^-1 (1 + keep (U - 1)) = keep + (1 - keep) adj U / J
        const T c11 = turn * u22 + keep, c12 = -(turn * u12), c22 = turn * u11 + keep;
        for (int row = 0; row < 4; row += 2) {
            out[row] = select(yields, a[row] * c11 + a[row + 1] * c12, a[row]);
            out[row + 1] = select(yields, a[row] * c12 + a[row + 1] * c22, a[row + 1]);
        }
    }
};

// materials/corotated.py: 2 mu (F - polar rotation) + pressure cof F.
template <class T>
constexpr Columns<T> corotated(T mu, T pressure, Vec<T> f1, Vec<T> f2, Vec<T> c1, Vec<T> c2, T J) {
    const T s = sqrt(dot(f1, f1) + dot(f2, f2) + 2.0 * J);
    const T bend = 2.0 * mu / s;
    const T along = 2.0 * mu - bend, across = pressure - bend;
    return {along * f1 + across * c1, along * f2 + across * c2};
}

// f1, f2, cofactors, n, J, mu, lambda -> stress columns. materials/aep.py
struct Isotropic {
    static constexpr const char* name = "aep";
    static constexpr int inputs = 18, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec(), c1 = r.vec(), c2 = r.vec();
        r.at += 3;
        const T J = r.number(), mu = r.number(), lam = r.number();
        const auto p = corotated(mu, lam * (J - 1.0), f1, f2, c1, c2, J);
        Write<T> w{out};
        w.vec(p.p1), w.vec(p.p2);
    }
};

// What stiffening adds to the tension. materials/stiffening.py
template <class T>
constexpr T stiffened(T modulus, T strain, T reach) {
    const T positive = at_least(strain, 0.0), curved = select(less(reach, positive), reach, positive);
    return modulus * curved * (curved + 2.0 * at_least(strain - reach, 0.0));
}

// f1, f2, cofactors, n, J, mu, lambda, balance, warp, weft, their toes, reach -> stress columns. materials/orthotropic.py
struct Orthotropic {
    static constexpr const char* name = "orthotropic";
    static constexpr int inputs = 24, outputs = 6;
    static constexpr auto fixed = bits(23, 1);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec(), c1 = r.vec(), c2 = r.vec();
        r.at += 3;
        const T J = r.number(), mu = r.number(), lam = r.number(), balance = r.number();
        const T warp = r.number(), weft = r.number(), warp_toe = r.number(), weft_toe = r.number(), reach = r.number();
        const T length1 = safe_norm(f1), length2 = safe_norm(f2);
        const T e1 = length1 - 1.0, e2 = length2 - 1.0;
        const T more = balance - 1.0, fewer = 1.0 / balance - 1.0;
        const T pressure = lam * (J - 1.0 + more * e1 + fewer * e2);
        const T tension1 = warp * e1 + more * pressure + stiffened(warp_toe, e1, reach);
        const T tension2 = weft * e2 + fewer * pressure + stiffened(weft_toe, e2, reach);
        const auto p = corotated(mu, pressure, f1, f2, c1, c2, J);
        Write<T> w{out};
        w.vec(p.p1 + tension1 / length1 * f1), w.vec(p.p2 + tension2 / length2 * f2);
    }
};

TC_KERNELS(material_kernels, SeenFrom, PulledBack, Grown, NormYield, Isotropic, Orthotropic)

}  // namespace tc
