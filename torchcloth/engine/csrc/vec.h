// Vectors of three numbers of any type, and readers that turn a kernel's flat arguments into them.
#pragma once

#include "tape.h"

namespace tc {

template <class T>
struct Vec {
    T x, y, z;
};

template <class T>
constexpr Vec<T> operator+(Vec<T> a, Vec<T> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class T>
constexpr Vec<T> operator-(Vec<T> a, Vec<T> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class T>
constexpr Vec<T> operator-(Vec<T> a) { return {-a.x, -a.y, -a.z}; }
template <class T>
constexpr Vec<T> operator*(T s, Vec<T> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class T>
constexpr Vec<T> operator*(double s, Vec<T> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class T>
constexpr Vec<T> operator/(Vec<T> a, T s) { return {a.x / s, a.y / s, a.z / s}; }
template <class T>
constexpr T dot(Vec<T> a, Vec<T> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
template <class T>
constexpr Vec<T> cross(Vec<T> a, Vec<T> b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
constexpr Vec<T> select(T c, Vec<T> a, Vec<T> b) {
    return {select(c, a.x, b.x), select(c, a.y, b.y), select(c, a.z, b.z)};
}

// Square root with value and derivative 0 at 0.
template <class T>
constexpr T safe_sqrt(T squared) {
    const T positive = less(0.0, squared);
    return select(positive, sqrt(select(positive, squared, 1.0)), 0.0);
}
template <class T>
constexpr T safe_norm(Vec<T> a) { return safe_sqrt(dot(a, a)); }

template <class T>
struct Mat {  // by rows
    Vec<T> a, b, c;
};
template <class T>
constexpr Vec<T> operator*(Mat<T> m, Vec<T> v) { return {dot(m.a, v), dot(m.b, v), dot(m.c, v)}; }
template <class T>
constexpr Vec<T> transposed(Mat<T> m, Vec<T> v) { return v.x * m.a + v.y * m.b + v.z * m.c; }

template <class T>
struct Symmetric {
    T xx, xy, xz, yy, yz, zz;
};
template <class T>
constexpr Symmetric<T> operator/(Symmetric<T> m, T s) {
    const T r = 1.0 / s;
    return {r * m.xx, r * m.xy, r * m.xz, r * m.yy, r * m.yz, r * m.zz};
}
template <class T>
constexpr Symmetric<T> outer(T s, Vec<T> a) {
    const auto b = s * a;
    return {b.x * a.x, b.x * a.y, b.x * a.z, b.y * a.y, b.y * a.z, b.z * a.z};
}
template <class T>
constexpr Vec<T> operator*(Symmetric<T> m, Vec<T> v) {
    return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
            m.xz * v.x + m.yz * v.y + m.zz * v.z};
}
template <class T>
constexpr Vec<T> solve(Symmetric<T> m, Vec<T> y) {
    const T xx = m.yy * m.zz - m.yz * m.yz, xy = m.xz * m.yz - m.xy * m.zz, xz = m.xy * m.yz - m.xz * m.yy;
    const T yy = m.xx * m.zz - m.xz * m.xz, yz = m.xy * m.xz - m.xx * m.yz, zz = m.xx * m.yy - m.xy * m.xy;
    return (Symmetric<T>{xx, xy, xz, yy, yz, zz} * y) / (m.xx * xx + m.xy * xy + m.xz * xz);
}

template <class T>
struct Pose {  // p -> R p + t
    Mat<T> R;
    Vec<T> t;
};

// Displacement of x by a rigid motion. A small rotation hardly changes the ones of its matrix, so it is computed from
// the other entries. With w = sin(angle) axis, (R - 1) x = w x x + (w (w . x) - |w|^2 x) / (1 + cos(angle)).
template <class T>
constexpr Vec<T> displacement(Pose<T> m, Vec<T> x) {
    const auto& R = m.R;
    const Vec<T> w = 0.5 * Vec<T>{R.c.y - R.b.z, R.a.z - R.c.x, R.b.x - R.a.y};
    const T squared = dot(w, w);
    return cross(w, x) + (1.0 / (1.0 + sqrt(1.0 - squared))) * (dot(w, x) * w - squared * x) + m.t;
}

template <class T>
struct Reader {
    const T* at;
    constexpr T number() { return *at++; }
    constexpr Vec<T> vec() { const T* p = at; at += 3; return {p[0], p[1], p[2]}; }
    constexpr Mat<T> mat() { Vec<T> a = vec(), b = vec(), c = vec(); return {a, b, c}; }
    constexpr Symmetric<T> symmetric() { const T* p = at; at += 6; return {p[0], p[1], p[2], p[3], p[4], p[5]}; }
    constexpr Pose<T> pose() {  // the first three rows of a 4 x 4 matrix
        const T* p = at;
        at += 12;
        return {{{p[0], p[1], p[2]}, {p[4], p[5], p[6]}, {p[8], p[9], p[10]}}, {p[3], p[7], p[11]}};
    }
};

template <class T>
struct Writer {
    T* at;
    constexpr void number(T a) { *at++ = a; }
    constexpr void vec(Vec<T> a) { *at++ = a.x; *at++ = a.y; *at++ = a.z; }
    constexpr void symmetric(Symmetric<T> m) { for (T a : {m.xx, m.xy, m.xz, m.yy, m.yz, m.zz}) *at++ = a; }
};

// Bit mask of inputs that never vary, such as constants of the mesh and dt. Their derivatives are not computed.
constexpr unsigned long long input_bits(int first, int count) { return ((1ull << count) - 1) << first; }

}  // namespace tc
