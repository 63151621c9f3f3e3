// Kinematics of the triangles, and how their stresses reach the vertices: torchcloth/dynamics/model.py, dynamics.py.
#pragma once

#include "../vec.h"

namespace tc {

// Corners, warp and weft coefficients -> f1, f2, cofactors dJ/df1 and dJ/df2, normal, J.
struct Surface {
    static constexpr const char* name = "surface";
    static constexpr int inputs = 13, outputs = 16;
    static constexpr auto fixed = bits(9, 4);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number();
        const auto d1 = x1 - x0, d2 = x2 - x0;
        const auto f1 = a1 * d1 + a2 * d2, f2 = b1 * d1 + b2 * d2;
        const auto normal = cross(f1, f2);
        const T J = sqrt(dot(normal, normal));
        const auto n = normal / J;
        Write<T> w{out};
        w.vec(f1), w.vec(f2), w.vec(cross(f2, n)), w.vec(cross(n, f1)), w.vec(n), w.number(J);
    }
};

// Corners, what float32 has lost of them -> the second and third from the first. See model.py, ``surface``.
struct Edges {
    static constexpr const char* name = "edges";
    static constexpr int inputs = 18, outputs = 6;
    static constexpr auto fixed = bits(9, 9);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec(), l0 = r.vec(), l1 = r.vec(), l2 = r.vec();
        Write<T> w{out};
        w.vec((x1 - x0) + (l1 - l0)), w.vec((x2 - x0) + (l2 - l0));
    }
};

// Stress columns, warp and weft coefficients, area -> forces on the three corners.
struct Assemble {
    static constexpr const char* name = "assemble";
    static constexpr int inputs = 11, outputs = 9;
    static constexpr auto fixed = bits(6, 5);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto p1 = r.vec(), p2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number(), area = r.number();
        const auto second = (-area) * (a1 * p1 + b1 * p2), third = (-area) * (a2 * p1 + b2 * p2);
        Write<T> w{out};
        w.vec(-(second + third)), w.vec(second), w.vec(third);
    }
};

// What an in-plane law sees of F: g = F^T F, and J = sqrt(det g) = |f1 x f2|. Frame-indifferent by construction.
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

// A membrane law from positions to forces: corners, warp and weft coefficients, area, the law's own numbers -> forces on
// the corners. Half the operations of the way over normals and cofactors.
template <class Law>
struct Sheet {
    static constexpr int inputs = 14 + Law::numbers, outputs = 9;
    static constexpr auto fixed = bits(9, 5);
    template <class T>
    static constexpr void run(const T* in, T* out) {
        Read<T> r{in};
        const auto x0 = r.vec(), x1 = r.vec(), x2 = r.vec();
        const T a1 = r.number(), a2 = r.number(), b1 = r.number(), b2 = r.number(), area = r.number();
        const auto d1 = x1 - x0, d2 = x2 - x0;
        const auto f1 = a1 * d1 + a2 * d2, f2 = b1 * d1 + b2 * d2;
        const Stress<T> s = Law::stress(metric(f1, f2), r.at);
        const auto p1 = (area * s.warp) * f1 + (area * s.shear) * f2, p2 = (area * s.shear) * f1 + (area * s.weft) * f2;
        const auto second = a1 * p1 + b1 * p2, third = a2 * p1 + b2 * p2;
        Write<T> w{out};
        w.vec(second + third), w.vec(-second), w.vec(-third);
    }
};

}  // namespace tc
