// Kinematics of the triangles, and forces of their stresses on the vertices: torchcloth/dynamics.
#pragma once

#include "../vec.h"

namespace tc {

// f1, f2, cofactors dJ/df1 and dJ/df2, normal and J, from the corners and the warp and weft coefficients.
struct Surface {
    static constexpr const char* name = "surface";
    static constexpr int inputs = 13, outputs = 16;
    static constexpr auto constant_inputs = input_bits(9, 4);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number();
        const auto d1 = x1 - x0, d2 = x2 - x0;
        const auto f1 = a1 * d1 + a2 * d2, f2 = b1 * d1 + b2 * d2;
        const auto normal = cross(f1, f2);
        const T J = sqrt(dot(normal, normal));
        const auto n = normal / J;
        Writer<T> w{out};
        w.vec(f1), w.vec(f2), w.vec(cross(f2, n)), w.vec(cross(n, f1)), w.vec(n), w.number(J);
    }
};

// Edges from the first corner, from the corners and their compensation in float32. dynamics/kinematics.py, `surface`
struct CompensatedEdges {
    static constexpr const char* name = "compensated_edges";
    static constexpr int inputs = 18, outputs = 6;
    static constexpr auto constant_inputs = input_bits(9, 9);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec(), l0 = r.vec(), l1 = r.vec(), l2 = r.vec();
        Writer<T> w{out};
        w.vec((x1 - x0) + (l1 - l0)), w.vec((x2 - x0) + (l2 - l0));
    }
};

// Forces on the three corners, from the stress columns, the warp and weft coefficients and the area.
struct AssembleForces {
    static constexpr const char* name = "assemble_forces";
    static constexpr int inputs = 11, outputs = 9;
    static constexpr auto constant_inputs = input_bits(6, 5);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto p1 = r.vec(), p2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number(), area = r.number();
        const auto second = (-area) * (a1 * p1 + b1 * p2), third = (-area) * (a2 * p1 + b2 * p2);
        Writer<T> w{out};
        w.vec(-(second + third)), w.vec(second), w.vec(third);
    }
};

// Metric g = F^T F and J = sqrt(det g) = |f1 x f2|: a law of these is frame-indifferent by construction.
template <class T>
struct Metric {
    T warp, weft, shear, J;  // f1 . f1, f2 . f2, f1 . f2
};

template <class T>
constexpr Metric<T> metric(Vec<T> f1, Vec<T> f2) {
    const Vec<T> normal = cross(f1, f2);  // det g of slivers has no digits left in float32
    return {dot(f1, f1), dot(f2, f2), dot(f1, f2), sqrt(dot(normal, normal))};
}

// Second Piola-Kirchhoff stress: P = F S.
template <class T>
struct Stress {
    T warp, weft, shear;
};

// Forces of a membrane law on the corners, from the corners, the warp and weft coefficients, the area and the law's
// coefficients. This takes half the operations of the path over normals and cofactors.
template <class Law>
struct CornerForces {
    static constexpr int inputs = 14 + Law::coefficients, outputs = 9;
    static constexpr auto constant_inputs = input_bits(9, 5);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Reader<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number(), area = r.number();
        const auto d1 = x1 - x0, d2 = x2 - x0;
        const auto f1 = a1 * d1 + a2 * d2, f2 = b1 * d1 + b2 * d2;
        const Stress<T> s = Law::stress(metric(f1, f2), r.at);
        const auto p1 = (area * s.warp) * f1 + (area * s.shear) * f2, p2 = (area * s.shear) * f1 + (area * s.weft) * f2;
        const auto second = a1 * p1 + b1 * p2, third = a2 * p1 + b2 * p2;
        Writer<T> w{out};
        w.vec(second + third), w.vec(-second), w.vec(-third);
    }
};

}  // namespace tc
