// Membrane laws: torchcloth/materials and dynamics/elasticity.py.
#include "kernels.h"
#include "surface.h"

namespace tc {
namespace {

// The elastic deformation F A, where A (by rows) leads from another rest shape to the pattern. dynamics/elasticity.py
template <class T>
struct Elastic {
    Vec<T> f1, f2;
    T J;
    constexpr Elastic(Vec<T> g1, Vec<T> g2, T ratio, const T* a)
        : f1(a[0] * g1 + a[2] * g2), f2(a[1] * g1 + a[3] * g2), J((a[0] * a[3] - a[1] * a[2]) * ratio) {}
};

// f1, f2, cofactors, n and J of F A, from those of F, and A.
struct ElasticDeformation {
    static constexpr const char* name = "elastic_deformation";
    static constexpr int inputs = 20, outputs = 16;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec();
        r.at += 6;
        const auto n = r.vec();
        const T J = r.number();
        const Elastic<T> s(f1, f2, J, r.at);
        Writer<T> w{out};
        w.vec(s.f1), w.vec(s.f2), w.vec(cross(s.f2, n)), w.vec(cross(n, s.f1)), w.vec(n), w.number(s.J);
    }
};
TC_KERNEL(ElasticDeformation)

template <class T>
struct Columns {
    Vec<T> p1, p2;
};
template <class T>
constexpr Columns<T> pulled_back(Columns<T> p, const T* a) {
    return {a[0] * p.p1 + a[1] * p.p2, a[2] * p.p1 + a[3] * p.p2};
}

// Stress columns P A^T, from those of F A, and A.
struct PullBackStress {
    static constexpr const char* name = "pull_back_stress";
    static constexpr int inputs = 10, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto p1 = r.vec(), p2 = r.vec();
        const auto p = pulled_back(Columns<T>{p1, p2}, r.at);
        Writer<T> w{out};
        w.vec(p.p1), w.vec(p.p2);
    }
};
TC_KERNEL(PullBackStress)

// Stress columns P A^T / det A per area of the pattern, from those per true rest area, and A, the inverse growth.
struct RestDeformationPullback {
    static constexpr const char* name = "rest_deformation_pullback";
    static constexpr int inputs = 10, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto p1 = r.vec(), p2 = r.vec();
        const T* a = r.at;
        const auto p = pulled_back(Columns<T>{p1, p2}, a);
        const T area_ratio = 1.0 / (a[0] * a[3] - a[1] * a[2]);
        Writer<T> w{out};
        w.vec(area_ratio * p.p1), w.vec(area_ratio * p.p2);
    }
};
TC_KERNEL(RestDeformationPullback)

// Plastic set A after the substep, from f1, f2, cofactors, n, J, A before and the limit. materials/yielding.py
struct NormYield {
    static constexpr const char* name = "norm_yield";
    static constexpr int inputs = 21, outputs = 4;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec();
        r.at += 9;
        const T J = r.number();
        const T* a = r.at;
        const T limit = a[4];
        const Elastic<T> s(f1, f2, J, a);
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
TC_KERNEL(NormYield)

// materials/corotated.py with the cofactors (g_ff f1 - g_wf f2) / J: 2 mu (F - polar rotation) + pressure cof F.
template <class T>
constexpr Stress<T> corotated(Metric<T> g, T mu, T pressure) {
    const T bend = 2.0 * mu / sqrt(g.warp + g.weft + 2.0 * g.J);
    const T along = 2.0 * mu - bend, across = (pressure - bend) / g.J;
    return {along + across * g.weft, along + across * g.warp, -(across * g.shear)};
}

// Coefficients mu, lambda. materials/aep.py
struct Isotropic {
    static constexpr int coefficients = 2;
    template <class T>
    static constexpr Stress<T> stress(Metric<T> g, const T* c) { return corotated(g, c[0], c[1] * (g.J - 1.0)); }
};

// Tension of the stiffening weave. materials/stiffening.py
template <class T>
constexpr T stiffened(T modulus, T strain, T reach) {
    const T positive = at_least(strain, 0.0), curved = select(less(reach, positive), reach, positive);
    return modulus * curved * (curved + 2.0 * at_least(strain - reach, 0.0));
}

// Coefficients mu, lambda, balance, warp, weft, their stiffening, its reach. materials/orthotropic.py
struct Orthotropic {
    static constexpr int coefficients = 8;
    template <class T>
    static constexpr Stress<T> stress(Metric<T> g, const T* c) {
        const T mu = c[0], lam = c[1], balance = c[2], warp = c[3], weft = c[4], warp_toe = c[5], weft_toe = c[6],
                reach = c[7];
        const T length1 = sqrt(g.warp), length2 = sqrt(g.weft);
        const T e1 = length1 - 1.0, e2 = length2 - 1.0;
        const T more = balance - 1.0, fewer = 1.0 / balance - 1.0;
        const T pressure = lam * (g.J - 1.0 + more * e1 + fewer * e2);
        const T tension1 = warp * e1 + more * pressure + stiffened(warp_toe, e1, reach);
        const T tension2 = weft * e2 + fewer * pressure + stiffened(weft_toe, e2, reach);
        const Stress<T> s = corotated(g, mu, pressure);
        return {s.warp + tension1 / length1, s.weft + tension2 / length2, s.shear};
    }
};

// Stress columns for rest shapes other than the pattern, from f1, f2, cofactors, n, J and the law's coefficients.
template <class Law>
struct SurfaceStress {
    static constexpr int inputs = Surface::outputs + Law::coefficients, outputs = 6;
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto f1 = r.vec(), f2 = r.vec();
        const Stress<T> s = Law::stress(Metric<T>{dot(f1, f1), dot(f2, f2), dot(f1, f2), in[15]}, in + 16);
        Writer<T> w{out};
        w.vec(s.warp * f1 + s.shear * f2), w.vec(s.shear * f1 + s.weft * f2);
    }
};

struct IsotropicForces : CornerForces<Isotropic> { static constexpr const char* name = "aep_forces"; };
TC_KERNEL(IsotropicForces)
struct IsotropicStress : SurfaceStress<Isotropic> { static constexpr const char* name = "aep_stress"; };
TC_KERNEL(IsotropicStress)
struct OrthotropicForces : CornerForces<Orthotropic> { static constexpr const char* name = "orthotropic_forces"; };
TC_KERNEL(OrthotropicForces)
struct OrthotropicStress : SurfaceStress<Orthotropic> { static constexpr const char* name = "orthotropic_stress"; };
TC_KERNEL(OrthotropicStress)

}  // namespace

}  // namespace tc
